"""The mismatch as white innovations from which everything that a linear model may absorb has been taken.

For a linear model, recordings and known forces, a `Bench` holds the innovations of every record, whitened in time (an autoregression for
each channel) and across channels, and the space of everything linear: stiffness and damping of each mode, gain and short filters of each
force chain, feed-through, offsets, and small errors of the mode shapes. What a candidate adds to the innovations is brought into the same
coordinates and freed of the same space, so that neither hides the other. Blocks of time keep the books for held-out comparisons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrated import Drive, Linear, best_drive, observer_of
from bayes_nlsid.mismatch.campaign import Campaign, Trial
from bayes_nlsid.mismatch.observer import ORDER, Observer, Smoothed, observe
from bayes_nlsid.mismatch.seen import SHAPE_SD
from bayes_nlsid.recordings.filtering import smooth_step
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
BLOCKS = 24           # blocks of time, all fitted records together
LEAST_CYCLES = 4      # of the slowest elastic mode in a block
PREWHITEN = 16        # order of the autoregression
FEW = 64              # columns of the linear space up to which it is laid out by singular values
TAPS = 3              # samples by which an input chain may smear a force to either side


@final
@dataclass(frozen=True, eq=False)
class Desk:
    """One record on the bench.

    Parameters
    ----------
    trial : Trial
    smoothed : Smoothed
    force : ndarray (n, m)
        Known modal force that was used.
    length : int
        Of the padded transform.
    force_path, channel_path : ndarray (L, s, m), (L, s, s)
        Whitened innovations per unit modal force, per unit channel signal.
    skip : int
        Samples at the beginning that do not count.
    part : float
        Share of the lines that lie in the analysed band: independent values per sample.
    weight : ndarray (n − skip,)
        So that loud and quiet stretches count alike: one over the level of what the linear model leaves.
    """

    trial: Trial
    smoothed: Smoothed
    force: Array
    length: int
    force_path: Complex
    channel_path: Complex
    skip: int
    part: float
    weight: Array

    @property
    def n(self) -> int:
        """Samples."""
        return self.trial.recording.n

    def respond(self, spectrum: Complex) -> Array:
        """Whitened innovations (..., counted samples · s) from their transform (..., L, s)."""
        wave = np.fft.irfft(spectrum, n=self.length, axis=-2)[..., self.skip:self.n, :] * self.weight[:, None]
        return wave.reshape(*wave.shape[:-2], -1)

    def to_force(self, row: Array, signals: Array, finer: int = 1) -> Array:
        """Whitened innovations (K, ...) of forces ``signals`` (K, n · finer), sampled finer than the record, along ``row`` (m,)."""
        path = self.force_path @ row
        lines = np.fft.rfft(signals, n=finer * self.length, axis=-1)[..., :len(path)] / finer
        return self.respond(lines[..., None] * path)

    def to_channel(self, channel: int, signals: Array) -> Array:
        """Whitened innovations (K, ...) of errors ``signals`` (K, n) of one channel."""
        return self.respond(np.fft.rfft(signals, n=self.length, axis=-1)[..., None] * self.channel_path[:, :, channel])


@final
@dataclass(frozen=True, eq=False)
class Bench:
    """All fitted records, whitened, with the linear space taken out.

    Parameters
    ----------
    linear : Linear
    desks : tuple of Desk
    innovations : ndarray (N,)
        Whitened, not yet projected.
    basis : ndarray (N, q)
        Orthonormal: everything linear.
    block : ndarray (N,)
        Block of each entry.
    counts : ndarray (B,)
        Independent values in each block.
    columns : tuple of str
        What the linear space consists of.
    drive : Drive
        What the observer was set up with.
    coefficients : ndarray
        Least-squares coefficients of those columns.
    """

    linear: Linear
    desks: tuple[Desk, ...]
    innovations: Array
    basis: Array
    block: NDArray[np.intp]
    counts: Array
    columns: tuple[str, ...]
    coefficients: Array
    drive: Drive

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self.block.max()) + 1

    def project(self, x: Array) -> Array:
        """Free of everything linear, (..., N)."""
        return np.asarray(x - (x @ self.basis) @ self.basis.T)

    def per_block(self, values: Array) -> Array:
        """Sums over each block, (..., B)."""
        edges = np.flatnonzero(np.diff(self.block, prepend=-1))
        return np.asarray(np.add.reduceat(values, edges, axis=-1))


def lay_out(campaign: Campaign, linear: Linear, known: Sequence[Array] | None = None, taps: bool = True,
            drive: Drive | None = None) -> Bench:
    """Filter every record to be fitted and prepare the bench.

    Parameters
    ----------
    campaign : Campaign
    linear : Linear
    known : sequence of ndarray (n, m) or None
        Modal forces of what has been found already, one for each fitted record.
    taps : bool
        Whether short filters of the force chain belong to the linear space.
    drive : Drive or None
        Found by maximum likelihood if None.
    """
    trials = campaign.used("fit")
    forces = [linear.forces(t) + (0.0 if known is None else known[i]) for i, t in enumerate(trials)]
    if drive is None:
        drive = best_drive(linear, trials, forces)
    paths: dict[tuple[object, ...], tuple[Observer, Complex, Complex, int]] = {}
    raw: list[tuple[Trial, Smoothed, Array, Observer, Complex, Complex, int]] = []
    for trial, force in zip(trials, forces, strict=True):
        record = trial.recording
        key = (record.n, record.dt, record.channels, trial.noise.tobytes())
        if key not in paths:
            observer = observer_of(linear, trial, drive)
            N = observer.length(record.n)
            resolvent = observer.resolvent(N)
            paths[key] = (observer, observer.from_force(N, resolvent), observer.from_channel(resolvent), N)
        observer, to_force, to_channel, N = paths[key]
        raw.append((trial, observe(observer, linear.response(record), force), force, observer, to_force, to_channel, N))
    plain = [_desk(*entry, np.ones((entry[6] // 2 + 1, entry[1].innovations.shape[1])), np.eye(entry[1].innovations.shape[1]),
                   campaign.top) for entry in raw]
    rough = _assemble(linear, plain, taps, drive)
    left = rough.project(rough.innovations)
    desks = []
    at = 0
    for entry, desk in zip(raw, plain, strict=True):
        s = entry[1].innovations.shape[1]
        count = (desk.n - desk.skip) * s
        filters, root = _whitener(left[at:at + count].reshape(-1, s), entry[6], 0 if entry[0].recording.free else PREWHITEN)
        at += count
        desks.append(_desk(*entry, filters, root, campaign.top))
    return _assemble(linear, _evened(linear, desks, taps, drive), taps, drive)


def _evened(linear: Linear, desks: Sequence[Desk], taps: bool, drive: Drive) -> list[Desk]:
    """The same desks, every block weighted by the level of what the linear model leaves there, to unit variance in all."""
    for _ in range(3):
        bench = _assemble(linear, desks, taps, drive)
        left = bench.project(bench.innovations)
        out, at = [], 0
        for d in desks:
            s = len(d.trial.recording.channels)
            count = (d.n - d.skip) * s
            block = bench.block[at:at + count:s]
            label = block - block[0]
            power = np.bincount(label, weights=(left[at:at + count].reshape(-1, s) ** 2).sum(1)) / (s * np.bincount(label))
            level = np.sqrt(power)
            weight = d.weight / np.maximum(level, 1e-3 * level.max() + 1e-300)[label]
            out.append(replace(d, weight=weight))
            at += count
        desks = out
    bench = _assemble(linear, desks, taps, drive)
    whole = float(np.sqrt(np.mean(bench.project(bench.innovations) ** 2)))
    return [replace(d, weight=d.weight / max(whole, 1e-300)) for d in desks]


def _desk(trial: Trial, smoothed: Smoothed, force: Array, observer: Observer, to_force: Complex, to_channel: Complex, N: int,
          filters: Complex | Array, root: Array, top: float) -> Desk:
    order = 0 if filters.dtype.kind == "f" else PREWHITEN
    if order:
        # what lies above the analysed band was taken off by the low-pass, in part
        f = np.arange(N // 2 + 1) / (N * trial.recording.dt)
        filters = filters * (1 - smooth_step(f, top, 1.25 * top))[:, None]
    skip = int(min(observer.memory + order, trial.recording.n // 5))
    shape = filters[:, :, None]
    return Desk(trial, replace(smoothed, innovations=_filtered(smoothed.innovations, filters, root, N)), force, N,
                np.einsum("rs,lsm->lrm", root, shape * to_force), np.einsum("rs,lsm->lrm", root, shape * to_channel), skip,
                min(1.0, 2.25 * top * trial.recording.dt), np.ones(trial.recording.n - skip))


def _filtered(e: Array, filters: Complex | Array, root: Array, N: int) -> Array:
    return np.asarray(np.fft.irfft(np.fft.rfft(e, n=N, axis=0) * filters, n=N, axis=0)[:len(e)] @ root.T)


def _whitener(left: Array, N: int, most: int) -> tuple[Complex, Array]:
    """Autoregressive filter of each channel at the lines of a transform of length N, and the root of the inverse covariance after it.

    ``most`` is its order at most: 0 for free decays, in which all that is left lies about one line and a filter would notch it out.
    """
    from scipy.linalg import solve_toeplitz
    from scipy.signal import lfilter

    n, s = left.shape
    order = min(most, n // 20)
    filters = np.ones((N // 2 + 1, s), dtype=complex)
    white = np.empty_like(left)
    for c in range(s):
        x = left[:, c] - left[:, c].mean()
        r = np.array([x[:n - k] @ x[k:] for k in range(order + 1)]) / n
        # a white part keeps frequencies at which nothing was recorded from being blown up
        r[0] = r[0] * (1 + 1e-4) + 1e-300
        a = np.concatenate([[1.0], -solve_toeplitz(r[:-1], r[1:])]) if order > 0 else np.ones(1)
        filters[:, c] = np.fft.rfft(a, n=N)
        white[:, c] = lfilter(a, 1.0, left[:, c])
    covariance = np.atleast_2d(np.cov(white[order:].T)) + 1e-12 * np.eye(s) * np.var(white)
    return filters, np.linalg.inv(np.linalg.cholesky(covariance))


def _assemble(linear: Linear, desks: Sequence[Desk], taps: bool, drive: Drive) -> Bench:
    names, parts, prior = linear_columns(linear, desks, taps)
    e = np.concatenate([(d.smoothed.innovations[d.skip:] * d.weight[:, None]).ravel() for d in desks])
    matrix = np.concatenate(parts, axis=1).T
    norm = np.linalg.norm(matrix, axis=0)
    keep = norm > 1e-12 * max(float(norm.max()), 1e-300)
    matrix, prior = matrix[:, keep], prior[keep]
    names = [n for n, k in zip(names, keep, strict=True) if k]
    # a column with a prior of its own may only take what the prior allows: rows of the prior below the data
    if matrix.shape[1] <= FEW:
        sd = np.where(np.isfinite(prior), prior, 1e6 / norm[keep])
        tall = np.concatenate([matrix * sd, np.eye(matrix.shape[1])])
        left, values, right = np.linalg.svd(tall, full_matrices=False)
        basis, vectors = left[:len(matrix), values > 1e-7 * values[0]], right.T
        inner = left[:len(matrix)].T @ e
    else:
        # by the normal matrix, since there are hundreds of columns where there are many channels and modes; the rows of the prior keep its
        # smallest eigenvalue at one
        sd = np.where(np.isfinite(prior), prior, 1e4 / norm[keep])
        scaled = matrix * sd
        squares, vectors = np.linalg.eigh(scaled.T @ scaled + np.eye(matrix.shape[1]))
        values = np.sqrt(squares)
        basis = scaled @ (vectors / values)
        inner = basis.T @ e
    coefficients = sd * (vectors @ (inner / values))
    block = _blocks(linear, desks)
    part = np.concatenate([np.full((d.n - d.skip) * len(d.trial.recording.channels), d.part) for d in desks])
    return Bench(linear, tuple(desks), e, np.ascontiguousarray(basis), block,
                 np.asarray(np.bincount(block, weights=part), dtype=np.float64), tuple(names), coefficients,
                 drive)


def linear_columns(linear: Linear, desks: Sequence[Desk], taps: bool) -> tuple[list[str], list[Array], Array]:
    """Names, whitened responses per record (k, N_i), and prior standard deviations (inf: none) of everything linear."""
    model = linear.model
    m, inputs = model.modes, list(model.inputs)
    shared: list[str] = [f"{kind}[{k + 1}]" for kind in ("stiffness", "damping") for k in range(m)]
    shared += [f"{kind}[{name}]" for name in inputs for kind in ("gain", "direct", *(f"tap{j}" for j in _shifts(taps)))]
    channels = list(dict.fromkeys((c.location, c.quantity) for d in desks for c in d.trial.recording.channels))
    shapes = [(c, k) for c in range(len(channels)) for k in range(m)] if len(channels) * m > 1 else []
    shared += [f"shape[{channels[c][0]},{k + 1}{part}]" for part in ("", ",quadrature") for c, k in shapes]
    own = [f"offset[{d.trial.name},{x}]" for d in desks for x in ("force", *(c.name for c in d.trial.recording.channels))]
    remembered = [d for d in desks if d.skip >= d.n // 5]   # the filter has not forgotten its start where counting begins
    starts = [f"start[{d.trial.name},{k + 1}]" for d in remembered for k in range(2 * m)]
    names = shared + own + starts
    parts = []
    for i, d in enumerate(desks):
        part = np.zeros((len(names), (d.n - d.skip) * len(d.trial.recording.channels)))
        _modal_columns(part, d, m)
        at = 2 * m
        for name in inputs:
            at = _force_columns(part, at, d, model, name, taps)
        motions = (d.smoothed.u, d.smoothed.v, d.smoothed.a, -linear.modal.stiffness * d.smoothed.v)
        for quadrature in (0, 1):
            for c, k in shapes:
                for j, channel in enumerate(d.trial.recording.channels):
                    if (channel.location, channel.quantity) == channels[c]:
                        z = motions[ORDER[channel.quantity] + quadrature][:, k] / linear.modal.omega[k] ** quadrature
                        part[at] += d.to_channel(j, np.abs(model.rows(model.sensors or model.locations)[:, k]).max() * z[None])[0]
                at += 1
        for other in range(len(desks)):
            count = 1 + len(desks[other].trial.recording.channels)
            if other == i:
                _offset_columns(part[at:at + count], d, model)
            at += count
        for d_other in remembered:
            if d_other is d:
                part[at:at + 2 * m] = _start_columns(d, linear)
            at += 2 * m
        parts.append(part)
    prior = np.array([SHAPE_SD if n.startswith("shape") else np.inf for n in names])
    return names, parts, prior


def _shifts(taps: bool) -> tuple[int, ...]:
    return tuple(j for j in range(-TAPS, TAPS + 1) if j) if taps else ()


def _modal_columns(part: Array, d: Desk, m: int) -> None:
    for k in range(m):
        row = np.eye(m)[k]
        part[k], part[m + k] = d.to_force(row, -d.smoothed.u[None, :, k])[0], d.to_force(row, -d.smoothed.v[None, :, k])[0]


def _force_columns(part: Array, at: int, d: Desk, model: ModalModel, name: str, taps: bool) -> int:
    """Gain, feed-through and shifted copies of one measured force; gives the next free column."""
    record = d.trial.recording
    row = model.rows([name])[0]
    F = sum((record.force[:, i] for i, c in enumerate(record.inputs) if c.location == name), np.zeros(record.n))
    part[at] = d.to_force(row, F[None])[0]
    flexible = max(range(len(record.channels)), key=lambda j: float(np.abs(model.rows([record.channels[j].location])[0] @ row)))
    part[at + 1] = d.to_channel(flexible, F[None])[0]
    at += 2
    for j in _shifts(taps):
        moved = np.zeros_like(F)
        if j > 0:
            moved[j:] = F[:-j]
        else:
            moved[:j] = F[-j:]
        part[at] = d.to_force(row, moved[None])[0]
        at += 1
    return at


def _offset_columns(part: Array, d: Desk, model: ModalModel) -> None:
    one = np.ones((1, d.n))
    row = model.rows([d.trial.recording.inputs[0].location])[0] if not d.trial.recording.free else np.zeros(model.modes)
    part[0] = d.to_force(row, one)[0]
    for j in range(len(d.trial.recording.channels)):
        part[1 + j] = d.to_channel(j, one)[0]


def _start_columns(d: Desk, linear: Linear) -> Array:
    """What another state at the first sample would do: free vibrations (2 m, ...) of the linear model seen by the channels."""
    record, out = d.trial.recording, []
    rows = linear.rows(record.channels)
    for mode, (k, c) in enumerate(zip(linear.modal.stiffness, linear.modal.damping, strict=True)):
        root = np.sqrt(complex(c * c / 4 - k))
        poles = (-c / 2 + root, -c / 2 - root)
        for part in (0, 1):
            wave = np.zeros((1, (d.n - d.skip) * len(record.channels)))
            for j, channel in enumerate(record.channels):
                order = ORDER[channel.quantity]
                if abs(root) < 1e-9:
                    free = ((1.0, 0.0, 0.0), (record.time, 1.0, 0.0))[part][order] + 0.0 * record.time
                elif root.imag:
                    vibration = np.exp(poles[0] * record.time) * poles[0] ** order
                    free = vibration.imag if part else vibration.real
                else:
                    free = (np.exp(poles[part] * record.time) * poles[part] ** order).real
                wave += d.to_channel(j, rows[j, mode] * free[None])
            out.append(wave[0])
    return np.array(out)


def _blocks(linear: Linear, desks: Sequence[Desk]) -> NDArray[np.intp]:
    """Block of every entry: contiguous, about equally long, none shorter than some cycles, none across records."""
    total = sum((d.n - d.skip) * d.trial.recording.dt for d in desks)
    elastic = linear.modal.omega[linear.modal.omega > 1e-3]
    cycle = 2 * np.pi / float(elastic[0]) if elastic.size else 0.0
    length = max(total / BLOCKS, LEAST_CYCLES * cycle)
    out, first = [], 0
    for d in desks:
        n = d.n - d.skip
        count = max(1, round(n * d.trial.recording.dt / length))
        labels = first + np.minimum(np.arange(n) * count // n, count - 1)
        first += count
        out.append(np.repeat(labels, len(d.trial.recording.channels)))
    return np.concatenate(out).astype(np.intp)
