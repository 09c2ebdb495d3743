"""A term step by step, for time integration: a batch of samples at one location.

    state = start_state(term, p)                       # unloaded: q = 0, v = 0
    state = commit(term, state, q0, v0, dt, p)         # the initial motion
    f, df_dq, df_dv = trial(term, state, q, v, dt, p)  # as often as Newton's method asks; the state stays as it was
    state = commit(term, state, q, v, dt, p)           # the step is accepted

The forces are those of ``force_along`` on the same samples. A commit takes over the storage of the state it is given: after it,
only the state returned is valid (``State.copy`` keeps a branch).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces import memory
from bayes_nlsid.forces.term import Term

Array = NDArray[np.float64]
CAPACITY = 16  # open loops for which there is room at first; doubled whenever a sample needs more


@final
@dataclass(frozen=True)
class State:
    """What a term remembers, for B samples.

    Parameters
    ----------
    q, v : ndarray (B,)
        Displacement (m) and velocity (m/s) last committed.
    force : ndarray (B,)
        Force there, N, without ``excess`` (terms with memory only).
    heading : ndarray (B,)
        Direction of the last movement: +1, −1, or 0 before any.
    depth : ndarray (B,) of int
        Number of open reversals.
    ends, forces : ndarray (B, capacity)
        Displacement (m) and force (N) at the open reversals; only the first ``depth`` of each row count.
    stretch, sliding, stiffness, slip : ndarray (B, sliders)
        Finite sliders: stretch (m), direction of sliding, stiffness (N/m), breaking displacement (m).
    """

    q: Array
    v: Array
    force: Array
    heading: Array
    depth: NDArray[np.intp]
    ends: Array
    forces: Array
    stretch: Array
    sliding: Array
    stiffness: Array
    slip: Array

    def copy(self) -> State:
        """A state that shares no storage with this one."""
        return State(*(getattr(self, name).copy() for name in self.__dataclass_fields__))


def start_state(term: Term, p: ArrayLike) -> State:
    """The unloaded state, q = v = f = 0.

    Parameters
    ----------
    term : Term
    p : array_like (B, n_p)
        Parameters, SI; the same must be given to every later ``trial`` and ``commit``.

    Returns
    -------
    State
        Empty for a term without memory.

    Raises
    ------
    ValueError
        If ``p`` is not (B, n_p).
    """
    values = _parameters(term, p)
    batch = len(values)
    none, zero = np.zeros((batch, 0)), np.zeros(batch)
    stack = (batch, CAPACITY if term.memory == "masing" else 0)
    stiffness, slip = memory.iwan_sliders(values)[:2] if term.memory == "sliders" else (none, none)
    return State(zero, zero, zero, zero, np.zeros(batch, dtype=np.intp), np.zeros(stack), np.zeros(stack), np.zeros_like(slip),
                 np.zeros_like(slip), stiffness, slip)


def trial(term: Term, state: State, q: ArrayLike, v: ArrayLike, dt: float, p: ArrayLike,
          excess: bool = False) -> tuple[Array, Array, Array]:
    """Force and tangents if the motion went on to (q, v); the state is left as it is.

    Parameters
    ----------
    term : Term
    state : State
        After the last accepted step.
    q, v : array_like (B,)
        m, m/s.
    dt : float
        Since the last accepted step, s.
    p : array_like (B, n_p)
        SI.
    excess : bool
        Subtract the spring at rest, f − f'(0) q.

    Returns
    -------
    force, df_dq, df_dv : ndarray (B,)
        N, N/m, N s/m. The tangent is that of the branch on which the step ends; what the position of a turning point inside the
        step adds to it is left out (of the order of the step).

    Raises
    ------
    ValueError
        If ``p`` is not (B, n_p).
    """
    here, speed, values = np.asarray(q, dtype=float), np.asarray(v, dtype=float), _parameters(term, p)
    with np.errstate(over="ignore", invalid="ignore"):
        if term.memory == "none":
            force = np.asarray(term.law(here, speed, *values.T), dtype=float)
            along, across = term.slope(here, speed, *values.T)
        else:
            after = _advance(term, state, here, speed, dt, values)
            force, along, across = after.state.force, after.tangent, np.zeros(len(values))
        if excess and term.stiffness is not None:
            spring = np.asarray(term.stiffness(*values.T))
            force, along = force - spring * here, along - spring
    out = np.empty((3, len(values)))
    out[0], out[1], out[2] = force, along, across
    return out[0], out[1], out[2]


def commit(term: Term, state: State, q: ArrayLike, v: ArrayLike, dt: float, p: ArrayLike) -> State:
    """The state after an accepted step to (q, v).

    Parameters
    ----------
    term, state, q, v, dt, p
        As in ``trial``.

    Returns
    -------
    State
        It takes over the storage of the one given.

    Raises
    ------
    ValueError
        If ``p`` is not (B, n_p).
    """
    here, speed, values = np.array(q, dtype=float), np.array(v, dtype=float), _parameters(term, p)
    if term.memory == "none":
        return replace(state, q=here, v=speed)
    with np.errstate(over="ignore", invalid="ignore"):
        after = _advance(term, state, here, speed, dt, values)
    return _with_pushed(after) if term.memory == "masing" else after.state


@final
@dataclass(frozen=True)
class _Advanced:
    """A state further on, its tangent (B,), and the reversals (position or −1, displacement, force) not yet written to its stack."""

    state: State
    tangent: Array
    pushed: tuple[tuple[NDArray[np.intp], Array, Array], ...] = ()


def _advance(term: Term, state: State, q: Array, v: Array, dt: float, p: Array) -> _Advanced:
    """Carry the state to (q, v), by way of the turning point if the velocity changed sign."""
    turned, extremum = memory.turning_point(state.q, state.v, q, v, dt)
    leg = {"masing": _masing_leg, "sliders": _sliders_leg, "bouc_wen": _bouc_wen_leg}[term.memory]
    after = leg(term, _Advanced(state, np.zeros_like(q)), extremum, p)
    if turned.any():
        after = leg(term, after, q, p)
    return replace(after, state=replace(after.state, q=q, v=v))


def _masing_leg(term: Term, before: _Advanced, target: Array, p: Array) -> _Advanced:
    """One monotone piece under Masing's rules; see ``motion.reversal_parents``."""
    state = before.state
    move = np.sign(target - state.q)
    heading = np.where(move != 0.0, move, state.heading)
    reverses = move * state.heading < 0.0
    pushed = (*before.pushed, (np.where(reverses, state.depth, -1), state.q, state.force))
    depth = state.depth + reverses
    ends, forces = ((state.ends, 1), (state.forces, 2))

    def at(position: NDArray[np.intp], stack: tuple[Array, int]) -> Array:
        """Entry of the stack, reversals not yet written included."""
        value = stack[0][np.arange(len(position)), np.clip(position, 0, stack[0].shape[1] - 1)]
        for entry in pushed:
            value = np.where(entry[0] == position, entry[stack[1]], value)
        return value

    while True:
        far = np.where(depth > 1, at(depth - 2, ends), -at(np.zeros_like(depth), ends))
        closes = (depth > 0) & (move != 0.0) & (move * (target - far) >= 0.0)
        if not closes.any():
            break
        depth = depth - np.where(closes, np.minimum(depth, 2), 0)
    first_loading = depth == 0
    origin = np.where(first_loading, 0.0, at(depth - 1, ends))
    base = np.where(first_loading, 0.0, at(depth - 1, forces))
    doubled = np.where(first_loading, 1.0, 2.0)
    still, reach = np.zeros_like(target), (target - origin) / doubled
    force = base + doubled * term.law(reach, still, *p.T)
    tangent = np.broadcast_to(np.asarray(term.slope(reach, still, *p.T)[0], dtype=float), target.shape)
    return _Advanced(replace(state, q=target, force=force, heading=heading, depth=depth), tangent, pushed)


