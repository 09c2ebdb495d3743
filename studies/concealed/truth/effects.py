"""Draw one missing effect and tune it to its target: the change it makes as a fraction of the high-level response."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import catalogue
from .beams import Assembled
from .campaign import FS, Campaign, Local, Truth, unsteadiness
from .catalogue import Place
from .channels import Tap, apply, multiplier
from .modes import Plant, plant
from .modulation import draw_modulation
from .response import Law, steady

Course = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Mod:
    """A change of the matrices: ``spring`` (delta N/m), ``mass`` (kg) or ``resonator`` (kg, with Hz and ratio per stage)."""

    kind: str
    place: str
    amount: float
    stages: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class Effect:
    """One missing effect, tuned.  ``achieved`` and ``target`` are fractions of the high-level response."""

    cls: str
    loc: str
    target: float
    achieved: float
    formula: str
    params: dict[str, Any]
    locals: tuple[Local, ...] = ()
    taps: tuple[Tap, ...] = ()
    mods: tuple[Mod, ...] = ()


@dataclass(frozen=True)
class Bench:
    """What tuning needs: the base structure, its plant, one high-level period and the linear response to it."""

    assembled: Assembled
    damping: Callable[[np.ndarray], np.ndarray]
    plant: Plant
    campaign: Campaign
    force: np.ndarray
    accel: np.ndarray
    joints: tuple[str, ...]
    own: dict[str, float]
    sensors: int
    joint_sd: float
    seed: int
    late_start: float
    places: dict[str, Place] = field(default_factory=dict)

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.accel**2)))


def modified(model: Assembled, mods: tuple[Mod, ...]) -> tuple[Assembled, np.ndarray | None]:
    """``model`` with ``mods`` built in; resonators append degrees of freedom.  Also their dashpots as a matrix (N, N) or None."""
    extra = sum(len(m.stages) for m in mods)
    N = model.M.shape[0]
    M, K = np.zeros((N + extra, N + extra)), np.zeros((N + extra, N + extra))
    M[:N, :N], K[:N, :N] = model.M, model.K
    C = np.zeros_like(K)
    vectors = {n: np.r_[v, np.full(extra, 1.0 if n == "BASE" else 0.0)] for n, v in model.vectors.items()}
    at = N
    for mod in mods:
        b = vectors[mod.place]
        if mod.kind == "spring":
            K += mod.amount * np.outer(b, b)
        elif mod.kind == "mass":
            M += mod.amount * np.outer(b, b)
            along = np.roll(b, -1)  # the axial motion of the same node, one degree of freedom before the transverse one
            M += mod.amount * np.outer(along, along)
        else:
            below = b.copy()
            for mass, hz, ratio in mod.stages:
                tip = np.zeros(N + extra)
                tip[at] = 1.0
                k = mass * (2 * np.pi * hz) ** 2
                M[at, at] += mass
                K += k * np.outer(tip - below, tip - below)
                C += 2 * ratio * np.sqrt(k * mass) * np.outer(tip - below, tip - below)
                below, at = tip, at + 1
    return replace(model, M=M, K=K, vectors=vectors), (C if extra else None)


def rebuilt(bench: Bench, mods: tuple[Mod, ...]) -> Plant:
    """Plant of the base structure with ``mods``."""
    if not mods:
        return bench.plant
    model, C = modified(bench.assembled, mods)
    return plant(model, bench.damping, extra_C=C)


def truth_of(bench: Bench, effects: tuple[Effect, ...]) -> Truth:
    """The truth with all ``effects`` at once."""
    base = rebuilt(bench, tuple(m for e in effects for m in e.mods))
    return Truth(base, tuple(x for e in effects for x in e.locals), tuple(t for e in effects for t in e.taps), bench.sensors, bench.seed)


def place(bench: Bench, name: str) -> Place:
    """Linear motion and stiffness at ``name`` under the high level."""
    d = steady(bench.plant, bench.force, FS, [name], "SHAKER", FS, 0)[:, 0]
    v = steady(bench.plant, bench.force, FS, [name], "SHAKER", FS, 1)[:, 0]
    compliance = bench.plant.receptance([name], [name], np.array([1e-3 + 0j]))[0, 0, 0].real
    return Place(name, float(np.std(d)), float(np.std(v)), bench.own.get(name, 0.0), 1.0 / compliance)


def draw_effect(
    cls: str, target: float, bench: Bench, rng: np.random.Generator, conceal: str | None, hidden: tuple[str, ...], taken: tuple[str, ...]
) -> Effect:
    """Draw and tune one effect of ``cls``; ``hidden`` joints are preferred when the concealment says so, ``taken`` places avoided."""
    if cls in catalogue.NONLINEAR:
        return _local(cls, "", target, bench, rng, conceal, hidden, taken)
    if cls in catalogue.LINEAR:
        return _matrix(cls, target, bench, rng, conceal, hidden, taken)
    if cls == "other":
        kind = str(rng.choice(catalogue.OTHER_KINDS, p=[0.25, 0.25, 0.14, 0.14, 0.12, 0.10]))
        if kind in ("parametric", "relaxation", "telegraph"):
            return _local(cls, kind, target, bench, rng, conceal, hidden, taken)
        return _tap(cls, kind, target, bench, rng, taken)
    return _tap(cls, "", target, bench, rng, taken)


def _local(
    cls: str,
    kind: str,
    target: float,
    bench: Bench,
    rng: np.random.Generator,
    conceal: str | None,
    hidden: tuple[str, ...],
    taken: tuple[str, ...],
) -> Effect:
    candidates = [c for c in catalogue.places_for(cls, list(bench.joints), bench.own, kind) if c not in taken]
    if conceal == "hidden_joint":
        candidates = [c for c in candidates if c in hidden] or candidates
    rare = conceal == "rare" and cls in catalogue.MAY_BE_RARE
    best: Effect | None = None
    for name in rng.permutation(candidates)[:4]:
        at = place(bench, str(name))
        formula = catalogue.draw_formula(cls, rng, at, rare, kind)
        course = draw_modulation(formula.name, rng, bench.late_start, bench.campaign.band) if formula.kind == 0 else None
        found = _steady(cls, kind, target, bench, formula, at, course)
        if best is None or abs(np.log(found.achieved / target)) < abs(np.log(best.achieved / target)):
            best = found
        if abs(np.log(best.achieved / target)) < 0.25:
            break
    assert best is not None
    return best


def _steady(cls: str, kind: str, target: float, bench: Bench, formula: catalogue.Formula, at: Place, course: Course | None) -> Effect:
    """Tuned effect whose response still repeats with the force: strong laws that go subharmonic or chaotic are halved."""
    aim = target
    for _ in range(4):
        found = _tuned(cls, kind, aim, bench, formula, at, course)
        if course is not None:
            break
        try:
            extra = Truth(bench.plant, found.locals, (), bench.sensors, 0).periodic_extra(bench.force, 40.0, 3, 2)
            if unsteadiness(extra, bench.force.size) < 2e-3 * bench.rms:
                break
        except FloatingPointError:
            pass  # as little use as a response that does not repeat
        aim *= 0.5
    return replace(found, target=target)


def _tuned(cls: str, kind: str, target: float, bench: Bench, formula: catalogue.Formula, at: Place, course: Course | None) -> Effect:
    """Bisect the formula's knob (in its logarithm) until the change meets the target; the best reachable value is kept."""

    def effect(knob: float, achieved: float) -> Effect:
        params = {
            "knob": knob,
            "params": list(formula.build(knob)),
            "d_rms": at.d,
            "v_rms": at.v,
            "k_static": at.k_static,
            "k_own": at.k_own,
        }
        if kind:
            params["kind"] = kind
        law = Law(at.name, formula.kind, formula.build(knob))
        return Effect(cls, at.name, target, achieved, formula.name, params, (Local(law, course),))

    def strength(knob: float) -> float:
        truth = Truth(bench.plant, effect(knob, 0.0).locals, (), bench.sensors, 0)
        start = bench.late_start if cls == "stiffness_drift" else 40.0
        try:
            extra = truth.periodic_extra(bench.force, start, 1, 1)
        except (FloatingPointError, OverflowError):
            return np.inf
        value = float(np.sqrt(np.mean(extra**2))) / bench.rms
        return value if np.isfinite(value) else np.inf

    low, high = formula.limits
    low = max(low, formula.start * 1e-6)
    knob, tried = float(np.clip(formula.start, low, high)), []
    for _ in range(9):
        value = max(strength(knob), 1e-12)
        tried.append((abs(np.log(value / target)) if np.isfinite(value) else 1e9, knob, value))
        if abs(np.log(value / target)) < 0.04:
            break
        too_much = (value > target) == formula.rising
        if too_much:
            high = min(high, knob)
        else:
            low = max(low, knob)
        guess = knob * (target / value) ** (1.0 if formula.rising else -0.7) if np.isfinite(value) else np.sqrt(low * knob)
        guess = float(np.clip(guess, knob / 30, knob * 30))
        knob = guess if low < guess < high else float(np.sqrt(low * high)) if tried[-1][1] not in (low, high) or len(tried) > 1 else guess
        knob = float(np.clip(knob, formula.limits[0], formula.limits[1]))
    _, knob, value = min(tried)
    return effect(knob, value)


