"""Forces of all elements of a model for a batch of samples, at one instant of a simulation.

Arrays are (R, S): one row per location that carries an element, one column per sample of theta.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.stepping import commit, start_state, trial
from bayes_nlsid.forces.term import Term
from bayes_nlsid.model import Model

Array = NDArray[np.float64]
PRELOAD_STEPS = 64
"""Pieces of the straight path from rest to the initial displacement (only Bouc-Wen loops need more than one)."""


@final
@dataclass(frozen=True)
class StaticGroup:
    """Locations of one memoryless element: the law is called once for all of them.

    ``rows`` (g,) are indices into the R locations; ``p`` a tuple of arrays (g, S); ``spring`` (g, S) what ``Element.excess`` takes away,
    or None; ``jumps`` tells which arguments ("q", "v") the law jumps in at zero.
    """

    term: Term
    rows: NDArray[np.intp]
    p: tuple[Array, ...]
    spring: Array | None
    jumps: tuple[str, ...]


@final
@dataclass(frozen=True)
class Entry:
    """One location of an element; ``p`` (S, n_p)."""

    term: Term
    row: int
    p: Array
    excess: bool


def jumps_of(term: Term, p: tuple[Array, ...]) -> tuple[str, ...]:
    """Arguments in which a law is discontinuous at zero, found by probing both sides."""
    rng = np.random.default_rng(0)
    found = []
    for name in ("q", "v"):
        for scale in (1e-6, 1e-3, 1.0):
            other = scale * (0.5 + rng.random(p[0].shape if p else (1, 1)))
            tiny = np.full_like(other, 1e-200)
            above = term.law(tiny, other, *p) if name == "q" else term.law(other, tiny, *p)
            below = term.law(-tiny, other, *p) if name == "q" else term.law(other, -tiny, *p)
            size = np.abs(term.law(other, other, *p))
            if (np.abs(above - below) > 1e-6 * size).any():
                found.append(name)
                break
    return tuple(found)


@final
class Joints:
    """All elements of a model at one batch of parameters, with the history of those that remember.

    Parameters
    ----------
    model : Model
    theta : ndarray (S, P)

    Notes
    -----
    A law that jumps by ±J at zero (dry friction) is read as a set: its force is the λ that solves λ = clip(λ + ρ v, −J, J), whatever ρ >
    0. That
    is the implicit treatment of sticking: where the clip is inactive the equation left is v = 0 (Alart and Curnier 1991).
    """

    def __init__(self, model: Model, theta: Array) -> None:
        self.samples = len(theta)
        names: list[str] = []
        for element in model.elements:
            names += [name for name in element.locations if name not in names]
        self.locations = tuple(names)
        self.shapes = model.linear.rows(self.locations) if names else np.zeros((0, model.linear.modes))
        self.static: list[StaticGroup] = []
        self.entries: list[Entry] = []
        for i, element in enumerate(model.elements):
            values = np.stack([model.element_values(theta, i, name) for name in element.locations])  # (g, S, n_p)
            rows = np.array([names.index(name) for name in element.locations], dtype=np.intp)
            self.entries += [Entry(element.term, int(r), values[g], element.excess) for g, r in enumerate(rows)]
            if element.term.memory == "none":
                p = tuple(np.ascontiguousarray(values[..., j]) for j in range(values.shape[-1]))
                stiffness = element.term.stiffness
                spring = np.broadcast_to(stiffness(*p), p[0].shape).copy() if element.excess and stiffness is not None else None
                self.static.append(StaticGroup(element.term, rows, p, spring, jumps_of(element.term, p)))
        self.memory = [entry for entry in self.entries if entry.term.memory != "none"]
        self.states: list[Any] = []
        # one memoryless element without jumps holds all rows in order: no gathering or scattering
        self._simple = len(self.static) == 1 and not self.memory and not self.static[0].jumps
        # forces with memory need the velocity to find turning points between samples
        self.velocity = any(_uses_velocity(group) for group in self.static) or bool(self.memory)
        self.jumping = any(group.jumps for group in self.static)
        self._steep: dict[str, Array] = {}
        self._still = np.zeros((self.count, self.samples))
        self._dt = 0.0

    @property
    def count(self) -> int:
        """Number of locations R that carry elements."""
        return len(self.locations)

    def begin(self, q: Array, v: Array, dt: float, give_q: Array, give_v: Array) -> Array:
        """Start the history at q, v (R, S), loaded from rest along a straight path; returns the force (R, S).

        ``give_q``, ``give_v`` (R, 1 or S): displacement and velocity that a unit force takes away within one step of length ``dt`` (s).
        """
        tiny = np.finfo(float).tiny
        self._dt = dt
        self._steep = {name: 1 / np.maximum(np.abs(give), tiny) for name, give in (("q", give_q), ("v", give_v))}
        self.states = [start_state(place.term, place.p) for place in self.memory]
        for part in np.arange(1, PRELOAD_STEPS + 1) / PRELOAD_STEPS:
            last = v if part == 1 else self._still
            self.states = [commit(place.term, state, part * q[place.row], last[place.row], dt, place.p)
                           for place, state in zip(self.memory, self.states, strict=True)]
        return self.evaluate(q, v, None)[0]

    def breakaway(self, q: Array, v: Array, acceleration: Array) -> Array:
        """Friction (R, S) where nothing moves yet: against the acceleration (R, S) about to begin the motion."""
        force = np.zeros_like(q)
        for group in self.static:
            for name in group.jumps:
                still = (q if name == "q" else v)[group.rows] == 0
                force[group.rows] += np.where(still, self._height(group, name, q[group.rows],
                                                                  v[group.rows]) * np.sign(acceleration[group.rows]), 0.0)
        return force

    def evaluate(self, q: Array, v: Array | None, g: Array | None) -> tuple[Array, Array, Array | None, Array | None]:
        """Force (R, S), its slopes by q and by v, and where friction holds, from the committed history.

        ``g`` (R, S): the force that belongs to q, v. Where friction holds (last array true), force − g is ρ times the motion that must
        vanish, and
        the slopes are its slopes. The slope by v is None while no law depends on velocity, the last array while no law jumps.
        """
        w = self._still if v is None else v
        if self._simple:
            f, fq, fv = self._group(0, q, w)
            return f, np.broadcast_to(fq, f.shape), np.broadcast_to(fv, f.shape) if self.velocity else None, None
        force, by_q, by_v = np.zeros_like(q), np.zeros_like(q), np.zeros_like(q)
        for i, group in enumerate(self.static):
            f, fq, fv = self._group(i, q[group.rows], w[group.rows])
            # rows of one element are distinct, so fancy indexing adds each once
            force[group.rows] += f
            by_q[group.rows] += fq
            by_v[group.rows] += fv
        for place, state in zip(self.memory, self.states, strict=True):
            f, fq, fv = trial(place.term, state, q[place.row], w[place.row], self._dt, place.p, place.excess)
            force[place.row] += f
            by_q[place.row] += fq
            by_v[place.row] += fv
        held = None
        if self.jumping and g is not None:
            force, by_q, by_v, held = self._hold(q, w, g, force, by_q, by_v)
        return force, by_q, by_v if self.velocity else None, held

    def _hold(self, q: Array, v: Array, g: Array, force: Array, by_q: Array, by_v: Array) -> tuple[Array, Array, Array, Array]:
        """Replace the sign of jumping laws by the set-valued reading."""
        held = np.zeros(q.shape, dtype=bool)
        for name, x in (("v", v), ("q", q)):
            height = np.zeros_like(q)
            for group in self.static:
                if name in group.jumps:
                    # a negative coefficient pushes instead of holding: the sign stays as the law has it
                    height[group.rows] += np.maximum(self._height(group, name, q[group.rows], v[group.rows]), 0.0)
            if not height.any():
                continue
            smooth = force - height * np.sign(x)
            pull = g - smooth + self._steep[name] * x
            inside = (np.abs(pull) < height) & ~held
            force = np.where(held, force, np.where(inside, g + self._steep[name] * x, smooth + np.clip(pull, -height, height)))
            by_q = np.where(inside, self._steep[name] if name == "q" else 0.0, by_q)
            by_v = np.where(inside, self._steep[name] if name == "v" else 0.0, by_v)
            held |= inside
        return force, by_q, by_v, held

    def commit(self, q: Array, v: Array | None) -> None:
        """Make q, v the new end of the history."""
        w = self._still if v is None else v
        self.states = [commit(place.term, state, q[place.row], w[place.row], self._dt, place.p)
                       for place, state in zip(self.memory, self.states, strict=True)]

    def _group(self, index: int, q: Array, v: Array) -> tuple[Array, Array, Array]:
        group = self.static[index]
        f = group.term.law(q, v, *group.p)
        fq, fv = group.term.slope(q, v, *group.p)
        if group.spring is not None:
            f = f - group.spring * q
            fq = fq - group.spring
        return f, fq, fv

    @staticmethod
    def _height(group: StaticGroup, name: str, q: Array, v: Array) -> Array:
        """Half the jump of the law at zero of one argument."""
        tiny = np.full_like(q, 1e-200)
        if name == "q":
            return 0.5 * (group.term.law(tiny, v, *group.p) - group.term.law(-tiny, v, *group.p))
        return 0.5 * (group.term.law(q, tiny, *group.p) - group.term.law(q, -tiny, *group.p))


def _uses_velocity(group: StaticGroup) -> bool:
    rng = np.random.default_rng(1)
    shape = group.p[0].shape if group.p else (1, 1)
    for scale in (1e-6, 1e-3, 1.0):
        q = scale * rng.standard_normal(shape)
        v = rng.standard_normal(shape)
        at_v = group.term.law(q, v, *group.p)
        if any(not np.array_equal(at_v, group.term.law(q, factor * v, *group.p)) for factor in (-1.0, 2.0, 1e-3)):
            return True
    return False
