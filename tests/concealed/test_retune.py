"""The answer sheet's linear fit: derivatives, exact recovery, prediction."""

import numpy as np
import pytest
from studies.concealed import retune as rt
from studies.concealed.truth.beams import Mesh, assemble
from studies.concealed.truth.draw import draw_scenery


@pytest.fixture(scope="module")
def problem():
    scenery = draw_scenery(np.random.default_rng(4), 5, False, False)
    a = assemble(scenery.nominal, Mesh(0.03, "euler", "consistent"))
    nominal = {
        "K_parts": np.array(list(a.K_parts.values())),
        "M_parts": np.array(list(a.M_parts.values())),
        "K_part_names": np.array(list(a.K_parts)),
        "M_part_names": np.array(list(a.M_parts)),
        "M": a.M,
        "K": a.K,
        "shaker_vector": a.vectors["SHAKER"],
        "sensor_select": np.array([a.vectors[f"S{i + 1}"] for i in range(5)]),
    }
    tolerances = {"E_rel_sd": 0.02, "rho_rel_sd": 0.008, "joint_stiffness_log_sd": 0.12, "root_fix_log_sd": 0.5, "damping_rel_sd": 0.2}
    return nominal, tolerances


def fit(problem, H, hz, start=None, iterations=12):
    nominal, tolerances = problem
    return rt.retune(nominal, tolerances, 0.01, hz, H, np.full(H.shape, 1e-4 * np.mean(np.abs(H) ** 2)), start or {}, iterations)


def test_recovers_a_model_inside_its_own_family(problem):
    hz = np.arange(20.5, 500, 2.0)
    nominal, tolerances = problem
    shifted = nominal | {"K_parts": nominal["K_parts"].copy()}
    shifted["K_parts"][0] *= 1.03
    shifted["K_parts"][2] *= 0.9
    shifted["K"] = shifted["K_parts"].sum(axis=0)
    H = fit((shifted, tolerances), np.ones((hz.size, 5), complex), hz, iterations=0).accelerance(2j * np.pi * hz)
    before, after = fit(problem, H, hz, iterations=0), fit(problem, H, hz)
    assert after.misfit < 0.1 and before.misfit > 20 * after.misfit


def test_steady_prediction_equals_the_response_from_rest_once_settled(problem):
    hz = np.arange(20.5, 500, 2.0)
    model = fit(problem, np.ones((hz.size, 5), complex), hz, iterations=0)
    fs, period = 1024.0, 2.0
    time = np.arange(int(fs * period)) / fs
    wave = sum(np.sin(2 * np.pi * f * time) for f in (60.0, 171.0, 333.0))
    steady = model.predict(np.tile(wave, 3), fs, 3)
    rest = model.predict(np.tile(wave, 12), fs, 0)
    assert np.std(rest[-2 * time.size : -time.size] - steady[: time.size]) < 0.01 * np.std(steady)
