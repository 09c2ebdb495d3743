"""Gauss–Newton steps along narrow, bent valleys of a sum of squares.

Sharp resonances fix combinations of parameters to parts in a million, so that the valley of the cost is far narrower than it is long. A
step along it leaves it by its own square. Damping, which asks that every step lowers the cost, then allows steps of a thousandth of the
way; full steps, which the next one mends, arrive in three or four (cf. the watchdog of Chamberlain, Powell, Lemarechal and Pedersen 1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LONGEST = 1.5  # step of any parameter


@final
@dataclass(frozen=True)
class Place:
    """Parameters ``y`` (P,) with the normal matrix (P, P) of the cost there, the gradient (P,) of −cost/2, and the cost."""

    y: Array
    normal: Array
    gradient: Array
    cost: float

    @property
    def step(self) -> Array:
        """(P,) of Gauss and Newton."""
        return np.asarray(np.linalg.solve(self.normal, self.gradient))

    @property
    def promise(self) -> float:
        """Decrease of the cost that a full step promises."""
        return float(self.gradient @ self.step)


class Landscape(Protocol):
    """Cost at ``y`` (P,), with its derivatives if these are asked for."""

    def __call__(self, y: Array, derivatives: bool = True) -> Place:
        """The place at ``y``."""


def follow(at: Landscape, y: Array, steps: int, tol: float, near: float = np.inf) -> Place:
    """The bottom of the valley in which ``y`` lies, or as far as ``steps`` lead.

    Parameters
    ----------
    tol : promise of a step, absolute and over a thousandth of the cost, below which there is nothing left to gain.
    near : cost above which only damped steps are taken.
    """
    here, damping = at(y), 1e-3
    for _ in range(steps):
        # along a valley each damped step gains little: what is left to gain decides, not what the last step gained
        if here.promise < tol * max(1.0, 1e-3 * here.cost):
            break
        there = _ahead(at, here) if here.cost < near else None
        if there is None:
            there, damping = _damped(at, here, damping)
        if there is None:
            break
        here = there
    return here


def _ahead(at: Landscape, here: Place, turns: int = 4) -> Place | None:
    """Where full steps lead within some ``turns``, the cost above what it was in between; None if they do not lead below it."""
    there = here
    for _ in range(turns):
        step = there.step
        if not np.abs(step).max(initial=0.0) < LONGEST:
            return None
        there = at(there.y + step)
        if there.cost < here.cost:
            return there
        if not there.promise > 0.5 * (there.cost - here.cost):
            return None
    return None


def _damped(at: Landscape, here: Place, damping: float) -> tuple[Place | None, float]:
    """The first damped step that lowers the cost (None if there is no such step), and the damping for the next."""
    for _ in range(6):
        step = np.linalg.solve(here.normal + damping * np.diag(np.diag(here.normal)), here.gradient)
        trial = here.y + np.clip(step, -LONGEST, LONGEST)
        if np.isfinite(trial).all() and at(trial, False).cost < here.cost:
            return at(trial), max(damping / 6, 1e-9)
        damping = max(damping * 8, 1e-4)
    return None, damping
