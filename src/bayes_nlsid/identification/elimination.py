"""Variable projection: coefficients that enter the residual linearly, solved in closed form within their bounds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.condensed import Regression
from bayes_nlsid.identification.problem import Problem


@final
@dataclass(frozen=True, eq=False)
class Elimination:
    """Least squares over 2ζω and ω² of every free mode and the coefficients of linear terms, columns scaled, bounds kept.

    The columns are factored once (QR), so that a solve costs one product with Q and a triangle of the size of the unknowns, and the
    residual is formed explicitly: accurate to rounding, where a difference of Gram energies would stop at 1e-8 of the force.

    Parameters
    ----------
    regression : Regression
    """

    regression: Regression
    q: NDArray[np.float64] = field(init=False, repr=False)
    r: NDArray[np.float64] = field(init=False, repr=False)
    norms: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        matrix = self.regression.columns
        norms = np.linalg.norm(matrix, axis=0)
        norms = np.where(norms > 0, norms, 1.0)
        q, r = np.linalg.qr(matrix / norms)
        for name, value in (("q", q), ("r", r), ("norms", norms)):
            object.__setattr__(self, name, value)

    @property
    def problem(self) -> Problem:
        """Whose coefficients are eliminated."""
        return self.regression.problem

    @property
    def count(self) -> int:
        """Number L of unknowns."""
        return len(self.norms)

    def solve(self, target: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Minimise ‖target + C x‖ within bounds, for B targets at once.

        Parameters
        ----------
        target : ndarray (B, n)
            Weighted residual without the eliminated columns.

        Returns
        -------
        x : ndarray (B, L)
            In physical units: 2ζω and ω² mode by mode, then coefficients.
        residual : ndarray (B, n)
        held : ndarray (B, L) of bool
            Coefficients that a bound holds.
        """
        held = np.zeros((len(target), self.count), dtype=bool)
        if self.count == 0:
            return np.zeros((len(target), 0)), target, held
        right = -(target @ self.q)
        scaled = self._least(right)
        # One step of refinement against the true residual recovers the digits that a close cancellation costs.
        scaled = scaled + self._least(-((target + (scaled @ self.r.T) @ self.q.T) @ self.q))
        lower, upper = self._box(scaled)
        for i in np.flatnonzero(((scaled < lower) | (scaled > upper)).any(axis=1)):
            scaled[i], held[i] = self._bounded(right[i], scaled[i])
        return scaled / self.norms, target + (scaled @ self.r.T) @ self.q.T, held

    def _least(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.linalg.lstsq(self.r, right.T, rcond=1e-13)[0].T, dtype=np.float64)

    def project(self, slope: NDArray[np.float64], held: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Part of slope (B, n, K) orthogonal to the columns that are not held (B, L)."""
        rows = slope.transpose(0, 2, 1)    # as the derivatives lie in memory
        inside = rows @ self.q
        for i in np.flatnonzero(held.any(axis=1)):
            basis = np.linalg.qr(self.r[:, ~held[i]])[0]
            inside[i] = (inside[i] @ basis) @ basis.T
        return (rows - inside @ self.q.T).transpose(0, 2, 1)

    def _bounded(self, right: NDArray[np.float64], scaled: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        for _ in range(3):   # the box of 2ζω depends on ω; ω moves by parts in a thousand, so this settles at once
            lower, upper = self._box(scaled)
            scaled = np.clip(self._within(right, lower, upper), lower, upper)
            if not self.problem.model.free_modes:
                break
        margin = 1e-10 * (upper - lower)
        return scaled, (scaled <= lower + margin) | (scaled >= upper - margin)

    def _within(self, right: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minimise ‖R x − right‖ in a box: hold what leaves it, let go what pushes inwards; scipy where that does not settle."""
        x = np.array(np.linalg.lstsq(self.r, right, rcond=1e-13)[0], dtype=np.float64)
        held = np.zeros(self.count, dtype=bool)
        for _ in range(2 * self.count + 5):
            out = ~held & ((x < lower) | (x > upper))
            if out.any():
                x[out] = np.clip(x[out], lower[out], upper[out])
                held |= out
            else:
                push = self.r.T @ (right - self.r @ x)    # downhill
                inwards = held & np.where(x <= lower, push > 0, push < 0)
                worst = int(np.argmax(np.where(inwards, np.abs(push), -1.0)))
                if not inwards[worst] or np.abs(push[worst]) <= 1e-12 * np.linalg.norm(right):
                    return x
                held[worst] = False
            free = ~held
            x[free] = np.linalg.lstsq(self.r[:, free], right - self.r[:, held] @ x[held], rcond=1e-13)[0]
        from scipy.optimize import lsq_linear

        return np.asarray(lsq_linear(self.r, right, (lower, upper), method="bvls").x)

    def _box(self, scaled: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds (..., L) of scaled coefficients (..., L)."""
        box = self.problem.bounds
        modes = len(self.problem.model.free_modes)
        out = np.empty((*scaled.shape, 2))
        square = (2 * np.pi * box[:modes]) ** 2
        omega = np.sqrt(np.clip(scaled[..., 1:2 * modes:2] / self.norms[1:2 * modes:2], square[:, 0], square[:, 1]))
        out[..., 1:2 * modes:2, :] = square
        out[..., 0:2 * modes:2, :] = 2 * box[modes:2 * modes] * omega[..., None]
        out[..., 2 * modes:, :] = box[list(self.problem.linear_index)].reshape(-1, 2)
        out *= self.norms[:, None]
        return out[..., 0], out[..., 1]

    def fill(self, theta: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Theta (B, P) with the eliminated entries (B, L) put in, clipped to the bounds against rounding."""
        out = theta.copy()
        modes = len(self.problem.model.free_modes)
        omega = np.sqrt(np.maximum(x[:, 1:2 * modes:2], 1e-300))
        out[:, :modes], out[:, modes:2 * modes] = omega / (2 * np.pi), x[:, 0:2 * modes:2] / (2 * omega)
        out[:, list(self.problem.linear_index)] = x[:, 2 * modes:]
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
        force = problem.observed.force(piece.element.term, piece.locations, values, piece.element.excess, problem.places,
                                         problem.kink(piece))
        out[:, columns] = ((force[1:] - force[0]) / move[:, None]).T
    return out
