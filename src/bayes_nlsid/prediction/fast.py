"""Backbones without time integration: harmonic balance at given amplitudes, then averaging; all samples and amplitudes at once.

At each amplitude of one mode the conservative motion u(θ), θ = Ωt, is balanced in odd harmonics, all modes taking part:

    (ω_k² − h²Ω² + 2iζ_k ω_k hΩ) U_kh = −F_kh,    U_mode,1 = a  ⇒  Ω² = ω² + Re F_mode,1 / a

(Krack and Gross 2019, chapter 2, with the amplitude prescribed). The decay follows from the action J = ½ Ω Σ h²|U_kh|², which loses W/2π
per radian where W
is the energy taken out per cycle, so that the rate of decay of the amplitude A is (W/2π) / (J dlnJ/dlnA) (averaging; Krylov and
Bogoliubov).
"""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.term import Term
from bayes_nlsid.model import Model
from bayes_nlsid.prediction.bands import Bands, Drawable, amplitude_grid, quantiles

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
HARMONICS = np.array([1, 3, 5])
POINTS = 16
INNER = 24
ROUNDS = 40   # five do where the modes are few; the flexibility of a joint that many modes carry needs twenty
CONVERGED = 1e-6
INTERACTION = 0.02
"""Share of kinetic energy outside the first harmonic of the mode beyond which one mode alone is not the motion."""
CHUNK_BYTES = 2**25


