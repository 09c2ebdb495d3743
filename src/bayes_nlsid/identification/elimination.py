"""Variable projection: coefficients that enter the residual linearly, solved in closed form within their bounds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.problem import Problem


@final
@dataclass(frozen=True, eq=False)
class Elimination:
    """Least squares over 2ζω and ω² of every free mode and the coefficients of linear terms, columns scaled, bounds kept.

    The columns are factored once (QR), so that a solve costs one product with Q and a triangle of the size of the unknowns, and the
    residual is formed explicitly: accurate to rounding, where a difference of Gram energies would stop at 1e-8 of the force.

    Parameters
    ----------
    problem : Problem
    root : ndarray (N,)
        Square roots of the weights.
    """

    problem: Problem
    root: NDArray[np.float64] = field(repr=False)
    q: NDArray[np.float64] = field(init=False, repr=False)
    r: NDArray[np.float64] = field(init=False, repr=False)
    norms: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        seen, modes = self.problem.observed, self.problem.model.free_modes
        rows = [np.where(seen.equation == k, column, 0.0) for k in modes for column in (seen.velocity, seen.displacement)]
        matrix = np.concatenate([np.array(rows).reshape(len(rows), seen.size), self.problem.columns]).T * self.root[:, None]
        norms = np.linalg.norm(matrix, axis=0)
        norms = np.where(norms > 0, norms, 1.0)
        q, r = np.linalg.qr(matrix / norms)
        for name, value in (("q", q), ("r", r), ("norms", norms)):
            object.__setattr__(self, name, value)

    @property
    def count(self) -> int:
        """Number L of unknowns."""
        return len(self.norms)

    def solve(self, target: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Minimise ‖target + C x‖ within bounds.

        Parameters
        ----------
        target : ndarray (N,)
            Weighted residual without the eliminated columns.

        Returns
        -------
        x : ndarray (L,)
            In physical units: 2ζω and ω² mode by mode, then coefficients.
        residual : ndarray (N,)
        basis : ndarray (N, free)
            Orthonormal basis of the columns that are not held by a bound, for projecting a Jacobian.
        """
        if self.count == 0:
            return np.zeros(0), target, self.q
        right = -(self.q.T @ target)
        scaled: NDArray[np.float64] = np.asarray(np.linalg.lstsq(self.r, right, rcond=1e-13)[0], dtype=np.float64)
        # One step of refinement against the true residual recovers the digits that a close cancellation costs.
        scaled = scaled + np.linalg.lstsq(self.r, -(self.q.T @ (target + self.q @ (self.r @ scaled))), rcond=1e-13)[0]
        lower, upper = self._box(scaled)
        held = np.zeros(self.count, dtype=bool)
        if not ((scaled >= lower) & (scaled <= upper)).all():
            scaled, held = self._bounded(right, scaled)
        residual = target + self.q @ (self.r @ scaled)
        basis = self.q if not held.any() else self.q @ np.linalg.qr(self.r[:, ~held])[0]
        return scaled / self.norms, residual, basis

    def _bounded(self, right: NDArray[np.float64], scaled: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        from scipy.optimize import lsq_linear

        for _ in range(3):   # the box of 2ζω depends on ω; ω moves by parts in a thousand, so this settles at once
            lower, upper = self._box(scaled)
            scaled = np.clip(lsq_linear(self.r, right, (lower, upper), method="bvls").x, lower, upper)
            if not self.problem.model.free_modes:
                break
        margin = 1e-10 * (upper - lower)
        return scaled, (scaled <= lower + margin) | (scaled >= upper - margin)

    def _box(self, scaled: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        box = self.problem.bounds
        modes = len(self.problem.model.free_modes)
        out = np.empty((self.count, 2))
        for i in range(modes):
            out[2 * i + 1] = (2 * np.pi * box[i]) ** 2
            omega = np.sqrt(np.clip(scaled[2 * i + 1] / self.norms[2 * i + 1], *out[2 * i + 1]))
            out[2 * i] = 2 * box[modes + i] * omega
        out[2 * modes:] = box[list(self.problem.linear_index)].reshape(-1, 2)
        out *= self.norms[:, None]
        return out[:, 0], out[:, 1]

    def fill(self, theta: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Theta (P,) with the eliminated entries put in, clipped to the bounds against rounding."""
        out = theta.copy()
        modes = len(self.problem.model.free_modes)
        omega = np.sqrt(x[1:2 * modes:2])
        out[:modes], out[modes:2 * modes] = omega / (2 * np.pi), x[0:2 * modes:2] / (2 * omega)
        out[list(self.problem.linear_index)] = x[2 * modes:]
        return np.clip(out, self.problem.bounds[:, 0], self.problem.bounds[:, 1])


def jacobian(problem: Problem, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (N, P) of the residual with respect to the search coordinates s: exact for what is linear, one-sided differences else."""
    seen, modes = problem.observed, problem.model.free_modes
    stretch = np.exp(problem.coordinates.log_jacobian(problem.to_s(theta)))
    out = np.zeros((problem.size, problem.model.size))
    for i, k in enumerate(modes):
        omega, zeta = 2 * np.pi * theta[i], theta[len(modes) + i]
        here = seen.equation == k
        out[here, i] = 2 * np.pi * (2 * zeta * seen.velocity[here] + 2 * omega * seen.displacement[here])
        out[here, len(modes) + i] = 2 * omega * seen.velocity[here]
    out[:, list(problem.linear_index)] = problem.columns.T
    out *= stretch
    free = [i for piece in problem.pieces for i in piece.columns]
    if free:
        low, high = problem.to_s(problem.bounds.T)
        out[:, free] = nonlinear_jacobian(problem, problem.to_s(theta), low, high)[:, free]
    return out


def nonlinear_jacobian(problem: Problem, s: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64],
                       step: float = 1e-6) -> NDArray[np.float64]:
    """Derivative (N, P) of ``Problem.nonlinear_force`` with respect to s, piece by piece; steps of ``step`` of the box, inwards."""
    out = np.zeros((problem.size, problem.model.size))
    width = high - low
    for piece in problem.pieces:
        columns = list(piece.columns)
        move = np.where(s[columns] + step * width[columns] <= high[columns], step, -step) * width[columns]
        rows = np.repeat(s[None], len(columns) + 1, axis=0)
        rows[np.arange(1, len(columns) + 1), columns] += move
        values = piece.values(problem.to_theta(rows))
        force = problem.observed.force(piece.element.term, piece.locations, values, piece.element.excess, problem.places)
        out[:, columns] = ((force[1:] - force[0]) / move[:, None]).T
    return out
