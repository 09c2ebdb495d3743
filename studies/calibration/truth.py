"""Virtual tests whose truth is known, written without the force laws and integrators of the package (no inverse crime).

One modal equation, unit mass, integrated by classical Runge–Kutta at eight steps per sample for many realisations at once:

    a + 2 ζ ω v + ω² u + g(u, v) = p(t) + w(t)

``p`` sweeps down through the resonance, then is shut off; ``w`` is force that nobody measured. ``g`` is static (k₂ u|u| + c₂ v|v|) or
has memory: a bank of sliders in parallel that stick and slip, one by one, whose yield displacements are spread as Segalman (2005) has
them, less their stiffness when all stick.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

FS, SECONDS, SWEEP = 1024.0, 2.5, 1.25      # Hz, s, s
FINE = 8                                    # integration steps per sample
BAND = (45.0, 200.0)                        # Hz
AMPLITUDE = 1.6                             # N
F0, ZETA = 78.56, 0.004
SLIDERS = 60
STICK, SHARE = 8e3, 0.5     # N/m and ratio: parameters of the joint with memory that are known
Array = np.ndarray


@dataclass(frozen=True)
class Scenario:
    """How noise enters: shares of the rms of the channel (1.0: as large as the signal), colour, force that nobody measured."""

    name: str
    channels: tuple[str, ...] = ("acceleration",)
    noise: tuple[float, ...] = (0.03,)
    coloured: bool = False
    process: float = 0.0        # N²/Hz, one-sided
    hidden_mode: bool = False


SCENARIOS = {s.name: s for s in (
    Scenario("white"),
    Scenario("coloured", coloured=True),
    Scenario("process", noise=(0.003,), process=2e-4),
    Scenario("unmodelled mode", noise=(0.01,), hidden_mode=True),
    Scenario("mixed sensors", ("acceleration", "acceleration", "displacement"), (0.01, 0.10, 0.02)),
)}


def force(time: Array) -> Array:
    """Sweep 79.5 to 76.5 Hz, then shut off smoothly."""
    phase = 2 * np.pi * (79.5 * time - 0.5 * 3.0 / SWEEP * time**2)
    edge = np.clip((SWEEP - time) / 0.02, 0, 1) * np.clip(time / 0.02, 0, 1)
    return AMPLITUDE * np.sin(0.5 * np.pi * edge) ** 2 * np.sin(phase)


class Static:
    """k₂ u|u| + c₂ v|v|; parameters (R, 4): Hz, ratio, N/m², N s²/m²."""

    def __init__(self, parameters: Array) -> None:
        self.k2, self.c2 = parameters[:, 2], parameters[:, 3]

    def force(self, u: Array, v: Array) -> Array:
        """N."""
        return self.k2 * u * np.abs(u) + self.c2 * v * np.abs(v)

    def commit(self, u: Array) -> None:
        """No memory."""

    @staticmethod
    def secant(parameters: Array, a: Array) -> Array:
        """First harmonic of the force over the amplitude a of a sine, N/m."""
        return parameters[..., 2:3] * a * 8 / (3 * np.pi)

    @staticmethod
    def lost(parameters: Array, a: Array, square: Array) -> Array:
        """Energy lost per cycle, J; ``square`` is that of the circular frequency."""
        return parameters[..., 3:4] * 8 / 3 * square * a**3


class Sliders:
    """Springs in series with sliders, whose yield displacements φ have the density R φ^χ up to φ_max and a lump there (Segalman 2005).

    Parameters (R, 4): Hz, ratio, N, −; stiffness when stuck and the lump's share are ``STICK`` and ``SHARE``. The spring that all of them
    make when stuck belongs to the linear part, so it is taken off.
    """

    def __init__(self, parameters: Array) -> None:
        slip, chi = parameters[:, 2:3], parameters[:, 3:4]
        share = SHARE + (chi + 1) / (chi + 2)
        largest = slip * (1 + SHARE) / (STICK * share)
        density = slip * (chi + 1) / (largest ** (chi + 2) * share)
        edges = largest * np.concatenate([[0.0], np.geomspace(1e-4, 1.0, SLIDERS)])
        part = np.diff(edges ** (chi + 1), axis=1) * density / (chi + 1)
        middle = np.diff(edges ** (chi + 2), axis=1) / (chi + 2) / (np.diff(edges ** (chi + 1), axis=1) / (chi + 1))
        lump = SHARE * density * largest ** (chi + 1) / (chi + 1)
        self.stiffness = np.concatenate([part, lump], axis=1)
        self.most = self.stiffness * np.concatenate([middle, largest], axis=1)
        self.now, self.last = np.zeros(self.most.shape), np.zeros(len(parameters))

    def _forces(self, u: Array) -> Array:
        return np.clip(self.now + self.stiffness * (u - self.last)[:, None], -self.most, self.most)

    def force(self, u: Array, v: Array) -> Array:
        """N."""
        return self._forces(u).sum(axis=1) - self.stiffness.sum(axis=1) * u

    def commit(self, u: Array) -> None:
        """The step has ended here."""
        self.now, self.last = self._forces(u), u

    @staticmethod
    def _density(parameters: Array) -> tuple[Array, Array]:
        slip, chi = parameters[..., 2:3], parameters[..., 3:4]
        share = SHARE + (chi + 1) / (chi + 2)
        largest = slip * (1 + SHARE) / (STICK * share)
        return slip * (chi + 1) / (largest ** (chi + 2) * share), chi

    @staticmethod
    def secant(parameters: Array, a: Array) -> Array:
        """At the turning point, N/m, below the last yield."""
        density, chi = Sliders._density(parameters)
        return -density * a ** (chi + 1) / ((chi + 1) * (chi + 2))

    @staticmethod
    def lost(parameters: Array, a: Array, square: Array) -> Array:
        """Area of Masing's loop, J; it does not depend on the frequency."""
        density, chi = Sliders._density(parameters)
        return 4 * density * a ** (chi + 3) / ((chi + 2) * (chi + 3))


