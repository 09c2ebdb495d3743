"""Laws of the catalogue: slopes, signs, memory within a period; and the stretch solver that starts strong ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayes_nlsid.forces.march import march
from bayes_nlsid.mismatch.catalogue import CATALOGUE, ROWS
from bayes_nlsid.mismatch.disturb import tones
from bayes_nlsid.mismatch.effects import along_period
from bayes_nlsid.mismatch.laws import Law, Size
from bayes_nlsid.mismatch.probability import Score, Scores, scores_from
from bayes_nlsid.simulation.volterra import nodes, solve_window

SIZE = Size(1e-5, 1e-2, 3e-5, 1e6)
STATIC = [pytest.param(law, id=f"{row.name}-{law.term.name}") for row in CATALOGUE for law in row.laws if law.term.memory == "none"]


@pytest.mark.parametrize("law", STATIC)
def test_slopes_are_derivatives(law: Law) -> None:
    """Central differences away from corners, for every shape that the search tries."""
    q, v = 1e-5 * np.array([-4.03, -1.51, -0.57, 0.13, 0.71, 1.77, 3.37]), 1e-2 * np.array([1.3, -0.7, 0.21, -0.05, 0.6, -2.1, 0.9])
    for values in law.shapes(SIZE):
        force = lambda a, b, p=values: np.asarray(law.term.static_force(a, b, p))  # noqa: E731
        stiffness, damping = (np.broadcast_to(x, q.shape) for x in law.term.slope(q, v, *values))
        scale = np.abs(force(q, v)).max()
        assert np.allclose((force(q + 1e-10, v) - force(q - 1e-10, v)) / 2e-10, stiffness, rtol=1e-4, atol=1e-4 * scale / 1e-5)
        assert np.allclose((force(q, v + 1e-7) - force(q, v - 1e-7)) / 2e-7, damping, rtol=1e-4, atol=1e-4 * scale / 1e-2)


def test_every_law_of_a_class_means_what_the_class_says() -> None:
    q, none = 1e-5 * np.linspace(0.01, 7, 350), np.zeros(350)

    def of(name: str) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(np.asarray(law.term.static_force(q, none, p)), np.asarray(law.term.static_force(-q, none, p)))
                for law in ROWS[name].laws for p in law.shapes(SIZE)]

    for plus, minus in of("hardening"):
        assert np.allclose(plus, -minus) and (np.diff(plus / q) > 0).all()
    for plus, minus in of("softening"):
        assert np.allclose(plus, -minus) and (np.diff(plus / q) < 0).all()
    for plus, minus in of("asymmetric"):
        assert np.abs(plus + minus).max() > 0.05 * max(np.abs(plus).max(), np.abs(minus).max())
    for plus, minus in of("clearance"):   # two faces; contact on one side only is asymmetric
        assert (plus >= 0).all() and (minus <= 0).all() and plus.max() > 0 > minus.min() and plus[0] < 1e-3 * plus.max()
    for name in ("coulomb", "quad_damping"):
        for law in ROWS[name].laws:
            for p in law.shapes(SIZE):
                f = np.asarray(law.term.static_force(none, 1e3 * q, p))
                assert (f > 0).all() and (np.diff(f / (1e3 * q)) * (-1 if name == "coulomb" else 1) > 0).all()


def test_a_loop_is_steady_within_its_period() -> None:
    law = next(x for x in ROWS["hysteresis"].laws if x.convert is not None)
    t = np.arange(2048) / 2048
    d = 1e-5 * sum(np.cos(2 * np.pi * k * t + k * k) for k in (3, 5, 8, 13))
    for p in law.shapes(SIZE):
        assert law.convert is not None and law.term.stiffness is not None
        long = march("bouc_wen", np.tile(d, 4), law.convert(p))[0, -2048:] - float(law.term.stiffness(*p)) * d
        assert np.abs(along_period(law, p, d, 0 * d, 1 / 2048, True) - long).max() < 2e-3 * np.abs(long).max()


def test_a_stretch_solves_its_equation() -> None:
    """Forces of two coupled places satisfy q = q° − K * g with a cubic and a rounded friction law."""
    rng = np.random.default_rng(3)
    n = 60
    q0, v0 = 1e-5 * rng.normal(size=(n, 2)).cumsum(0), 1e-2 * rng.normal(size=(n, 2))
    decay = np.exp(-np.arange(n) / 20.0)
    K = 1e-8 * np.array([[1.0, 0.3], [0.3, 1.0]])[:, :, None] * np.sin(0.2 * np.arange(n)) * decay
    V = 1e-5 * np.array([[1.0, 0.2], [0.2, 1.0]])[:, :, None] * np.cos(0.2 * np.arange(n)) * decay
    V[0, 1, 0] = V[1, 0, 0] = 0.0
    reach = np.array([[1e-3, 1e-3], [1.0, 1.0]])
    laws = [lambda q: 2e13 * q ** 3, lambda v: 50 * np.tanh(v / 1e-2)]
    zero = np.zeros_like(nodes(1.0))
    tables = np.array([[laws[0](nodes(1e-3)), zero], [zero, laws[1](nodes(1.0))]])
    g = np.zeros((n, 2))
    assert solve_window(q0, v0, K, V, tables, reach, g, np.zeros((2, n))) == 0
    q = q0 - np.array([sum(K[:, :, i - k] @ g[k] for k in range(i + 1)) for i in range(n)])
    v = v0 - np.array([sum(V[:, :, i - k] @ g[k] for k in range(i + 1)) for i in range(n)])
    wanted = np.stack([laws[0](q[:, 0]), laws[1](v[:, 1])], axis=1)
    assert np.abs(g - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_scores_survive_their_file() -> None:
    one = Scores((Score((("hardening", "J1_slip"),), 100.0, 0.0, 0.1, float("nan"), 5.0, 0.2),), 0.1, 1.2, 1.1, 0.4)
    stored = {"items": [{"key": [["hardening", "J1_slip"]], "gain": 100.0, "alone": 0.0, "strength": 0.1, "visible": None, "rest": 5.0,
                         "held": 0.2}], "unexplained": 0.1, "dispersion": 1.2, "linear": 1.1, "held": 0.4}
    again = scores_from(stored)
    assert again.items[0].key == one.items[0].key and np.isnan(again.items[0].visible)
    assert replace(again.items[0], visible=0.0) == replace(one.items[0], visible=0.0) and again.held == one.held


def test_a_hum_out_of_step_with_the_record_is_taken_out() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(4096) / 1024.0
    other = rng.normal(size=(4096, 2)) + 3 * np.cos(2 * np.pi * 45 * t)[:, None]
    hum = np.stack([5 * np.cos(2 * np.pi * 50.017 * t + 0.3), 2 * np.cos(2 * np.pi * 100.034 * t)], axis=1)
    found = tones(other + hum, 50.0, 1024.0)
    assert (np.abs(found - hum).std(0) < 0.05 * hum.std(0)).all()


@pytest.mark.parametrize("law", STATIC)
def test_every_law_runs_compiled(law: Law) -> None:
    """The scalar code is the law itself, so that no class of the catalogue is stepped slowly."""
    compiled = pytest.importorskip("bayes_nlsid.forces.compiled")
    code = compiled.law_code(law.term)
    assert code is not None
    for p in law.shapes(SIZE):
        for q in 1e-5 * np.array([-3.3, -0.4, 0.0, 0.9, 40.0]):
            for v in 1e-2 * np.array([-1.1, 0.0, 0.3]):
                expected = [float(np.asarray(x)) for x in (law.term.law(q, v, *p), *law.term.slope(q, v, *p))]
                np.testing.assert_allclose(compiled.law_value(*code, q, v, p), expected, rtol=1e-12, atol=1e-15)