def _matrix(
    cls: str, target: float, bench: Bench, rng: np.random.Generator, conceal: str | None, hidden: tuple[str, ...], taken: tuple[str, ...]
) -> Effect:
    """Linear structural effects: rebuild the matrices until the steady response changes by the target."""
    if cls == "linear_stiffness":
        candidates = [c for c in bench.joints if bench.own.get(c, 0.0) > 0 and c not in taken]
        if conceal == "hidden_joint":
            candidates = [c for c in candidates if c in hidden] or candidates
        direction = float(rng.choice([-1.0, 1.0]))
        formula = "loosened" if direction < 0 else "stiffer"
    else:
        candidates = [f"P{i + 1}" for i in range(bench.sensors)] + ["SHAKER"]
        direction = 1.0
        formula = "rigid" if cls == "added_mass" else str(rng.choice(["one_stage", "two_stages"]))
    hz = float(np.exp(rng.uniform(np.log(1.8 * bench.campaign.band[0]), np.log(0.8 * bench.campaign.band[1]))))
    ratios, split = rng.uniform(0.005, 0.02, 2), rng.uniform(1.4, 2.2)
    total = float(np.trace(bench.assembled.M)) / 3.0

    def mods(name: str, knob: float) -> tuple[Mod, ...]:
        if cls == "linear_stiffness":
            return (Mod("spring", name, bench.own[name] * (np.exp(direction * knob) - 1.0)),)
        if cls == "added_mass":
            return (Mod("mass", name, knob * total),)
        stages = (
            ((knob * total, hz, ratios[0]),)
            if formula == "one_stage"
            else ((knob * total, hz, ratios[0]), (0.4 * knob * total, hz * split, ratios[1]))
        )
        return (Mod("resonator", name, knob * total, stages),)

    names = [f"S{i + 1}" for i in range(bench.sensors)]

    def strength(name: str, knob: float) -> float:
        new = steady(rebuilt(bench, mods(name, knob)), bench.force, FS, names, "SHAKER", FS, 2)
        return float(np.sqrt(np.mean((new - bench.accel) ** 2))) / bench.rms

    # Three tolerances is the least that counts as missing; the achieved strength is recorded as it is.
    floor, roof = (3.0 * bench.joint_sd, 6.0) if cls == "linear_stiffness" else (1e-6, 0.4)
    best: tuple[float, str, float, float] | None = None
    for name in rng.permutation(candidates)[:4]:
        knob, low, high = (0.5 if cls == "linear_stiffness" else 0.01), floor, roof
        for _ in range(8):
            knob = float(np.clip(knob, low, high))
            value = strength(str(name), knob)
            score = abs(np.log(value / target))
            if best is None or score < best[0]:
                best = (score, str(name), knob, value)
            if score < 0.04 or (knob == low and value > target) or (knob == high and value < target):
                break
            if value > target:
                high = knob
            else:
                low = knob
            guess = knob * target / value
            knob = guess if low < guess < high else float(np.sqrt(low * high))
        if best[0] < 0.25:
            break
    assert best is not None
    _, name, knob, value = best
    done = mods(name, knob)
    params: dict[str, Any] = {"amount": done[0].amount, "stages": [list(s) for s in done[0].stages]}
    if cls == "linear_stiffness":
        params["factor"] = float(np.exp(direction * knob))
    return Effect(cls, name, target, value, formula, params, (), (), done)