def fast_bands(draws: ArrayLike | Drawable, model: Model, *, at: str, start_amplitude: float, mode: int = 0,
               amplitudes: ArrayLike | None = None,
               stop_amplitude: float | None = None, samples: int = 200, seed: int = 0) -> Bands:
    """Backbone bands of one mode by harmonic balance and averaging, far faster than time integration.

    Parameters
    ----------
    draws, model, at, start_amplitude, mode, amplitudes, stop_amplitude, samples, seed
        As in ``backbone_bands``.

    Returns
    -------
    Bands
        ``scheme`` is ``"averaging"``; the numerical errors are NaN, as nothing is integrated. Status of a sample: ``"ok"``; ``"modes
        interact"``: more than
        2 % of the kinetic energy is in other modes or harmonics somewhere, so a decay would beat; ``"not converged"``.

    Raises
    ------
    ValueError
        If the location does not move in this mode, or a term is neither odd and memoryless nor of Masing's kind: those need time
        integration.
    """
    theta = np.atleast_2d(draws.draws(samples, seed) if isinstance(draws, Drawable) else np.asarray(draws, dtype=float))
    shape = abs(float(model.linear.rows((at,))[0, mode]))
    if shape == 0:
        raise ValueError(f"location {at!r} does not move in mode {mode}; name another")
    grid = amplitude_grid(amplitudes, start_amplitude, stop_amplitude or start_amplitude / 400)
    # wider than what is asked for: the slope at the ends needs neighbours
    log_a = np.linspace(np.log(0.8 * grid[0] / shape), np.log(1.25 * grid[-1] / shape), INNER)
    per_sample = 8 * INNER * POINTS * 8 * max(1, len(_Joints.locations_of(model)))
    chunk = max(1, CHUNK_BYTES // per_sample)
    parts = [_curves(model, theta[i:i + chunk], mode, at, log_a, np.log(grid / shape)) for i in range(0, len(theta), chunk)]
    frequency, damping = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
    status = np.concatenate([p[2] for p in parts])
    ok = status == "ok"
    nothing = np.full(len(grid), np.nan)
    counts = {str(name): int((status == name).sum()) for name in np.unique(status)}
    zero = np.zeros(model.linear.modes)
    return Bands(grid, quantiles(frequency, ok), quantiles(damping, ok), frequency, damping, nothing, nothing.copy(), at, mode, counts,
                 "averaging",
                 0.0, zero, zero.copy())


@final
class _Joints:
    """Forces of all elements over half a period of a motion that is odd under θ → θ + π."""

    def __init__(self, model: Model, theta: Array) -> None:
        self.locations = self.locations_of(model)
        self.shapes = model.linear.rows(self.locations) if self.locations else np.zeros((0, model.linear.modes))
        self.entries: list[tuple[int, Term, tuple[Array, ...], Any]] = []
        for i, element in enumerate(model.elements):
            term = element.term
            if term.parity != "odd" or term.memory not in ("none", "masing"):
                raise ValueError(f"term {term.name!r}: averaging takes odd memoryless terms and Masing memory; use backbone_bands")
            for name in element.locations:
                values = model.element_values(theta, i, name)
                p = tuple(values[:, j, None, None] for j in range(values.shape[1]))
                spring = term.stiffness(*p) if element.excess and term.stiffness is not None else 0.0
                self.entries.append((self.locations.index(name), term, p, spring))

    @staticmethod
    def locations_of(model: Model) -> tuple[str, ...]:
        """Locations that carry elements, each once."""
        return tuple(dict.fromkeys(name for element in model.elements for name in element.locations))

    def force(self, q: Array, v: Array, peak: Array) -> Array:
        """(R, S, K, points) for displacement, velocity of that shape; ``peak`` (R, S, K, 1): displacement at θ = 0, where loops turn."""
        out = np.zeros_like(q)
        for r, term, p, spring in self.entries:
            if term.memory == "masing":
                still = np.zeros_like(q[r])
                f = term.law(peak[r], still[..., :1], *p) + 2 * term.law((q[r] - peak[r]) / 2, still, *p)
            else:
                f = term.law(q[r], v[r], *p)
            out[r] += f - spring * q[r]
        return out


def _curves(model: Model, theta: Array, mode: int, at: str, log_a: Array, wanted: Array) -> tuple[Array, Array, NDArray[np.str_]]:
    """Frequency (Hz), damping (S, K) at the wanted ln(A/|shape|), and status (S,)."""
    from scipy.interpolate import CubicSpline

    omega, zeta = model.linear_values(theta)
    motion, square, converged, force = _balance(model, theta, omega, zeta, mode, np.exp(log_a))
    h2 = HARMONICS**2
    w = np.sqrt(np.where(square > 0, square, np.nan))
    kinetic = np.einsum("mskh,h->msk", np.abs(motion) ** 2, h2)
    action = 0.5 * w * kinetic.sum(axis=0)
    linear = 2 * np.pi * w * np.einsum("sm,msk->sk", zeta * omega, kinetic)
    memory = any(element.term.memory != "none" for element in model.elements)
    joints = np.pi * np.einsum("mskh,h->sk", (force * motion.conj()).imag, HARMONICS)
    loss = linear + joints
    rows = model.linear.rows((at,))[0]
    peak = np.abs(np.einsum("m,mskh->sk", rows, motion).real)
    excess = np.log(peak / abs(rows[mode])) - log_a
    other = 1 - np.abs(motion[mode, ..., 0]) ** 2 / kinetic.sum(axis=0)
    used = (log_a >= wanted[0] - 0.1) & (log_a <= wanted[-1] + 0.1)
    status = np.full(len(theta), "ok", dtype="<U16")
    status[~(converged & np.isfinite(w) & (peak > 0))[:, used].all(axis=1)] = "not converged"
    status[(np.nan_to_num(other, nan=1.0) > INTERACTION)[:, used].any(axis=1)] = "modes interact"
    out = np.full((2, len(theta), len(wanted)), np.nan)
    good = status == "ok"
    if good.any():
        # loss over action is nearly flat, where loss alone grows like the square of the amplitude
        viscous = (linear + (0.0 if memory else joints)) / action
        turning = _turning(model, theta, motion, mode) if memory else ()
        curves = np.stack([w, np.log(action), loss / action, excess, viscous, *turning])[:, good]
        finite = np.isfinite(curves).all(axis=(0, 1))
        spline = CubicSpline(log_a[finite], curves[:, :, finite], axis=2)
        # the peak is the prescribed amplitude times exp(excess): go back by that much along the curve
        value, slope = spline(wanted), spline(wanted, 1)
        back = value[3] / (1 + slope[3])
        value, slope = value - slope * back, slope - spline(wanted, 2) * back
        growth = slope[1] / (1 + slope[3])
        rate, slowing = value[2] / (2 * np.pi) / growth, value[4] / (2 * np.pi) / growth
        if memory:
            secant = value[0] ** 2 + 0.5 * value[0] * slope[0] / (1 + slope[3])
            rate = rate * secant / (omega[good, mode, None] ** 2 + value[6] + value[5] + slope[5] / (1 + slope[3]))
        # Zero crossings come later for what is lost in proportion to velocity; loops open towards the turning points and hardly delay them.
        out[0, good], out[1, good] = np.sqrt(np.maximum(value[0] ** 2 - slowing**2, 0.0)) / (2 * np.pi), rate / value[0]
    return out[0], out[1], status


def _turning(model: Model, theta: Array, motion: Complex, mode: int) -> tuple[Array, Array]:
    """Forces (S, K) of elements with and without memory where the motion turns, in the equation of the mode, over its amplitude.

    In a decay no loop closes. The branch that leaves the amplitude A ends at A' where the energy is used up: by Masing's rule
    f(A) (A + A') = 4 Φ((A + A')/2), Φ the integral of the backbone f. To second order that is the loss of the closed loop at the
    mean amplitude a over a f'(a), the slope of the backbone, where averaging has f(a).
    """
    joints = _Joints(model, theta)
    at_joints = np.tensordot(joints.shapes, motion, axes=1).sum(axis=-1).real[..., None]
    still, amplitude = np.zeros_like(at_joints[:1])[0], motion[mode, ..., 0].real
    parts = [np.zeros(amplitude.shape), np.zeros(amplitude.shape)]
    for r, term, p, spring in joints.entries:
        force = term.law(at_joints[r], still, *p) - spring * at_joints[r]
        parts[0 if term.memory == "masing" else 1] += joints.shapes[r, mode] * force[..., 0] / amplitude
    return parts[0], parts[1]


def _balance(model: Model, theta: Array, omega: Array, zeta: Array, mode: int, amplitude: Array) -> tuple[Complex, Array,
                                                                                                          NDArray[np.bool_], Complex]:
    """Harmonics U (m, S, K, h), Ω² (S, K), convergence (S, K) and modal forces F (m, S, K, h)."""
    joints = _Joints(model, theta)
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    angle, weights = (nodes + 1) * np.pi / 2, weights * np.pi / 2
    wave = np.exp(1j * np.outer(HARMONICS, angle))
    project = (2 / np.pi) * weights[:, None] * wave.conj().T
    samples, count, m = len(theta), len(amplitude), model.linear.modes
    motion = np.zeros((m, samples, count, len(HARMONICS)), dtype=complex)
    motion[mode, ..., 0] = amplitude
    square = np.repeat(omega[:, mode, None] ** 2, count, axis=1)
    converged = np.zeros((samples, count), dtype=bool)
    force = np.zeros_like(motion)
    w2, c = (omega.T**2)[..., None, None], (2 * zeta * omega).T[..., None, None]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(ROUNDS):
            at_joints = np.tensordot(joints.shapes, motion, axes=1)
            speed = np.sqrt(square)[None, ..., None]
            q, v = (at_joints @ wave).real, speed * ((1j * HARMONICS * at_joints) @ wave).real
            force = np.tensordot(joints.shapes.T, joints.force(q, v, at_joints.sum(axis=-1, keepdims=True).real) @ project, axes=1)
            new = omega[:, mode, None] ** 2 + force[mode, ..., 0].real / amplitude
            converged = np.abs(new / square - 1) < CONVERGED
            square = new
            h = HARMONICS * np.sqrt(square)[None, ..., None]
            motion = -force / (w2 - h**2 + 1j * c * h)
            motion[mode, ..., 0] = amplitude
            if converged.all():
                break
    return motion, square, converged, force
