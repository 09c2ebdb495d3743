"""What is recorded on the test day, and the recordings of a truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import channels, excitation
from .channels import Tap
from .modes import Plant
from .noise import coloured
from .response import Law, drive, local_forces, steady

FS = 2048.0
PERIOD = 2.0
PERIODS = 3
SETTLE = 3
STEADY = f"steady multisine, {PERIODS} periods"
BURST = "burst random from rest"
OFF = "shaker off"


@dataclass(frozen=True)
class Entry:
    """One record: its place in the day and the seed of its force."""

    name: str
    level: float
    kind: str
    start_s: float
    sealed: bool
    force_seed: int


@dataclass(frozen=True)
class Campaign:
    """Records and force of a test day; ``rms`` N is the force at level one."""

    entries: tuple[Entry, ...]
    lines: np.ndarray
    band: tuple[float, float]
    rms: float

    def force(self, entry: Entry) -> np.ndarray:
        """Applied force (n,) N; one period for multisines."""
        rng = np.random.default_rng(entry.force_seed)
        if entry.kind == STEADY:
            return excitation.multisine(rng, self.lines, self.rms * entry.level, FS, PERIOD)
        return excitation.burst(rng, self.band, self.rms * entry.level, FS, 10.0, (0.5, 6.0))


def draw_campaign(rng: np.random.Generator, one_level: bool, burst_only: bool) -> Campaign:
    """Two realisations at three levels with a repeat of the low one, a burst, two sealed records, shaker off."""
    levels = (1.0, 1.0, 1.0) if one_level else (float(rng.choice([0.08, 0.1, 0.15])), float(rng.choice([0.3, 0.35, 0.45])), 1.0)
    seeds = [int(v) for v in rng.integers(2**62, size=8)]
    steady_plan = [
        ("low_1", levels[0], 0),
        ("mid_1", levels[1], 1),
        ("high_1", 1.0, 2),
        ("high_2", 1.0, 3),
        ("mid_2", levels[1], 4),
        ("low_2", levels[0], 0),
    ]
    kind, bursts = (BURST, [("burst_1", 1.0, 5)]) if burst_only else (STEADY, [("burst_1", 1.0, 5)])
    plan = [(n.replace("_", "_burst_") if burst_only else n, lv, sd, kind, False) for n, lv, sd in steady_plan]
    plan += [(n, lv, sd, BURST, False) for n, lv, sd in bursts]
    sealed_level = float(rng.choice([0.4, 0.7])) if one_level or rng.random() < 0.3 else 1.0
    plan.append(("sealed_burst_2" if burst_only else "sealed_ms", sealed_level, 6, kind, True))
    plan.append(("sealed_burst", float(rng.choice([1.15, 1.3, 1.4])), 7, BURST, True))
    entries = [Entry(n, lv, kd, 10.0 + 15.0 * i, sealed, seeds[sd]) for i, (n, lv, sd, kd, sealed) in enumerate(plan)]
    entries.append(Entry("noise", 0.0, OFF, 0.0, False, 0))
    band = [(20.0, 800.0), (16.0, 620.0), (25.0, 720.0)][int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
    return Campaign(tuple(entries), excitation.odd_lines(rng, band, PERIOD), band, float(rng.choice([5.0, 10.0, 20.0])))


@dataclass(frozen=True)
class Local:
    """A local law and, for springs that change in time, their course over the day."""

    law: Law
    course: Callable[[np.ndarray], np.ndarray] | None = None


@dataclass(frozen=True)
class Truth:
    """A plant with everything that is missing from the nominal model."""

    plant: Plant
    locals: tuple[Local, ...]
    taps: tuple[Tap, ...]
    sensors: int
    seed: int

    def rate(self) -> float:
        """Integration rate, Hz: contacts get the higher one."""
        return 32768.0 if any(20 <= x.law.kind <= 24 for x in self.locals) else 16384.0

    def clean(self, campaign: Campaign, entry: Entry) -> tuple[np.ndarray, np.ndarray]:
        """Noise-free record as the file would hold it: ``force`` (n,) N, ``accel`` (n, s) m/s^2, channel effects included."""
        accel, force = self.structural(campaign, entry)
        for i, tap in enumerate(self.taps):
            name = sum(ord(c) * 257**k for k, c in enumerate(entry.name))
            rng = np.random.default_rng([self.seed, i, name % 2**31])
            accel, force = channels.apply(tap, accel, force, FS, entry.start_s, rng, self.plant, entry.kind == OFF)
        return force, accel

    def structural(self, campaign: Campaign, entry: Entry) -> tuple[np.ndarray, np.ndarray]:
        """True acceleration (n, s) and applied force (n,) before any channel."""
        names = [f"S{i + 1}" for i in range(self.sensors)]
        if entry.kind == OFF:
            return np.zeros((int(2 * FS), self.sensors)), np.zeros(int(2 * FS))
        force = campaign.force(entry)
        if entry.kind == STEADY:
            accel = np.tile(steady(self.plant, force, FS, names, "SHAKER", FS, 2), (PERIODS, 1))
            if self.locals:
                extra = self.periodic_extra(force, entry.start_s, SETTLE, PERIODS)
                if unsteadiness(extra, force.size) > 1e-3 * float(np.std(accel)) and all(x.course is None for x in self.locals):
                    extra = self.periodic_extra(force, entry.start_s, 3 * SETTLE, PERIODS)
                accel = accel + extra
            return accel, np.tile(force, PERIODS)
        accel = drive(self.plant, force[:, None], FS, names, ["SHAKER"], FS, 2)
        if self.locals:
            rate, places = self.rate(), [x.law.name for x in self.locals]
            d = drive(self.plant, force[:, None], FS, places, ["SHAKER"], rate, 0)
            v = drive(self.plant, force[:, None], FS, places, ["SHAKER"], rate, 1)
            reply = self._local(d, v, entry.start_s)
            accel = accel + drive(self.plant, reply, rate, names, places, FS, 2)
        return accel, force

    def _local(self, d: np.ndarray, v: np.ndarray, start: float) -> np.ndarray:
        time = start + np.arange(d.shape[0]) / self.rate()
        course = np.zeros(d.shape)
        for i, item in enumerate(self.locals):
            if item.course is not None:
                course[:, i] = item.course(time)
        return local_forces(self.plant, tuple(x.law for x in self.locals), d, v, self.rate(), course)

    def periodic_extra(self, force: np.ndarray, start: float, settle: int, keep: int) -> np.ndarray:
        """Acceleration (keep * n, s) that the local laws add to the steady response, after ``settle`` periods."""
        rate, places = self.rate(), [x.law.name for x in self.locals]
        names = [f"S{i + 1}" for i in range(self.sensors)]
        d = np.tile(steady(self.plant, force, FS, places, "SHAKER", rate, 0), (settle + keep, 1))
        v = np.tile(steady(self.plant, force, FS, places, "SHAKER", rate, 1), (settle + keep, 1))
        reply = self._local(d, v, start - settle * PERIOD)
        return drive(self.plant, reply, rate, names, places, FS, 2)[settle * force.size :]


def unsteadiness(accel: np.ndarray, period: int) -> float:
    """Rms difference (m/s^2) between the last period of ``accel`` (n, s) and the one before."""
    return float(np.sqrt(np.mean((accel[-period:] - accel[-2 * period : -period]) ** 2)))


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviation (s,) m/s^2 and colour of each channel; ``force`` N."""

    sigma: np.ndarray
    corner: np.ndarray
    bump: tuple[tuple[float, float], ...]
    force: float
    seed: int

    def add(self, accel: np.ndarray, force: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Noisy copies of a record's channels; ``index`` numbers the record."""
        rng = np.random.default_rng([self.seed, index])
        n = force.size
        noisy = accel + np.array([coloured(rng, n, FS, s, c, b) for s, c, b in zip(self.sigma, self.corner, self.bump, strict=True)]).T
        return noisy, force + coloured(rng, n, FS, self.force, 5.0, (50.0, 0.0))
