"""The structure with five joints as a case: model of S2 or S3, priors, truths drawn from them, backbone of mode 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from studies.calibration import assembly, truth

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.prior import Prior, default_priors
from bayes_nlsid.model import Element, Model
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.modal import ModalModel
from bayes_nlsid.structure.sensing import modal_data

NAMES = tuple(f"J{j + 1}" for j in range(len(assembly.JOINTS)))
SOFTENING, DAMPING = -4e5, 2.0      # N/m² of each joint, N s²/m² of all: middles of the priors
SLIP, CHI = 5.0, -0.5               # N, −
Array = np.ndarray


def structure(modes: int = assembly.KEPT) -> ModalModel:
    """What the model knows: the nominal modes, sensors, shaker and joints."""
    sensors = tuple(f"S{i + 1}" for i in range(len(assembly.SENSORS)))
    rows = np.concatenate([assembly.shapes(assembly.SENSORS, modes), assembly.shapes(assembly.SHAKER, modes), assembly.slips(modes)])
    return ModalModel(2 * np.pi * assembly.FREQUENCY[:modes], assembly.ZETA[:modes].copy(), (*sensors, "F", *NAMES), rows, sensors=sensors,
                      inputs=("F",), joints=NAMES)


@dataclass(frozen=True)
class FiveJoints:
    """Five joints with static or remembering laws, identified in one of the scenarios of the paper.

    ``free`` is the number of modes whose frequency and damping are unknown; ``hidden`` that of modes which only the truth has.
    """

    name: str
    law: type[truth.Static] | type[truth.Sliders]
    scheme: str
    hidden: int = 0

    @property
    def free(self) -> tuple[int, ...]:
        """0-based modes whose linear parameters are estimated."""
        return (0,) if self.scheme == "S2" else tuple(range(assembly.KEPT))

    @property
    def elements(self) -> tuple[Element, ...]:
        """Of the model."""
        if self.law is truth.Static:
            return Element(LIBRARY["q|q|"], NAMES), Element(LIBRARY["v|v|"], NAMES, tied=True)
        return (Element(LIBRARY["iwan4_memory"], NAMES, fixed=(("k_t", truth.STICK), ("beta", truth.SHARE))),)

    @property
    def amplitudes(self) -> Array:
        """Modal amplitudes of the backbone, kg^1/2 m, within what the force reaches."""
        return 1e-3 * np.array([0.15, 0.3, 0.45, 0.6, 0.75])

    def _stated(self, names: tuple[str, ...]) -> list[tuple[str, float, float]]:
        """Kind and two numbers of the prior of every parameter."""
        out = []
        for name in names:
            mode = int(name[name.index("[") + 1]) - 1 if name.startswith(("f[", "zeta[")) else 0
            out.append(("normal", assembly.FREQUENCY[mode], 2e-3 * assembly.FREQUENCY[mode]) if name.startswith("f[")
                       else ("normal", assembly.ZETA[mode], 0.1 * assembly.ZETA[mode]) if name.startswith("zeta[")
                       else ("normal", SOFTENING, 0.2 * abs(SOFTENING)) if name.startswith("q|q|")
                       else ("normal", DAMPING, 0.25 * DAMPING) if name.startswith("v|v|")
                       else ("lognormal", SLIP, 0.2) if name.endswith("f_s") else ("normal", CHI, 0.08))
        return out

    @property
    def names(self) -> tuple[str, ...]:
        """Of theta."""
        return Model(structure(), self.elements, self.free).names

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Truths (count, P) from the priors."""
        known = self._stated(self.names)
        z = rng.normal(size=(count, len(known)))
        return np.stack([a * np.exp(b * x) if kind == "lognormal" else a + b * x for (kind, a, b), x in zip(known, z.T, strict=True)],
                        axis=1)

    def priors(self, problem: Problem) -> tuple[Prior, ...]:
        """The same as the package takes them."""
        return tuple(replace(p, kind=kind, a=a, b=b)
                     for p, (kind, a, b) in zip(default_priors(problem), self._stated(problem.names), strict=True))

    def _parts(self, theta: Array) -> tuple[Array, Array, list[Array]]:
        """Frequencies and damping ratios (R, modes) and, for each joint, what its law takes (R, 4)."""
        modes, n = assembly.KEPT + self.hidden, len(theta)
        f, zeta = np.tile(assembly.FREQUENCY[:modes], (n, 1)), np.tile(assembly.ZETA[:modes], (n, 1))
        laws = np.zeros((len(NAMES), n, 4))
        for name, column in zip(self.names, theta.T, strict=True):
            inside = name[name.index("[") + 1:name.index("]")]
            if name.startswith("f["):
                f[:, int(inside) - 1] = column
            elif name.startswith("zeta["):
                zeta[:, int(inside) - 1] = column
            elif name.startswith("v|v|"):
                laws[:, :, 3] = column
            else:
                laws[NAMES.index(inside), :, 3 if name.endswith("chi") else 2] = column
        return f, zeta, list(laws)

    def measure(self, noise: truth.Scenario, theta: Array, rng: np.random.Generator, seed: int = 0) -> Array:
        """Accelerations (R, n, 4) of a virtual test; every sensor has the noise of its place in the scenario, in turn."""
        f, zeta, laws = self._parts(theta)
        n = round(assembly.FS * assembly.SECONDS)
        disturbance = None
        if noise.process:
            scale = np.sqrt(noise.process * assembly.FS * assembly.FINE / 2)
            disturbance = rng.normal(scale=scale, size=(len(theta), n * assembly.FINE, f.shape[1]))
        clean = assembly.integrate(f, zeta, [self.law(p) for p in laws], seed, disturbance)
        if noise.hidden_mode:
            clean = clean + truth.hidden_mode(rng, len(theta), n, lambda t: assembly.force(t, seed))[:, :, None]
        rms = np.sqrt(np.mean(clean**2, axis=1, keepdims=True))
        unit = np.stack([truth.noise(rng, clean.shape[:2], noise.coloured) for _ in assembly.SENSORS], axis=-1)
        return np.asarray(clean + self.shares(noise) * rms * unit)

    def shares(self, noise: truth.Scenario) -> Array:
        """Noise of each sensor over the rms of its signal (4,)."""
        return np.resize(np.asarray(noise.noise), len(assembly.SENSORS))

    def recording(self, noise: truth.Scenario, channels: Array, seed: int = 0, name: str = "test") -> Recording:
        """One virtual test (n, 4) as a recording."""
        sensors = tuple(Channel(f"sensor {i + 1}", f"S{i + 1}", "acceleration", "m/s^2") for i in range(len(assembly.SENSORS)))
        pushed = assembly.force(np.arange(len(channels)) / assembly.FS, seed)
        return Recording(name, 1 / assembly.FS, channels, sensors, pushed[:, None], (Channel("force", "F", "force", "N"),))

    def problem(self, recording: Recording, scheme: str | None = None, elements: tuple[Element, ...] | None = None) -> Problem:
        """The regression's problem; another scenario or other elements where a comparison asks for them."""
        linear, asked = structure(), self.scheme if scheme is None else scheme
        data = modal_data(recording, linear, list(range(assembly.KEPT)), NAMES, assembly.BAND)
        free = (0,) if asked != "S3" else tuple(range(assembly.KEPT))
        return Problem(Model(linear, self.elements if elements is None else elements, free), (data,), scenario(asked, assembly.KEPT),
                       None, 1.0, (1.0, 4.0))

    def regression(self, recording: Recording, seed: int) -> Fit:
        """The regression of Eq. 13."""
        problem = self.problem(recording)
        return fit(problem, starts=1 if not problem.pieces else 8, seed=seed)

    def backbone(self, theta: Array) -> tuple[Array, Array]:
        """Frequency (Hz) and damping ratio (..., 5) of mode 1 at ``amplitudes`` by first harmonics, in closed form."""
        f, zeta, laws = self._parts(theta)
        omega, rows = 2 * np.pi * f[:, :1], np.abs(assembly.slips(1)[:, 0])
        seen = [(p, b * self.amplitudes) for p, b in zip(laws, rows, strict=True)]
        square = omega**2 + sum(b**2 * self.law.secant(p, a) for b, (p, a) in zip(rows, seen, strict=True))
        loss = sum(self.law.lost(p, a, square) for p, a in seen)
        return np.sqrt(square) / (2 * np.pi), zeta[:, :1] * omega / np.sqrt(square) + loss / (2 * np.pi * square * self.amplitudes**2)
