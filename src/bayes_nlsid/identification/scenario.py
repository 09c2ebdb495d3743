"""S1, S2, S3 of the paper (Table 3) as index tuples: which equations are fitted, and which modes the nonlinear part sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class Scenario:
    """Which modal equations enter the residual and which modes build the motion of the joints.

    Parameters
    ----------
    name : str
    equations : tuple of int
        0-based modes whose equation is fitted; the first is the main (excited) one of Eq. 13a.
    coupled : tuple of int
        0-based modes from which the relative motion of every location is built.

    Raises
    ------
    ValueError
        If a tuple is empty, holds a negative index or repeats one, or an equation is not among the coupled modes.
    """

    name: str
    equations: tuple[int, ...]
    coupled: tuple[int, ...]

    def __post_init__(self) -> None:
        for what in ("equations", "coupled"):
            modes = getattr(self, what)
            if not modes or len(set(modes)) != len(modes) or min(modes) < 0:
                raise ValueError(f"scenario {self.name!r}: {what} must be distinct 0-based modes, at least one, got {modes}")
        if not set(self.equations) <= set(self.coupled):
            raise ValueError(f"scenario {self.name!r}: equations {self.equations} must be among the coupled modes {self.coupled}")

    @property
    def main(self) -> int:
        """The excited mode."""
        return self.equations[0]


def scenario(name: str, modes: int | Sequence[int], main: int = 0) -> Scenario:
    """S1 (one equation, one mode), S2 (one equation, all modes) or S3 (all equations, all modes).

    Parameters
    ----------
    name : {"S1", "S2", "S3"}
    modes : int or sequence of int
        Number of modes, or their 0-based indices.
    main : int
        0-based index of the excited mode.

    Raises
    ------
    ValueError
        If the name is unknown or ``main`` is not among the modes.
    """
    every = tuple(range(modes)) if isinstance(modes, int) else tuple(int(k) for k in modes)
    if main not in every:
        raise ValueError(f"main mode {main} is not among the modes {every}")
    first = (main, *(k for k in every if k != main))
    match name:
        case "S1":
            return Scenario("S1", (main,), (main,))
        case "S2":
            return Scenario("S2", (main,), every)
        case "S3":
            return Scenario("S3", first, every)
    raise ValueError(f"scenario must be 'S1', 'S2' or 'S3', not {name!r}; build a Scenario for anything else")
