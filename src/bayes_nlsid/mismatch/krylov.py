"""Linear equations in a complex unknown that are linear over the reals only, by a Krylov method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]


def gmres(apply: Callable[[Complex], Complex], right: Complex, most: int, tolerance: float) -> Complex:
    """Solve a real-linear equation in a complex unknown from zero, without restart, to a relative residual.

    Classical Gram–Schmidt done twice, so that it is two matrix products; the small least-squares problem by Givens rotations.
    """
    flat = np.ascontiguousarray(right, dtype=complex).view(float).ravel()
    norm = float(np.linalg.norm(flat))
    if norm == 0 or not np.isfinite(norm):
        return right
    basis = np.empty((most + 1, flat.size))
    basis[0] = flat / norm
    upper, turns, target = np.zeros((most, most)), np.zeros((most, 2)), np.zeros(most + 1)
    target[0], used = norm, 0
    for k in range(most):
        w = np.ascontiguousarray(apply(basis[k].view(complex).reshape(right.shape)), dtype=complex).view(float).ravel()
        known = basis[:k + 1]
        column = known @ w
        w = w - column @ known
        again = known @ w
        w -= again @ known
        column += again
        left = float(np.linalg.norm(w))
        for i in range(k):
            c, s = turns[i]
            column[i], column[i + 1] = c * column[i] + s * column[i + 1], c * column[i + 1] - s * column[i]
        length = float(np.hypot(column[k], left))
        if not length > 0 or not np.isfinite(length):
            break
        c, s = column[k] / length, left / length
        column[k], turns[k], used = length, (c, s), k + 1
        upper[:k + 1, k] = column
        target[k], target[k + 1] = c * target[k], -s * target[k]
        if abs(target[k + 1]) < tolerance * norm or left < 1e-14 * norm:
            break
        basis[k + 1] = w / left
    solution = np.linalg.solve(upper[:used, :used], target[:used]) @ basis[:used] if used else np.zeros_like(flat)
    return np.asarray(solution.view(complex).reshape(right.shape))
