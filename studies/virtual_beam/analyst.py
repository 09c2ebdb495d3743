"""What the analyst knows and does: modal model, virtual sensing by three routes, training windows, and the fits of Table 3 and 4."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from studies.virtual_beam import beam
from studies.virtual_beam.beam import SLIP, Array

import bayes_nlsid as nl
from bayes_nlsid.inference.likelihood import whittle_variance
from bayes_nlsid.recordings.kinematics import kinematics
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.modal import ModalData, ModalModel
from bayes_nlsid.structure.sensing import modal_data

MODES = tuple(range(10))
BAND = (40.0, 700.0)    # Hz: eight harmonics of mode 1
RATE = 2048.0           # Hz, of the recordings as they are identified from
IWAN = nl.LIBRARY["iwan4"]
EDGE = 0.02             # share of a recording under the edges of the window through which joint forces are solved for
PLACES = 96             # between which force laws are interpolated while fitting


def recording(name: str, acceleration: Array, force: Array, noise: float, raw_rate: float, seed: int, role: str = "train",
              ) -> tuple[Recording, NoiseFloor]:
    """Noisy accelerations of all points at ``RATE``, and the density of their noise.

    ``noise`` is the rms (m/s²) of white noise at the rate of the recorder; ``acceleration`` (n, 12) and ``force`` (n,) are at ``RATE``.
    """
    sensors = tuple(f"P{i}" for i in range(1, 13))
    channels = tuple(Channel(s, s, "acceleration", "m/s^2") for s in sensors)
    density = 2 * noise**2 / raw_rate
    rng = np.random.default_rng(seed)
    response = acceleration + np.sqrt(density * RATE / 2) * rng.normal(size=acceleration.shape)
    frequency = np.linspace(0, RATE / 2, 50)
    floor = NoiseFloor(frequency, np.full((50, len(channels)), density), channels, "stated by the study", "measured", np.zeros((50, 1)))
    return Recording(name, 1 / RATE, response, channels, force[:, None], (Channel("force", beam.SHAKER, "force", "N"),),
                     role), floor  # type: ignore[arg-type]


@dataclass(frozen=True)
class Sensing:
    """Residual flexibilities between joints and sensors, and the modal filter: what the joints' own flexibility does to virtual sensing."""

    model: ModalModel

    @property
    def G_jj(self) -> Array:
        """(J, J) m/N between joints."""
        return self._part(SLIP, SLIP)

    @property
    def G_sj(self) -> Array:
        """(s, J) m/N from joints to sensors."""
        return self._part(self.model.sensors, SLIP)

    def _part(self, to: Sequence[str], at: Sequence[str]) -> Array:
        assert self.model.residual is not None
        index = self.model.locations.index
        return self.model.residual[np.ix_([index(n) for n in to], [index(n) for n in at])]

    def forces(self, data: ModalData) -> Array:
        """Excess force (n, J), N, of every joint, straight from a recording and without any law.

        In every frequency bin of the band, the equations of all modes say Bᵀ g = F − Z (u + S⁺ G_sj g), Z = ω_k² − ω² + 2iζω_kω:
        weighted least squares for as many unknowns as joints, each equation weighted by the noise that its stiffness makes of the sensors'.
        """
        lever, B = self._lever(data)
        omega, zeta = self.model.omega[list(data.modes)], self.model.zeta[list(data.modes)]
        edge = np.minimum(np.arange(data.n), np.arange(data.n)[::-1]) / (EDGE * data.n)
        window = np.sin(0.5 * np.pi * np.minimum(edge + 1e-3, 1))[:, None]
        # In time first, where a, v and u belong together; a window on u alone would leave the end of a decay as a force.
        missing = data.force - data.a - 2 * zeta * omega * data.v - omega**2 * data.u
        f = np.fft.rfftfreq(data.n, data.dt)
        inside = np.flatnonzero((f >= data.band[0]) & (f <= data.band[1]))
        w = 2 * np.pi * f[inside, None]
        Z = omega**2 - w**2 + 2j * zeta * omega * w
        weight = 1 / (np.maximum(np.abs(Z), 0.05 * omega**2) / w**2 * np.sqrt(data.noise))
        A = (B.T[None] + Z[:, :, None] * lever.T[None]) * weight[:, :, None]
        known = np.fft.rfft(window * missing, axis=0)[inside] * weight
        adjoint = A.conj().transpose(0, 2, 1)
        spectrum = np.zeros((len(f), len(B)), dtype=complex)
        spectrum[inside] = np.linalg.solve(adjoint @ A, adjoint @ known[..., None])[..., 0]
        return np.fft.irfft(spectrum, n=data.n, axis=0) / window


    def corrected(self, data: ModalData, force: Array) -> ModalData:
        """Modal and joint motion with what the joints' excess forces (n, J) take away from them put back.

        Sensors move by x = S u − G_sj g and joints by q = B u − G_jj g, so u = S⁺ (x + G_sj g).
        """
        lever, B = self._lever(data)
        channels = tuple(Channel(s, s, "displacement", "N") for s in SLIP)
        g = kinematics(Recording("force", data.dt, force, channels, np.zeros((data.n, 0))), data.band)
        du, dv, da = (x @ lever for x in (g.displacement, g.velocity, g.acceleration))
        return replace(data, u=data.u + du, v=data.v + dv, a=data.a + da, q=data.q + du @ B.T - g.displacement @ self.G_jj.T,
                       qd=data.qd + dv @ B.T - g.velocity @ self.G_jj.T)

    def force_of(self, data: ModalData, values: Array) -> Array:
        """Excess force (n, J) of known Iwan elements (J, 4), consistent with the joint motion that it leads to."""
        lever, B = self._lever(data)
        both = self.G_jj - B @ lever.T
        q = data.q
        for _ in range(30):
            g, slope = excess(q, values)
            miss = q + g @ both.T - data.q
            if np.abs(miss).max() < 1e-13:
                break
            q = q - np.linalg.solve(np.eye(len(SLIP)) + both * slope[:, None, :], miss[..., None])[..., 0]
        return excess(q, values)[0]

    def _lever(self, data: ModalData) -> tuple[Array, Array]:
        """What a joint's force takes from the modal coordinates (J, m), (S⁺ G_sj)ᵀ, and the joints' rows (J, m)."""
        filter_ = np.linalg.pinv(self.model.rows(self.model.sensors)[:, list(data.modes)])
        return self.G_sj.T @ filter_.T, self.model.rows(SLIP)[:, list(data.modes)]


