"""Virtual sensing: exact on linear responses, honest about what sensors cannot tell apart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.beam import LappedBeam, lapped_beam
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.modal_model import modal_model
from bayes_nlsid.structure.sensing import modal_data

FS, N = 8192.0, 8192
SENSORS = (("S1", 0.02), ("S2", 0.24), ("S3", 0.5), ("S4", 0.65))


@dataclass(frozen=True)
class Floor:
    """Stands in for a noise floor: white noise of stated density per channel."""

    frequency: np.ndarray
    psd: np.ndarray


@pytest.fixture(scope="module")
def model() -> ModalModel:
    beam = LappedBeam(0.72, 0.0254, 0.0127, 2e11, 7800, lap=(0.3, 0.42), stations=(0.33, 0.36, 0.39), tangential=3e7, normal=1e9,
                      element_size=0.015, sensors=SENSORS, inputs=(("F1", 0.65),))
    return modal_model(lapped_beam(beam), 6, zeta=0.01)


def channels(names: tuple[str, ...], quantity: str = "acceleration") -> tuple[Channel, ...]:
    return tuple(Channel(f"acc {n}", n, quantity, "g") for n in names)  # type: ignore[arg-type]


def white(density: float, count: int) -> Floor:
    return Floor(np.linspace(0, FS / 2, 100), np.full((100, count), density))


def periodic(model: ModalModel, modes: list[int], names: tuple[str, ...], residual: bool = False, seed: int = 1,
             ) -> tuple[Recording, dict[str, np.ndarray]]:
    """Steady response of the stated modes to a multisine at F1, in closed form at every line."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(N, 1 / FS)
    F = np.where((f >= 40) & (f <= 900), np.exp(2j * np.pi * rng.random(f.size)), 0) * N / 50
    w = 2 * np.pi * f
    u = [F * model.rows(["F1"])[0, k] / (model.omega[k] ** 2 - w**2 + 2j * model.zeta[k] * model.omega[k] * w) for k in modes]
    x = model.rows(names)[:, modes] @ np.array(u)
    q = model.rows(model.joints)[:, modes] @ np.array(u)
    if residual:
        at = model.locations.index("F1")
        x = x + model.residual[[model.locations.index(n) for n in names], at][:, None] * F
        q = q + model.residual[[model.locations.index(n) for n in model.joints], at][:, None] * F
    back = lambda spectrum: np.fft.irfft(spectrum, n=N).T  # noqa: E731
    recording = Recording("steady", 1 / FS, back(-w**2 * x), channels(names), back(F)[:, None], channels(("F1",), "force"), period=N)
    return recording, {"u": back(np.array(u)), "v": back(1j * w * np.array(u)), "q": back(q), "qd": back(1j * w * q), "F": back(F)}


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def test_exact_on_a_linear_response_of_observed_modes(model: ModalModel) -> None:
    modes = [0, 1, 2, 3]
    recording, truth = periodic(model, modes, tuple(n for n, _ in SENSORS))
    data = modal_data(recording, model, modes, model.joints, (40.0, 900.0), noise=white(1e-6, 4))
    for name in ("u", "v", "q", "qd"):
        assert relative(getattr(data, name), truth[name]) < 1e-9, name
    np.testing.assert_allclose(data.force, np.outer(truth["F"], model.rows(["F1"])[0, modes]), atol=1e-9)
    residual = data.a + 2 * model.zeta[modes] * model.omega[modes] * data.v + model.omega[modes] ** 2 * data.u - data.force
    assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(data.force)
    assert data.periodic and data.condition > 1 and data.valid == slice(0, N)


def test_weights_give_the_least_noise_a_linear_filter_can(model: ModalModel) -> None:
    names = tuple(n for n, _ in SENSORS)
    recording, _ = periodic(model, [0, 1], names)
    density = np.array([1e-6, 1e-6, 1e-6, 1e-2])
    floor = Floor(np.linspace(0, FS / 2, 100), np.tile(density, (100, 1)))
    data = modal_data(recording, model, [0, 1], (), (40.0, 900.0), noise=floor)
    rows = model.rows(names)[:, [0, 1]]
    best = np.diag(np.linalg.inv(rows.T @ np.diag(1 / density) @ rows))
    np.testing.assert_allclose(data.noise, best, rtol=1e-9)
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((N, 4)) * np.sqrt(density * FS / 2)
    noisy = modal_data(replace(recording, response=recording.response + noise), model, [0, 1], (), (40.0, 900.0), noise=floor)
    spectrum = np.abs(np.fft.rfft(noisy.a - data.a, axis=0)[40:901]) ** 2 * 2 / (N * FS)
    np.testing.assert_allclose(spectrum.mean(axis=0), data.noise, rtol=0.15)


