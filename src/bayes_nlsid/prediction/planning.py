"""Before a test: which sensors, which excitation and which level let the parameters of suspected joints be learned, and what cannot be.

The response to a periodic random-phase multisine is simulated at assumed parameter values and at values a little larger and smaller. Its
derivatives J by ln p give the Fisher information of every sensor, Σ_k 4 |J_k|² / (N fs S) over lines k of a record of N samples at
rate fs with a flat one-sided noise spectrum S (Kay, *Estimation Theory*, 1993, Eq. 3.31, for independent spectral lines). Frequencies
and damping of modes in the band are parameters too, so that what they can imitate is not counted as learned. Information adds over
sensors, records and the prior; everything is local to the values that were assumed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.model import Element, Model
from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.structure.modal import ModalModel

Array = NDArray[np.float64]
STEP = 0.1  # of ln p in central differences, as a share of the smallest damping ratio: small beside the width of a resonance
DECADE = float(np.log(10.0))
FREQUENCY_PRIOR, DAMPING_PRIOR = 0.05, 0.5
"""Standard deviations of ln before the test: of linear frequencies and damping; of joint parameters it is one decade."""
LEARNED, ROUGHLY = 0.1, 0.5  # standard deviations of ln p up to which a parameter counts as learned, and as roughly learned
UNSEEN = 0.5  # a direction whose standard deviation shrinks to no less than this share of the prior is not learned
OVERSAMPLING = 20  # steps for one period of the highest frequency of the band
MOST_SAMPLES = 2_000_000  # of one simulation
HARMONICS = 3  # response is compared up to this multiple of the band


@final
@dataclass(frozen=True)
class Excitation:
    """One way to excite: where and how strongly, and what the joints and sensors then do.

    Parameters
    ----------
    input : str
    level : float
        rms of the force, N.
    information : ndarray (s, P, P)
        Of each candidate sensor about the logarithms of all parameters.
    motion : ndarray (l,)
        Largest displacement (m or rad) at the locations of the joints.
    status : str
        ``"ok"``, or why the simulation failed; then the information is zero.
    """

    input: str
    level: float
    information: Array
    motion: Array
    status: str = "ok"


@final
@dataclass(frozen=True)
class MeasurementPlan:
    """What tests can teach.

    Parameters
    ----------
    names, units : tuple of str, length P
        Parameters, linear ones first.
    values : ndarray (P,)
        Where the information was computed.
    linear : int
        How many of them are linear (frequencies, damping).
    sensors, places : tuple of str
        Candidate sensors, and locations of the joints.
    prior_sd : ndarray (P,)
        Of ln p.
    excitations : tuple of Excitation
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    linear: int
    sensors: tuple[str, ...]
    places: tuple[str, ...]
    prior_sd: Array
    excitations: tuple[Excitation, ...]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints' parameters."""
        return self.names[self.linear:]

    def covariance(self, information: Array) -> Array:
        """(J, J) of the logarithms of the joints' parameters, the linear ones marginalised, from information (P, P) and the prior."""
        scale = self.prior_sd
        whitened = np.eye(len(scale)) + scale[:, None] * information * scale
        full = scale[:, None] * np.linalg.inv(0.5 * (whitened + whitened.T)) * scale
        return np.asarray(full[self.linear:, self.linear:])

    def sd(self, information: Array) -> Array:
        """(J,) standard deviations of ln p of the joints' parameters."""
        return np.sqrt(np.diag(self.covariance(information)))

    def gain(self, information: Array) -> float:
        """Nats by which the test narrows the joints' parameters: half the log-ratio of prior to posterior volume squared."""
        prior = np.log(self.prior_sd[self.linear:]).sum()
        return float(prior - 0.5 * np.linalg.slogdet(self.covariance(information))[1])

    def ranked(self) -> list[tuple[Excitation, float, Array]]:
        """Excitations with (gain, sd (J,)) when all candidate sensors are used, the best first."""
        rows = [(e, self.gain(e.information.sum(axis=0)), self.sd(e.information.sum(axis=0))) for e in self.excitations]
        return sorted(rows, key=lambda row: -row[1])

    def sensors_for(self, excitation: Excitation) -> list[tuple[str, float]]:
        """Sensors in the order in which each adds most to those before it, with the gain reached."""
        left, total, out = list(range(len(self.sensors))), np.zeros((len(self.names),) * 2), []
        while left:
            gains = [self.gain(total + excitation.information[i]) for i in left]
            best = int(np.argmax(gains))
            total = total + excitation.information[left[best]]
            out.append((self.sensors[left.pop(best)], gains[best]))
        return out

    def unlearnable(self) -> list[tuple[float, tuple[tuple[str, float], ...]]]:
        """Directions that all sensors, places and levels together leave open: (remaining share of the prior sd, ((name, weight), ...))."""
        total = sum((e.information.sum(axis=0) for e in self.excitations), np.zeros((len(self.names),) * 2))
        scale = self.prior_sd[self.linear:]
        values, vectors = np.linalg.eigh(self.covariance(total) / np.outer(scale, scale))
        out = []
        for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
            if np.sqrt(max(value, 0.0)) >= UNSEEN:
                signed = vector * np.sign(vector[np.argmax(np.abs(vector))])
                parts = [(n, float(w)) for n, w in zip(self.joint_names, signed, strict=True) if abs(w) > 0.3 * np.abs(signed).max()]
                out.append((float(np.sqrt(value)), tuple(parts)))
        return out