def excess(q: Array, values: Array) -> tuple[Array, Array]:
    """Force of Iwan elements (J, 4) less that of their stuck springs at q (n, J), N, and its slope, N/m."""
    p = [values[:, i] for i in range(4)]
    return IWAN.law(q, 0 * q, *p) - p[1] * q, IWAN.slope(q, 0 * q, *p)[0] - p[1]


def observe(record: Recording, noise: NoiseFloor, model: ModalModel) -> ModalData:
    """Route (i) of virtual sensing: ten modes, and the measured force's quasi-static part."""
    return modal_data(record, model, MODES, SLIP, BAND, noise=noise, static_correction=True)


def windowed(data: ModalData, windows: dict[str, tuple[float, float]]) -> tuple[ModalData, ...]:
    """The training windows, s, all cut from one filtered recording."""
    return tuple(replace(data, name=name, valid=slice(round(a / data.dt), round(b / data.dt))) for name, (a, b) in windows.items())


def problem(model: ModalModel, data: Sequence[ModalData], name: str, elements: Sequence[nl.Element] | None = None,
            places: int = PLACES) -> nl.Problem:
    """Eq. 13 for S1, S2 or S3 with the 4-parameter Iwan element of known stuck stiffness at every joint, unless others are given."""
    chosen = iwan() if elements is None else tuple(elements)
    return nl.Problem(nl.Model(model, chosen, (0,)), tuple(data), nl.scenario(name, MODES), places=places)


def iwan(tied: bool = False) -> tuple[nl.Element, ...]:
    """k_t is the linear spring that the solid model already has."""
    return (nl.Element(IWAN, SLIP, tied=tied, fixed=(("k_t", beam.K_T),)),)