def _with_pushed(after: _Advanced) -> State:
    """Write the reversals that are still open to the stack, with more room if any sample needs it."""
    state = after.state
    need, have = int(state.depth.max(initial=0)), state.ends.shape[1]
    if need > have:
        room = ((0, 0), (0, max(need, 2 * have) - have))
        state = replace(state, ends=np.pad(state.ends, room), forces=np.pad(state.forces, room))
    for position, end, force in after.pushed:
        rows = np.flatnonzero((position >= 0) & (position < state.depth))
        state.ends[rows, position[rows]] = end[rows]
        state.forces[rows, position[rows]] = force[rows]
    return state


def _sliders_leg(term: Term, before: _Advanced, target: Array, p: Array) -> _Advanced:
    state = before.state
    stretch, sliding = memory.slider_step((target - state.q)[:, None], state.stretch, state.sliding, state.slip, p[:, 4:5])
    force = np.sum(state.stiffness * stretch, axis=-1)
    tangent = np.sum(state.stiffness * (sliding == 0.0), axis=-1)
    return _Advanced(replace(state, q=target, force=force, stretch=stretch, sliding=sliding), tangent)


def _bouc_wen_leg(term: Term, before: _Advanced, target: Array, p: Array) -> _Advanced:
    state = before.state
    move = target - state.q
    force = memory.bouc_wen_step(state.force, move, *p.T)
    return _Advanced(replace(state, q=target, force=force), memory.bouc_wen_slope(force, move, *p.T))


def _parameters(term: Term, p: ArrayLike) -> Array:
    values = np.asarray(p, dtype=float)
    if values.ndim != 2 or values.shape[1] != len(term.params):
        raise ValueError(f"term {term.name!r}: p has shape {values.shape}, expected (B, {len(term.params)})")
    return values
