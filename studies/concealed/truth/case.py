"""One case: what is ordered, drawn, tuned and recorded."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from . import catalogue
from .beams import Assembled, assemble
from .campaign import FS, PERIOD, Campaign, NoiseModel, Truth, draw_campaign
from .draw import Scenery, draw_scenery
from .effects import Bench, Effect, draw_effect, truth_of
from .excitation import multisine
from .modes import plant
from .response import steady


@dataclass(frozen=True)
class Order:
    """What a case is to contain: classes with target strengths, concealment, tier."""

    index: int
    effects: tuple[tuple[str, float], ...]
    conceal: str | None
    burst_only: bool
    few_sensors: bool

    @property
    def tier(self) -> str:
        return "hard" if self.burst_only or self.few_sensors else "normal"


CONCEALMENTS = ("loose_prior", "noise", "rare", "hidden_joint", "one_level")
STRENGTHS = (0.3, 0.1, 0.03, 0.01)


def plan(cases: int, seed: int, hard: float = 0.15) -> list[Order]:
    """Orders of a batch by quota: 20 % nothing, 12 % doubles, 40 % concealed, ``hard`` bursts only and/or four sensors."""
    rng = np.random.default_rng([seed, 1])
    nulls, doubles = round(0.2 * cases), round(0.12 * cases)
    classes = [c for c in catalogue.CLASSES if c != "none"] + ["other", "other"]
    deck: list[str] = []
    while len(deck) < 2 * (cases + doubles):
        deck += list(rng.permutation(classes))
    # Every class walks through the strengths, each from its own start.
    starts = rng.permutation(len(catalogue.CLASSES))
    turns = {c: int(k) for c, k in zip(catalogue.CLASSES, starts, strict=True)}

    def draw() -> tuple[str, float]:
        cls = str(deck.pop())
        turns[cls] += 1
        return cls, STRENGTHS[turns[cls] % 4]

    contents: list[tuple[tuple[str, float], ...]] = []
    for i in range(cases):
        if i < nulls:
            contents.append(())
            continue
        count = 2 if i < nulls + doubles else 1
        drawn = [draw() for _ in range(count)]
        while count == 2 and drawn[0][0] == drawn[1][0]:
            drawn[1] = draw()
        contents.append(tuple(drawn))
    # Quotas within nulls and within the others alike, so that no concealment hints at an effect.
    hidden = _quota(rng, nulls, cases, 0.4)
    tough = _quota(rng, nulls, cases, hard)
    turn = {True: int(rng.integers(5)), False: int(rng.integers(5))}
    orders = []
    for i, content in enumerate(contents):
        conceal = None
        if hidden[i]:
            conceal = CONCEALMENTS[turn[i < nulls] % 5]
            turn[i < nulls] += 1
            if any(c in catalogue.MAY_BE_RARE for c, _ in content) and rng.random() < 0.4:
                conceal = "rare"
            if conceal == "rare" and content and not any(c in catalogue.MAY_BE_RARE for c, _ in content):
                conceal = str(rng.choice(["loose_prior", "noise", "hidden_joint", "one_level"]))
        kind = int(rng.integers(3)) if tough[i] else -1
        orders.append((content, conceal, kind in (0, 2), kind in (1, 2)))
    shuffled = rng.permutation(cases)
    return [Order(i, *orders[j]) for i, j in enumerate(shuffled)]


def _quota(rng: np.random.Generator, nulls: int, cases: int, share: float) -> np.ndarray:
    flags = np.zeros(cases, bool)
    for group in (np.arange(nulls), np.arange(nulls, cases)):
        flags[rng.permutation(group)[: round(share * group.size)]] = True
    return flags


@dataclass(frozen=True)
class Made:
    """A finished case in memory."""

    name: str
    order: Order
    scenery: Scenery
    nominal: Assembled
    bench: Bench
    campaign: Campaign
    effects: tuple[Effect, ...]
    truth: Truth
    noise: NoiseModel
    noise_rel: float
    clean: dict[str, tuple[np.ndarray, np.ndarray]]
    noisy: dict[str, tuple[np.ndarray, np.ndarray]]
    baseline: dict[str, tuple[np.ndarray, np.ndarray]]


def make(order: Order, seed: int) -> Made:
    """Build one case; the same order and seed give the same bytes."""
    rng = np.random.default_rng([seed, 2, order.index])
    name = "case_" + hashlib.sha256(f"{seed}-{order.index}".encode()).hexdigest()[:8]
    sensors = 4 if order.few_sensors else int(rng.integers(5, 13))
    scenery = draw_scenery(rng, sensors, order.conceal == "hidden_joint", order.conceal == "loose_prior")
    campaign = draw_campaign(rng, order.conceal == "one_level", order.burst_only)
    bench = _bench(scenery, campaign, sensors, int(rng.integers(2**62)))
    effects, truth, clean = _recorded(order, bench, campaign, rng)
    noise_rel = float(rng.uniform(0.05, 0.15) if order.conceal == "noise" else rng.uniform(0.0025, 0.01))
    quality = np.exp(0.15 * rng.standard_normal(sensors)) * np.where(rng.random(sensors) < 0.15, rng.uniform(2, 4, sensors), 1.0)
    noise = NoiseModel(
        noise_rel * bench.rms * quality,
        rng.uniform(2, 25, sensors),
        tuple((float(a), float(b)) for a, b in zip(rng.uniform(100, 900, sensors), rng.uniform(0, 1.5, sensors), strict=True)),
        float(10 ** rng.uniform(-3.3, -2.7)) * campaign.rms,
        int(rng.integers(2**62)),
    )
    plain = Truth(bench.plant, (), (), sensors, 0)
    baseline = {e.name: plain.clean(campaign, e) for e in campaign.entries} if effects else clean
    noisy = {e.name: noise.add(clean[e.name][1], clean[e.name][0], i)[::-1] for i, e in enumerate(campaign.entries)}
    nominal = assemble(scenery.nominal, scenery.nominal_mesh)
    return Made(name, order, scenery, nominal, bench, campaign, effects, truth, noise, noise_rel, clean, noisy, baseline)


def _recorded(order: Order, bench: Bench, campaign: Campaign, rng: np.random.Generator):
    """Tuned effects, the truth with them and its noise-free records; targets are halved while a record cannot be computed."""
    hidden = tuple(j for j in bench.joints if j.startswith("J"))
    for halvings in range(4):
        effects: tuple[Effect, ...] = ()
        for cls, target in order.effects:
            effects += (draw_effect(cls, target / 2**halvings, bench, rng, order.conceal, hidden, tuple(e.loc for e in effects)),)
        truth = truth_of(bench, effects)
        try:
            return effects, truth, {e.name: truth.clean(campaign, e) for e in campaign.entries}
        except FloatingPointError:
            continue
    raise FloatingPointError(f"case {order.index}: no drawn effect could be simulated; use another seed")


def _bench(scenery: Scenery, campaign: Campaign, sensors: int, seed: int) -> Bench:
    model = assemble(scenery.truth, scenery.truth_mesh)
    base = plant(model, scenery.damping)
    force = multisine(np.random.default_rng([seed, 3]), campaign.lines, campaign.rms, FS, PERIOD)
    accel = steady(base, force, FS, [f"S{i + 1}" for i in range(sensors)], "SHAKER", FS, 2)
    own = {n: float(np.trace(k)) / float(model.vectors[n] @ model.vectors[n]) for n, k in model.K_parts.items() if n in model.joint_names}
    late = max(e.start_s for e in campaign.entries if not e.sealed and e.level == 1.0)
    return Bench(
        model,
        scenery.damping,
        base,
        campaign,
        force,
        accel,
        model.joint_names,
        own,
        sensors,
        scenery.tolerances.joint_stiffness_log_sd,
        seed,
        late,
    )
