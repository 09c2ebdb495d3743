"""Forces of all elements along a steady period, with their tangent: alternating frequency and time, for a batch of motions.

A steady motion at R locations is q(θ) = Σ x_c e_c(θ), θ = Ωt, with e = 1, cos hθ, sin hθ. The force of an element is sampled over one
period by the element's own law, and projected back; the tangent is the law's own slope carried through the same projection (Cameron and
Griffin 1989). Forces with memory follow the same path until their loop has closed:

* Masing: from the largest excursion, where every earlier loop has been wiped out, one period is the whole loop;
* sliders: two periods, the second of which is the loop;
* Bouc–Wen: period after period, with Newton's method on the force at the start, until it returns to where it began.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.march import march_bouc_wen_each
from bayes_nlsid.forces.memory import bouc_wen_step, iwan_sliders, slider_step
from bayes_nlsid.forces.motion import reversal_parents
from bayes_nlsid.forces.term import Term
from bayes_nlsid.model import Model
from bayes_nlsid.simulation.joints import jumps_of

Array = NDArray[np.float64]
Forces = tuple[Array, Array, Array]
CREEP = 0.02
"""Share of the largest velocity (or displacement) over which a law that jumps at zero is drawn out into a ramp."""
MOST_PERIODS = 12
CLOSED = 1e-9


@final
@dataclass(frozen=True)
class Basis:
    """Harmonics of a period.

    Parameters
    ----------
    orders : tuple of int
        Ascending; 0 is the mean.
    samples : int
        Instants N per period.

    Raises
    ------
    ValueError
        If the samples do not resolve the highest harmonic.
    """

    orders: tuple[int, ...]
    samples: int

    def __post_init__(self) -> None:
        if not self.orders or list(self.orders) != sorted(set(self.orders)) or self.orders[0] < 0:
            raise ValueError(f"orders {self.orders} must be distinct, ascending and not negative")
        if self.samples < 4 * self.orders[-1]:
            raise ValueError(f"{self.samples} samples per period do not resolve harmonic {self.orders[-1]}; take at least four per cycle")

    @property
    def size(self) -> int:
        """Number of coefficients C of one motion."""
        return len(self.each)

    @cached_property
    def each(self) -> NDArray[np.intp]:
        """Harmonic (C,) of every coefficient; cosine first."""
        return np.array([h for h in self.orders for _ in range(1 if h == 0 else 2)], dtype=np.intp)

    @cached_property
    def sine(self) -> NDArray[np.bool_]:
        """Whether each coefficient (C,) belongs to a sine."""
        return np.array([s for h in self.orders for s in ((False,) if h == 0 else (False, True))])

    @cached_property
    def wave(self) -> Array:
        """Values (N, C) of every function."""
        return self.at(2 * np.pi * np.arange(self.samples) / self.samples)

    @cached_property
    def slope(self) -> Array:
        """Derivatives (N, C) by θ."""
        angle = 2 * np.pi * np.arange(self.samples)[:, None] / self.samples * self.each
        return np.where(self.sine, np.cos(angle), -np.sin(angle)) * self.each

    @cached_property
    def project(self) -> Array:
        """(C, N): from samples to coefficients."""
        return self.wave.T * (np.where(self.each == 0, 1.0, 2.0) / self.samples)[:, None]

    def at(self, angle: Array) -> Array:
        """Values (n, C) at any angles (n,), rad."""
        phase = np.asarray(angle, dtype=float)[:, None] * self.each
        return np.where(self.sine, np.sin(phase), np.cos(phase))

    def complex(self, x: Array) -> NDArray[np.complex128]:
        """Complex amplitudes (..., len(orders)) of coefficients (..., C): x(θ) = Re Σ X_h exp(ihθ)."""
        cosine = ~self.sine
        out = x[..., cosine].astype(complex)
        out[..., [i for i, h in enumerate(self.orders) if h > 0]] -= 1j * x[..., self.sine]
        return out

    def real(self, values: NDArray[np.complex128]) -> Array:
        """The inverse of `complex`."""
        out = np.empty((*values.shape[:-1], self.size))
        out[..., ~self.sine] = values.real
        out[..., self.sine] = -values.imag[..., [i for i, h in enumerate(self.orders) if h > 0]]
        return out


@final
@dataclass(frozen=True)
class _Place:
    """One element at one location: its row among the joints, parameters (S, n_p), the spring taken away (S,), arguments it jumps in."""

    term: Term
    row: int
    p: Array
    spring: Array
    jumps: tuple[str, ...]


@final
class SteadyForces:
    """All elements of a model along steady motions.

    Parameters
    ----------
    model : Model
    theta : ndarray (S, P)
    basis : Basis
    """

    def __init__(self, model: Model, theta: Array, basis: Basis) -> None:
        self.basis = basis
        self.locations = tuple(dict.fromkeys(name for element in model.elements for name in element.locations))
        self.places: list[_Place] = []
        for i, element in enumerate(model.elements):
            for name in element.locations:
                p = model.element_values(theta, i, name)
                stiffness = element.term.stiffness
                spring = np.broadcast_to(stiffness(*p.T) if element.excess and stiffness is not None else 0.0, (len(theta),))
                jumps = jumps_of(element.term, tuple(p.T[:, None])) if element.term.memory == "none" else ()
                self.places.append(_Place(element.term, self.locations.index(name), p, spring, jumps))

    def evaluate(self, x: Array, omega: Array, which: NDArray[np.intp]) -> Forces:
        """Forces and tangents of some samples.

        Parameters
        ----------
        x : ndarray (B, R, C)
            Coefficients of the motion at ``locations``, m.
        omega : ndarray (B,)
            rad/s.
        which : ndarray (B,) of int
            Row of theta that each motion belongs to.

        Returns
        -------
        force, by_x, by_omega : ndarray (B, R, C), (B, R, C, C), (B, R, C)
            N, N/m, N s. A location's force depends on its own motion only.
        """
        basis = self.basis
        force, by_omega = np.zeros_like(x), np.zeros_like(x)
        by_x = np.zeros((*x.shape, basis.size))
        kinds = {"masing": _masing, "sliders": _sliders, "bouc_wen": _bouc_wen}
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for place in self.places:
                r, p = place.row, place.p[which]
                q = x[:, r] @ basis.wave.T
                if place.term.memory == "none":
                    v = omega[:, None] * (x[:, r] @ basis.slope.T)
                    f, fq, fv = _static(place, q, v, p)
                    by_x[:, r] += basis.project @ (fq[..., None] * basis.wave + (omega[:, None] * fv)[..., None] * basis.slope)
                    by_omega[:, r] += (fv * v / omega[:, None]) @ basis.project.T
                else:
                    f, along = kinds[place.term.memory](place.term, q, p, basis)
                    by_x[:, r] += basis.project @ along
                force[:, r] += f @ basis.project.T
                spring = place.spring[which]
                force[:, r] -= spring[:, None] * x[:, r]
                by_x[:, r] -= spring[:, None, None] * np.eye(basis.size)
        return force, by_x, by_omega

    def slopes(self, x: Array, omega: Array, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Slopes ∂f/∂q (N/m) and ∂f/∂v (N s/m), each (B, R, N), of forces without memory along the period; arguments as `evaluate`.

        Raises
        ------
        ValueError
            If a force has memory: what it answers to a disturbance depends on more than the instant.
        """
        shape = (*x.shape[:2], self.basis.samples)
        stiffness, damping = np.zeros(shape), np.zeros(shape)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for place in self.places:
                if place.term.memory != "none":
                    raise ValueError(f"{place.term.name} has memory; its slope at an instant does not tell what it answers")
                r = place.row
                q, v = x[:, r] @ self.basis.wave.T, omega[:, None] * (x[:, r] @ self.basis.slope.T)
                _, fq, fv = _static(place, q, v, place.p[which])
                stiffness[:, r] += fq - place.spring[which, None]
                damping[:, r] += fv
        return stiffness, damping