def _tap(cls: str, kind: str, target: float, bench: Bench, rng: np.random.Generator, taken: tuple[str, ...]) -> Effect:
    """Channel effects; single-channel ones are measured against that channel's own response."""
    free = [i for i in range(bench.sensors) if f"S{i + 1}" not in taken]
    channel = int(rng.choice(free))
    if cls in catalogue.INPUT or kind == "cell_curvature":
        channel, loc = -1, "FORCE"
    else:
        loc = f"S{channel + 1}"
    own = float(np.std(bench.accel[:, channel])) if channel >= 0 else bench.rms
    tap = _draw_tap(cls, kind, target, bench, rng, channel, own)
    if tap.channel == -2:
        loc = "BASE" if cls == "base_motion" else "ALL_SENSORS"
        own = bench.rms
    direct = multiplier(tap) is None and tap.formula in ("walk", "warm_up", "sway", "hum")
    amount = target * own if direct else _tune_tap(tap, target, bench, own)
    tap = replace(tap, amount=amount)
    params: dict[str, Any] = {"amount": amount, **{k: v for k, v in tap.params.items()}}
    if kind:
        params["kind"] = kind
    achieved = target if direct else _tap_strength(tap, bench, own)
    return Effect(cls, loc, target, achieved, tap.formula, params, (), (tap,))


