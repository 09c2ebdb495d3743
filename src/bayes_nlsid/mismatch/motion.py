"""Self-consistent motion at places where a force law acts, by alternating between frequency and time.

The response to a periodic force (or a burst that begins and ends at rest) is known everywhere once the few joint motions d are known:
D = R_jf F − R_jj G, G the transform of the law along d. The fixed point is found by Anderson acceleration of a step preconditioned
with the best linear stiffness and damping of the law along the current motion (Cameron and Griffin 1989; Walker and Ni 2011).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.krylov import gmres
from bayes_nlsid.mismatch.marching import march_laws
from bayes_nlsid.mismatch.paths import Bed, LawAlong, forces_along, through

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def settle(paths: Bed, record: int, laws: tuple[LawAlong, ...], start: Complex | None = None, most: int = 40,
           tolerance: float = 1e-5, march_only: bool = False) -> tuple[Complex, Complex, str]:
    """Motion and force at every place in one record.

    Laws without memory on nothing but modes are marched in the order of time; else (attachments, memory, no compiled code) the fixed
    point is sought over the whole record.

    Parameters
    ----------
    laws : one per place.
    start : (K, J) first guess.
    march_only : do without the whole record where a march is not sound, as a search may.

    Returns
    -------
    D, G : (K, J) spectra of motion and force
    status : ``"ok"`` or ``"not converged"``
    """
    if any(law.slope is None for law in laws):
        D, G, error = _relax(paths, record, laws, start, most, tolerance)
        return D, G, _status(error, tolerance)
    if paths.modes is not None and len(laws) <= 2 and all(law.code is not None for law in laws):
        D, G, sound = march_laws(paths, record, laws, start if paths.periodic else None)
        if sound or march_only:
            return D, G, "ok" if sound else "not converged"
    turns = max(most // 3, 4)
    best: tuple[Complex, Complex, float] = paths.linear(record), np.zeros_like(paths.linear(record)), np.inf
    if start is not None or paths.periodic:
        best = _newton(paths, record, laws, start, turns, tolerance)
    if best[2] >= 30 * tolerance and most >= 30:
        found = _newton(paths, record, laws, _sweep(paths, record, laws), turns, tolerance)
        best = min((best, found), key=lambda x: x[2])
    return best[0], best[1], _status(best[2], tolerance)


def _status(error: float, tolerance: float) -> str:
    return "ok" if error < 30 * tolerance else "not converged"


def _rest(paths: Bed, linear: Complex, D: Complex, laws: tuple[LawAlong, ...]) -> tuple[Complex, Complex, Array, Array, Array]:
    """Residual of the fixed point, force spectrum, and motion and force in time."""
    G, d, v, g = forces_along(paths, D, laws)
    return linear - through(paths.among, G) - D, G, d, v, g


def _preconditioner(paths: Bed, d: Array, v: Array, g: Array) -> Complex:
    """(K, J, J): (1 + R z)⁻¹ with the best linear stiffness and damping z of each law along its motion."""
    equivalent = _equivalent(d, v, g)
    dynamic = equivalent[:, 0] + paths.s[:, None] * equivalent[:, 1]
    if d.shape[1] == 1:
        return np.asarray(1 / (1 + paths.among * dynamic[:, None, :]))
    return np.asarray(np.linalg.inv(np.eye(d.shape[1]) + paths.among * dynamic[:, None, :]))


def _newton(paths: Bed, record: int, laws: tuple[LawAlong, ...], start: Complex | None, most: int, tolerance: float
            ) -> tuple[Complex, Complex, float]:
    """Newton's method, each step by GMRES (Saad and Schultz 1986), with halving where it overshoots."""
    linear = paths.linear(record)
    D = linear.copy() if start is None else start
    size = np.linalg.norm(linear) + 1e-300
    rest, G, d, v, g = _rest(paths, linear, D, laws)
    error = np.linalg.norm(rest) / size
    slow = 0
    for _ in range(most):
        if not np.isfinite(error) or error < tolerance or slow > 1:
            break
        slopes = [law.slope(d[:, j], v[:, j]) for j, law in enumerate(laws) if law.slope is not None]
        stiff = np.stack([np.broadcast_to(a, len(d)) for a, _ in slopes], axis=1)
        damp = np.stack([np.broadcast_to(b, len(d)) for _, b in slopes], axis=1)
        inverse = _preconditioner(paths, d, v, g)

        bent, damped = bool(stiff.any()), bool(damp.any())

        def apply(x: Complex, stiff: Array = stiff, damp: Array = damp, inverse: Complex = inverse, bent: bool = bent,
                  damped: bool = damped) -> Complex:
            rows = np.ascontiguousarray(x.T)
            if damped:
                force = damp * paths.wave(paths.s * rows) + (stiff * paths.wave(rows) if bent else 0.0)
            else:
                force = stiff * paths.wave(rows)
            return through(inverse, x + through(paths.among, paths.to_lines(force)))

        step = gmres(apply, through(inverse, rest), 40, max(0.02, 0.1 * tolerance / float(error)))
        length, accepted = 1.0, False
        for _ in range(6):
            trial = _rest(paths, linear, D + length * step, laws)
            new = np.linalg.norm(trial[0]) / size
            if np.isfinite(new) and new < error * (1 - 0.1 * length):
                accepted = True
                break
            length /= 2.5
        if not accepted:
            break
        D = D + length * step
        slow += int(new > 0.5 * error)    # from near the solution it converges in a few turns or not at all
        (rest, G, d, v, g), error = trial, new
    return D, G, float(error) if np.isfinite(error) else np.inf


