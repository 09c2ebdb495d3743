"""Memory that must be carried node by node: finite sliders and Bouc–Wen loops.

Compiled where numba can compile (``forces/compiled.py``), else plain numpy over the batch; the same functions, the same numbers.
Set the environment variable BAYES_NLSID_COMPILED=0 to force the plain path.
"""

from __future__ import annotations

import os
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.memory import bouc_wen_step, iwan_sliders, slider_step


def compiled_wanted() -> bool:
    """Whether to run compiled loops: numba is installed, and BAYES_NLSID_COMPILED is not 0."""
    return os.environ.get("BAYES_NLSID_COMPILED", "1") != "0" and find_spec("numba") is not None


def march(kind: str, nodes: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Force at every node of a path.

    Parameters
    ----------
    kind : {"sliders", "bouc_wen"}
    nodes : ndarray (N,)
        Displacement, m; loaded from rest at q = 0 to the first.
    p : ndarray (B, n_p)
        Parameters, SI.

    Returns
    -------
    ndarray (B, N)
        N.
    """
    moves = np.diff(nodes, prepend=0.0)
    if kind == "sliders":
        stiffness, slip, theta = iwan_sliders(p)
        if compiled_wanted():
            from bayes_nlsid.forces import compiled
            return compiled.march_sliders(moves, np.ascontiguousarray(stiffness), np.ascontiguousarray(slip), theta[:, 0].copy())
        return _sliders(moves, stiffness, slip, theta)
    if compiled_wanted():
        from bayes_nlsid.forces import compiled
        return compiled.march_bouc_wen(moves, np.ascontiguousarray(p))
    return _bouc_wen(moves, p)


def march_bouc_wen_each(start: NDArray[np.float64], moves: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bouc–Wen forces along a path of each sample's own.

    Parameters
    ----------
    start : ndarray (B,)
        Force at the first node, N.
    moves : ndarray (B, N)
        From node to node, m.
    p : ndarray (B, 5)
        Parameters, SI.

    Returns
    -------
    ndarray (B, N + 1)
        N.
    """
    if compiled_wanted():
        from bayes_nlsid.forces import compiled
        return compiled.march_bouc_wen_each(*map(np.ascontiguousarray, (start, moves, p)))
    force = np.empty((len(start), moves.shape[1] + 1))
    force[:, 0] = start
    for i in range(moves.shape[1]):
        force[:, i + 1] = bouc_wen_step(force[:, i], moves[:, i], *p.T)
    return force


def _sliders(moves: NDArray[np.float64], stiffness: NDArray[np.float64], slip: NDArray[np.float64],
             theta: NDArray[np.float64]) -> NDArray[np.float64]:
    stretch, sliding = np.zeros_like(slip), np.zeros_like(slip)
    force = np.empty((len(slip), len(moves)))
    for i, move in enumerate(moves):
        stretch, sliding = slider_step(move, stretch, sliding, slip, theta)
        force[:, i] = np.sum(stiffness * stretch, axis=-1)
    return force


def _bouc_wen(moves: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    force = np.empty((len(p), len(moves)))
    z = np.zeros(len(p))
    for i, move in enumerate(moves):
        z = bouc_wen_step(z, move, p[:, 0], p[:, 1], p[:, 2], p[:, 3], p[:, 4])
        force[:, i] = z
    return force
