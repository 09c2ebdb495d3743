"""Self-consistent motion at places where a force law acts, by alternating between frequency and time.

The response to a periodic force (or a burst that begins and ends at rest) is known everywhere once the few joint motions d are known:
D = R_jf F − R_jj G, G the transform of the law along d. The fixed point is found by Anderson acceleration of a step preconditioned
with the best linear stiffness and damping of the law along the current motion (Cameron and Griffin 1989; Walker and Ni 2011).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.linear import Attachment, Modes, receptances
from bayes_nlsid.mismatch.spectra import Spectra

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
LawAlong = Callable[[Array, Array, float], Array]
Attached = Callable[[Complex], tuple[Attachment, ...]] | None
FINER = 2  # samples of the simulation per sample of the recording


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
    """

    s: Complex
    to_force: Complex
    among: Complex
    drive: Complex
    samples: int
    dt: float
    window: Array
    periodic: bool

    def linear(self, record: int) -> Complex:
        """(K, J): motion without any law."""
        return np.asarray(self.to_force * self.drive[record][:, None])

    def in_time(self, D: Complex) -> tuple[Array, Array]:
        """Displacement and velocity (samples, J) of a spectrum (K, J)."""
        both = np.concatenate([D, self.s[:, None] * D], axis=1)
        out = np.fft.irfft(both * self.samples, self.samples, axis=0) / self.window[:, None]
        return out[:, :D.shape[1]], out[:, D.shape[1]:]

    def to_lines(self, force: Array) -> Complex:
        """Spectrum (K, J) of forces (samples, J)."""
        return np.asarray(np.fft.rfft(force * self.window[:, None], axis=0) / self.samples)


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
    s = spectra.alpha + 2j * np.pi * np.arange(count) * spectra.rate / block
    full = receptances(modes, s, rows, np.concatenate([rows, shaker[None]]), attach(s) if attach is not None else ())
    time = spectra.waveforms if waveforms is None else waveforms
    decay = np.exp(-spectra.alpha * np.arange(block) / spectra.rate)
    drive = np.zeros((len(time), count), dtype=complex)
    half = np.fft.rfft(time * decay, axis=1) / block
    drive[:, :half.shape[1] - 1] = half[:, :-1]
    grid = np.exp(-spectra.alpha * np.arange(samples) / (finer * spectra.rate))
    return Bed(s, full[:, :, -1], full[:, :, :-1], drive, samples, 1 / (finer * spectra.rate), grid, spectra.kind == "steady")


def settle(paths: Bed, record: int, laws: tuple[LawAlong, ...], start: Complex | None = None, most: int = 40,
           tolerance: float = 1e-5, depth: int = 8) -> tuple[Complex, Complex, str]:
    """Motion and force at every place in one record.

    Parameters
    ----------
    laws : one callable per place, ``law(d, v, dt) -> force`` along one period (or burst), memory honoured inside.
    start : (K, J) first guess.

    Returns
    -------
    D, G : (K, J) spectra of motion and force
    status : ``"ok"`` or ``"not converged"``
    """
    linear = paths.linear(record)
    D = linear.copy() if start is None else start
    size = np.linalg.norm(linear) + 1e-300
    G = np.zeros_like(D)
    states: list[Complex] = []
    steps: list[Complex] = []
    best, kept = np.inf, (D, G)
    J = D.shape[1]
    eye = np.eye(J)
    for iteration in range(most):
        d, v = paths.in_time(D)
        g = np.stack([law(d[:, j], v[:, j], paths.dt) for j, law in enumerate(laws)], axis=1)
        if not np.isfinite(g).all():
            break
        G = paths.to_lines(g)
        rest = linear - np.einsum("kij,kj->ki", paths.among, G) - D if J > 1 else linear - paths.among[:, :, 0] * G - D
        if iteration % 6 == 0:
            equivalent = _equivalent(d, v, g)
            dynamic = equivalent[:, 0] + paths.s[:, None] * equivalent[:, 1]
            if J == 1:
                inverse = 1 / (1 + paths.among[:, :, 0] * dynamic)
            else:
                inverse = np.linalg.inv(eye + paths.among * dynamic[:, None, :])
            states, steps = [], []
        error = np.linalg.norm(rest) / size
        if error < best:
            best, kept = error, (D, G)
        if error < tolerance:
            return D, G, "ok"
        step = inverse * rest if J == 1 else np.einsum("kij,kj->ki", inverse, rest)
        states.append(D)
        steps.append(step)
        D = _anderson(states[-depth:], steps[-depth:])
        if not np.isfinite(D).all():
            break
    return kept[0], kept[1], "ok" if best < 30 * tolerance else "not converged"


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
