"""Laws without memory marched in the order of time, on the modes behind the paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.paths import Bed, LawAlong, forces_along, through

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
RINGING = 1.0   # second difference of a force over the force: 4 where it changes sign at every step
HUGE = 1e100    # N; only a march that has lost its law gets there
FINEST = 16     # steps per sample beyond which nothing is refined


def march_laws(paths: Bed, record: int, laws: tuple[LawAlong, ...], start: Complex | None = None, passes: int = 5
           ) -> tuple[Complex, Complex, bool]:
    """Motion, force and whether they are sound, from a march in the order of time: a burst once, a period until it ends as it began."""
    from bayes_nlsid.simulation.modal_march import march_modes

    steps, linear = paths.steps, paths.linear(record)
    n = paths.marched * paths.samples
    decay = np.exp(np.arange(n) / paths.marched * np.log(paths.window[1]))    # 1 for periodic records
    rows = np.ascontiguousarray(linear.T)
    q0, v0 = (np.ascontiguousarray((np.fft.irfft(x, n, axis=1, norm="forward") / decay).T) for x in (rows, paths.s * rows))
    codes, powers = (np.array([law.code[k] for law in laws if law.code is not None]) for k in (0, 1))
    values = np.zeros((len(laws), max(max(len(law.values) for law in laws), 1)))
    for j, law in enumerate(laws):
        values[j, :len(law.values)] = law.values
    g, state, before = np.zeros((n, len(laws))), np.zeros((2, steps.b.shape[1])), np.zeros(len(laws))
    if start is not None:
        G, _, _, along = forces_along(paths, start, laws)
        state, before = _begin(paths, G), along[-1].copy()
    lost, closed = 0, not paths.periodic
    for _ in range(passes if paths.periodic else 1):
        begun = state.copy()
        lost = march_modes(q0, v0, steps.own, steps.forced, steps.b, steps.yielding, paths.dt / paths.marched, codes, powers, values, g,
                           state, before)
        if paths.marched < FINEST and _rings(g):
            return march_laws(replace(paths, marched=min(4 * paths.marched, FINEST)), record, laws, start, passes)
        if not np.abs(g).max() < HUGE:
            return linear, np.zeros_like(linear), False
        G = np.asarray(np.fft.rfft(g * decay[:, None], axis=0, norm="forward")[:len(paths.s)])
        if not paths.periodic:
            break
        sizes = np.abs(state).max(axis=1, keepdims=True) + 1e-300
        change = float((np.abs(state - begun) * steps.lasting / sizes).max())
        closed = change < 0.03
        if change < 2e-3:
            break
        state, before = _begin(paths, G), g[-1].copy()
    D = linear - through(paths.among, G)
    return D, G, bool(closed and lost < 1e-3 * n)


def _rings(g: Array) -> bool:
    """Whether a force changes sign from step to step, as that of a hard stop does where the steps are too long for it."""
    largest = float(np.abs(g).max())
    if not largest < HUGE:
        return True
    return bool(largest > 0 and np.linalg.norm(np.diff(g, 2, axis=0)) > RINGING * np.linalg.norm(g))


def _begin(paths: Bed, G: Complex) -> Array:
    """State of the modes one step before a period that these forces make steady, where the march takes it up."""
    u = G @ paths.steps.b
    return np.stack([_first(u * back) for back in paths.steps.back])


def _first(lines: Complex) -> Array:
    """Value in time at t = 0 of spectra (K, m) of real signals."""
    return np.asarray(lines[0].real + 2 * lines[1:].real.sum(axis=0))
