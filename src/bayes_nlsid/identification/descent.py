"""Bounded Levenberg–Marquardt on the residual that is left when linear coefficients are eliminated, many starts side by side."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.condensed import Regression
from bayes_nlsid.identification.elimination import Elimination
from bayes_nlsid.identification.problem import Problem

FLAT = 1e-4   # share of the largest curvature that every direction of the unit box is given in the damping
TRIALS = 12   # damping factors tried in one step
Array = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Points:
    """Where B starts stand.

    ``x`` (B, K) in the unit box of the search coordinates, ``theta`` (B, P) with eliminated entries, ``cost`` (B,) the weighted sum of
    squares, ``residual`` (B, n), ``held`` (B, L) eliminated coefficients at a bound, ``damping``, ``evaluations``, ``quiet`` steps in a row
    without gain, ``status`` (B,).
    """

    x: Array
    theta: Array = field(repr=False)
    cost: Array
    residual: Array = field(repr=False)
    held: NDArray[np.bool_] = field(repr=False)
    damping: Array
    evaluations: NDArray[np.int64]
    quiet: NDArray[np.int64]
    status: NDArray[np.str_]

    def take(self, which: NDArray[np.intp]) -> Points:
        """Some of them."""
        return replace(self, **{name: getattr(self, name)[which] for name in self.__dataclass_fields__})

    def joined(self, other: Points) -> Points:
        """These and others."""
        return replace(self, **{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__dataclass_fields__})

    def put(self, which: NDArray[np.intp], other: Points) -> Points:
        """The same with some of them replaced."""
        out = {}
        for name in self.__dataclass_fields__:
            out[name] = getattr(self, name).copy()
            out[name][which] = getattr(other, name)
        return replace(self, **out)


@final
@dataclass(frozen=True, eq=False)
class Descent:
    """Variable projection with Kaufman's Jacobian: the derivative of the nonlinear force, made orthogonal to the eliminated columns.

    Parameters
    ----------
    regression : Regression
    moving : ndarray (K,) of bool or None
        Which nonlinear entries move, the others being held; None for all.
    """

    regression: Regression
    moving: NDArray[np.bool_] | None = None
    elimination: Elimination = field(init=False, repr=False)
    free: NDArray[np.intp] = field(init=False, repr=False)
    low: Array = field(init=False, repr=False)
    high: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        low, high = self.problem.to_s(self.problem.bounds.T)
        for name, value in (("elimination", Elimination(self.regression)), ("low", low), ("high", high),
                            ("free", np.array([i for piece in self.problem.pieces for i in piece.columns], dtype=np.intp))):
            object.__setattr__(self, name, value)

    @property
    def active(self) -> NDArray[np.intp]:
        """Entries of the unit box that move."""
        return np.arange(len(self.free)) if self.moving is None else np.flatnonzero(self.moving)

    @property
    def problem(self) -> Problem:
        """Whose residual is brought down."""
        return self.regression.problem

    def s_of(self, x: Array) -> Array:
        """Search coordinates (B, P) of points (B, K) of the unit box; entries that are eliminated stand in the middle of their box."""
        s = np.repeat(0.5 * (self.low + self.high)[None], len(x), axis=0)
        s[:, self.free] = self.low[self.free] + x * (self.high - self.low)[self.free]
        return s

    def x_of(self, theta: Array) -> Array:
        """Point of the unit box (K,), clipped into it, of the nonlinear entries of theta (P,)."""
        s = self.problem.to_s(np.clip(theta, self.problem.bounds[:, 0], self.problem.bounds[:, 1]))
        return np.clip((s - self.low)[self.free] / (self.high - self.low)[self.free], 0.0, 1.0)

    def at(self, x: Array) -> Points:
        """Evaluate points (B, K); a force law that fails gives infinite cost and the status ``"not finite"``."""
        count = len(x)
        theta = np.clip(self.problem.to_theta(self.s_of(x)), self.problem.bounds[:, 0], self.problem.bounds[:, 1])
        with np.errstate(all="ignore"):
            target = self.regression.base + self.regression.forces(theta)
        fine = np.asarray(np.isfinite(target).all(axis=1))
        target[~fine] = 0.0
        solution, residual, held = self.elimination.solve(target)
        filled = self.elimination.fill(theta, solution)
        cost = np.where(fine, np.einsum("bn,bn->b", residual, residual), np.inf)
        return Points(x, np.where(fine[:, None], filled, theta), cost, residual, held, np.full(count, 1e-3), np.ones(count, dtype=np.int64),
                      np.zeros(count, dtype=np.int64), np.where(fine, "running", "not finite").astype("<U32"))

    def advance(self, points: Points, iterations: int, gain: float = 1e-9) -> Points:
        """Up to ``iterations`` accepted steps each; the status becomes ``"converged"`` when neither cost nor point moves any more.

        ``gain``: share of the cost that a step must win to count as one.
        """
        for _ in range(iterations):
            running = np.flatnonzero(points.status == "running")
            if not len(running):
                break
            before = points.take(running)
            after = self._step(before)
            still = (before.cost - after.cost <= gain * before.cost) | (np.max(np.abs(after.x - before.x), axis=1, initial=0.0) < 1e-10)
            quiet = np.where(still, before.quiet + 1, 0)
            status = np.where((quiet >= 2) & (after.status == "running"), "converged", after.status)
            points = points.put(running, replace(after, quiet=quiet, status=status))
        return points

    def _step(self, points: Points) -> Points:
        """One accepted step for each, or the same point with a final status."""
        active = self.active
        low, width = self.low, (self.high - self.low)[self.free[active]]
        with np.errstate(all="ignore"):
            slope = self.regression.jacobian(self.s_of(points.x), low, self.high, self.moving) * width
        points = replace(points, evaluations=points.evaluations + 1 + len(active))
        fine = np.isfinite(slope).all(axis=(1, 2))
        slope[~fine] = 0.0
        slope = self.elimination.project(slope, points.held)
        gradient, curvature = np.einsum("bnk,bn->bk", slope, points.residual), slope.transpose(0, 2, 1) @ slope
        at = points.x[:, active]
        loose = ~(((at <= 0) & (gradient > 0)) | ((at >= 1) & (gradient < 0)))
        settled = ~(loose & (gradient != 0)).any(axis=1)
        status = np.where(~fine, "derivative not finite", np.where(settled, "converged", points.status))
        points = replace(points, status=status)
        open_ = np.flatnonzero(fine & ~settled)
        for _ in range(TRIALS):
            if not len(open_):
                return points
            here = points.take(open_)
            move = self._move(here, gradient[open_], curvature[open_], loose[open_])
            to = here.x.copy()
            to[:, active] = np.clip(to[:, active] + move, 0.0, 1.0)
            trial = self.at(to)
            taken = trial.cost < here.cost
            moved = (trial.x - here.x)[:, active]
            foreseen = -(2 * np.einsum("bk,bk->b", gradient[open_], moved) + np.einsum("bk,bkl,bl->b", moved, curvature[open_], moved))
            trusted = here.cost - trial.cost > 0.25 * foreseen
            damping = np.where(trusted, np.maximum(here.damping / 5, 1e-12), 2 * here.damping)
            better = replace(trial, damping=damping, evaluations=here.evaluations + 1, quiet=here.quiet)
            worse = replace(here, damping=4 * here.damping, evaluations=here.evaluations + 1)
            points = points.put(open_[taken], better.take(np.flatnonzero(taken))).put(open_[~taken], worse.take(np.flatnonzero(~taken)))
            open_ = open_[~taken]
        status = points.status.copy()
        status[open_] = "converged"
        return replace(points, status=status)

    @staticmethod
    def _move(points: Points, gradient: Array, curvature: Array, loose: NDArray[np.bool_]) -> Array:
        """Damped steps (B, K) in the loose directions.

        Marquardt's scaling with a share of Levenberg's: without it the flat directions of a joint that hardly slips run to their bounds.
        More than a third of the box is outside anything the linearisation knows; each entry is cut by itself, lest one flat direction
        shorten the step in all others.
        """
        both = loose[:, :, None] & loose[:, None, :]
        size = np.diagonal(curvature, axis1=1, axis2=2)
        scale = size + FLAT * size.max(axis=1, keepdims=True) + 1e-300
        matrix = np.where(both, curvature, 0.0)
        diagonal = np.where(loose, size + points.damping[:, None] * scale, 1.0)
        index = np.arange(matrix.shape[1])
        matrix[:, index, index] = diagonal
        step = np.linalg.solve(matrix, -np.where(loose, gradient, 0.0)[:, :, None])[:, :, 0]
        return np.clip(np.where(loose, step, 0.0), -1 / 3, 1 / 3)