def _columns(p: Array) -> tuple[Array, ...]:
    """Parameters (B, n_p) as columns that broadcast over instants."""
    return tuple(p[:, j, None] for j in range(p.shape[1]))


def _static(place: _Place, q: Array, v: Array, p: Array) -> Forces:
    """Force and slopes (B, N) of a law without memory; jumps at zero become steep ramps, so that sticking is a slow creep."""
    values = _columns(p)
    f = np.array(np.broadcast_to(place.term.law(q, v, *values), q.shape))
    fq, fv = (np.array(np.broadcast_to(s, q.shape)) for s in place.term.slope(q, v, *values))
    for name in place.jumps:
        moved = q if name == "q" else v
        width = CREEP * np.abs(moved).max(axis=1, keepdims=True) + 1e-300
        tiny = np.full_like(q, 1e-200)
        if name == "q":
            height = 0.5 * (place.term.law(tiny, v, *values) - place.term.law(-tiny, v, *values))
        else:
            height = 0.5 * (place.term.law(q, tiny, *values) - place.term.law(q, -tiny, *values))
        f += height * (np.clip(moved / width, -1, 1) - np.sign(moved))
        slope = np.where(np.abs(moved) < width, height / width, 0.0)
        if name == "q":
            fq += slope
        else:
            fv += slope
    return f, fq, fv


