"""The compiled loop gives the numbers of the numpy loop."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.simulation.response import Response
from tests.simulation.problems import IWAN, beam, oscillator, scattered

VALUES = {"iwan4": IWAN, "iwan4_memory": IWAN, "iwan5": np.tile([60.0, 1e6, -0.5, 0.3, 0.8], 2), "clearance": np.tile([2e6, 4e-5], 2),
          "iwan5_memory": np.tile([60.0, 1e6, -0.5, 0.3, 0.8], 2), "bouc_wen": np.tile([1e6, 1e4, 0.5, 0.5, 1.2], 2),
          "cubic": np.array([1e13, 2e13]), "v|v|": np.array([2e3, 1e3]), "jenkins_prager": np.tile([10.0, 1e5, 50.0], 2)}


def agree(one: Response, other: Response) -> None:
    assert one.compiled and not other.compiled
    for name in ("displacement", "velocity", "acceleration"):
        a, b = getattr(one, name), getattr(other, name)
        assert np.abs(a - b).max() < 1e-9 * np.abs(b).max()
    assert list(one.status) == list(other.status)


@pytest.mark.parametrize("scheme", ["hht", "exponential"])
@pytest.mark.parametrize("terms", [("iwan4", "v|v|"), ("iwan4_memory",), ("iwan5", "clearance"), ("iwan5_memory", "cubic"),
                                   ("bouc_wen", "jenkins_prager")])
def test_compiled_and_numpy_agree(terms: tuple[str, ...], scheme: str) -> None:
    model = beam(*terms)
    theta = scattered(np.concatenate([VALUES[t] for t in terms]), 3)
    kwargs = {"fs": 4096.0, "samples": 120, "u0": np.array([5e-3, 0.0, 0.0]), "keep": ("tip", "J1"), "scheme": scheme,
              "force": np.random.default_rng(0).standard_normal((120, 1))}
    agree(simulate(model, theta, **kwargs, compiled=True), simulate(model, theta, **kwargs, compiled=False))  # type: ignore[arg-type]


def test_own_linear_parts_and_forces_agree() -> None:
    model = beam("iwan4_memory", free=(0, 1))
    theta = scattered(model.start(IWAN), 11, 0.02)
    force = np.random.default_rng(0).standard_normal((11, 150, 1))
    kwargs = {"fs": 4096.0, "samples": 150, "force": force, "u0": np.array([4e-3, 0, 0]), "keep": ("tip",), "every": 3}
    agree(simulate(model, theta, **kwargs, compiled=True), simulate(model, theta, **kwargs, compiled=False))  # type: ignore[arg-type]


def test_newton_in_lanes_agrees_and_diverging_lanes_leave_the_others_alone() -> None:
    model = oscillator("clearance", zeta=0.0)
    theta = np.array([[1e5, 0.1], [1e7, 0.1], [3e7, 0.09]])
    kwargs = {"fs": 5000.0, "samples": 400, "u0": [0.04], "v0": [2.0], "scheme": "exponential"}
    one, other = (simulate(model, theta, **kwargs, compiled=c) for c in (True, False))  # type: ignore[arg-type]
    agree(one, other)
    assert one.iterations.sum() > 0
    cubic = simulate(oscillator("cubic"), [[-1e9], [1e3]], fs=1000, samples=600, u0=[0.1], compiled=True)
    assert list(cubic.status) == ["diverged", "ok"]


def test_the_stack_of_reversals_grows() -> None:
    model = oscillator("iwan4_memory", zeta=0.002)
    kwargs = {"fs": 600.0, "samples": 1500, "u0": [0.02], "scheme": "exponential"}
    theta = [[40.0, 2000.0, -0.4, 0.2], [30.0, 1500.0, -0.3, 0.5]]
    one, other = (simulate(model, theta, **kwargs, compiled=c) for c in (True, False))  # type: ignore[arg-type]
    agree(one, other)


def test_power_without_a_call_is_the_power() -> None:
    from bayes_nlsid.simulation.compiled import power_of

    rng = np.random.default_rng(2)
    r: NDArray[np.float64] = np.concatenate([10 ** rng.uniform(-30, 0, 4000), [1e-300, 1.0, 0.5, np.nextafter(1, 0)] * 2])
    m = rng.uniform(0, 2, len(r))
    out = np.empty_like(r)
    power_of(r, m, out)
    # exponents of 2 are clipped at -1000
    exact = np.maximum(r**m, 2.0**-1000)
    assert np.abs(out / exact - 1).max() < 3e-13


def test_compiling_is_announced_when_it_must_be_done(monkeypatch: pytest.MonkeyPatch) -> None:
    from bayes_nlsid.simulation import compiled_loop

    said: list[str] = []
    for _ in range(2):
        simulate(oscillator("cubic"), [[1e3]], fs=100, samples=5, u0=[0.1], compiled=True, progress=said.append)
    assert len(said) < 2 and compiled_loop.ready()
    said.clear()
    monkeypatch.setattr(compiled_loop, "ready", lambda: False)
    simulate(oscillator("cubic"), [[1e3]], fs=100, samples=5, u0=[0.1], compiled=True, progress=said.append)
    assert len(said) == 1 and "compiling" in said[0]
    monkeypatch.setenv("BAYES_NLSID_COMPILED", "0")
    assert not simulate(oscillator("cubic"), [[1e3]], fs=100, samples=5, u0=[0.1], compiled=True).compiled


def test_laws_that_jump_run_in_numpy() -> None:
    assert not simulate(oscillator("coulomb"), [[1.0]], fs=100, samples=5, u0=[0.1], compiled=True).compiled
