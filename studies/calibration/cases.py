"""What is calibrated: the model, its priors, how truths are drawn, and the exact backbone of each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from studies.calibration import truth
from studies.calibration.five_joints import FiveJoints

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.prior import Prior, default_priors
from bayes_nlsid.model import Element, Model
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.chains import oscillator
from bayes_nlsid.structure.sensing import modal_data

UNITS = {"acceleration": "m/s^2", "displacement": "m"}
AMPLITUDES = 1e-3 * np.array([0.1, 0.2, 0.35, 0.5, 0.7])     # m, within what the sweep reaches
Array = np.ndarray


@dataclass(frozen=True)
class Case:
    """A single degree of freedom with a static or a remembering joint."""

    name: str
    law: type[truth.Static] | type[truth.Sliders]
    elements: tuple[Element, ...]
    stated: tuple[tuple[str, float, float], ...]     # kind, a, b of the priors of the joint's parameters
    amplitudes: Array = field(default_factory=lambda: AMPLITUDES, repr=False)

    def measure(self, scenario_: truth.Scenario, theta: Array, rng: np.random.Generator) -> Array:
        """Channels (R, n, s) of virtual tests."""
        return truth.measure(scenario_, theta, rng, self.law)

    def shares(self, scenario_: truth.Scenario) -> Array:
        """Noise of each channel over the rms of its signal."""
        return np.asarray(scenario_.noise)

    @property
    def names(self) -> tuple[str, ...]:
        """Of theta."""
        return Model(oscillator(frequency=truth.F0, zeta=truth.ZETA, location="M"), self.elements, (0,)).names

    def recording(self, scenario_: truth.Scenario, channels: Array) -> Recording:
        """One virtual test (n, s) as a recording."""
        names = [Channel(f"sensor {i + 1}", "M", q, UNITS[q]) for i, q in enumerate(scenario_.channels)]
        force = truth.force(np.arange(len(channels)) / truth.FS)
        return Recording("test", 1 / truth.FS, channels, tuple(names), force[:, None], (Channel("force", "M", "force", "N"),))

    def regression(self, recording: Recording, seed: int) -> Fit:
        """The regression of Eq. 13."""
        linear = oscillator(frequency=truth.F0, zeta=truth.ZETA, location="M")
        data = modal_data(recording, linear, [0], ["M"], truth.BAND)
        problem = Problem(Model(linear, self.elements, (0,)), (data,), scenario("S1", 1), None, 1.0, (1.0, 4.0))
        return fit(problem, starts=1 if not problem.pieces else 8, seed=seed)

    def priors(self, problem: Problem) -> tuple[Prior, ...]:
        """Normal around the nominal frequency and damping, and what is stated of the joint."""
        known = [("normal", truth.F0, 0.15), ("normal", truth.ZETA, 0.1 * truth.ZETA), *self.stated]
        return tuple(replace(p, kind=kind, a=a, b=b) for p, (kind, a, b) in zip(default_priors(problem), known, strict=True))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Truths (count, P) from the same priors (their bounds lie far outside)."""
        known = [("normal", truth.F0, 0.15), ("normal", truth.ZETA, 0.1 * truth.ZETA), *self.stated]
        z = rng.normal(size=(count, len(known)))
        return np.stack([a * np.exp(b * x) if kind == "lognormal" else a + b * x for (kind, a, b), x in zip(known, z.T, strict=True)],
                        axis=1)

    def backbone(self, theta: Array) -> tuple[Array, Array]:
        """Frequency (Hz) and damping ratio (..., 5) at ``AMPLITUDES`` by first harmonics, in closed form."""
        omega, zeta, a = 2 * np.pi * theta[..., 0:1], theta[..., 1:2], self.amplitudes
        square = omega**2 + self.law.secant(theta, a)
        loss = self.law.lost(theta, a, square)
        return np.sqrt(square) / (2 * np.pi), zeta * omega / np.sqrt(square) + loss / (2 * np.pi * square * a**2)


def _element(name: str, **fixed: float) -> Element:
    return Element(LIBRARY[name], ("M",), fixed=tuple(fixed.items()))


CASES: dict[str, Case | FiveJoints] = {
    "static": Case("static", truth.Static, (_element("q|q|"), _element("v|v|")), (("normal", -2.4e6, 4e5), ("normal", 4.0, 1.0))),
    "memory": Case("memory", truth.Sliders, (_element("iwan4_memory", k_t=truth.STICK, beta=truth.SHARE),),
                   (("lognormal", 13.0, 0.15), ("normal", -0.5, 0.08))),
    **{name: FiveJoints(name, law, scheme) for name, law, scheme in (
        ("five S2", truth.Static, "S2"), ("five S3", truth.Static, "S3"),
        ("five S2 memory", truth.Sliders, "S2"), ("five S3 memory", truth.Sliders, "S3"))},
}
QUICK = tuple(name for name, case in CASES.items() if isinstance(case, Case))      # the others take ten seconds and more for each test
