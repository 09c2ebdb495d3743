"""What a test can teach: closed forms of the information, blind sensors, joints that never slip, laws that cannot be told apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.forces.library import find_term
from bayes_nlsid.model import Element
from bayes_nlsid.prediction.planning import DECADE, LEARNED, UNSEEN, MeasurementPlan, plan_test
from bayes_nlsid.structure.chains import oscillator
from bayes_nlsid.structure.modal import ModalModel

F0, ZETA = 20.0, 0.02
X = oscillator(mass=1.0, frequency=F0, zeta=ZETA, location="x")
SETTINGS = {"band": (10.0, 40.0), "noise": 0.01, "seconds": 10.0}


def plan(linear: ModalModel, elements: list[Element], values: list[float], **changes: object) -> MeasurementPlan:
    given = {"sensors": ("x",), "inputs": ("x",), "levels": (1.0,), **SETTINGS, **changes}
    return plan_test(linear, elements, values, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize(("zeta", "within"), [(ZETA, 0.02), (0.001, 0.2)])
def test_the_information_about_a_spring_is_that_of_its_transfer_function(zeta: float, within: float) -> None:
    """a = −ω² F/(k + …), so da/d ln k = k ω² H² F; noise variance and lines as stated. Frequency and damping are known here.

    A sharp resonance is moved between lines by the integrator's period error, which is all that remains: it falls with the step.
    """
    k = 2000.0
    found = plan(oscillator(mass=1.0, frequency=F0, zeta=zeta, location="x"), [Element(find_term("spring"), ("x",), excess=False)], [k],
                 band=(12.0, 40.0))
    information = found.excitations[0].information[0]
    at = found.names.index("spring[x].k")
    period = 1 / (2 * zeta * F0)
    lines = np.arange(round(12 * period), round(40 * period) + 1) / period
    omega, omega0 = 2 * np.pi * lines, 2 * np.pi * F0
    H = 1 / (omega0**2 + k - omega**2 + 2j * zeta * omega0 * omega)
    amplitude = np.sqrt(2 / len(lines))  # of each line for rms 1
    expected = np.sum((k * omega**2 * np.abs(H) ** 2 * amplitude) ** 2) * 10.0 * 28.0 / 0.01**2
    assert information[at, at] == pytest.approx(expected, rel=within)


def test_more_noise_shorter_records_and_weaker_forces_teach_less_by_the_known_factor() -> None:
    element = [Element(find_term("spring"), ("x",))]
    base = plan(X, element, [2000.0]).excitations[0].information
    for change, factor in (({"noise": 0.02}, 0.25), ({"seconds": 5.0}, 0.5), ({"levels": (2.0,)}, 4.0)):
        np.testing.assert_allclose(plan(X, element, [2000.0], **change).excitations[0].information, factor * base, rtol=1e-6)


def test_a_joint_that_does_not_slip_teaches_no_slip_force() -> None:
    element = [Element(find_term("jenkins"), ("x",))]
    found = plan(X, element, [5.0, 1e4], levels=(0.1, 3.0))
    weak, strong = (found.sd(e.information.sum(axis=0)) for e in found.excitations)
    slip = found.joint_names.index("jenkins[x].f_s")
    assert found.excitations[0].motion[0] < 5.0 / 1e4 < found.excitations[1].motion[0]
    assert weak[slip] > 0.99 * DECADE and strong[slip] < LEARNED
    assert found.ranked()[0][0].level == 3.0


def two_masses() -> ModalModel:
    """Modes (1, 1) and (1, −1) over √2, so that ``middle`` is a node of the second."""
    shapes = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 0.0], [0.0, 2.0]]) / np.sqrt(2)
    return ModalModel(2 * np.pi * np.array([15.0, 30.0]), np.full(2, 0.02), ("left", "right", "middle", "J"), shapes)


def test_a_sensor_on_a_node_comes_last() -> None:
    found = plan(two_masses(), [Element(find_term("cubic"), ("J",))], [1e8], sensors=("middle", "left"), inputs=("left", "middle"),
                 levels=(3.0,))
    assert [name for name, _ in found.sensors_for(found.excitations[0])] == ["left", "middle"]
    best, gain, _ = found.ranked()[0]
    assert best.input == "left" and gain > found.ranked()[1][1] and found.ranked()[1][1] < 0.1


def test_two_joints_that_act_alike_are_told_apart_by_nothing() -> None:
    linear = replace(two_masses(), locations=("left", "right", "K", "J"), shapes=two_masses().shapes[[0, 1, 3, 3]])
    found = plan(linear, [Element(find_term("cubic"), ("J",)), Element(find_term("cubic"), ("K",))], [1e8, 1e8], sensors=("left", "right"),
                 inputs=("left", "right"), levels=(1.0, 3.0))
    (share, parts), = found.unlearnable()
    assert share >= UNSEEN and {n for n, _ in parts} == {"cubic[J].c", "cubic[K].c"}
    assert parts[0][1] * parts[1][1] < 0  # the difference; the sum is learned
    alone = plan(linear, [Element(find_term("cubic"), ("J",))], [1e8], sensors=("left", "right"), inputs=("left",), levels=(3.0,))
    assert alone.unlearnable() == []


def test_bad_plans_are_refused() -> None:
    element = [Element(find_term("spring"), ("x",))]
    with pytest.raises(ValueError, match="no mode of the model lies between 100 and 200 Hz; its modes are at 20"):
        plan(X, element, [1.0], band=(100.0, 200.0))
    with pytest.raises(ValueError, match="must be positive"):
        plan(X, element, [-1.0])
    with pytest.raises(ValueError, match="unknown locations"):
        plan(X, element, [1.0], sensors=("y",))
    undamped = replace(X, zeta=np.zeros(1))
    with pytest.raises(ValueError, match="too little for its motion to be computed until it is steady"):
        plan(undamped, element, [1.0])