def _sweep(paths: Bed, record: int, laws: tuple[LawAlong, ...], window: int = 384) -> Complex:
    """A first guess for strong laws: solve short windows one after the other, in the order of time (waveform relaxation).

    The motion follows from the past only, so each window is a Volterra equation with a short memory, which Newton's method solves where
    the whole record defeats it. A burst is gone through once, a period until it closes on itself.
    """
    from bayes_nlsid.simulation.volterra import solve_window

    J, n = paths.to_force.shape[1], paths.samples
    d, v = paths.in_time(paths.linear(record))
    tables, reach = _tables(laws, d, v, paths.dt)
    kernels = [np.fft.irfft(k, n, axis=0) for k in (paths.among, paths.s[:, None, None] * paths.among)]
    spectra = [np.fft.rfft(k, axis=0) for k in kernels]
    near = [np.ascontiguousarray(np.moveaxis(k[:window], 0, -1)) for k in kernels]
    short = [np.fft.rfft(np.concatenate([k[:window], np.zeros_like(k[:window])]), axis=0) for k in kernels]
    g = np.zeros((n, J))
    for _ in range(1 if not paths.periodic else 6):
        before = g.copy()
        for first in range(0, n, window):
            here = slice(first, min(first + window, n))
            old, w = g[here].copy(), min(window, n - first)
            padded = np.fft.rfft(np.concatenate([old, np.zeros((2 * window - w, J))]), axis=0)
            own = [np.fft.irfft(through(k, padded), 2 * window, axis=0)[:w] for k in short]
            solve_window(d[here] + own[0], v[here] + own[1], *near, tables, reach, g[here], np.zeros((J, w)))
            step = np.zeros((n, J))
            step[here] = g[here] - old
            spectrum = np.fft.rfft(step, axis=0)
            d = d - np.fft.irfft(through(spectra[0], spectrum), n, axis=0)
            v = v - np.fft.irfft(through(spectra[1], spectrum), n, axis=0)
        change = float(np.abs(g - before).max())
        if not 1e-4 * float(np.abs(g).max()) < change < np.inf:
            break
    found = paths.linear(record) - through(paths.among, paths.to_lines(g))
    sound = np.isfinite(found).all() and np.abs(found).max() < 10 * np.abs(paths.linear(record)).max()
    return found if sound else paths.linear(record)


def _tables(laws: tuple[LawAlong, ...], d: Array, v: Array, dt: float) -> tuple[Array, Array]:
    """Laws (2, J, nodes) as functions of displacement and of velocity, and how far they reach (2, J)."""
    from bayes_nlsid.simulation.volterra import nodes

    reach = 4 * np.stack([np.abs(d).max(0), np.abs(v).max(0)]) + 1e-300
    out = []
    for j, law in enumerate(laws):
        q, u = nodes(float(reach[0, j])), nodes(float(reach[1, j]))
        none = np.zeros_like(q)
        still = law.force(q, none, dt)
        out.append((still, law.force(none, u, dt) - np.interp(0.0, q, still)))
    return np.array(out).swapaxes(0, 1).copy(), reach


def _relax(paths: Bed, record: int, laws: tuple[LawAlong, ...], start: Complex | None, most: int, tolerance: float, depth: int = 8
           ) -> tuple[Complex, Complex, float]:
    """Anderson acceleration of the preconditioned fixed point, for laws whose slope along the path is not at hand."""
    linear = paths.linear(record)
    D = linear.copy() if start is None else start
    size = np.linalg.norm(linear) + 1e-300
    states: list[Complex] = []
    steps: list[Complex] = []
    best, kept = np.inf, (D, np.zeros_like(D))
    inverse = None
    for iteration in range(most):
        rest, G, d, v, g = _rest(paths, linear, D, laws)
        error = np.linalg.norm(rest) / size
        if not np.isfinite(error):
            break
        if error < best:
            best, kept = float(error), (D, G)
        if error < tolerance:
            break
        if iteration in (0, 3, 10, 20) or inverse is None:
            inverse = _preconditioner(paths, d, v, g)
            states, steps = [], []
        states.append(D)
        steps.append(through(inverse, rest))
        D = _anderson(states[-depth:], steps[-depth:])
    return kept[0], kept[1], float(best)


def _anderson(states: list[Complex], steps: list[Complex]) -> Complex:
    """Next state that makes the extrapolated step smallest."""
    if len(states) == 1:
        return states[0] + steps[0]
    changes = np.array([(b - a).ravel() for a, b in zip(steps[:-1], steps[1:], strict=True)])
    moves = np.array([(b - a).ravel() for a, b in zip(states[:-1], states[1:], strict=True)])
    gram = (changes.conj() @ changes.T).real
    gram += 1e-12 * np.trace(gram) * np.eye(len(gram)) + 1e-300 * np.eye(len(gram))
    weight = np.linalg.solve(gram, (changes.conj() @ steps[-1].ravel()).real)
    return np.asarray(states[-1] + steps[-1] - (weight @ (moves + changes)).reshape(states[-1].shape))


def _equivalent(d: Array, v: Array, g: Array) -> Array:
    """(J, 2): linear stiffness and damping that fit each force best along its motion."""
    power_d, power_v = (d * d).sum(0), (v * v).sum(0)
    return np.stack([(g * d).sum(0) / np.maximum(power_d, 1e-300), (g * v).sum(0) / np.maximum(power_v, 1e-300)], axis=1)
