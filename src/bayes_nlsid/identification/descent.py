"""Bounded Levenberg–Marquardt on the residual that is left when linear coefficients are eliminated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.elimination import Elimination, nonlinear_jacobian
from bayes_nlsid.identification.problem import Problem

FLAT = 1e-4   # share of the largest curvature that every direction of the unit box is given in the damping


@final
@dataclass(frozen=True, eq=False)
class Point:
    """Where one start stands.

    ``x`` (K,) in the unit box of the search coordinates, ``theta`` (P,) with eliminated entries, ``cost`` the weighted sum of squares.
    """

    x: NDArray[np.float64]
    theta: NDArray[np.float64] = field(repr=False)
    cost: float
    residual: NDArray[np.float64] = field(repr=False)
    basis: NDArray[np.float64] = field(repr=False)
    damping: float = 1e-3
    evaluations: int = 1
    status: str = "running"


@final
@dataclass(frozen=True, eq=False)
class Descent:
    """Variable projection with Kaufman's Jacobian: the derivative of the nonlinear force, made orthogonal to the eliminated columns.

    Parameters
    ----------
    problem : Problem
    weights : ndarray (N,)
    """

    problem: Problem
    weights: NDArray[np.float64] = field(repr=False)
    root: NDArray[np.float64] = field(init=False, repr=False)
    elimination: Elimination = field(init=False, repr=False)
    free: NDArray[np.intp] = field(init=False, repr=False)
    low: NDArray[np.float64] = field(init=False, repr=False)
    high: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.weights.shape != (self.problem.size,) or not (np.isfinite(self.weights).all() and (self.weights >= 0).all()):
            raise ValueError(f"weights must be ({self.problem.size},), finite and not negative, got shape {self.weights.shape}")
        low, high = self.problem.to_s(self.problem.bounds.T)
        root = np.sqrt(self.weights)
        for name, value in (("root", root), ("elimination", Elimination(self.problem, root)), ("low", low), ("high", high),
                            ("free", np.array([i for piece in self.problem.pieces for i in piece.columns], dtype=np.intp))):
            object.__setattr__(self, name, value)

    def s_of(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Search coordinates (P,) of a point of the unit box; entries that are eliminated stand in the middle of their box."""
        s = 0.5 * (self.low + self.high)
        s[self.free] = self.low[self.free] + x * (self.high - self.low)[self.free]
        return s

    def x_of(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Point of the unit box (K,), clipped into it, of the nonlinear entries of theta (P,)."""
        s = self.problem.to_s(np.clip(theta, self.problem.bounds[:, 0], self.problem.bounds[:, 1]))
        return np.clip((s - self.low)[self.free] / (self.high - self.low)[self.free], 0.0, 1.0)

    def at(self, x: NDArray[np.float64]) -> Point:
        """Evaluate a point; a force law that fails gives infinite cost and the status ``"not finite"``."""
        theta = np.clip(self.problem.to_theta(self.s_of(x)), self.problem.bounds[:, 0], self.problem.bounds[:, 1])
        with np.errstate(all="ignore"):
            target = self.root * (self.problem.base + self.problem.nonlinear_force(theta))
        if not np.isfinite(target).all():
            return Point(x, theta, np.inf, target, self.elimination.q, status="not finite")
        solution, residual, basis = self.elimination.solve(target)
        return Point(x, self.elimination.fill(theta, solution), float(residual @ residual), residual, basis)

    def advance(self, point: Point, iterations: int) -> Point:
        """Up to ``iterations`` accepted steps; the status becomes ``"converged"`` when neither cost nor point moves any more."""
        quiet = 0
        for _ in range(iterations):
            if point.status != "running":
                return point
            stepped = self._step(point)
            gain = point.cost - stepped.cost
            moved = float(np.max(np.abs(stepped.x - point.x), initial=0.0))
            quiet = quiet + 1 if gain <= 1e-9 * point.cost or moved < 1e-10 else 0
            point = replace(stepped, status="converged") if quiet >= 2 and stepped.status == "running" else stepped
        return point

    def _step(self, point: Point) -> Point:
        """One accepted step, or the same point with a final status."""
        with np.errstate(all="ignore"):
            slope = nonlinear_jacobian(self.problem, self.s_of(point.x), self.low, self.high)[:, self.free]
        slope *= self.root[:, None] * (self.high - self.low)[self.free]
        spent = point.evaluations + 1 + len(self.free)
        if not np.isfinite(slope).all():
            return replace(point, status="derivative not finite", evaluations=spent)
        slope -= point.basis @ (point.basis.T @ slope)
        gradient, curvature = slope.T @ point.residual, slope.T @ slope
        loose = ~(((point.x <= 0) & (gradient > 0)) | ((point.x >= 1) & (gradient < 0)))
        if not loose.any() or not np.any(gradient[loose]):
            return replace(point, status="converged", evaluations=spent)
        # Marquardt's scaling with a share of Levenberg's: without it the flat directions of a joint that hardly slips run to their bounds.
        scale = np.diag(curvature)[loose] + FLAT * np.max(np.diag(curvature)) + 1e-300
        damping = point.damping
        for _ in range(12):
            step = np.zeros(len(self.free))
            step[loose] = -np.linalg.solve(curvature[np.ix_(loose, loose)] + damping * np.diag(scale), gradient[loose])
            # More than a third of the box is outside anything the linearisation knows; each entry is cut by itself, lest one flat
            # direction shorten the step in all others.
            trial = self.at(np.clip(point.x + np.clip(step, -1 / 3, 1 / 3), 0.0, 1.0))
            spent += 1
            if trial.cost < point.cost:
                move = trial.x - point.x
                foreseen = -float(2 * gradient @ move + move @ curvature @ move)
                trusted = point.cost - trial.cost > 0.25 * foreseen
                return replace(trial, damping=max(damping / 5, 1e-12) if trusted else 2 * damping, evaluations=spent)
            damping *= 4
        return replace(point, status="converged", evaluations=spent, damping=damping)
