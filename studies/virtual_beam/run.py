"""The study from the solid model on, in order."""

from __future__ import annotations

from studies.virtual_beam import linear_steps, nonlinear_steps, prediction_steps
from studies.virtual_beam.study import Book, Settings, solid_of


def run(settings: Settings) -> Book:
    """Everything; figures, ``table.md`` and ``numbers.json`` go to ``settings.out``."""
    settings.out.mkdir(parents=True, exist_ok=True)
    book = Book(settings)
    with book.step("solid model"):
        solid = solid_of(settings)
    with book.step("frequencies (Table 2)"):
        linear_steps.frequencies(book, solid)
    with book.step("reductions (Table 2, Fig. 4)"):
        reduced = linear_steps.reductions(book, solid)
    with book.step("updating (Tables 5, 6)"):
        linear_steps.updating(book, solid)
    with book.step("backbones (Fig. 5)"):
        models = nonlinear_steps.models_of(solid, reduced)
        nonlinear_steps.backbones(book, models)
    with book.step("check of the algebra"):
        nonlinear_steps.algebra(book, models)
    with book.step("virtual tests (Fig. 6)"):
        recorded = nonlinear_steps.record(book, models)
    with book.step("virtual sensing (Fig. 6)"):
        law = nonlinear_steps.sensing(book, models, recorded)
    with book.step("fits (Tables 3, 4)"):
        found = nonlinear_steps.fits(book, models, recorded, law)
    with book.step("posteriors (Table 4)"):
        posteriors = nonlinear_steps.posteriors(book, found)
    with book.step("force maps (Fig. 7)"):
        nonlinear_steps.force_maps(book, models, recorded, found, posteriors)
    with book.step("Monte Carlo (Fig. 8)"):
        prediction_steps.monte_carlo(book, models, posteriors)
    with book.step("selection (Fig. 9)"):
        prediction_steps.selection(book, models, found)
    with book.step("validation (Fig. 10)"):
        prediction_steps.validation(book, models, recorded, posteriors)
    with book.step("response curves (Fig. 16)"):
        prediction_steps.responses(book, models, posteriors["S3"])
    return book
