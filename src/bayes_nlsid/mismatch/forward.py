"""Forward simulation of whole recordings: joint re-estimation of linear and nonlinear parameters, and prediction of what was not used.

The model is the library's own (`Model`, elements with memory, `predict_record`); parameters and the unknown state at the first sample of
every transient are moved together by damped Gauss–Newton on the simulated channels. Loud and quiet stretches are weighted alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces import laws
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Term
from bayes_nlsid.mismatch.calibrated import Drive, Linear, observer_of
from bayes_nlsid.mismatch.campaign import RIGID, Campaign, Trial
from bayes_nlsid.mismatch.observer import observe
from bayes_nlsid.mismatch.prove import envelope
from bayes_nlsid.mismatch.seen import Seen, charge, corrected, modal_channels, modal_locations, unseen
from bayes_nlsid.mismatch.suspects import Suspect
from bayes_nlsid.model import Element, Model
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.simulation.replay import predict_record

Array = NDArray[np.float64]
EVEN = 0.05          # share of the local rms that counts as error beside the noise
START_CYCLES = 6     # of the slowest mode, from which an unknown start is estimated; not scored
AT_REST = 0.03
SAMPLES = 12_000     # of all records that a re-estimation simulates
WORK = 300_000       # the same times channels and modes
SHIFT = 1e-5
FREQUENCIES = (0.6, 1.6)   # of the linear part beside a law, over those as delivered and those of the best linear model
DAMPING = (0.03, 30.0)
CLOSE = 4e-3         # error of the integrator, relative, that is accepted here
OFFSET = Term("constant", "f", (Param("f", "N", "coefficient", meaning="constant force"),), partial(laws.displacement_even, power=0.0),
              partial(laws.displacement_even_slope, power=0.0), parity="even",
              meaning="constant force: offset of a force channel, weight, static load")
"""c |q|^0, a law that the compiled loop knows."""
COMPILED = True      # many runs follow each other
HUGE = 1e100


@final
@dataclass(frozen=True, eq=False)
class Extended:
    """A model that can run any record.

    Parameters
    ----------
    model : Model
    theta : ndarray (P,)
    kind : tuple of str (P,)
        ``log``, ``linear`` or ``held``: how each entry of theta moves.
    unit : ndarray (P,)
        Step of one for linear entries.
    seen : Seen
        Corrections of the channels that the fitted records showed.
    covariance : ndarray (P, P)
        Of the moving coordinates (zero for held ones).
    status : str
    suspects : tuple of Suspect
        Effects beside the linear model.
    low, high : ndarray (P,)
        Between which each parameter must stay.
    freed : bool
        Whether linear parameters may move and channels be corrected.
    """

    model: Model
    theta: Array
    kind: tuple[str, ...]
    unit: Array
    seen: Seen
    covariance: Array
    status: str = "ok"
    suspects: tuple[Suspect, ...] = ()
    low: Array = field(default_factory=lambda: np.array(-np.inf))
    high: Array = field(default_factory=lambda: np.array(np.inf))
    freed: bool = True

    def at(self, x: Array) -> Array:
        """Theta (K, P) for moves x (K, P) from here, clipped to what the laws admit."""
        out = np.where([k == "log" for k in self.kind], self.theta * np.exp(np.clip(x, -20, 20)), self.theta + x * self.unit)
        return np.where([k == "held" for k in self.kind], self.theta, np.clip(out, self.low, self.high))

    def draws(self, count: int, seed: int) -> Array:
        """Parameters (count, P) from the normal approximation."""
        values, vectors = np.linalg.eigh((self.covariance + self.covariance.T) / 2)   # semidefinite up to rounding
        root = vectors * np.sqrt(np.clip(values, 0.0, 25.0))
        return self.at(np.random.default_rng(seed).standard_normal((count, len(self.theta))) @ root.T)


def extended(linear: Linear, suspects: Sequence[Suspect], factors: Sequence[float], records: Sequence[Recording], freed: bool = True,
             push: float = 1.0) -> Extended:
    """The linear model with the laws of the suspects; ``freed``: whether its linear parameters may move; ``push``: size of the forces."""
    bare = linear.model
    base = replace(bare, omega=linear.modal.omega, zeta=linear.modal.zeta, locations=(*bare.locations, *modal_locations(bare.modes)),
                   shapes=np.concatenate([bare.shapes, np.eye(bare.modes)]), residual=None)
    forced = bool(base.inputs)
    elements: list[Element] = [Element(OFFSET, (base.inputs[0],), excess=False)] if forced else []
    values: list[float] = [-float(linear.offsets[0])] if forced else []
    kinds: list[str] = ["linear"] if forced else []
    units: list[float] = [1.0] if forced else []
    edges: list[tuple[float, float]] = []
    for suspect, factor in zip(suspects, factors, strict=True):
        law = suspect.law
        assert law is not None
        p = suspect.parameters(factor)
        names = [q.name for q in law.term.params]
        held = tuple((n, float(v)) for n, v, k in zip(names, p, law.free, strict=True) if k == "fixed")
        elements.append(Element(law.term, (suspect.place,), excess=law.excess, fixed=held))
        for value, kind, q, low, high in zip(p, law.free, law.term.params, *suspect.bounds, strict=True):
            if kind == "fixed":
                continue
            edges.append((float(low), float(high)))
            values.append(float(value))
            kinds.append("log" if kind == "log" and value > 0 else "linear")
            size = suspect.size
            units.append(abs(float(value)) or (size.displacement if q.unit == "m" and size is not None else 1.0))
    model = Model(base, tuple(elements), tuple(range(base.modes)), forced)
    rigid = base.omega < RIGID
    move = "log" if freed else "held"
    moves = [*("held" if r else move for r in rigid), *[move] * base.modes, *([move] if forced else []), *kinds]
    if forced and not (freed and (suspects or rigid.any())):
        # a constant force on a linear spring is a constant of the channel
        moves[2 * base.modes + 1] = "held"
    theta = np.concatenate([base.omega / (2 * np.pi), base.zeta, [linear.gain] if forced else [], values])
    unit = np.concatenate([np.ones(2 * base.modes + (1 if forced else 0)), units])
    if forced:
        unit[2 * base.modes + 1] = max(push, 1e-300)
    limits = np.array([(-np.inf, np.inf)] * (len(theta) - len(edges)) + edges)
    if not rigid.any() and freed:
        # a law must not take the place of the linear spring
        limits[:base.modes] = _around(base.frequency, linear.model.frequency, FREQUENCIES)
        limits[base.modes:2 * base.modes] = _around(base.zeta, linear.model.zeta, DAMPING)
    return Extended(model, theta, tuple(moves), unit, unseen(base, records), np.zeros((len(theta), len(theta))), suspects=tuple(suspects),
                    low=limits[:, 0], high=limits[:, 1], freed=freed)


def _around(one: Array, other: Array, reach: tuple[float, float]) -> Array:
    """Lowest and highest value (m, 2) about two sets of them."""
    return np.stack([reach[0] * np.minimum(one, other), reach[1] * np.maximum(one, other)], axis=1)


@final
@dataclass(frozen=True, eq=False)
class Task:
    """One record to be simulated: weights, what is free of its start, and steps per sample."""

    trial: Trial
    recording: Recording
    weight: Array            # (n, s)
    start: Array | None      # (2m,) or None: steady state
    spread: Array            # (2m,)
    substeps: int

    @property
    def unknown(self) -> int:
        """Number of unknown entries of the start."""
        return 0 if self.start is None else int((self.spread > 0).sum())


def task_of(linear: Linear, drive: Drive, trial: Trial, ext: Extended, most: int) -> Task:
    """The record, or its first ``most`` samples, with a first guess of the state at its beginning."""
    record = trial.recording
    if record.period is None and record.n > most:
        record = record.window(0.0, most * record.dt)
    level = np.sqrt(trial.noise ** 2 + (EVEN * envelope(record.response, record.fs)) ** 2 + (1e-3 * record.response.std(axis=0)) ** 2)
    weight = 1 / np.maximum(level, 1e-300) / np.sqrt(record.n * len(record.channels))
    start, spread = None, np.zeros(2 * linear.model.modes)
    if record.period is None or record.free:
        start, spread = first_state(linear, drive, trial)
        record = replace(record, period=None)
    u, v = (None, None) if start is None else np.split(start, 2)
    piece = record if record.period else record.window(0.0, min(record.n, 4000) * record.dt)
    found = predict_record(ext.model, ext.theta[None], piece, u0=u, v0=v, tolerance=CLOSE, compiled=COMPILED)
    return Task(trial, record, weight, start, spread, found.substeps)


def first_state(linear: Linear, drive: Drive, trial: Trial) -> tuple[Array, Array]:
    """Modal state (2m,) at the first sample by the smoother, and how large its unknown part may be."""
    record = trial.recording
    if trial.use == "sealed":
        return np.zeros(2 * linear.model.modes), np.zeros(2 * linear.model.modes)
    count = min(record.n, max(400, early_samples(linear, record)))
    part = replace(trial, recording=replace(record.window(0.0, count * record.dt), period=None))
    found = observe(observer_of(linear, part, drive), linear.response(part.recording), linear.forces(part))
    quiet = np.abs(record.response[:max(3, count // 40)]).max(axis=0) < AT_REST * np.abs(record.response).max(axis=0)
    if not record.free and quiet.all():
        return np.zeros(2 * linear.model.modes), np.zeros(2 * linear.model.modes)
    start = np.concatenate([found.u[0], found.v[0]])
    return start, np.concatenate([found.u.std(axis=0), found.v.std(axis=0)])


def early_samples(linear: Linear, record: Recording) -> int:
    """Samples from which an unknown start is estimated."""
    elastic = linear.modal.omega[linear.modal.omega > RIGID]
    if not elastic.size:
        return max(32, record.n // 25)
    return int(min(record.n // 3, max(16, np.ceil(START_CYCLES * 2 * np.pi / (float(elastic[0]) * record.dt)))))


def simulate_task(ext: Extended, task: Task, theta: Array, starts: Array) -> Array:
    """Modal motion (K, n, q, m), see `seen`, for parameters (K, P) and moves of the start (K, unknown); nan where the simulation fails."""
    u = v = None
    if task.start is not None:
        state = np.tile(task.start, (len(theta), 1))
        state[:, task.spread > 0] += starts * task.spread[task.spread > 0]
        u, v = np.split(state, 2, axis=1)
    modes = ext.model.linear.modes
    channels = modal_channels(task.recording, modes)
    record = replace(task.recording, channels=channels, response=np.zeros((task.recording.n, len(channels))))
    with np.errstate(all="ignore"):
        found = predict_record(ext.model, theta, record, u0=u, v0=v, substeps=task.substeps, compiled=COMPILED)
    values = found.values.copy()
    values[found.status == "diverged"] = np.nan
    values[found.status == "newton"] = np.nan
    return values.reshape(*values.shape[:2], -1, modes)


def estimate(linear: Linear, drive: Drive, campaign: Campaign, ext: Extended, iterations: int = 8, starts: Sequence[Array] = ()
             ) -> tuple[Extended, list[Array]]:
    """Least squares on the simulated channels of all fitted records.

    Parameters
    ----------
    linear, drive, campaign
    ext : Extended
    iterations : int
    starts : sequence of ndarray (P,)
        Other parameters to start from; the one whose simulation is closest is taken.

    Returns
    -------
    Extended
        At the optimum, with covariance widened for residuals that are correlated in time.
    list of ndarray (n, s)
        Simulated channels of the fitted records.
    """
    trials = simulated(campaign)
    wide = max(len(t.recording.channels) for t in trials) * linear.model.modes
    most = max(1500, min(SAMPLES, WORK // wide) // len(trials))
    try:
        tasks = [task_of(linear, drive, t, ext, most) for t in trials]
    except (ValueError, np.linalg.LinAlgError) as error:
        return replace(ext, status=f"not simulated: {error}"), []
    ext = _closest(ext, tasks, starts)
    moving = np.array([k != "held" for k in ext.kind])
    sizes = [t.unknown for t in tasks]
    P = int(moving.sum())

    def unpack(x: Array) -> tuple[Array, list[Array]]:
        full = np.zeros((len(x), len(ext.theta)))
        full[:, moving] = x[:, :P]
        return ext.at(full), np.split(x[:, P:], np.cumsum(sizes)[:-1], axis=1)

    def run(x: Array) -> tuple[Array, list[Array]]:
        theta, starts = unpack(x)
        motions = [simulate_task(ext, t, theta, s) for t, s in zip(tasks, starts, strict=True)]
        return np.stack([_residual(ext, tasks, [q[i] for q in motions])[0] for i in range(len(x))]), motions

    x, residual, motions, slope, status = _descend(run, P + sum(sizes), iterations)
    if not np.isfinite(residual).all():
        return replace(ext, status="the simulation failed"), []
    theta = unpack(x[None])[0][0]
    _, seen, waves = _residual(ext, tasks, [q[0] for q in motions])
    covariance = np.zeros_like(ext.covariance)
    covariance[np.ix_(moving, moving)] = _covariance(slope, residual, P)
    return replace(ext, theta=theta, seen=seen, covariance=covariance, status=status), waves


def _residual(ext: Extended, tasks: Sequence[Task], motions: Sequence[Array]) -> tuple[Array, Seen, list[Array]]:
    """Weighted errors (N,) of the channels of modal motions (n, q, m), with the corrections of the channels that make them smallest."""
    model, records = ext.model.linear, [t.recording for t in tasks]
    if not all(np.abs(q).max(initial=0.0) < HUGE for q in motions):
        return np.full(sum(r.response.size for r in records) + ext.seen.shapes.size, np.nan), ext.seen, []
    seen = corrected(model, records, [t.weight for t in tasks], motions) if ext.freed else ext.seen
    waves = [seen.wave(model, r, q) for r, q in zip(records, motions, strict=True)]
    parts = [((w - r.response) * t.weight).ravel() for w, r, t in zip(waves, records, tasks, strict=True)]
    return np.concatenate([*parts, charge(model, seen)]), seen, waves


def _closest(ext: Extended, tasks: Sequence[Task], starts: Sequence[Array]) -> Extended:
    """The extended model at its own parameters or at those of the starts, whichever simulates the records most closely."""
    if not starts:
        return ext
    thetas = np.array([ext.theta, *starts])
    motions = [simulate_task(ext, t, thetas, np.zeros((len(thetas), t.unknown))) for t in tasks]
    with np.errstate(invalid="ignore", over="ignore"):
        cost = np.array([(_residual(ext, tasks, [q[i] for q in motions])[0] ** 2).sum() for i in range(len(thetas))])
    cost = np.where(np.isfinite(cost), cost, np.inf)
    # the last start is the most settled one: taken where no simulation can be trusted
    best = int(np.argmin(cost)) if np.isfinite(cost).any() else len(thetas) - 1
    return replace(ext, theta=thetas[best])


def simulated(campaign: Campaign) -> tuple[Trial, ...]:
    """Fitted records that are simulated: all but periodic ones, loudest first, as many as the budget of samples admits (one at least)."""
    trials = sorted(campaign.used("fit"), key=lambda t: -t.level)
    chosen: list[Trial] = []
    spent = 0
    for t in trials:
        cost = t.recording.period or 0
        if not chosen or spent + cost <= SAMPLES:
            chosen.append(t)
            spent += cost
    return tuple(t for t in campaign.used("fit") if t in chosen)


def _descend(run: Any, size: int, iterations: int) -> tuple[Array, Array, list[Array], Array, str]:
    """Damped Gauss–Newton from zero; gives the point, residual, simulated waves, last derivative and status."""
    x = np.zeros(size)
    first, waves = run(x[None])
    residual, damping, status = first[0], 1e-3, "iteration limit"
    slope = np.zeros((len(residual), size))
    if not np.isfinite(residual).all():
        return x, residual, waves, slope, "the simulation failed"
    for _ in range(iterations):
        moved = run(x + SHIFT * np.eye(size))[0]
        slope = ((moved - residual) / SHIFT).T
        slope[:, ~np.isfinite(slope).all(axis=0)] = 0.0
        curvature, gradient = slope.T @ slope, slope.T @ residual
        scale = np.diag(curvature) + 1e-12 * np.diag(curvature).max() + 1e-300
        steps = []
        for factor in (0.01, 1.0, 100.0, 1e4):
            step = -np.linalg.solve(curvature + damping * factor * np.diag(scale), gradient)
            steps.append(step * min(1.0, 0.7 / max(float(np.abs(step).max()), 1e-300)))
        tried, some = run(x + np.array(steps))
        costs = np.where(np.isfinite(tried).all(axis=1), (np.nan_to_num(tried) ** 2).sum(axis=1), np.inf)
        best, cost = int(np.argmin(costs)), float(residual @ residual)
        if not costs[best] < cost:
            if damping > 1e4:
                status = "converged"
                break
            damping *= 1e4
            continue
        x, residual, waves = x + steps[best], tried[best], [w[[best]] for w in some]
        damping = float(np.clip(damping * (0.01, 1.0, 100.0, 1e4)[best], 1e-9, 1e9))
        if costs[best] > cost * (1 - 1e-4):
            status = "converged"
            break
    return x, residual, waves, slope, status


def _covariance(slope: Array, residual: Array, count: int, blocks: int = 24) -> Array:
    """Covariance of the first ``count`` coordinates, starts marginalised; the sandwich of block scores widens the usual one."""
    n, P = slope.shape
    variance = float(residual @ residual) / max(1, n - P)
    usual = np.linalg.pinv(slope.T @ slope, rcond=1e-12, hermitian=True)
    scores = np.stack([slope[b].T @ residual[b] for b in np.array_split(np.arange(n), blocks)])
    sandwich = usual @ (scores.T @ scores) @ usual
    plain = variance * usual
    ratio = np.diag(sandwich)[:count] / np.maximum(np.diag(plain)[:count], 1e-300)
    widening = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(plain[:count, :count] * np.outer(widening, widening))


def predict(linear: Linear, drive: Drive, ext: Extended, trial: Trial) -> tuple[Array, int, str]:
    """Channels (n, s) of a record that was not fitted, first scored sample, status.

    An unknown start is estimated from the first cycles, which are not scored.
    """
    early = early_samples(linear, trial.recording)
    try:
        task = task_of(linear, drive, trial, ext, trial.recording.n)
        if task.unknown:
            head = replace(task, recording=task.recording.window(0.0, early * task.recording.dt), weight=task.weight[:early])

            def run(x: Array) -> tuple[Array, list[Array]]:
                motion = simulate_task(ext, head, np.tile(ext.theta, (len(x), 1)), x)
                error = ext.seen.wave(ext.model.linear, head.recording, motion) - head.recording.response
                return (error * head.weight).reshape(len(x), -1), [motion]

            at = _descend(run, task.unknown, 6)[0]
        else:
            at = np.zeros(0)
        wave = ext.seen.wave(ext.model.linear, task.recording, simulate_task(ext, task, ext.theta[None], at[None])[0])
    except (ValueError, np.linalg.LinAlgError) as error:
        return np.full(trial.recording.response.shape, np.nan), 0, str(error)
    status = "ok" if np.isfinite(wave).all() else "the simulation failed"
    return wave, early if task.unknown else 0, status
