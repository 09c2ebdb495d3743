"""Linear paths between the force and the places where laws act, on the grid of a simulation; a law as the solver sees it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

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
RESONANT = 1.0  # rad per step, up to which a mode is excited at its own frequency
QUICK = 2.0  # rad per step beyond which a mode is taken as a spring


@final
@dataclass(frozen=True)
class Steps:
    """One step of a march: ``own``, ``forced`` (4, m), ``b`` (J, m) and ``yielding`` (J, J) as in ``simulation.modal_march``.

    ``back`` (2, K, m): modal x and ẋ under a unit force, in these very steps, one step earlier. ``lasting`` (m,): share of a period
    over which a wrong start of a mode is felt.
    """

    own: Array
    forced: Array
    b: Array
    yielding: Array
    back: Complex
    lasting: Array


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
    marched : int
        Steps of a march per sample.
    """

    s: Complex
    to_force: Complex
    among: Complex
    drive: Complex
    samples: int
    dt: float
    window: Array
    periodic: bool
    modes: Modes | None
    rows: Array
    marched: int = MARCHED

    def at(self, places: list[int]) -> Bed:
        """Some of the places alone."""
        return replace(self, to_force=self.to_force[:, places], among=self.among[:, places][:, :, places], rows=self.rows[places])

    @cached_property
    def steps(self) -> Steps:
        """What one step of a march in the order of time needs; the highest modes are springs."""
        from bayes_nlsid.simulation.modal_march import propagators

        assert self.modes is not None
        dt = self.dt / self.marched
        low = self.modes.omega * dt < QUICK
        high = self.rows[:, ~low] / self.modes.omega[~low]
        own, forced = propagators(self.modes.omega[low], self.modes.zeta[low], dt)
        # a force that is linear within a step has less of each frequency than the force itself: near its own a mode would feel it
        more = np.where(self.modes.omega[low] * dt < RESONANT, np.sinc(self.modes.omega[low] * dt / (2 * np.pi)) ** -2.0, 1.0)
        forced, slow = forced * more, self.rows[:, low] * np.sqrt(more - 1.0) / self.modes.omega[low]    # far below it, it gets no more
        back = _steady(own, forced, np.exp(self.s * dt)) if self.periodic else np.zeros((2, 0, 0), dtype=complex)
        fading = np.maximum(self.modes.zeta[low] * self.modes.omega[low] * self.samples * self.dt, 1e-12)
        return Steps(own, forced, np.ascontiguousarray(self.rows[:, low]), high @ high.T - slow @ slow.T, back, -np.expm1(-fading) / fading)

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


def _steady(own: Array, forced: Array, z: Complex) -> Complex:
    """(2, K, m): steady x and ẋ, one step back, under u = z^n; from state(n+1) = own state(n) + forced (u(n), u(n+1))."""
    z = z[:, None]
    a, b, c, d = own
    rx, rv = forced[0] + forced[1] * z, forced[2] + forced[3] * z
    determinant = ((z - a) * (z - d) - b * c) * z
    return np.stack([((z - d) * rx + b * rv) / determinant, (c * rx + (z - a) * rv) / determinant])


def forces_along(paths: Bed, D: Complex, laws: tuple[LawAlong, ...]) -> tuple[Complex, Array, Array, Array]:
    """Spectrum of the forces along a motion, the motion in time, and the forces in time."""
    d, v = paths.in_time(D)
    g = np.stack([law.force(d[:, j], v[:, j], paths.dt) for j, law in enumerate(laws)], axis=1)
    return paths.to_lines(g), d, v, g


def through(matrix: Complex, vector: Complex) -> Complex:
    """Line by line, (K, J, J) times (K, J)."""
    return np.asarray(matrix[:, :, 0] * vector if vector.shape[1] == 1 else (matrix @ vector[:, :, None])[:, :, 0])