def _draw_tap(cls: str, kind: str, target: float, bench: Bench, rng: np.random.Generator, channel: int, own: float) -> Tap:
    sign = float(rng.choice([-1.0, 1.0]))
    if cls in ("force_gain", "sensor_gain"):
        return Tap(str(rng.choice(["gain", "tilted_gain"])), channel, sign * 0.1, {"tilt": float(rng.uniform(-0.3, 0.3))})
    if cls in ("force_delay", "sensor_delay"):
        return Tap(str(rng.choice(["delay", "lag", "allpass"])), channel, 1e-5)
    if cls == "sensor_drift":
        return Tap(
            str(rng.choice(["walk", "warm_up", "sway"])),
            channel,
            1.0,
            {"cutoff": float(rng.uniform(1.0, 3.5)), "tau": float(rng.uniform(1.5, 6.0)), "hz": float(rng.uniform(0.3, 2.0))},
        )
    if cls == "clipping":
        return Tap(str(rng.choice(["hard_clip", "soft_clip", "uneven_clip"])), channel, 2.0 * own)
    if cls == "mains_hum":
        everywhere = bool(rng.random() < 0.5)
        weights = rng.uniform(0.4, 1.4, bench.sensors) * rng.choice([-1, 1], bench.sensors) if everywhere else np.zeros(bench.sensors)
        if everywhere:
            weights = weights / np.sqrt(np.mean(weights**2))
        else:
            weights[channel] = 1.0
        return Tap(
            "hum",
            -2 if everywhere else channel,
            1.0,
            {
                "mains": 50.0,
                "weights": [float(w) for w in weights],
                "shares": [1.0, float(rng.uniform(0.05, 0.5)), float(rng.uniform(0.1, 0.6))],
            },
            in_noise_record=bool(rng.random() < 0.5),
        )
    if cls == "base_motion":
        low = float(rng.uniform(12, 60))
        return Tap(
            "base",
            -2,
            1.0,
            {"band": [low, float(low + rng.uniform(60, 500))], "slope": float(rng.uniform(0.0, 1.2))},
            in_noise_record=bool(rng.random() < 0.5),
        )
    if kind == "crosstalk":
        source = int(rng.choice([i for i in range(-1, bench.sensors) if i != channel]))
        return Tap("crosstalk", channel, sign * 0.1, {"source": source})
    if kind == "dropouts":
        length = float(rng.uniform(0.002, 0.01))
        # Enough of the time is touched for the target to be reached with part of the signal lost.
        return Tap("dropouts", channel, 0.7, {"length": length, "rate": float(np.clip(2.0 * target**2, 0.02, 0.3)) / length})
    return Tap("cell_curvature", -1, sign * 0.1, {"rms": float(np.std(bench.force))})


def _tap_strength(tap: Tap, bench: Bench, own: float) -> float:
    """Change (fraction) of the response, or for the force cell of the force read as response."""
    rng = np.random.default_rng([bench.seed, 7])
    accel, force = np.tile(bench.accel, (3, 1)), np.tile(bench.force, 3)
    new, cell = apply(tap, accel, force, FS, 40.0, rng, bench.plant, False)
    if tap.channel == -1:
        # A force misread by X changes the response expected from it by X, line by line.
        ratio = np.fft.rfft(cell - force)[::3]
        line = np.abs(np.fft.rfft(force)[::3])
        weight = (np.abs(np.fft.rfft(bench.accel, axis=0)) ** 2).sum(axis=1)
        lit = line > 1e-3 * line.max()
        if tap.formula == "cell_curvature":
            return float(np.std(cell - force) / np.std(force))
        return float(np.sqrt(np.sum(np.abs(ratio[lit] / line[lit]) ** 2 * weight[lit]) / weight[lit].sum()))
    if tap.channel == -2:
        return float(np.sqrt(np.mean((new - accel) ** 2)) / own)
    return float(np.sqrt(np.mean((new[:, tap.channel] - accel[:, tap.channel]) ** 2)) / own)


def _tune_tap(tap: Tap, target: float, bench: Bench, own: float) -> float:
    """Amount of a tap that reaches the target: secant for nearly proportional ones, bisection for clipping."""
    if "clip" in tap.formula:
        low, high = 0.2 * own, 6.0 * own
        for _ in range(40):
            middle = np.sqrt(low * high)
            low, high = (middle, high) if _tap_strength(replace(tap, amount=middle), bench, own) > target else (low, middle)
        return float(np.sqrt(low * high))
    amount = tap.amount
    for _ in range(8):
        value = max(_tap_strength(replace(tap, amount=amount), bench, own), 1e-12)
        if abs(np.log(value / target)) < 0.005:
            break
        amount = float(amount * np.clip(target / value, 0.02, 50.0))
        if tap.formula == "dropouts":
            amount = min(amount, 1.0)
    return amount