def plan_test(linear: ModalModel, elements: Sequence[Element], values: Sequence[float], *, sensors: Sequence[str], inputs: Sequence[str],
              band: tuple[float, float], levels: Sequence[float], noise: float, seconds: float, quantity: str = "acceleration",
              seed: int = 0, progress: Callable[[float, str], None] | None = None) -> MeasurementPlan:
    """The Fisher information of every sensor under every excitation.

    Parameters
    ----------
    linear : ModalModel
    elements : sequence of Element
        Suspected joints.
    values : sequence of float
        Assumed values of their parameters in the order of `Model.names`, positive.
    sensors, inputs : sequence of str
        Candidate places for sensors and for the shaker.
    band : tuple of float
        Hz, of the multisine.
    levels : sequence of float
        rms of the force, N.
    noise : float
        rms of a sensor's noise within the band, in SI of ``quantity``.
    seconds : float
        Length of a record.
    quantity : {"acceleration", "velocity", "displacement"}

    Raises
    ------
    ValueError
        If a value is not positive, no mode lies in the band, a mode is too lightly damped to become steady, or a location is unknown.
    """
    near = tuple(k for k, f in enumerate(linear.frequency) if 0.8 * band[0] <= f <= 1.2 * band[1])
    if not near:
        raise ValueError(f"no mode of the model lies between {band[0]:g} and {band[1]:g} Hz; its modes are at "
                         f"{', '.join(f'{f:.4g}' for f in linear.frequency)} Hz")
    clock = _Clock.of(linear, near, band)
    model = Model(replace(linear, inputs=tuple(inputs)), tuple(elements), near)
    theta = model.start(values)
    if not (theta > 0).all():
        raise ValueError(f"values must be positive, got {list(values)}")
    places = tuple(dict.fromkeys(p for e in elements for p in e.locations))
    shape = _multisine(clock, band, np.random.default_rng(seed))
    found: list[Excitation] = []
    for i, where in enumerate(inputs):
        for level in levels:
            if progress is not None:
                progress(len(found) / (len(inputs) * len(levels)), f"{where}, {level:g} N")
            force = np.zeros((clock.total, len(inputs)))
            force[:, i] = level * shape
            found.append(_excite(model, theta, force, clock, (where, level), tuple(sensors), places, quantity,
                                 seconds * (band[1] - band[0]) / noise**2))
    prior = np.concatenate([np.full(len(near), FREQUENCY_PRIOR), np.full(len(near), DAMPING_PRIOR),
                            np.full(model.size - 2 * len(near), DECADE)])
    return MeasurementPlan(model.names, tuple(p.unit for p in model.parameters), theta, 2 * len(near), tuple(sensors), places, prior,
                           tuple(found))


