"""Units: factors against their definitions, dimension checks, and refusal of anything that would have to be guessed."""

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.units import EXAMPLES, to_si, unit_factor


@pytest.mark.parametrize(("unit", "quantity", "factor"), [
    ("s", "time", 1.0), ("ms", "time", 1e-3), ("µs", "time", 1e-6), ("min", "time", 60.0), ("h", "time", 3600.0),
    ("m/s^2", "acceleration", 1.0), ("m/s²", "acceleration", 1.0), ("m s^-2", "acceleration", 1.0), ("m·s⁻²", "acceleration", 1.0),
    ("m/s2", "acceleration", 1.0), ("mm/s^2", "acceleration", 1e-3), ("m/(s s)", "acceleration", 1.0),
    ("g", "acceleration", 9.80665), ("gn", "acceleration", 9.80665), ("mg", "acceleration", 9.80665e-3),
    ("in/s^2", "acceleration", 0.0254), ("ft/s^2", "acceleration", 0.3048), ("Gal", "acceleration", 0.01),
    ("mm/s", "velocity", 1e-3), ("in/s", "velocity", 0.0254), ("km/h", "velocity", 1 / 3.6), ("m s-1", "velocity", 1.0),
    ("um", "displacement", 1e-6), ("mil", "displacement", 2.54e-5), ("in", "displacement", 0.0254), ("nm", "displacement", 1e-9),
    ("kN", "force", 1e3), ("lbf", "force", 4.4482216152605), ("kgf", "force", 9.80665), ("V", "voltage", 1.0), ("mV", "voltage", 1e-3),
])
def test_factors(unit: str, quantity: str, factor: float) -> None:
    assert unit_factor(unit, quantity) == pytest.approx(factor, rel=1e-14)


@pytest.mark.parametrize(("unit", "quantity"), [
    ("N", "acceleration"), ("g", "force"), ("m/s", "acceleration"), ("m", "velocity"), ("V", "displacement"), ("m/s^2", "time"),
])
def test_wrong_dimension_is_refused(unit: str, quantity: str) -> None:
    with pytest.raises(InputError, match="but the quantity is"):
        unit_factor(unit, quantity)


UNKNOWN = ["", "  ", "G/", "/s", "m//s", "m/s/s", "meter", "KN", "kg", "mmin", "m^0", "m^10", "m/s^2 pk", "%", "m**2"]


@pytest.mark.parametrize("unit", UNKNOWN)
def test_unknown_unit_lists_what_is_known(unit: str) -> None:
    with pytest.raises(InputError) as caught:
        unit_factor(unit, "acceleration")
    assert EXAMPLES["acceleration"] in str(caught.value) and str(caught.value).count("\n") == 0


def test_every_example_is_accepted() -> None:
    for quantity, examples in EXAMPLES.items():
        assert all(unit_factor(unit.strip(), quantity) > 0 for unit in examples.split(","))


def test_unknown_quantity_is_the_callers_error() -> None:
    with pytest.raises(ValueError, match="quantity must be one of"):
        unit_factor("m", "length")


def test_values_keep_their_shape() -> None:
    values = np.arange(6).reshape(3, 2)
    out = to_si(values, "mm", "displacement")
    assert out.dtype == float and np.array_equal(out, values * 1e-3)
