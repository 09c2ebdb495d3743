"""Stepped-sine response curves: harmonic balance followed along its arc, past turning points, for a batch of curves side by side.

Everything is condensed onto the R locations that carry elements and the one whose response is wanted: with the compliance of the linear
part C_h(Ω) = Σ_m b_m b_mᵀ / (ω_m² − h²Ω² + 2iζ_m ω_m hΩ), a steady motion under F cos Ωt fulfils for every harmonic h

    x_h = C_h(Ω) (e_F F δ_h1 − G_h(x, Ω)),

G: forces of the elements along the motion (``prediction/harmonics.py``). However many modes there are, x is the only unknown. Curves are
followed by pseudo-arc-length continuation: a step along the tangent, Newton's method back onto the curve in the plane across it (Krack and
Gross 2019, chapter 4). Lengths are relative to the motion at the point, so that resonances get points and the flat parts do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.model import Model
from bayes_nlsid.prediction.harmonics import Basis, SteadyForces, orders_for, period_samples
from bayes_nlsid.prediction.response_curve import Curve
from bayes_nlsid.prediction.stability import has_multipliers, multipliers

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
LONGEST, SHORTEST, FIRST = 0.15, 1e-7, 0.03
SPAN = 9.0
"""The band counts as this many lengths of relative change: at least 60 steps over it."""
ROUNDS = 9
SETTLED = 1e-7
SHARP = 0.85
"""Smallest cosine between successive tangents; a sharper turn is taken in shorter steps, down to a length at which it is a corner."""
CORNER = 2e-3
MOST_POINTS = 4000
RAMPS, RAMP_STEPS = (0.02, 50.0), 16
FLOOR = 0.02
FAILED, FINER = "the corrector failed", 4


def response_curves(model: Model, theta: ArrayLike, *, drive: str, at: str, levels: ArrayLike, band: tuple[float, float],
                    harmonics: int = 7, samples: int | None = None, most_points: int = MOST_POINTS, stability: bool = True,
                    progress: Callable[[float], None] | None = None) -> list[list[Curve]]:
    """Response curves under a sine force, for every sample of theta at every level.

    Parameters
    ----------
    model : Model
    theta : array_like (S, P) or (P,)
    drive, at : str
        Locations of the force and of the response.
    levels : array_like (F,)
        Amplitudes of the force as recorded, N; where the model has a gain, the structure feels gain · F.
    band : (low, high)
        Hz.
    harmonics : int
        The highest; odd ones only where every force is odd.
    samples : int or None
        Instants per period at which forces are evaluated; None: as the laws need, four times as many where that fails.
    most_points : int
        Points after which a curve is given up.
    stability : bool
        Whether Floquet multipliers are computed; they are not where a force has memory.
    progress : callable or None
        Share of the band done by the slowest curve.

    Returns
    -------
    list (S) of list (F) of Curve

    Raises
    ------
    ValueError
        If a location is unknown or does not move, or band and levels are not positive.
    """
    values = np.atleast_2d(np.asarray(theta, dtype=float))
    force = np.atleast_1d(np.asarray(levels, dtype=float))
    if not (0 < band[0] < band[1] and np.isfinite(band).all()):
        raise ValueError(f"band {band} Hz must run from a positive frequency to a higher one")
    if force.ndim != 1 or not (np.isfinite(force).all() and (force > 0).all()):
        raise ValueError(f"levels {force} must be positive numbers of N")
    if harmonics < 1:
        raise ValueError(f"harmonics must be at least 1, got {harmonics}")
    for name, what in ((drive, "driven"), (at, "observed")):
        if not np.any(model.linear.rows((name,))):
            raise ValueError(f"location {name!r} does not move in any mode, it cannot be {what}")
    count = len(force)
    gain = model.gain(values)
    applied = np.tile(force, (len(values), 1)) * (1.0 if gain is None else gain[:, None])
    every, applied = np.repeat(values, count, axis=0), applied.ravel()

    def trace(which: NDArray[np.intp], instants: int) -> list[Curve]:
        basis = Basis(orders_for(model, harmonics), instants)
        return _Tracer(_System(model, every[which], applied[which], drive, at, basis), band, most_points).trace(progress)

    first = samples or period_samples(model, harmonics)
    curves = trace(np.arange(len(every)), first)
    failed = np.flatnonzero([curve.status.startswith(FAILED) for curve in curves]) if samples is None else np.zeros(0, dtype=np.intp)
    if failed.size:  # at kinks a coarse period is jagged
        for i, again in zip(failed, trace(failed, FINER * first), strict=True):
            curves[i] = again
    if stability and has_multipliers(model):
        found = multipliers(model, every, curves)
        curves = [replace(curve, multiplier=one) for curve, one in zip(curves, found, strict=True)]
    curves = [replace(curve, level=float(force[i % count])) for i, curve in enumerate(curves)]
    return [curves[i * count:(i + 1) * count] for i in range(len(values))]


@final
class _System:
    """The balance of every curve: residual and derivatives."""

    def __init__(self, model: Model, theta: Array, level: Array, drive: str, at: str, basis: Basis) -> None:
        self.basis, self.level = basis, level
        self.forces = SteadyForces(model, theta, basis)
        self.joints = len(self.forces.locations)
        self.locations = self.forces.locations if at in self.forces.locations else (*self.forces.locations, at)
        self.at = self.locations.index(at)
        self.rows = model.linear.rows(self.locations)
        self.drive = model.linear.rows((drive,))[0]
        self.omega, self.zeta = model.linear_values(theta)
        self.size = len(self.locations) * basis.size
        self._orders = np.asarray(basis.orders, dtype=float)

    def compliance(self, w: Array, which: NDArray[np.intp]) -> tuple[Complex, Complex]:
        """1/(ω² − h²Ω² + 2iζω hΩ) and its derivative by Ω, (B, H, m)."""
        h = self._orders[None, :, None]
        omega, damping = self.omega[which, None], 2j * (self.zeta * self.omega)[which, None]
        hw = h * w[:, None, None]
        inverse = 1 / (omega**2 - hw**2 + damping * hw)
        return np.asarray(inverse), np.asarray(inverse**2 * h * (2 * hw - damping))

    def linear(self, w: Array, which: NDArray[np.intp]) -> Array:
        """Motion (B, L, C) without any element."""
        return self._driven(self.compliance(w, which)[0], which)

    def _driven(self, inverse: Complex, which: NDArray[np.intp]) -> Array:
        out = np.zeros((len(which), len(self.locations), len(self.basis.orders)), dtype=complex)
        first = self.basis.orders.index(1)
        out[..., first] = self.level[which, None] * np.einsum("lm,m,bm->bl", self.rows, self.drive, inverse[:, first])
        return self.basis.real(out)

    def _blocks(self, inverse: Complex) -> Array:
        """C_h between all locations and the joints as real matrices (B, L, R, C, C)."""
        between = np.einsum("lm,rm,bhm->blrh", self.rows, self.rows[:self.joints], inverse)
        c = self.basis.size
        out = np.zeros((*between.shape[:3], c, c))
        cosine, sine = np.flatnonzero(~self.basis.sine), np.flatnonzero(self.basis.sine)
        out[..., cosine, cosine] = between.real
        paired = between[..., [i for i, h in enumerate(self.basis.orders) if h > 0]]
        out[..., sine, sine] = paired.real
        out[..., sine - 1, sine] = paired.imag
        out[..., sine, sine - 1] = -paired.imag
        return out

    def residual(self, x: Array, w: Array, which: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """r (B, n), ∂r/∂x (B, n, n), ∂r/∂Ω (B, n) for x (B, n)."""
        batch, n, c, r = len(x), self.size, self.basis.size, self.joints
        inverse, slope = self.compliance(w, which)
        motion = x.reshape(batch, -1, c)
        out, by_w = motion - self._driven(inverse, which), -self._driven(slope, which)
        jacobian = np.zeros((batch, len(self.locations), c, len(self.locations), c))
        if r:
            force, by_x, by_omega = self.forces.evaluate(motion[:, :r], w, which)
            between = self._blocks(inverse)
            out = out + np.einsum("blrij,brj->bli", between, force)
            by_w += np.einsum("blrij,brj->bli", self._blocks(slope), force) + np.einsum("blrij,brj->bli", between, by_omega)
            jacobian[:, :, :, :r] = (between @ by_x[:, None]).transpose(0, 1, 3, 2, 4)
        whole = jacobian.reshape(batch, n, n)
        whole[:, np.arange(n), np.arange(n)] += 1.0
        return out.reshape(batch, n), whole, by_w.reshape(batch, n)


@final
class _Tracer:
    """All curves of a batch, each at its own step length; arrays with one row per curve."""

    def __init__(self, system: _System, band: tuple[float, float], most_points: int) -> None:
        self.system, self.most = system, most_points
        self.low, self.high = 2 * np.pi * band[0], 2 * np.pi * band[1]
        count = len(system.level)
        self.kappa = (self.high - self.low) / SPAN
        self.x, self.w = np.zeros((count, system.size)), np.full(count, self.low)
        self.tangent = np.zeros((count, system.size + 1))
        self.step = np.full(count, FIRST)
        self.peak = np.zeros((count, len(system.locations)))
        self.points: list[list[tuple[float, Array]]] = [[] for _ in range(count)]
        self.status = np.full(count, "ok", dtype="<U64")
        self.active = np.ones(count, dtype=bool)

    def trace(self, progress: Callable[[float], None] | None) -> list[Curve]:
        """Follow every curve to the end of the band."""
        self._begin()
        while self.active.any():
            self._advance(np.flatnonzero(self.active))
            if progress is not None:
                progress(float(np.clip((self.w.min() - self.low) / (self.high - self.low), 0, 1)))
        system, c = self.system, self.system.basis.size
        out = []
        for i, points in enumerate(self.points):
            frequency = np.array([w for w, _ in points]) / (2 * np.pi)
            motion = np.array([x for _, x in points]).reshape(len(points), len(system.locations), c)
            out.append(Curve(frequency, system.locations, motion, system.basis, float(system.level[i]), str(self.status[i])))
        return out

    def _scale(self, x: Array, which: NDArray[np.intp]) -> Array:
        """Size (B, n) of the motion at each location, which lengths are relative to."""
        size = np.sqrt((x.reshape(len(x), len(self.system.locations), -1) ** 2).sum(axis=2))
        self.peak[which] = np.maximum(self.peak[which], size)
        size = np.maximum(size, FLOOR * self.peak[which]) + 1e-300
        return np.repeat(size, self.system.basis.size, axis=1)

    def _begin(self) -> None:
        """The first point, at the lower end: Newton from the linear response, else from a small force upwards or a large one downwards."""
        system, full = self.system, self.system.level
        x = system.linear(self.w, np.arange(len(self.w))).reshape(len(self.w), -1)
        self.x, good = self._settle(x, self.w, np.arange(len(self.w)))
        for far in RAMPS:
            rest = np.flatnonzero(~good)
            if not rest.size:
                break
            y = far * x[rest]
            for share in np.geomspace(far, 1.0, RAMP_STEPS):
                system.level = share * full
                y, good[rest] = self._settle(y, self.w[rest], rest)
            self.x[rest] = y
        system.level = full
        self.status[~good], self.active[~good] = "no steady response found at the lower end of the band", False
        which = np.flatnonzero(good)
        if len(which):
            scale = self._scale(self.x[which], which)
            ahead = np.zeros((len(which), system.size + 1))
            ahead[:, -1] = 1.0
            _, jacobian, by_w = system.residual(self.x[which], self.w[which], which)
            self.tangent[which] = self._direction(jacobian, by_w, scale, ahead)
            self._record(which)

    def _settle(self, x: Array, w: Array, which: NDArray[np.intp]) -> tuple[Array, NDArray[np.bool_]]:
        """Newton at fixed frequency."""
        x, done = x.copy(), np.zeros(len(x), dtype=bool)
        for _ in range(2 * ROUNDS):
            r, jacobian, _ = self.system.residual(x, w, which)
            delta = _solve(jacobian, -r)
            x = x + delta
            size = np.abs(x).max(axis=1)
            done = np.abs(delta).max(axis=1) <= SETTLED * size
            if done.all():
                break
        return x, done

    def _direction(self, jacobian: Array, by_w: Array, scale: Array, before: Array) -> Array:
        """Unit tangent (B, n + 1) in relative lengths, pointing the way ``before`` does."""
        matrix = self._bordered(jacobian, by_w, scale, before)
        right = np.zeros(matrix.shape[:2])
        right[:, -1] = 1.0
        tangent = _solve(matrix, right)
        return np.asarray(tangent / np.linalg.norm(tangent, axis=1, keepdims=True))

    def _bordered(self, jacobian: Array, by_w: Array, scale: Array, across: Array) -> Array:
        n = self.system.size
        matrix = np.empty((len(jacobian), n + 1, n + 1))
        matrix[:, :n, :n] = jacobian * scale[:, None, :] / scale[:, :, None]
        matrix[:, :n, n] = self.kappa * by_w / scale
        matrix[:, n] = across
        return matrix

    def _advance(self, which: NDArray[np.intp]) -> None:
        """One step of the given curves: predict, correct, accept or shorten."""
        scale = self._scale(self.x[which], which)
        start = self.tangent[which]
        move = self.step[which, None] * start
        x, w = self.x[which] + scale * move[:, :-1], self.w[which] + self.kappa * move[:, -1]
        rounds, open_ = np.zeros(len(which), dtype=int), np.ones(len(which), dtype=bool)
        failed, ahead = np.zeros(len(which), dtype=bool), np.zeros_like(start)
        for _ in range(ROUNDS):
            part = np.flatnonzero(open_)
            if not part.size:
                break
            r, jacobian, by_w = self.system.residual(x[part], w[part], which[part])
            matrix = self._bordered(jacobian, by_w, scale[part], start[part])
            right = np.zeros((len(part), matrix.shape[1], 2))
            right[:, :-1, 0], right[:, -1, 1] = -r / scale[part], 1.0
            solved = _solve(matrix, right)
            delta = solved[..., 0]
            x[part] += scale[part] * delta[:, :-1]
            w[part] += self.kappa * delta[:, -1]
            rounds[part] += 1
            size = np.abs(delta).max(axis=1)
            ahead[part] = solved[..., 1] / np.linalg.norm(solved[..., 1], axis=1, keepdims=True)
            failed[part] = ~(size < 1.0) | (w[part] <= 0)
            open_[part] = ~(size <= SETTLED) & ~failed[part]
        turn = np.einsum("bi,bi->b", ahead, start)
        good = ~open_ & ~failed & ((turn > SHARP) | (self.step[which] < CORNER))
        self._accept(which[good], x[good], w[good], ahead[good], rounds[good], turn[good])
        short = which[~good]
        self.step[short] *= 0.4
        ended = short[self.step[short] < SHORTEST]
        for i in ended:
            self.status[i] = f"{FAILED} at {self.w[i] / (2 * np.pi):.4g} Hz"
        self.active[ended] = False

    def _accept(self, which: NDArray[np.intp], x: Array, w: Array, ahead: Array, rounds: NDArray[np.int64], turn: Array) -> None:
        """Take the points, turn the tangents into the new measure of length, choose the next steps."""
        if not which.size:
            return
        old, self.x[which], self.w[which] = self._scale(self.x[which], which), x, w
        ahead = ahead.copy()
        ahead[:, :-1] *= old / self._scale(x, which)
        self.tangent[which] = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        grow = np.select([rounds > 5, turn < 0.96, rounds <= 3], [0.6, 0.8, 1.5], 1.0)
        self.step[which] = np.minimum(self.step[which] * grow, LONGEST)
        self._record(which)
        self.active[which[(w > self.high) | (w < self.low)]] = False
        long = which[[len(self.points[i]) >= self.most for i in which]]
        self.status[long[self.active[long]]] = f"the band was not crossed in {self.most} points"
        self.active[long] = False

    def _record(self, which: NDArray[np.intp]) -> None:
        for i in which:
            self.points[i].append((float(self.w[i]), self.x[i].copy()))


def _solve(matrix: Array, right: Array) -> Array:
    """Solutions for right sides (B, n) or (B, n, k); NaN where a matrix is singular or not finite."""
    sides = right[..., None] if right.ndim == 2 else right
    finite = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(sides).all(axis=(1, 2))
    out = np.full(sides.shape, np.nan)
    try:
        out[finite] = np.linalg.solve(matrix[finite], sides[finite])
    except np.linalg.LinAlgError:
        for i in np.flatnonzero(finite):
            try:
                out[i] = np.linalg.solve(matrix[i], sides[i])
            except np.linalg.LinAlgError:
                continue
    return out[..., 0] if right.ndim == 2 else out
