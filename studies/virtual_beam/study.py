"""What all steps share: settings, the folder for results, the rows of the table."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from studies.virtual_beam import beam
from studies.virtual_beam.beam import Solid
from studies.virtual_beam.table import Row, write


@dataclass(frozen=True)
class Settings:
    """How much is computed. ``fast`` is a coarse mesh, short sweeps and few starts: the same story with wider tolerances."""

    fast: bool
    out: Path
    seed: int = 20230110

    def pick(self, full: int, fast: int) -> int:
        """One of two numbers."""
        return fast if self.fast else full

    @property
    def beam(self) -> beam.SolidBeam:
        """Which mesh."""
        return beam.COARSE if self.fast else beam.BEAM


@dataclass
class Book:
    """Rows, notes and times, filled step by step, and named numbers that tests look at."""

    settings: Settings
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    numbers: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, part: str, what: str, paper: str, here: str, band: str = "") -> None:
        """One row."""
        self.rows.append(Row(part, what, paper, here, band))

    def figure(self, name: str) -> Path:
        """Where a figure goes."""
        return self.settings.out / f"{name}.png"

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Say what is being done and how long it took."""
        start = time.perf_counter()
        print(f"{name} ...", flush=True)
        yield
        self.seconds[name] = time.perf_counter() - start
        print(f"{name}: {self.seconds[name]:.1f} s", flush=True)
        self.save()

    def save(self) -> None:
        """Write ``table.md`` and ``numbers.json`` as far as they go."""
        kind = "Fast variant: coarse mesh, short sweep, few starts and draws. " if self.settings.fast else ""
        took = ", ".join(f"{k} {v:.0f}" for k, v in self.seconds.items())
        own = f"{kind}Seed {self.settings.seed}; {sum(self.seconds.values()):.0f} s in all: {took}."
        write(self.rows, [own, *self.notes], self.settings.out / "table.md")
        (self.settings.out / "numbers.json").write_text(json.dumps(self.numbers, indent=1) + "\n", encoding="utf-8")


def solid_of(settings: Settings) -> Solid:
    """The solid model of the settings."""
    return beam.build(settings.beam)
