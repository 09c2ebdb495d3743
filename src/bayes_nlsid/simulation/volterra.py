"""A short stretch of a motion that local laws feed back into, solved in the order of time.

    q_n = q°_n − Σ_{k ≤ n} K_{n−k} g_k,   v_n = v°_n − Σ_{k ≤ n} V_{n−k} g_k,   g_n = f(q_n) + h(v_n)

A Volterra equation: every instant depends on the past only, so Newton's method has one small equation per instant to solve where it would
be lost in the whole record. The laws come as tables, so that any law of the library serves. Import this module only where compiled code
is about to run: it brings numba with it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.simulation.compiled import inner, kernel

Array = NDArray[np.float64]
NODES = 4097
BEND = 9.0  # nodes are spaced as a hyperbolic sine: finest, e^-9 of the range, at rest


def nodes(reach: float) -> Array:
    """(NODES,) arguments at which a law is tabulated, from −reach to reach."""
    return np.asarray(reach * np.sinh(BEND * np.linspace(-1.0, 1.0, NODES)) / np.sinh(BEND))


@inner
def _look_up(table: np.ndarray, reach: float, x: float) -> tuple[float, float]:
    """Value and slope of a table at x; beyond its reach it goes on straight."""
    scale = math.sinh(BEND)
    y = min(max(x / reach, -1.0), 1.0)
    place = 0.5 * (NODES - 1) * (1.0 + math.asinh(y * scale) / BEND)
    i = min(int(place), NODES - 2)
    step = BEND / (0.5 * (NODES - 1))
    left = reach * math.sinh(BEND * (i / (0.5 * (NODES - 1)) - 1.0)) / scale
    right = reach * math.sinh(BEND * (i / (0.5 * (NODES - 1)) - 1.0) + step) / scale
    slope = (table[i + 1] - table[i]) / (right - left)
    return table[i] + slope * (x - left), slope


@inner
def _force(tables: np.ndarray, reach: np.ndarray, j: int, q: float, v: float) -> tuple[float, float, float]:
    f, fq = _look_up(tables[0, j], reach[0, j], q)
    h, hv = _look_up(tables[1, j], reach[1, j], v)
    return f + h, fq, hv


@kernel
def solve_window(q0: np.ndarray, v0: np.ndarray, kernel_q: np.ndarray, kernel_v: np.ndarray, tables: np.ndarray, reach: np.ndarray,
                 g: np.ndarray, past: np.ndarray) -> int:
    """Forces of one stretch.

    Parameters
    ----------
    q0, v0 : ndarray (n, J)
        Motion without the forces of this stretch, m and m/s.
    kernel_q, kernel_v : ndarray (J, J, w ≥ n)
        Motion of place i, so many samples after a force of one newton on one sample at place j.
    tables : ndarray (2, J, NODES)
        Laws at the ``nodes`` of displacement and of velocity, N.
    reach : ndarray (2, J)
        Largest arguments of the tables.
    g : ndarray (n, J)
        Filled: N.
    past : ndarray (J, n)
        Scratch: forces, newest first from the end, so that sums run forward in memory.

    Returns
    -------
    int
        Instants at which no solution was found to 1e-9 of the largest force so far.
    """
    n, places = q0.shape
    lost, largest = 0, 1e-300
    for i in range(n):
        for j in range(places):
            g[i, j] = g[i - 1, j] if i else 0.0
        found = False
        for _ in range(12):
            worst = 0.0
            for j in range(places):                    # places in turn (Gauss–Seidel): the path from one to another takes time
                q, v = q0[i, j], v0[i, j]
                for k in range(places):
                    sq, sv = 0.0, 0.0
                    first = n - i
                    for t in range(i):
                        sq += kernel_q[j, k, 1 + t] * past[k, first + t]
                        sv += kernel_v[j, k, 1 + t] * past[k, first + t]
                    q -= sq + (kernel_q[j, k, 0] * g[i, k] if k != j else 0.0)
                    v -= sv + (kernel_v[j, k, 0] * g[i, k] if k != j else 0.0)
                own_q, own_v, x = kernel_q[j, j, 0], kernel_v[j, j, 0], g[i, j]
                for _ in range(30):
                    f, fq, fv = _force(tables, reach, j, q - own_q * x, v - own_v * x)
                    step = (f - x) / max(1.0 + own_q * fq + own_v * fv, 0.2)
                    x += step
                    if abs(step) <= 1e-10 * largest:
                        break
                worst = max(worst, abs(x - g[i, j]))
                g[i, j] = x
                largest = max(largest, abs(x))
            found = worst <= 1e-9 * largest
            if found or places == 1:
                break
        lost += 0 if (found or places == 1) else 1
        for j in range(places):
            past[j, n - 1 - i] = g[i, j]
    return lost
