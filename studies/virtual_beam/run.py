"""The study from the solid model on, in order."""

from __future__ import annotations

import json
import time

from studies.virtual_beam import linear_steps
from studies.virtual_beam.study import Book, Settings, solid_of
from studies.virtual_beam.table import write


def run(settings: Settings) -> Book:
    """Everything; figures, ``table.md`` and ``numbers.json`` go to ``settings.out``."""
    start = time.perf_counter()
    settings.out.mkdir(parents=True, exist_ok=True)
    book = Book(settings)
    with book.step("solid model"):
        solid = solid_of(settings)
    with book.step("frequencies (Table 2)"):
        linear_steps.frequencies(book, solid)
    with book.step("reductions (Table 2, Fig. 4)"):
        linear_steps.reductions(book, solid)
    with book.step("updating (Tables 5, 6)"):
        linear_steps.updating(book, solid)
    total = time.perf_counter() - start
    book.notes.append(f"{'Fast variant (coarse mesh): numbers have the tolerances of tests/studies. ' if settings.fast else ''}"
                      f"Seed {settings.seed}; {total:.0f} s: " + ", ".join(f"{k} {v:.0f}" for k, v in book.seconds.items()))
    write(book.rows, book.notes, settings.out / "table.md")
    (settings.out / "numbers.json").write_text(json.dumps(book.numbers, indent=1) + "\n", encoding="utf-8")
    return book
