"""Terms and parameters check themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.parameter import Param


@pytest.mark.parametrize(("change", "message"), [
    ({"params": (Param("c", "N", "coefficient"), Param("c", "N", "coefficient"))}, "names repeat"),
    ({"params": (Param("c", "N", "coefficient"), Param("d", "N", "coefficient"))}, "exactly one coefficient"),
    ({"memory": "long"}, "unknown memory"),
])
def test_a_term_that_contradicts_itself_is_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(LIBRARY["cubic"], **change)


@pytest.mark.parametrize(("fields", "message"), [
    (("a", "N", "guess"), "unknown bound rule"), (("a", "N", "range", 2.0, 1.0), "below upper"),
    (("a", "N", "range", 0.0, np.inf), "finite"),
])
def test_a_parameter_without_bounds_is_refused(fields: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Param(*fields)


def test_only_coefficients_and_ranges_below_zero_are_signed() -> None:
    signed = {f"{term.name}.{p.name}" for term in LIBRARY.values() for p in term.params if p.signed}
    assert {"cubic.c", "spring.k", "bouc_wen.delta", "iwan4.chi"} <= signed
    assert not {"iwan4.f_s", "iwan4.k_t", "iwan4.beta", "clearance.d", "jenkins_prager.sigma"} & signed


def test_parameters_must_fit_the_term() -> None:
    with pytest.raises(ValueError, match=r"'iwan4': p has shape \(5, 3\), its last axis must be 4"):
        LIBRARY["iwan4"].static_force(np.zeros(7), np.zeros(7), np.zeros((5, 3)))