def stepped(rate: Callable[[Array, Array, float], Array], u: Array, v: Array, a1: Array, h: float, pushes: tuple[float, float]
            ) -> tuple[Array, Array]:
    """One step h of Runge and Kutta for ü = rate(u, u̇, push); ``a1``: rate at its beginning, ``pushes``: in its middle and at its end."""
    half, last = pushes
    u2, v2 = u + 0.5 * h * v, v + 0.5 * h * a1
    a2 = rate(u2, v2, half)
    u3, v3 = u + 0.5 * h * v2, v + 0.5 * h * a2
    a3 = rate(u3, v3, half)
    u4, v4 = u + h * v3, v + h * a3
    a4 = rate(u4, v4, last)
    return u + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def integrate(frequency: Array, zeta: Array, law: Static | Sliders, disturbance: Array | None) -> tuple[Array, Array]:
    """Displacement and acceleration (R, n) at the rate ``FS``; ``disturbance`` (R, n · FINE), N, held over each fine step."""
    n, h = round(FS * SECONDS), 1 / (FS * FINE)
    p = force(h / 2 * np.arange(2 * n * FINE + 1))
    omega = 2 * np.pi * frequency
    c, k = 2 * zeta * omega, omega**2
    u, v = np.zeros(len(omega)), np.zeros(len(omega))
    out = np.empty((2, len(omega), n))
    for i in range(n * FINE):
        w = 0.0 if disturbance is None else disturbance[:, i]

        def rate(x: Array, y: Array, push: float, w: Array | float = w) -> Array:
            return push + w - c * y - k * x - law.force(x, y)

        a1 = rate(u, v, p[2 * i])
        if i % FINE == 0:
            # what a sensor shows is the motion: the jump of a force held over one fine step is not part of it
            out[0, :, i // FINE] = u
            out[1, :, i // FINE] = rate(u, v, p[2 * i], 0.0 if disturbance is None else 0.5 * (disturbance[:, i] + disturbance[:, i - 1]))
        u, v = stepped(rate, u, v, a1, h, (p[2 * i + 1], p[2 * i + 2]))
        law.commit(u)
    return out[0], out[1]


def hidden_mode(rng: np.random.Generator, count: int, n: int, push: Callable[[Array], Array]) -> Array:
    """Acceleration (count, n) of a mode at 151 Hz that the model does not have, shaken by the same force and a little noise."""
    frequency, zeta = 151.0 + rng.normal(size=(count, 1)), 0.003
    f = np.fft.rfftfreq(4 * n, 1 / FS)
    drive = np.concatenate([np.tile(push(np.arange(n) / FS), (count, 1)) + 0.02 * rng.normal(size=(count, n)),
                            np.zeros((count, 3 * n))], 1)
    gain = -(f**2) / (frequency**2 - f**2 + 2j * zeta * frequency * f)
    return np.fft.irfft(np.fft.rfft(drive, axis=1) * gain, 4 * n, axis=1)[:, :n]


def noise(rng: np.random.Generator, shape: tuple[int, int], coloured: bool) -> Array:
    """Unit rms over the band, white or falling as 1/f in power."""
    if not coloured:
        return rng.normal(size=shape)
    n = shape[1]
    f = np.fft.rfftfreq(2 * n, 1 / FS)
    shape_ = 1 / np.sqrt(np.maximum(f, 5.0) / 80.0)
    x = np.fft.irfft(np.fft.rfft(rng.normal(size=(shape[0], 2 * n)), axis=1) * shape_, 2 * n, axis=1)[:, :n]
    return x


def measure(scenario: Scenario, parameters: Array, rng: np.random.Generator,
            law: type[Static] | type[Sliders] = Static) -> Array:
    """Channels (R, n, s) of a virtual test for parameters (R, P), frequency and damping ratio first."""
    count, n = len(parameters), round(FS * SECONDS)
    disturbance = None
    if scenario.process:
        disturbance = rng.normal(scale=np.sqrt(scenario.process * FS * FINE / 2), size=(count, n * FINE))
    u, a = integrate(parameters[:, 0], parameters[:, 1], law(parameters), disturbance)
    if scenario.hidden_mode:
        a = a + hidden_mode(rng, count, n, force)
    out = []
    for quantity, share in zip(scenario.channels, scenario.noise, strict=True):
        clean = u if quantity == "displacement" else a
        out.append(clean + share * np.sqrt(np.mean(clean**2, axis=1, keepdims=True)) * noise(rng, (count, n), scenario.coloured))
    return np.stack(out, axis=-1)
