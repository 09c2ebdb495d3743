"""Self-consistent motion at places where a force law acts, by alternating between frequency and time.

The response to a periodic force (or a burst that begins and ends at rest) is known everywhere once the few joint motions d are known:
D = R_jf F − R_jj G, G the transform of the law along d. The fixed point is found by Anderson acceleration of a step preconditioned
with the best linear stiffness and damping of the law along the current motion (Cameron and Griffin 1989; Walker and Ni 2011).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.krylov import gmres
from bayes_nlsid.mismatch.linear import Attachment, Modes, receptances
from bayes_nlsid.mismatch.spectra import Spectra

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Attached = Callable[[Complex], tuple[Attachment, ...]] | None


@final
@dataclass(frozen=True)
class LawAlong:
    """A law as the solver sees it.

    Parameters
    ----------
    force : callable
        ``force(d, v, dt) -> (n,)`` along one period or burst, memory honoured inside.
    slope : callable or None
        ``slope(d, v) -> (dg/dd, dg/dv)``, if the force depends on the present motion only.
    code : tuple of (int, float) or None
        Number of the law for compiled code (``forces.compiled.law_code``), if it has one.
    values : ndarray
        Its parameters.
    """

    force: Callable[[Array, Array, float], Array]
    slope: Callable[[Array, Array], tuple[Array, Array]] | None = None
    code: tuple[int, float] | None = None
    values: Array = field(default_factory=lambda: np.zeros(0))


FINER = 2  # samples of the simulation per sample of the recording
MARCHED = 4  # steps of a march in the order of time per sample of the simulation
QUICK = 2.0  # rad per step beyond which a mode is taken as a spring


@final
@dataclass(frozen=True)
class Steps:
    """One step of a march: ``own``, ``forced`` (4, m), ``b`` (J, m) and ``yielding`` (J, J) as in ``simulation.modal_march``.

    ``back`` (K, m): modal response to a unit force one step earlier.
    """

    own: Array
    forced: Array
    b: Array
    yielding: Array
    back: Complex


@final
@dataclass(frozen=True)
class Bed:
    """Linear paths between the force and some places on all lines of the simulation grid.

    Parameters
    ----------
    s : ndarray complex (K,)
    to_force : ndarray complex (K, J)
        Motion of each place per shaker force, m/N.
    among : ndarray complex (K, J, J)
        Motion of place i per force at place j.
    drive : ndarray complex (R, K)
        Force spectra.
    samples : int
    dt : float
    window : ndarray (samples,)
        exp(-alpha t), 1 for periodic records.
    periodic : bool
    modes : Modes or None
        Of the structure, if nothing but its modes stands behind the paths: what a march in the order of time needs.
    rows : ndarray (J, m)
        Of the places in these modes.
    """

    s: Complex
    to_force: Complex
    among: Complex
    drive: Complex
    samples: int
    dt: float
    window: Array
    periodic: bool
    modes: Modes | None = None
    rows: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def at(self, places: list[int]) -> Bed:
        """Some of the places alone."""
        return replace(self, to_force=self.to_force[:, places], among=self.among[:, places][:, :, places],
                       rows=self.rows[places] if self.modes is not None else self.rows)

    @cached_property
    def steps(self) -> Steps:
        """What one step of a march in the order of time needs; the highest modes are springs."""
        from bayes_nlsid.simulation.modal_march import propagators

        assert self.modes is not None
        dt = self.dt / MARCHED
        low = self.modes.omega * dt < QUICK
        high = self.rows[:, ~low] / self.modes.omega[~low]
        own, forced = propagators(self.modes.omega[low], self.modes.zeta[low], dt)
        back = np.exp(-self.s * dt)[:, None] / self.modes.denominators(self.s)[:, low]
        return Steps(own, forced, np.ascontiguousarray(self.rows[:, low]), high @ high.T, back)

    def linear(self, record: int) -> Complex:
        """(K, J): motion without any law."""
        return np.asarray(self.to_force * self.drive[record][:, None])

    def in_time(self, D: Complex) -> tuple[Array, Array]:
        """Displacement and velocity (samples, J) of a spectrum (K, J)."""
        rows = np.ascontiguousarray(D.T)
        return self.wave(rows), self.wave(self.s * rows)

    def wave(self, rows: Complex) -> Array:
        """(samples, J) in time from spectra (J, K)."""
        out = np.fft.irfft(rows, self.samples, axis=1, norm="forward")
        return np.asarray((out if self.periodic else out / self.window).T)

    def to_lines(self, force: Array) -> Complex:
        """Spectrum (K, J) of forces (samples, J)."""
        rows = np.ascontiguousarray(force.T)
        return np.asarray(np.fft.rfft(rows if self.periodic else rows * self.window, axis=1, norm="forward").T)


def bed(modes: Modes, spectra: Spectra, rows: Array, shaker: Array, attach: Attached = None, waveforms: Array | None = None,
        finer: int = FINER) -> Bed:
    """Paths on the grid of a group of records.

    Parameters
    ----------
    rows : (J, n) places; ``shaker`` (n,).
    attach : callable ``s -> tuple of Attachment``, or None.
    waveforms : (R, block) forces in time, N; those of ``spectra`` by default.
    """
    block = spectra.block
    samples = finer * block
    count = samples // 2 + 1
    s = np.asarray(spectra.alpha + 2j * np.pi * np.arange(count) * spectra.rate / block, dtype=complex)
    attached = attach(s) if attach is not None else ()
    full = receptances(modes, s, rows, np.concatenate([rows, shaker[None]]), attached)
    time = spectra.waveforms if waveforms is None else waveforms
    decay = np.exp(-spectra.alpha * np.arange(block) / spectra.rate)
    drive = np.zeros((len(time), count), dtype=complex)
    half = np.fft.rfft(time * decay, axis=1) / block
    drive[:, :half.shape[1] - 1] = half[:, :-1]
    grid = np.exp(-spectra.alpha * np.arange(samples) / (finer * spectra.rate))
    return Bed(s, full[:, :, -1], full[:, :, :-1], drive, samples, 1 / (finer * spectra.rate), grid, spectra.kind == "steady",
               None if attached else modes, rows @ modes.basis)


def settle(paths: Bed, record: int, laws: tuple[LawAlong, ...], start: Complex | None = None, most: int = 40,
           tolerance: float = 1e-5) -> tuple[Complex, Complex, str]:
    """Motion and force at every place in one record.

    Laws without memory on nothing but modes are marched in the order of time; else (attachments, memory, no compiled code) the fixed
    point is sought over the whole record.

    Parameters
    ----------
    laws : one per place.
    start : (K, J) first guess.

    Returns
    -------
    D, G : (K, J) spectra of motion and force
    status : ``"ok"`` or ``"not converged"``
    """
    if any(law.slope is None for law in laws):
        D, G, error = _relax(paths, record, laws, start, most, tolerance)
        return D, G, _status(error, tolerance)
    if paths.modes is not None and len(laws) <= 2 and all(law.code is not None for law in laws):
        D, G, sound = _march(paths, record, laws)
        if sound:
            return D, G, "ok"
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


def _march(paths: Bed, record: int, laws: tuple[LawAlong, ...], passes: int = 4) -> tuple[Complex, Complex, bool]:
    """Motion, force and whether they are sound, from a march in the order of time: a burst once, a period until it closes on itself."""
    from bayes_nlsid.simulation.modal_march import march_modes

    steps, linear = paths.steps, paths.linear(record)
    n = MARCHED * paths.samples
    decay = np.exp(np.arange(n) / MARCHED * np.log(paths.window[1]))    # 1 for periodic records
    rows = np.ascontiguousarray(linear.T)
    q0, v0 = (np.ascontiguousarray((np.fft.irfft(x, n, axis=1, norm="forward") / decay).T) for x in (rows, paths.s * rows))
    codes, powers = (np.array([law.code[k] for law in laws if law.code is not None]) for k in (0, 1))
    values = np.zeros((len(laws), max(max(len(law.values) for law in laws), 1)))
    for j, law in enumerate(laws):
        values[j, :len(law.values)] = law.values
    g, state, before = np.zeros((n, len(laws))), np.zeros((2, steps.b.shape[1])), np.zeros(len(laws))
    kept: Array = np.zeros(0)
    lost, closed = 0, not paths.periodic
    for _ in range(passes if paths.periodic else 1):
        lost = march_modes(q0, v0, steps.own, steps.forced, steps.b, steps.yielding, codes, powers, values, g, state, before)
        G = np.asarray(np.fft.rfft(g * decay[:, None], axis=0, norm="forward")[:len(paths.s)])
        if not paths.periodic or not np.isfinite(g).all():
            break
        change = float(np.abs(g - kept).max() / max(float(np.abs(g).max()), 1e-300)) if len(kept) else 1.0
        closed = change < 0.05
        if change < 1e-3:
            break
        kept, before = g.copy(), g[-1].copy()
        # the state at the start of a period that these forces would make steady; one step back, where the march takes it up
        X = (G @ steps.b) * steps.back
        state = np.stack([_first(X), _first(paths.s[:, None] * X)])
    D = linear - _mul(paths.among, G)
    return D, G, bool(np.isfinite(g).all() and closed and lost < 1e-3 * n)


def _first(lines: Complex) -> Array:
    """Value in time at t = 0 of spectra (K, m) of real signals."""
    return np.asarray(lines[0].real + 2 * lines[1:].real.sum(axis=0))


def _rest(paths: Bed, linear: Complex, D: Complex, laws: tuple[LawAlong, ...]) -> tuple[Complex, Complex, Array, Array, Array]:
    """Residual of the fixed point, force spectrum, and motion and force in time."""
    d, v = paths.in_time(D)
    g = np.stack([law.force(d[:, j], v[:, j], paths.dt) for j, law in enumerate(laws)], axis=1)
    G = paths.to_lines(g)
    return linear - _mul(paths.among, G) - D, G, d, v, g


def _mul(matrix: Complex, vector: Complex) -> Complex:
    return np.asarray(matrix[:, :, 0] * vector if vector.shape[1] == 1 else (matrix @ vector[:, :, None])[:, :, 0])


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
            return _mul(inverse, x + _mul(paths.among, paths.to_lines(force)))

        step = gmres(apply, _mul(inverse, rest), 40, max(0.02, 0.1 * tolerance / float(error)))
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
            own = [np.fft.irfft(_mul(k, padded), 2 * window, axis=0)[:w] for k in short]
            solve_window(d[here] + own[0], v[here] + own[1], *near, tables, reach, g[here], np.zeros((J, w)))
            step = np.zeros((n, J))
            step[here] = g[here] - old
            spectrum = np.fft.rfft(step, axis=0)
            d = d - np.fft.irfft(_mul(spectra[0], spectrum), n, axis=0)
            v = v - np.fft.irfft(_mul(spectra[1], spectrum), n, axis=0)
        change = float(np.abs(g - before).max())
        if not 1e-4 * float(np.abs(g).max()) < change < np.inf:
            break
    found = paths.linear(record) - _mul(paths.among, paths.to_lines(g))
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
        steps.append(_mul(inverse, rest))
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
