"""Sensors against the model's answer to a measured force: wrong signs and wrong units are named, right ones are not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bayes_nlsid.recordings.recording import Channel, Quantity, Recording
from bayes_nlsid.structure.agreement import response_findings
from bayes_nlsid.structure.chains import oscillator, spring_mass_chain
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.modal_model import modal_model

FS, PERIOD, ZETA = 128.0, 1024, 0.01
CHAIN = spring_mass_chain([1.0, 1.5, 1.0], [4e3, 3e3, 2e3], inputs=(2,))
MODEL = modal_model(CHAIN, 3, zeta=ZETA)


@cache
def recorded(quantity: Quantity = "acceleration", *, steady: bool = True, seed: int = 1, noise: float = 0.02) -> Recording:
    """All masses under a random force on the second: from the stiffness and mass matrices line by line, never through modes; either its
    steady state or what follows a start from rest."""
    rng = np.random.default_rng(seed)
    n = PERIOD if steady else 4 * PERIOD
    f = np.fft.rfftfreq(n, 1 / FS)
    force = np.zeros(len(f), dtype=complex)
    lit = (f > 2) & (f < 25)
    force[lit] = np.exp(2j * np.pi * rng.random(int(lit.sum())))
    omega = 2 * np.pi * f
    answer = np.zeros((len(f), 3), dtype=complex)
    place = np.array([0.0, 1.0, 0.0])
    for i in np.flatnonzero(lit):
        answer[i] = np.linalg.solve(CHAIN.K * (1 + 2j * ZETA) - omega[i]**2 * CHAIN.M, place * force[i])
    order = {"displacement": 0, "velocity": 1, "acceleration": 2}[quantity]
    response = np.fft.irfft(answer * (1j * omega[:, None])**order, n, axis=0)
    response += noise * response.std(axis=0) * rng.standard_normal(response.shape)
    channels = tuple(Channel(f"c{i}", f"S{i}", quantity, "-") for i in (1, 2, 3))
    return Recording("shaken", 1 / FS, response, channels, np.fft.irfft(force, n)[:, None], (Channel("hammer", "F2", "force", "N"),),
                     period=PERIOD if steady else None)


def findings(recording: Recording, model: ModalModel = MODEL, **options: bool) -> list[tuple[str, str]]:
    return [(f.channel, f.kind) for f in response_findings(recording, model, **options)]


@pytest.mark.parametrize("steady", [True, False])
@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_right_recordings_raise_nothing(quantity: Quantity, steady: bool) -> None:
    assert not any(findings(recorded(quantity, steady=steady, seed=seed, noise=0.1)) for seed in range(5))


@pytest.mark.parametrize("steady", [True, False])
@pytest.mark.parametrize("factors", [(-1, 1, 1), (1, 1, -1), (-1, -1, -1), (1, 9.81, 1), (1, 1, -1e-3)])
def test_signs_and_scales_are_named(factors: tuple[float, ...], steady: bool) -> None:
    right = recorded(steady=steady)
    found = findings(replace(right, response=right.response * np.array(factors)))
    expected = [(f"c{i + 1}", "inverted") for i, x in enumerate(factors) if x < 0]
    assert found == expected + [(f"c{i + 1}", "scaled") for i, x in enumerate(factors) if abs(x) != 1]


def test_a_model_that_is_several_per_cent_off_still_tells() -> None:
    right, stiffer = recorded(), replace(MODEL, omega=1.06 * MODEL.omega, zeta=0.3 * MODEL.zeta)
    assert findings(right, stiffer) == []
    assert findings(replace(right, response=right.response * np.array([1, -1, 1])), stiffer) == [("c2", "inverted")]


def test_one_sensor_alone_leaves_two_possibilities_and_says_so() -> None:
    right = recorded()
    one = replace(right, response=-right.response[:, 1:2], channels=right.channels[1:2])
    (found,) = response_findings(one, MODEL)
    assert "either hammer is inverted, or this channel is" in found.sentence and found.confidence > 0.9
    turned = replace(right, force=-right.force)
    sentences = [f.sentence for f in response_findings(turned, MODEL)]
    assert len(sentences) == 3 and all("either hammer is inverted, or all channels are" in s for s in sentences)


def test_the_likely_unit_is_named_and_an_unknown_gain_is_no_finding() -> None:
    right = recorded()
    in_g = replace(right, response=right.response / 9.80665)
    sentences = [f.sentence for f in response_findings(in_g, MODEL)]
    assert len(sentences) == 3 and all("g for m/s²" in s for s in sentences)
    assert findings(in_g, scale=False) == []


def test_a_force_and_a_response_that_were_exchanged_are_named() -> None:
    right = recorded()
    wrong = replace(right, response=right.force, force=right.response[:, 1:2], channels=right.channels[1:2])
    (found,) = response_findings(wrong, MODEL)
    assert (found.channel, found.kind, found.other) == ("c2", "swapped", "hammer")


def test_what_is_not_the_same_motion_is_not_compared() -> None:
    right, rng = recorded(), np.random.default_rng(3)
    noise = replace(right, response=-50 * rng.standard_normal(right.response.shape))
    assert response_findings(noise, MODEL) == ()
    node = replace(MODEL, shapes=MODEL.shapes * (1 - (np.arange(len(MODEL.locations)) == MODEL.locations.index("S3")))[:, None])
    assert findings(replace(right, response=right.response * np.array([1, 1, -1])), node) == []
    free = replace(right, force=np.zeros((right.n, 0)), inputs=())
    assert response_findings(free, MODEL) == ()


def test_a_hardening_spring_does_not_hide_the_sign() -> None:
    """Duffing oscillator driven well past its linear range, integrated by scipy."""
    from scipy.integrate import solve_ivp

    rng = np.random.default_rng(5)
    t = np.arange(2048) / 128.0
    lines = 2 * np.pi * np.arange(3.0, 12.0, 0.25)
    phases = rng.uniform(0, 2 * np.pi, len(lines))

    def force(at: np.ndarray | float) -> np.ndarray:
        return 1.5 * np.cos(np.multiply.outer(at, lines) + phases).sum(axis=-1)

    omega = 2 * np.pi * 6.0
    solved = solve_ivp(lambda at, y: [y[1], force(at) - 2 * 0.02 * omega * y[1] - omega**2 * y[0] - 5e5 * y[0]**3], (0, t[-1]), [0, 0],
                       t_eval=t, rtol=1e-7, atol=1e-9)
    x = solved.y[0]
    assert 0.1 < np.mean(5e5 * x**4) / np.mean(omega**2 * x**2) < 1.0
    model = oscillator(frequency=6.0, zeta=0.02, location="x")
    for sign in (1, -1):
        recording = Recording("driven", 1 / 128, sign * x[:, None], (Channel("x", "x", "displacement", "m"),), force(t)[:, None],
                              (Channel("f", "x", "force", "N"),))
        assert findings(recording, model) == ([] if sign > 0 else [("x", "inverted")])
