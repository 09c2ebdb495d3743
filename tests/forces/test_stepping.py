"""Terms step by step: the same forces as along a recorded motion, and a state that only a commit moves."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.forces.stepping import State, commit, start_state, trial
from bayes_nlsid.forces.term import Term
from tests.forces.cases import ordinary, phi_max, ringing

REMEMBERING = [term for term in LIBRARY.values() if term.memory != "none"]
memories = pytest.mark.parametrize("term", REMEMBERING, ids=lambda t: t.name)
every = pytest.mark.parametrize("term", LIBRARY.values(), ids=LIBRARY.keys())


def batch_of(term: Term, size: int, seed: int = 0) -> np.ndarray:
    """Parameters (size, n_p) scattered by 10 %."""
    return ordinary(term) * (1 + 0.1 * (np.random.default_rng(seed).random((size, len(term.params))) - 0.5))


def marched(term: Term, q: np.ndarray, v: np.ndarray, dt: float, p: np.ndarray, excess: bool = False) -> np.ndarray:
    """Force (B, n) step by step, every sample of the batch on the same motion."""
    state, out = start_state(term, p), np.empty((len(p), len(q)))
    for i in range(len(q)):
        here, speed = np.full(len(p), q[i]), np.full(len(p), v[i])
        out[:, i] = trial(term, state, here, speed, dt, p, excess)[0]
        state = commit(term, state, here, speed, dt, p)
    return out


@every
@pytest.mark.parametrize("excess", [False, True])
def test_step_by_step_equals_along_the_motion(term: Term, excess: bool) -> None:
    q, v = ringing(250, 1 / 2000)
    p = batch_of(term, 3)
    expected = force_along(term, motion(q, v, 1 / 2000), p, excess)
    found = marched(term, q, v, 1 / 2000, p, excess)
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()


@memories
@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(-12, 12), st.integers(-3, 3)), min_size=1, max_size=40))
def test_step_by_step_equals_along_any_path(term: Term, steps: list[tuple[int, int]]) -> None:
    """Also where velocities disagree with displacements, samples repeat, and turning points close several loops at once."""
    q, v = (np.array(x, dtype=float) for x in zip(*steps, strict=True))
    q, v = 4e-6 * q, 1e-5 * v
    p = batch_of(term, 2)
    expected = force_along(term, motion(q, v, 1.0), p)
    np.testing.assert_allclose(marched(term, q, v, 1.0, p), expected, atol=1e-10 * (1.0 + np.abs(expected).max()))


@memories
def test_samples_of_a_batch_do_not_touch_each_other(term: Term) -> None:
    q, v = ringing(120, 1 / 2000)
    p = batch_of(term, 4)
    gain = np.array([1.0, -0.3, 0.02, 2.0])
    state, out = start_state(term, p), np.empty((4, len(q)))
    for i in range(len(q)):
        state = commit(term, state, gain * q[i], gain * v[i], 1 / 2000, p)
        out[:, i] = state.force
    for row in range(4):
        alone = force_along(term, motion(gain[row] * q, gain[row] * v, 1 / 2000), p[row])
        np.testing.assert_allclose(out[row], alone, atol=1e-9 * np.abs(alone).max())


@memories
def test_a_trial_leaves_no_trace(term: Term) -> None:
    q, v = ringing(100, 1 / 2000)
    p = batch_of(term, 2)
    state = start_state(term, p)
    for i in range(100):
        before = {f.name: getattr(state, f.name).copy() for f in fields(State)}
        first = trial(term, state, np.full(2, q[i]), np.full(2, v[i]), 1 / 2000, p)
        trial(term, state, np.full(2, -2 * q[i]), np.full(2, -v[i]), 1 / 2000, p)  # a wild iterate: reverses and closes loops
        again = trial(term, state, np.full(2, q[i]), np.full(2, v[i]), 1 / 2000, p)
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a, b)
        for name, value in before.items():
            np.testing.assert_array_equal(getattr(state, name), value)
        state = commit(term, state, np.full(2, q[i]), np.full(2, v[i]), 1 / 2000, p)


@memories
def test_tangent_is_the_derivative_of_the_trial_force(term: Term) -> None:
    """On steps without a turning point inside; away from the instant at which a slider breaks or a loop closes."""
    q, v = ringing(400, 1 / 20000)
    p = batch_of(term, 1)
    state, checked = start_state(term, p), 0
    for i in range(400):
        if i and v[i - 1] * v[i] > 0:
            h = 1e-6 * abs(q[i] - q[i - 1])
            low, here, high = (trial(term, state, q[i:i + 1] + k * h, v[i:i + 1], 1 / 20000, p) for k in (-1, 0, 1))
            if np.isclose(low[1], high[1], rtol=1e-4)[0]:
                checked += 1
                assert (high[0] - low[0])[0] / (2 * h) == pytest.approx(here[1][0], rel=5e-3, abs=1e-3 * p[0].max())
        state = commit(term, state, q[i:i + 1], v[i:i + 1], 1 / 20000, p)
    assert checked > 300


def test_five_thousand_open_loops_fit() -> None:
    term, p = LIBRARY["iwan4_memory"], ordinary(LIBRARY["iwan4_memory"])[None]
    peaks = 0.9 * phi_max(*p[0]) * 0.999 ** np.arange(5000) * (-1.0) ** np.arange(5000)
    state, still = start_state(term, p), np.zeros(1)
    for peak in peaks:
        state = commit(term, state, np.array([peak]), still, 1.0, p)
    assert state.depth[0] == 4999
    assert state.force[0] == pytest.approx(force_along(term, motion(peaks, 0 * peaks, 1.0), p)[0, -1], abs=1e-9 * 2000)
    # One large excursion closes them all.
    state = commit(term, state, np.array([phi_max(*p[0])]), still, 1.0, p)
    assert state.depth[0] == 0
    assert state.force[0] == pytest.approx(2000.0)


def test_a_copy_is_a_branch_of_its_own() -> None:
    term, p = LIBRARY["iwan4_memory"], ordinary(LIBRARY["iwan4_memory"])[None]
    state = start_state(term, p)
    for peak in (3e-5, -2e-5, 1e-5):
        state = commit(term, state, np.array([peak]), np.zeros(1), 1.0, p)
    branch = state.copy()
    for peak in (0.5e-5, 4e-5, -3e-5):
        state = commit(term, state, np.array([peak]), np.zeros(1), 1.0, p)
    found = commit(term, branch, np.array([-1e-5]), np.zeros(1), 1.0, p).force[0]
    path = np.array([3e-5, -2e-5, 1e-5, -1e-5])
    assert found == pytest.approx(force_along(term, motion(path, 0 * path, 1.0), p)[0, -1], rel=1e-12)


def test_energy_is_never_made() -> None:
    """Work over any closed path from the unloaded state is not negative, for every dissipative memory."""
    rng = np.random.default_rng(5)
    corners = np.concatenate([[0.0], rng.uniform(-5e-5, 5e-5, 60), [0.0]])
    path = np.concatenate([np.linspace(a, b, 200, endpoint=False) for a, b in zip(corners[:-1], corners[1:], strict=True)])
    for name in ("jenkins_memory", "iwan4_memory", "iwan5_memory"):
        f = force_along(LIBRARY[name], motion(path, 0 * path, 1.0), ordinary(LIBRARY[name]))
        work = np.concatenate([[0.0], np.cumsum(0.5 * (f[1:] + f[:-1]) * np.diff(path))])
        assert work.min() > -1e-6 * work.max()


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"p has shape \(4,\), expected \(B, 4\)"):
        start_state(LIBRARY["iwan4_memory"], np.ones(4))