@final
@dataclass(frozen=True)
class _Clock:
    """Rate (Hz), samples of one period, samples until the motion is steady, and (first, last) line that is compared."""

    rate: float
    period: int
    settle: int
    lines: tuple[int, int]

    @property
    def total(self) -> int:
        return self.settle + self.period + 1

    @classmethod
    def of(cls, linear: ModalModel, near: Sequence[int], band: tuple[float, float]) -> _Clock:
        """Periods that resolve the half-power width of the narrowest mode; two of them are six of its time constants."""
        width = min(2 * linear.zeta[k] * linear.frequency[k] for k in near)
        rate = OVERSAMPLING * band[1]
        if not width > 0 or 3 * rate / width > MOST_SAMPLES:
            raise ValueError(f"the narrowest mode of the band is {width:.2g} Hz wide, too little for its motion to be computed until it is "
                             f"steady in a band up to {band[1]:g} Hz; state its damping ([linear] damping) or narrow the band")
        seconds = max(1 / width, 0.5)
        period = round(seconds * rate)
        first, last = int(np.ceil(band[0] / 2 * seconds)), int(min(HARMONICS * band[1] * seconds, period // 2 - 1))
        return cls(rate, period, 2 * period, (max(first, 1), last))


def _multisine(clock: _Clock, band: tuple[float, float], rng: np.random.Generator) -> Array:
    """(total,) of rms 1: equal amplitudes and random phases at every line of the band."""
    spectrum = np.zeros(clock.period // 2 + 1, dtype=complex)
    low, high = (round(f * clock.period / clock.rate) for f in band)
    index = np.arange(max(low, 1), high + 1)
    spectrum[index] = np.exp(2j * np.pi * rng.random(index.size))
    one = np.fft.irfft(spectrum, clock.period)
    return np.asarray(np.resize(one / one.std(), clock.total))


def _excite(model: Model, theta: Array, force: Array, clock: _Clock, named: tuple[str, float], sensors: tuple[str, ...],
            places: tuple[str, ...], quantity: str, weight: float) -> Excitation:
    """Simulate at theta and around it; ``weight`` is record length over noise spectrum, s over (quantity² per Hz)."""
    size = model.size
    step = STEP * float(model.linear.zeta[list(model.free_modes)].min())
    steps = np.exp(step * np.concatenate([np.zeros((1, size)), np.eye(size), -np.eye(size)]))
    response = simulate(model, theta * steps, fs=clock.rate, samples=clock.total, force=force, scheme="exponential",
                        keep=(*sensors, *places), store=tuple({quantity, "displacement"}), skip=clock.settle)
    count = len(sensors)
    nothing = np.zeros((count, size, size))
    if not all(s == "ok" for s in response.status):
        return Excitation(*named, nothing, np.full(len(places), np.nan), "the simulation diverged at this level")
    signals = getattr(response, quantity)[:, -clock.period:, :count]
    first, last = clock.lines
    spectra = np.fft.rfft(signals, axis=1)[:, first:last + 1] / clock.period
    slopes = (spectra[1:size + 1] - spectra[size + 1:]) / (2 * step)  # (P, lines, s)
    # a record of N samples holds N / period repetitions: 4 |J_N|² / (N fs S) with J_N = N J becomes 4 |J|² · seconds / S
    information = 4 * weight * np.einsum("pks,qks->spq", slopes.conj(), slopes).real
    moved = np.abs(response.displacement[0, -clock.period:, count:]).max(axis=0)
    return Excitation(*named, information, moved)