def values_of(theta: Array) -> Array:
    """(J, 4) parameters of the Iwan elements from theta of a problem as above."""
    x = np.asarray(theta)[2:].reshape(len(SLIP), 3)
    return np.column_stack([x[:, 0], np.full(len(SLIP), beam.K_T), x[:, 1:]])


def largest(values: Array) -> Array:
    """Displacement at macroslip φ_max (..., J), m, of values (..., J, 4)."""
    f, k, chi, beta = np.moveaxis(np.asarray(values), -1, 0)
    return f * (1 + beta) / (k * (beta + (chi + 1) / (chi + 2)))


def softening(values: Array) -> Array:
    """What micro-slip alone informs beside χ: R = k_t (χ+1) / ((1+β) φ_max^(χ+1)), given at χ as lost force at 10 µm, N."""
    f, k, chi, beta = np.moveaxis(np.asarray(values), -1, 0)
    return k / ((1 + beta) * (chi + 2) * largest(values) ** (chi + 1)) * (1e-5) ** (chi + 2)


@dataclass(frozen=True)
class Fitted:
    """One row of Table 3: a fit, and the data it was made on."""

    name: str
    fit: nl.Fit
    data: tuple[ModalData, ...]
    rounds: int

    @property
    def values(self) -> Array:
        """(J, 4)."""
        return values_of(self.fit.theta)


SETTLED = 1e-3


def common_law(model: ModalModel, data: ModalData, windows: dict[str, tuple[float, float]], *, rounds: int, starts: int,
               seed: int) -> tuple[nl.Fit, float]:
    """One Iwan law for all joints, equation of mode 1, the joints' flexibility put back anew in each round: a start that converges.

    Ends when a round changes the joints' forces by less than ``SETTLED`` (rms); also returns the last change.
    """
    sensing, found, force, change = Sensing(model), None, np.zeros_like(data.q), np.inf
    for i in range(rounds):
        own = sensing.corrected(data, force) if i else data
        found = nl.fit(problem(model, windowed(own, windows), "S2", iwan(tied=True)), starts=starts if i == 0 else 3, seed=seed,
                       warm=None if found is None else found.theta)
        new = sensing.force_of(data, common_values(found.theta))
        change = float(np.sqrt(np.mean((new - force) ** 2) / np.mean(new**2)))
        # Each step overshoots: the mean of both settles in half the rounds.
        force = new if i == 0 else 0.5 * (force + new)
        if change < SETTLED:
            break
    assert found is not None
    return found, change


def common_values(theta: Array) -> Array:
    """(J, 4) from theta (5,) of the common law."""
    return np.tile([theta[2], beam.K_T, theta[3], theta[4]], (len(SLIP), 1))


def fit_scenario(model: ModalModel, data: ModalData, windows: dict[str, tuple[float, float]], name: str, *, starts: int, seed: int,
                 rounds: int = 0, first: Array | None = None) -> Fitted:
    """Fit S1, S2 or S3.

    Parameters
    ----------
    rounds : int
        How often the joints' own flexibility is put back with the law found so far and the fit repeated; 0 does as the paper does.
    first : ndarray (5,), optional
        Theta of the common law, from which the first round starts.
    """
    sensing = Sensing(model)
    warm = None if first is None else np.concatenate([first[:2], np.tile(first[2:], len(SLIP))])
    own, weights = data, None
    for _ in range(max(1, rounds)):
        if rounds:
            assert warm is not None
            own = sensing.corrected(data, sensing.force_of(data, values_of(warm)))
        cut = windowed(own, windows)
        asked = problem(model, cut, name)
        if name == "S3":
            # Equations of high modes hold errors of the model far above sensor noise: weigh each by the spectrum of what it leaves.
            if warm is None:
                warm = nl.fit(asked, starts=starts, seed=seed).theta
            weights = 1 / whittle_variance(asked, warm)
        found = nl.fit(asked, starts=starts if warm is None else 3, seed=seed, warm=warm, weights=weights)
        warm = found.theta
    return Fitted(name + (" with joint flexibility" if rounds else ""), found, cut, rounds)
