"""Compiled loops and scalar building blocks, made from the very functions of ``forces/laws.py`` and ``forces/memory.py``.

Import this module only where compiled code is about to run: it imports numba (0.3 s). Compiled code is kept in numba's cache
directory; where none can be written it is compiled anew in each process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numba.extending
import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces import laws, memory


@numba.extending.overload(laws.where, strict=False)
def _scalar_where(condition: Any, yes: Any, no: Any) -> Any:
    """``laws.where`` for numbers; numba's own ``np.where`` would make an array of each."""
    return lambda condition, yes, no: yes if condition else no


def compiled(function: Callable[..., Any]) -> Any:
    """The function compiled by numba, cached on disk if a cache directory can be written."""
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba: "cannot cache function ...: no locator available"
        return numba.njit(error_model="numpy")(function)


turning_point = compiled(memory.turning_point)
slider_step = compiled(memory.slider_step)
bouc_wen_step = compiled(memory.bouc_wen_step)


@compiled
def march_sliders(moves: NDArray[np.float64], stiffness: NDArray[np.float64], slip: NDArray[np.float64],
                  theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slider forces (B, N) along moves (N,); stiffness, slip (B, sliders), theta (B,)."""
    batch, count = slip.shape
    force = np.zeros((batch, len(moves)))
    for b in range(batch):
        for j in range(count):
            stretch, sliding, k, s, t = 0.0, 0.0, stiffness[b, j], slip[b, j], theta[b]
            for i in range(len(moves)):
                stretch, sliding = slider_step(moves[i], stretch, sliding, s, t)
                force[b, i] += k * stretch
    return force


@compiled
def march_bouc_wen(moves: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bouc–Wen forces (B, N) along moves (N,); p (B, 5)."""
    batch = len(p)
    force = np.empty((batch, len(moves)))
    for b in range(batch):
        z = 0.0
        for i in range(len(moves)):
            z = bouc_wen_step(z, moves[i], p[b, 0], p[b, 1], p[b, 2], p[b, 3], p[b, 4])
            force[b, i] = z
    return force