def _masing(term: Term, q: Array, p: Array, basis: Basis) -> tuple[Array, Array]:
    """Force (B, N) and its derivative (B, N, C) by the coefficients, under Masing's rules.

    All paths lie behind each other in one long list of nodes; chains of reversals are summed by doubling as in ``forces.motion``.
    """
    batch, n = q.shape
    begin = np.argmax(np.abs(q), axis=1)
    order = (begin[:, None] + np.arange(n)) % n
    nodes = np.take_along_axis(q, order, axis=1)
    parent = np.concatenate([np.where(one < 0, -1, one + b * n) for b, one in enumerate(map(reversal_parents, nodes))])
    flat, virgin = nodes.ravel(), parent < 0
    scale = np.where(virgin, 1.0, 2.0)
    reach = (flat - np.where(virgin, 0.0, flat[parent])) / scale
    values = tuple(np.repeat(p[:, j], n) for j in range(p.shape[1]))
    still = np.zeros_like(reach)
    wave = basis.wave[order].reshape(batch * n, basis.size)
    slope = np.broadcast_to(np.asarray(term.slope(reach, still, *values)[0], dtype=float), reach.shape)
    rise = np.empty((batch * n, 1 + basis.size))
    rise[:, 0] = scale * term.law(reach, still, *values)
    rise[:, 1:] = slope[:, None] * (wave - np.where(virgin[:, None], 0.0, wave[parent]))
    turns = np.unique(parent[~virgin])
    slot = np.where(virgin, len(turns), np.searchsorted(turns, parent))
    total, link = np.concatenate([rise[turns], np.zeros((1, rise.shape[1]))]), np.append(slot[turns], len(turns))
    while (link < len(turns)).any():
        total = total + total[link]
        link = link[link]
    along = (rise + total[slot]).reshape(batch, n, -1)
    back = np.empty_like(along)
    np.put_along_axis(back, order[..., None], along, axis=1)
    return back[..., 0], back[..., 1:]


