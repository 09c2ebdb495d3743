"""From matrices to complex modes: the linear half of a truth, exact in frequency and in time.

Undamped modes up to a cut-off and static attachment modes of every named place are combined and diagonalised again (Craig and
Chang's residual attachment idea), then damped non-proportionally and split into complex poles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from .beams import Assembled


@dataclass(frozen=True)
class Plant:
    """Complex modal model.

    ``poles`` (n,) rad/s with positive imaginary part; ``out[name]`` (n,) and ``into[name]`` (n,) so that the receptance from place
    ``b`` to place ``a`` is ``sum out[a] into[b] / (s - poles) + conjugate``.  ``frequency`` (n,) Hz undamped, ``ratio`` (n,).
    """

    poles: np.ndarray
    out: Mapping[str, np.ndarray]
    into: Mapping[str, np.ndarray]
    frequency: np.ndarray
    ratio: np.ndarray

    def receptance(self, outs: Sequence[str], ins: Sequence[str], s: np.ndarray) -> np.ndarray:
        """Displacement per force (f, len(outs), len(ins)) at complex frequencies ``s`` (f,) rad/s."""
        C = np.array([self.out[o] for o in outs])
        L = np.array([self.into[i] for i in ins])
        upper = 1.0 / (s[:, None] - self.poles)
        lower = 1.0 / (s[:, None] - self.poles.conj())
        pair = (C[:, None, :] * L[None, :, :]).reshape(-1, self.poles.size)
        return (upper @ pair.T + lower @ pair.conj().T).reshape(s.size, len(outs), len(ins))


def plant(
    model: Assembled,
    damping: Callable[[np.ndarray], np.ndarray],
    cutoff: float = 6000.0,
    dashpots: Mapping[str, float] | None = None,
    extra_C: np.ndarray | None = None,
) -> Plant:
    """Complex modes of ``model``.

    Parameters
    ----------
    damping : maps frequency (m,) Hz to a damping ratio (m,); a function of frequency so that adding a part never renumbers it.
    cutoff : modes kept, Hz.
    dashpots : N s/m between the sides of named places (makes damping non-proportional).
    extra_C : (N, N) further damping, N s/m.
    """
    w2, shapes = la.eigh(model.K, model.M, subset_by_value=[-np.inf, (2 * np.pi * cutoff) ** 2])
    names = [n for n in model.vectors if n != "BASE" and not n.startswith("S") or n == "SHAKER"]
    load = np.array([model.vectors[n] for n in names]).T
    residual = la.solve(model.K, load, assume_a="pos") - shapes @ ((shapes.T @ load) / w2[:, None])
    basis = np.hstack([shapes, _independent(residual, model.M)])
    w2, mix = la.eigh(basis.T @ model.K @ basis, basis.T @ model.M @ basis)
    modes = basis @ mix
    omega = np.sqrt(np.maximum(w2, 1e-6))
    ratio = np.where(omega < 2 * np.pi * cutoff, damping(omega / (2 * np.pi)), 0.1)
    C = np.diag(2 * ratio * omega)
    for name, c in (dashpots if dashpots is not None else model.dashpots).items():
        row = modes.T @ model.vectors[name]
        C += c * np.outer(row, row)
    if extra_C is not None:
        C += modes.T @ extra_C @ modes
    poles, right, left = _poles(w2, C)
    n = omega.size
    rows = {name: modes.T @ v for name, v in model.vectors.items()}
    base = modes.T @ (model.M @ model.vectors["BASE"])
    out = {name: row @ right[:n] for name, row in rows.items() if name != "BASE"}
    into = {name: left[:, n:] @ row for name, row in rows.items() if name != "BASE"}
    into["BASE"] = -(left[:, n:] @ base)
    return Plant(poles, out, into, omega / (2 * np.pi), np.diag(C) / (2 * omega))


def _independent(vectors: np.ndarray, M: np.ndarray, tolerance: float = 1e-5) -> np.ndarray:
    """M-orthonormal basis of ``vectors`` (N, r) after scaling each to unit mass; nearly dependent directions are dropped."""
    scale = np.sqrt(np.einsum("nr,nr->r", vectors, M @ vectors))
    unit = vectors[:, scale > 0] / scale[scale > 0]
    w, q = la.eigh(unit.T @ M @ unit)
    keep = w > tolerance * w[-1]
    return unit @ (q[:, keep] / np.sqrt(w[keep]))


def _poles(w2: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poles with positive imaginary part, right (2n, n) and left (n, 2n) vectors of the first-order form, sorted by frequency."""
    n = w2.size
    scale = np.sqrt(w2)
    # Displacements scaled by their frequency keep the state matrix balanced over five decades.
    A = np.block([[np.zeros((n, n)), np.diag(scale)], [-np.diag(scale), -C]])
    poles, right = la.eig(A)
    left = la.inv(right)
    keep = np.nonzero(poles.imag > 0)[0]
    if keep.size != n:
        raise ValueError("damping: an overdamped mode has no complex pole pair; lower the dashpots")
    keep = keep[np.argsort(poles[keep].imag)]
    right = right[:, keep].copy()
    right[:n] /= scale[:, None]
    return poles[keep], right, left[keep]
