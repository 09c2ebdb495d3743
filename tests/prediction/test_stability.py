"""Floquet multipliers against closed forms, turning points, an independent integrator, and what a disturbance really does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayes_nlsid.model import Model
from bayes_nlsid.prediction import stability
from bayes_nlsid.prediction.continuation import response_curves
from bayes_nlsid.prediction.harmonics import SteadyForces
from bayes_nlsid.prediction.response_curve import Curve
from bayes_nlsid.structure.modal import ModalModel
from tests.simulation.problems import IWAN, beam, oscillator

W0 = 2 * np.pi * 10
C = 2e5
# the second mode close to three times the first
INTERACTING = Model(ModalModel(2 * np.pi * np.array([10.0, 30.3]), np.array([0.003, 0.003]), ("x",), np.array([[1.0, 1.0]]), ("x",), ("x",),
                               ("x",)), oscillator("cubic").elements)


def duffing(levels: list[float], zeta: float = 0.01, c: float = C) -> list[Curve]:
    return response_curves(oscillator("cubic", zeta=zeta), [c], drive="x", at="x", levels=levels, band=(6, 20))[0]


def test_one_harmonic_of_duffing_is_the_closed_form() -> None:
    """[(ω₀² − Ω² + ¾ c A²)² + (2 ζ ω₀ Ω)²] A² = F²."""
    curve = response_curves(oscillator("cubic"), [C], drive="x", at="x", levels=[5.0], band=(6, 20), harmonics=1)[0][0]
    a, w = np.abs(curve.harmonic("x")), 2 * np.pi * curve.frequency
    assert ((W0**2 - w**2 + 0.75 * C * a**2) ** 2 + (0.02 * W0 * w) ** 2) * a**2 == pytest.approx(25.0, rel=1e-5)
    # its turning points: where dΩ²/dA² of that form vanishes
    turns = np.flatnonzero(np.diff(np.sign(np.diff(curve.frequency))) != 0) + 1
    slope = (W0**2 - w**2 + 0.75 * C * a**2) * (W0**2 - w**2 + 2.25 * C * a**2) + (0.02 * W0 * w) ** 2
    assert len(turns) == 2 and all(slope[i - 1] * slope[i + 1] < 0 for i in turns)


def test_linear_modes_decay_by_their_damping() -> None:
    curve = response_curves(beam(), np.zeros(0), drive="shaker", at="tip", levels=[1.0], band=(10, 60))[0][0]
    assert curve.multiplier is not None
    assert np.abs(curve.multiplier) == pytest.approx(np.exp(-0.004 * 2 * np.pi * 20.0 / curve.frequency), rel=1e-12)
    assert curve.stable.all() and curve.lost == ""


def test_stability_changes_at_the_turning_points_of_duffing() -> None:
    for curve in duffing([0.05, 5.0, 8.0]):
        turns = np.flatnonzero(np.diff(np.sign(np.diff(curve.frequency))) != 0) + 1
        changes = np.flatnonzero(np.diff(curve.stable.astype(int)) != 0)
        assert len(changes) == len(turns) == (0 if curve.level < 1 else 2)
        assert (np.abs(changes + 0.5 - turns) <= 1.5).all()
        assert curve.lost == "" and (np.abs(curve.multiplier) >= np.exp(-0.01 * W0 / curve.frequency) * (1 - 1e-12)).all()  # Liouville
        assert curve.peak_stands("x")


@pytest.mark.parametrize("share", [0.2, 0.5, 0.55, 0.8])
def test_against_the_equation_of_disturbances(share: float) -> None:
    curve = duffing([5.0])[0]
    i = int(share * len(curve.frequency))
    w = 2 * np.pi * curve.frequency[i]

    def slope(t: float, y: np.ndarray) -> list[float]:
        q = float((curve.basis.at(np.array([w * t])) @ curve.coefficients[i, 0])[0])
        return [y[1], -0.02 * W0 * y[1] - (W0**2 + 3 * C * q**2) * y[0]]

    found = [solve_ivp(slope, (0, 2 * np.pi / w), one, rtol=1e-9, atol=1e-12).y[:, -1] for one in np.eye(2)]
    exact = np.linalg.eigvals(np.transpose(found))
    assert curve.multiplier is not None
    assert abs(curve.multiplier[i]) == pytest.approx(np.abs(exact).max(), rel=1e-5)


def test_where_modes_interact_a_disturbance_grows_as_told() -> None:
    curve = response_curves(INTERACTING, [C], drive="x", at="x", levels=[4.0], band=(8, 12), harmonics=9)[0][0]
    assert curve.lost == "a second frequency appears" and curve.multiplier is not None
    first = np.flatnonzero(~curve.stable & ~curve.folded)
    i = int(first[np.argmax(np.abs(curve.multiplier[first]))])
    growth, w = abs(curve.multiplier[i]), 2 * np.pi * curve.frequency[i]
    assert growth > 1.01
    start = _start(curve, i, w)
    runs = [_integrated(start + shift, w, 4.0, 160) for shift in (0.0, np.array([1e-9, 0, 0, 0]))]
    apart = np.linalg.norm((runs[1] - runs[0]) * [1, 1, 1 / W0, 1 / W0], axis=1)
    late = np.arange(80, 161)
    assert np.polyfit(late, np.log(apart[late]), 1)[0] == pytest.approx(np.log(growth), rel=0.1)


def _start(curve: Curve, i: int, w: float) -> np.ndarray:
    """Modal displacements and velocities at θ = 0 of the balanced motion."""
    forces = SteadyForces(INTERACTING, np.array([[C]]), curve.basis)
    f = curve.basis.complex(forces.evaluate(curve.coefficients[i:i + 1, :1], np.array([w]), np.zeros(1, dtype=int))[0])[0, 0]
    h = np.array(curve.basis.orders) * w
    push = -f
    push[curve.basis.orders.index(1)] += curve.level
    omega = INTERACTING.linear.omega[:, None]
    u = push / (omega**2 - h**2 + 2j * 0.003 * omega * h)
    return np.concatenate([u.real.sum(axis=1), (1j * h * u).real.sum(axis=1)])


def _integrated(start: np.ndarray, w: float, level: float, periods: int) -> np.ndarray:
    one, two = INTERACTING.linear.omega.tolist()

    def slope(t: float, y: np.ndarray) -> tuple[float, ...]:
        a, b, va, vb = y.tolist()
        pull = level * math.cos(w * t) - C * (a + b) ** 3
        return va, vb, pull - 0.006 * one * va - one**2 * a, pull - 0.006 * two * vb - two**2 * b

    at = 2 * np.pi / w * np.arange(periods + 1)
    return np.asarray(solve_ivp(slope, (0, at[-1]), start, method="DOP853", rtol=1e-12, atol=1e-15, t_eval=at).y.T)


def test_modes_far_above_act_as_springs_in_series(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against all modes followed in time; leaving the high ones out altogether would be wrong."""
    omega = 2 * np.pi * np.array([10.0, 260.0, 410.0])
    linear = ModalModel(omega, np.full(3, 0.01), ("x", "tip"), np.array([[1.0, 6.0, -8.0], [1.0, 0.0, 0.0]]), ("tip",), ("tip",), ("x",))
    model = Model(linear, oscillator("cubic").elements)
    options = {"drive": "tip", "at": "tip", "levels": [5.0], "band": (8.0, 20.0)}
    short = response_curves(model, [C], **options)[0][0]  # type: ignore[arg-type]
    monkeypatch.setattr(stability, "FAR", 1e9)
    whole = response_curves(model, [C], **options)[0][0]  # type: ignore[arg-type]
    assert short.multiplier is not None and whole.multiplier is not None
    assert np.abs(short.multiplier) == pytest.approx(np.abs(whole.multiplier), rel=3e-3)
    flat = replace(linear, omega=omega * np.array([1.0, 1e3, 1e3]))
    without = stability.multipliers(Model(flat, model.elements), np.array([[C]]), [whole])[0]
    assert np.abs(np.abs(without) / np.abs(whole.multiplier) - 1).max() > 3e-2


def test_friction_cannot_overshoot_and_memory_is_left_to_turning_points() -> None:
    curve = response_curves(oscillator("coulomb", zeta=0.02), [0.2], drive="x", at="x", levels=[0.6], band=(5, 15))[0][0]
    assert curve.status == "ok" and curve.stable.all()
    memory = response_curves(beam("iwan4_memory"), IWAN, drive="shaker", at="tip", levels=[4.0], band=(18, 22))[0][0]
    assert memory.multiplier is None and memory.lost == "" and memory.stable.all()
    model = oscillator("iwan4_memory")
    with pytest.raises(ValueError, match="has memory"):
        SteadyForces(model, np.array([[8.0, 2e3, -0.4, 0.2]]), memory.basis).slopes(np.ones((1, 1, memory.basis.size)), np.ones(1),
                                                                                   np.zeros(1, dtype=int))
