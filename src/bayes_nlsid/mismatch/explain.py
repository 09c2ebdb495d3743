"""First search: every law at every place, every linear effect everywhere, each judged by one regression.

Forces are tried on the motion of the calibrated model, with all that a linear system may absorb projected out; linear effects by
their column on the transfer function, with all calibration parameters and shape errors projected out. What comes out is a short list for
the joint estimation in ``polish``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import LinearFit
from bayes_nlsid.mismatch.catalogue import ROWS
from bayes_nlsid.mismatch.effects import DELAY, GAIN, Effect, along_period, effect_of
from bayes_nlsid.mismatch.evidence import Evidence
from bayes_nlsid.mismatch.laws import Law, Size
from bayes_nlsid.mismatch.linear import Family
from bayes_nlsid.mismatch.paths import Bed, bed
from bayes_nlsid.mismatch.shapes import accelerance
from bayes_nlsid.mismatch.spectra import repeats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@final
@dataclass(frozen=True)
class Candidate:
    """An effect with the decrease of −2 log likelihood that one regression promises.

    ``start`` carries the coefficient (in search units) and ``frequency`` (Hz) of a linear effect; ``other`` a leaking channel; ``moves``
    (P + X,) how the parameters of the linear fit that it was found by move with it.
    """

    effect: Effect
    gain: float
    start: float = 0.0
    frequency: float = 0.0
    other: int = -1
    moves: Array = field(default_factory=lambda: np.zeros(0))


@final
@dataclass(frozen=True)
class Latent:
    """Law-free force at one place: what share of the projected residual any force there could explain.

    Parameters
    ----------
    place : str
    explained : float
        Decrease of −2 log likelihood with a free force per line and record.
    share : float
        Of the energy above noise.
    force : ndarray (R, n), displacement, velocity : ndarray (R, n)
        N, m, m/s, in time.
    """

    place: str
    explained: float
    share: float
    force: Array
    displacement: Array
    velocity: Array


def sizes(paths: Bed, places: list[str], motions: Sequence[Complex] | None = None) -> dict[str, Size]:
    """Scales of motion at each place in the record where it moves most; ``motions`` (K, J) per record, the linear ones by default."""
    out = {}
    best: Array = np.zeros((len(places), 3))
    for r in range(len(paths.drive)):
        d, v = paths.in_time(paths.linear(r) if motions is None else motions[r])
        scale = np.stack([d.std(0), v.std(0), np.abs(d).max(0)], axis=1)
        best = np.where(scale[:, :1] > best[:, :1], scale, best)
    for name, row in zip(places, best, strict=True):
        out[name] = Size(*(max(float(x), 1e-30) for x in row))
    return out


def scan_forces(fam: Family, fit: LinearFit, evidence: Evidence, places: list[str], residual: Complex | None = None,
                paths: Bed | None = None, motions: Sequence[Complex] | None = None, every: bool = False
                ) -> tuple[list[Candidate], list[Latent], dict[str, Size]]:
    """All force laws and drifts at all places.

    Parameters
    ----------
    residual : (R, L, S) projected residual to explain; that of ``evidence`` by default.
    paths, motions : bed of all places and the motions (K, J) there per record on which laws are tried; by default the linear ones.
    every : return every law of a class, not only the best.
    """
    spectra = evidence.spectra
    modes = fit.fields.modes
    rows = np.array([fam.places[p] for p in places])
    paths = bed(modes, spectra, rows, fam.shaker) if paths is None else paths
    motions = [paths.linear(r) for r in range(len(spectra.names))] if motions is None else motions
    scale = sizes(paths, places, motions)
    h = accelerance(fam, modes, spectra.s, rows, fit.shape_errors)
    data = evidence.residual if residual is None else residual
    moved = [paths.in_time(D) for D in motions]
    candidates: list[Candidate] = []
    latents: list[Latent] = []
    start = spectra.starts - spectra.starts.mean()
    tau = start / max(np.abs(start).max(), 1e-9)
    total = evidence.chi2
    for j, place in enumerate(places):
        weight = np.einsum("ls,ls->l", evidence.weight, np.abs(h[:, :, j]) ** 2)
        z = np.einsum("ls,ls,rls->rl", evidence.weight, h[:, :, j].conj(), data, optimize=True)
        latents.append(_latent(evidence, place, z, weight, total, moved, j, paths))
        for row in ROWS.values():
            if row.kind == "force":
                tried = [_best_shape(evidence, law, law.shapes(scale[place]), paths, moved, j, z, weight, row.name, place)
                         for law in row.laws]
                candidates += [c for c in sorted(tried, key=lambda c: -c.gain)[:len(tried) if every else 1] if c.gain > 0]
        if np.ptp(spectra.starts) > 0:
            D = np.array([m[spectra.lines, j] for m in motions])
            # a stiffness of its own in every record: drifts may creep, jump or settle; their mean is the linear model's
            order = np.argsort(tau)
            gain, values = _regress(evidence, D[None] * np.eye(len(tau), dtype=complex)[order][:, :, None], z, weight)
            names = tuple(f"at {spectra.starts[r]:g} s" for r in order)
            candidates.append(Candidate(Effect("stiffness_drift", place, None, values - values.mean(), names, ("N/m",) * len(tau), "",
                                               tau[order]), gain))
    candidates.sort(key=lambda c: -c.gain)
    return candidates, latents, scale


def forced(fam: Family, fit: LinearFit, evidence: Evidence, place: str, size: Size, share: float) -> list[Candidate]:
    """Every force law at one place, in a middle shape and so strong that it changes the response by ``share`` of it.

    Starts for laws so strong that the motion of the linear model says nothing about them; no gain is promised.
    """
    spectra = evidence.spectra
    top = int(np.argmax(spectra.levels))
    paths = bed(fit.fields.modes, spectra, fam.places[place][None], fam.shaker)
    d, v = paths.in_time(paths.linear(top))
    h = accelerance(fam, fit.fields.modes, spectra.s, fam.places[place][None], fit.shape_errors)[:, :, 0]
    out = []
    for row in ROWS.values():
        for law in row.laws[:1] if row.kind == "force" else ():
            shapes = law.shapes(size)
            values = shapes[len(shapes) // 2].copy()
            force = along_period(law, values, d[:, 0], v[:, 0], paths.dt, paths.periodic)
            moved = np.linalg.norm(h * paths.to_lines(force[:, None])[spectra.lines])
            values[list(law.scaled)] *= share * np.linalg.norm(spectra.response[top]) / max(float(moved), 1e-300)
            out.append(Candidate(effect_of(row.name, place, law, values), 0.0))
    return out


def _best_shape(evidence: Evidence, law: Law, shapes: Array, paths: Bed, moved: list[tuple[Array, Array]], j: int, z: Complex,
                weight: Array, cls: str, place: str) -> Candidate:
    spectra = evidence.spectra
    columns = np.empty((len(shapes), len(moved), len(spectra.lines)), dtype=complex)
    unique = repeats(spectra)
    for r, (d, v) in enumerate(moved):
        if unique[r] < r:
            columns[:, r] = columns[:, unique[r]]
            continue
        g = along_period(law, shapes, d[:, j], v[:, j], paths.dt, paths.periodic)
        columns[:, r] = np.fft.rfft(g * paths.window, axis=1)[:, spectra.lines] / paths.samples
    columns = -evidence.project(columns)
    top = np.einsum("r,krl,rl->k", evidence.trust, columns.conj(), z, optimize=True).real
    bottom = np.einsum("r,l,krl->k", evidence.trust, weight, np.abs(columns) ** 2, optimize=True)
    factor = top / np.maximum(bottom, 1e-300)
    gain = 2 * top * factor
    if not law.signed:
        gain = np.where(factor > 0, gain, 0)
    best = int(np.argmax(gain))
    values = shapes[best].copy()
    values[list(law.scaled)] *= factor[best]
    return Candidate(effect_of(cls, place, law, values), float(gain[best]))


def _regress(evidence: Evidence, columns: Complex, z: Complex, weight: Array) -> tuple[float, Array]:
    """Several columns (C, R, L) of force at one place at once: gain and coefficients."""
    X = -evidence.project(columns)
    normal = np.einsum("r,l,crl,drl->cd", evidence.trust, weight, X.conj(), X, optimize=True).real
    right = np.einsum("r,crl,rl->c", evidence.trust, X.conj(), z, optimize=True).real
    normal += 1e-9 * np.trace(normal) * np.eye(len(normal)) + 1e-300 * np.eye(len(normal))
    coefficients = np.linalg.solve(normal, right)
    return float(2 * right @ coefficients), coefficients


def _latent(evidence: Evidence, place: str, z: Complex, weight: Array, total: float, moved: list[tuple[Array, Array]], j: int,
            paths: Bed) -> Latent:
    spectra = evidence.spectra
    explained = 2 * float(np.einsum("r,rl->", evidence.trust, np.abs(z) ** 2 / weight))
    free = 2 * (int(evidence.excited.sum()) * (len(z) - 1) + int((~evidence.excited).sum()) * len(z))
    above = max(total - evidence.values, 1.0)
    G = np.zeros((len(z), spectra.block // 2 + 1), dtype=complex)
    # shrinkage: where noise dominates the estimate goes to zero
    G[:, spectra.lines] = -z / weight * (1 - 1 / np.maximum(np.abs(z) ** 2 / weight, 1.0))
    force = np.fft.irfft(G * spectra.block, spectra.block, axis=1)
    step = paths.samples // spectra.block
    return Latent(place, explained - free, max(explained - free, 0.0) / above, force,
                  np.array([d[::step, j] for d, _ in moved]), np.array([v[::step, j] for _, v in moved]))


def scan_linear(fam: Family, fit: LinearFit, names: tuple[str, ...], mass: float, stiffness: dict[str, float],
                band: tuple[float, float]) -> list[Candidate]:
    """All linear effects by one column each, everything the calibration may absorb projected out.

    Parameters
    ----------
    names : names of the channels of the fit.
    mass : kg, unit of masses. stiffness : N/m per place, unit of relaxing branches.
    """
    fld, s = fit.fields, fit.s
    s2 = (s ** 2)[:, None]
    system, full = fit.system, fit.normal
    H = fit.model
    out: list[Candidate] = []

    def judge(columns: Complex, effects: list[Effect], positive: bool, frequencies: Array | None = None, other: list[int] | None = None
              ) -> None:
        gains, values, moves = system.gains(columns, full, fit.rest)
        for i, effect in enumerate(effects):
            if positive and values[i] <= 0:
                continue
            out.append(Candidate(effect, float(gains[i]), float(values[i]), 0.0 if frequencies is None else float(frequencies[i]),
                                 -1 if other is None else other[i], moves[i]))

    grid = np.exp(np.arange(np.log(0.9 * band[0]), np.log(1.15 * band[1]), 0.03))
    for place, direction in fam.points.items():
        b = direction @ fld.modes.basis[:, :fld.right.shape[1]]
        path = -s2 * (fld.left @ b) * (fld.right @ b)[:, None] * mass
        judge((path * s2)[None], [Effect("added_mass", place)], True)
        w = 2 * np.pi * grid[:, None]
        z = s ** 2 * (w ** 2 + 0.04 * w * s) / (s ** 2 + 0.04 * w * s + w ** 2)
        judge(path[None] * z[:, :, None], [Effect("unmodelled_mode", place)] * len(grid), True, grid)
    for place, direction in fam.places.items():
        b = direction @ fld.modes.basis[:, :fld.right.shape[1]]
        path = -s2 * (fld.left @ b) * (fld.right @ b)[:, None] * stiffness[place]
        corner = np.geomspace(band[0], band[1], 6)
        tau = 1 / (2 * np.pi * corner[:, None])
        judge(path[None] * (s * tau / (1 + s * tau))[:, :, None], [Effect("other", place, kind="maxwell")] * len(corner), True, corner)
    judge((-GAIN * H)[None], [Effect("force_gain", "FORCE")], False)
    judge((DELAY * s[:, None] * H)[None], [Effect("force_delay", "FORCE")], False)
    eye = np.eye(len(names))
    judge(GAIN * H[None] * eye[:, None, :], [Effect("sensor_gain", n) for n in names], False)
    judge(-DELAY * s[:, None] * H[None] * eye[:, None, :], [Effect("sensor_delay", n) for n in names], False)
    for i, name in enumerate(names):
        others = [k for k in range(len(names)) if k != i]
        if others:
            judge(np.array([GAIN * H[:, k:k + 1] * eye[i] for k in others]), [Effect("other", name, kind="crosstalk")] * len(others), False,
                  other=others)
    covariance = np.linalg.inv(full)
    for i, name in enumerate(fam.names[:len(fam.K_parts)]):
        if name in fam.places:
            precision = 1 / fam.scale_sd[i] ** 2
            released = precision * (1 - 1 / 25)
            gain = fit.theta[i] ** 2 * released / max(1 - released * covariance[i, i], 1e-6)
            out.append(Candidate(Effect("linear_stiffness", name), float(gain)))
    out.sort(key=lambda c: -c.gain)
    return out