def _sliders(term: Term, q: Array, p: Array, basis: Basis) -> tuple[Array, Array]:
    """The same for parallel sliders: what is stuck moves along from where it last slid."""
    batch, n = q.shape
    stiffness, slip, theta = iwan_sliders(p)
    stretch, sliding = slider_step(q[:, :1], np.zeros_like(slip), np.zeros_like(slip), slip, theta)
    anchor = np.where(sliding != 0, 0, n)
    wave = np.concatenate([basis.wave, np.zeros((1, basis.size))])  # last row: the unloaded origin, which does not move
    force, along = np.empty((batch, n)), np.empty((batch, n, basis.size))
    for step in range(1, 2 * n + 1):
        k = step % n
        stretch, sliding = slider_step((q[:, k] - q[:, k - 1])[:, None], stretch, sliding, slip, theta)
        anchor = np.where(sliding != 0, k, anchor)
        if step > n:
            force[:, k] = np.sum(stiffness * stretch, axis=1)
            held = np.where(sliding == 0, stiffness, 0.0)
            along[:, k] = held.sum(axis=1)[:, None] * basis.wave[k] - np.einsum("bs,bsc->bc", held, wave[anchor])
    return force, along


def _bouc_wen(term: Term, q: Array, p: Array, basis: Basis) -> tuple[Array, Array]:
    """The same for a Bouc–Wen loop; its tangent follows from the step's own derivatives, closed over the period."""
    n = q.shape[1]
    values = tuple(p.T)
    moves = np.roll(q, -1, axis=1) - q
    size = np.abs(p[:, 0]) * np.abs(q).max(axis=1) + 1e-300
    z = bouc_wen_step(np.zeros(len(q)), q[:, 0], *values)
    for _ in range(MOST_PERIODS):
        near = z + 1e-6 * size
        path, beside = march_bouc_wen_each(z, moves, p), march_bouc_wen_each(near, moves, p)[:, -1]
        gap, carried = path[:, -1] - z, (beside - path[:, -1]) / (near - z)
        if (np.abs(gap) <= CLOSED * size).all():
            break
        z = np.where(carried < 1 - 1e-6, z + gap / np.maximum(1 - carried, 1e-6), path[:, -1])
    # derivative of each step by force and by move, all steps at once
    here, move = path[:, :n], moves
    wide = tuple(v[:, None] for v in values)
    dz, dm = 1e-6 * size[:, None], 1e-6 * np.abs(moves).max(axis=1, keepdims=True) + 1e-300
    by_force = (bouc_wen_step(here + dz, move, *wide) - bouc_wen_step(here - dz, move, *wide)) / (2 * dz)
    by_move = (bouc_wen_step(here, move + dm, *wide) - bouc_wen_step(here, move - dm, *wide)) / (2 * dm)
    push = by_move[..., None] * (np.roll(basis.wave, -1, axis=0) - basis.wave)
    along = np.zeros((len(q), n, basis.size))
    at, carried = np.zeros((len(q), basis.size)), np.ones(len(q))
    for k in range(n):
        at, carried = by_force[:, k, None] * at + push[:, k], carried * by_force[:, k]
    at = at / np.where(np.abs(1 - carried) > 1e-9, 1 - carried, np.inf)[:, None]
    for k in range(n):
        along[:, k] = at
        at = by_force[:, k, None] * at + push[:, k]
    return here, along


def orders_for(model: Model, highest: int) -> tuple[int, ...]:
    """Harmonics that the steady response needs: odd ones where every force is odd, else all from 0.

    Of a model with odd forces only the motion that repeats itself with opposite sign after half a period is sought.
    """
    odd = all(element.term.parity == "odd" for element in model.elements)
    return tuple(range(1, highest + 1, 2)) if odd else tuple(range(highest + 1))


def period_samples(model: Model, highest: int) -> int:
    """Instants per period: enough for kinks and loops, and for several on the ramp of a jump."""
    least = 256
    for element in model.elements:
        one = tuple(np.ones((1, 1)) for _ in element.term.params)
        if element.term.memory == "none" and jumps_of(element.term, one):
            least = 512
    return int(max(least, 2 ** np.ceil(np.log2(16 * highest))))