def test_noise_of_displacement_sensors_grows_with_frequency_on_the_way_to_acceleration(model: ModalModel) -> None:
    names = tuple(n for n, _ in SENSORS)
    recording, _ = periodic(model, [0, 1], names)
    moved = replace(recording, channels=tuple(replace(c, quantity="displacement") for c in recording.channels))
    density = np.array([1e-12, 2e-12, 3e-12, 1e-10])
    floor = Floor(np.linspace(0, FS / 2, 4000), np.tile(density, (4000, 1)))
    data = modal_data(moved, model, [0, 1], (), (40.0, 900.0), noise=floor)
    noise = np.random.default_rng(6).standard_normal((N, 4)) * np.sqrt(density * FS / 2)
    noisy = modal_data(replace(moved, response=moved.response + noise), model, [0, 1], (), (40.0, 900.0), noise=floor)
    f = np.fft.rfftfreq(N, 1 / FS)
    spectrum = np.abs(np.fft.rfft(noisy.a - data.a, axis=0)) ** 2 * 2 / (N * FS)
    for low, high in ((45, 120), (120, 300), (300, 800)):
        part = (f > low) & (f < high)
        for k in (0, 1):
            assert np.mean(spectrum[part, k] / data.noise_density(k, f[part])) == pytest.approx(1.0, rel=0.3)
    inside = np.linspace(40.0, 900.0, 2000)
    assert [data.noise_density(k, inside).mean() for k in (0, 1)] == pytest.approx(data.noise, rel=0.02)


def test_too_few_or_blind_sensors_are_refused_naming_modes(model: ModalModel) -> None:
    recording, _ = periodic(model, [0, 1, 2], ("S1", "S3"))
    with pytest.raises(ValueError, match=r"2 sensors cannot tell 3 modes apart \(1 \("):
        modal_data(recording, model, [0, 1, 2], (), (40.0, 900.0), noise=white(1e-6, 2))
    rows = np.vstack([model.shapes, 1.0001 * model.rows(["S1"])])
    twins = replace(model, locations=(*model.locations, "S1b"), shapes=rows, residual=None)
    recording, _ = periodic(twins, [0, 1], ("S1", "S1b"))
    with pytest.raises(ValueError, match="modes 1 .* 2 .* cannot be told apart"):
        modal_data(recording, twins, [0, 1], (), (40.0, 900.0), noise=white(1e-6, 2))


def test_one_band_per_mode_lets_two_sensors_feed_three_modes(model: ModalModel) -> None:
    modes = [0, 1, 2]
    bands = [(0.9 * f, 1.1 * f) for f in model.frequency[modes]]
    recording, truth = periodic(model, modes, ("S1", "S4"))
    data = modal_data(recording, model, modes, model.joints, (40.0, 900.0), bands=bands, noise=white(1e-6, 2))
    assert relative(data.u, truth["u"]) < 0.1
    with pytest.raises(ValueError, match="one .* per mode"):
        modal_data(recording, model, modes, (), (40.0, 900.0), bands=bands[:1], noise=white(1e-6, 2))


def test_overlapping_bands_are_solved_together(model: ModalModel) -> None:
    modes = [0, 1]
    recording, truth = periodic(model, modes, ("S1", "S4"))
    data = modal_data(recording, model, modes, (), (40.0, 900.0), bands=[(40.0, 900.0), (40.0, 900.0)], noise=white(1e-6, 2))
    assert relative(data.u, truth["u"]) < 1e-9


def test_static_correction_restores_what_modes_left_out(model: ModalModel) -> None:
    modes = [0, 1, 2, 3, 4, 5]
    names = tuple(n for n, _ in SENSORS)
    with pytest.raises(ValueError, match="4 sensors"):
        modal_data(periodic(model, modes, names)[0], model, modes, (), (40.0, 900.0), noise=white(1e-6, 4))
    observed = [0, 1, 2]
    recording, truth = periodic(model, observed, names, residual=True)
    plain = modal_data(recording, model, observed, model.joints, (40.0, 900.0), noise=white(1e-6, 4))
    corrected = modal_data(recording, model, observed, model.joints, (40.0, 900.0), noise=white(1e-6, 4), static_correction=True)
    assert relative(plain.q, truth["q"]) > 1e-3
    assert relative(corrected.q, truth["q"]) < 1e-9 and relative(corrected.qd, truth["qd"]) < 1e-9
    with pytest.raises(ValueError, match="residual"):
        modal_data(recording, replace(model, residual=None), observed, (), (40.0, 900.0), noise=white(1e-6, 4), static_correction=True)


def test_free_decay_at_a_lower_rate(model: ModalModel) -> None:
    names = ("S1", "S3")
    t = np.arange(4 * N) / FS
    zeta, omega = 0.002, model.omega[:2]
    s = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
    u = np.real(1e-3 * np.exp(np.outer(t, s)))
    response = np.real(1e-3 * s**2 * np.exp(np.outer(t, s))) @ model.rows(names)[:, :2].T
    recording = Recording("decay", 1 / FS, response, channels(names), np.zeros((t.size, 0)))
    data = modal_data(recording, model, [0, 1], model.joints, (40.0, 500.0), fs=FS / 4, noise=white(1e-6, 2))
    inside = data.valid
    assert data.dt == pytest.approx(4 / FS) and not data.force.any()
    assert relative(data.u[inside], u[::4][inside]) < 2e-3
