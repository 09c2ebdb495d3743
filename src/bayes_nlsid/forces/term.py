"""A term: one force law with its parameters, written once and used by every room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.parameter import Param

Memory = Literal["none", "masing", "sliders", "bouc_wen"]
Parity = Literal["odd", "even", "none"]
Confidence = Literal["H", "M", "L", "-"]
Law = Callable[..., NDArray[np.float64]]
Slope = Callable[..., tuple[Any, Any]]


@final
@dataclass(frozen=True)
class Term:
    """A force law f(q, q̇, history; p) acting along one location.

    Parameters
    ----------
    name : str
        Key in the library, e.g. ``"iwan4"``.
    formula : str
        The law in words of numpy, e.g. ``"c*q*abs(q)"``; a test evaluates it against ``law``.
    params : tuple of Param
        In the order in which ``law`` takes them.
    law : callable
        ``law(q, v, *p) -> force``: q in m, v in m/s, force in N. Only numpy functions that act element by element, no
        branching on arrays, so that it broadcasts over any batch and can be compiled as it stands for scalars. For a term with
        memory it is the *backbone* (``masing``, ``sliders``: first loading curve) or the instantaneous part (``bouc_wen``).
    slope : callable
        ``slope(q, v, *p) -> (df/dq, df/dv)`` of ``law``, in the same style; finite everywhere (0 where the derivative is not).
        Either may be a plain number, to be broadcast.
    stiffness : callable or None
        ``stiffness(*p)``: the spring at rest f'(0), N/m, that a linear model of the stuck joint already contains; None if zero.
    memory : {"none", "masing", "sliders", "bouc_wen"}
        ``masing``: first loading follows the law, every reversal restarts it at twice the scale, closed loops are wiped out.
    index : int or None
        Number in Table 1.
    linear : bool
        Whether the force is linear in its one coefficient.
    parity : {"odd", "even", "none"}
        f(−q, −v) = −f(q, v), f(q, v), or neither.
    dissipative : bool
        Whether the term can take energy out over a symmetric cycle.
    confidence : {"H", "M", "L", "-"}
        How sure the reading of the printed table is; ``-`` if not from the table.
    meaning, source : str
        For tables and reports.

    Raises
    ------
    ValueError
        If a linear term has more than one parameter, or names repeat.
    """

    name: str
    formula: str
    params: tuple[Param, ...]
    law: Law
    slope: Slope
    memory: Memory = "none"
    stiffness: Law | None = None
    index: int | None = None
    linear: bool = False
    parity: Parity = "odd"
    dissipative: bool = False
    confidence: Confidence = "-"
    meaning: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        names = [p.name for p in self.params]
        if len(set(names)) != len(names):
            raise ValueError(f"term {self.name!r}: parameter names repeat: {names}")
        if self.linear and len(self.params) != 1:
            raise ValueError(f"term {self.name!r}: a linear term has exactly one coefficient, not {len(self.params)}")
        if self.memory not in ("none", "masing", "sliders", "bouc_wen"):
            raise ValueError(f"term {self.name!r}: unknown memory {self.memory!r}")

    def static_force(self, q: ArrayLike, v: ArrayLike, p: ArrayLike) -> NDArray[np.float64]:
        """The law itself, without history.

        Parameters
        ----------
        q, v : array_like (..., n)
            Relative displacement (m) and velocity (m/s).
        p : array_like (..., n_p)
            Parameters; batch axes broadcast against those of q.

        Returns
        -------
        ndarray (..., n)
            Force, N.

        Raises
        ------
        ValueError
            If the last axis of ``p`` is not the number of parameters.
        """
        values = np.asarray(p, dtype=float)
        if values.shape[-1:] != (len(self.params),):
            raise ValueError(f"term {self.name!r}: p has shape {values.shape}, its last axis must be {len(self.params)}")
        arguments = [values[..., i, None] for i in range(len(self.params))]
        return np.asarray(self.law(np.asarray(q, dtype=float), np.asarray(v, dtype=float), *arguments), dtype=float)
