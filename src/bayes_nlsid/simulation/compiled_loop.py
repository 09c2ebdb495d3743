"""The time loop compiled: the same scheme as ``stepping.py`` step by step, for eight samples side by side.

Import this module only where compiled code is about to run: it brings numba with it. All numbers of a block stand in one array ``w``
(rows, 8), and ``at`` says which row is what, see ``lanes.py``.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from bayes_nlsid.simulation.compiled import ROW, commit, evaluate, inline, inner, kernel, one_entry
from bayes_nlsid.simulation.joints import PRELOAD_STEPS
from bayes_nlsid.simulation.lanes import At, Walks
from bayes_nlsid.simulation.stepping import ACCEPT, CONVERGED, MOST_ITERATIONS, SMALLEST_CONTRACTION
from bayes_nlsid.simulation.vector import WIDTH, lanes_of, larger, load, size, spread, store

# --- the linear part ----------------------------------------------------------------------------------------------------------


@inline
def _rows(b: np.ndarray, w: np.ndarray, x: int, out: np.ndarray, to: int) -> None:
    """Rows of ``out`` from ``to`` on = b times the rows of w from x on, for a matrix that all lanes share."""
    for r in range(b.shape[0]):
        total = b[r, 0] * load(w, x)
        for k in range(1, b.shape[1]):
            total = total + b[r, k] * load(w, x + k)
        store(out, to + r, total)


@inline
def _given(w: np.ndarray, s: int, r: int, g: int, joints: int) -> Any:
    """Row r of S g."""
    total = load(w, s + r * joints) * load(w, g)
    for t in range(1, joints):
        total = total + load(w, s + r * joints + t) * load(w, g + t)
    return total


@inline
def _applied(force: np.ndarray, i: int, k: int) -> Any:
    """Modal force on mode k at instant i."""
    return spread(force[i, k, 0]) if force.shape[2] == 1 else load(force, i * force.shape[1] + k)


@inline
def _predict(at: At, w: np.ndarray, force: np.ndarray, i: int) -> None:
    """Where every mode would be at the end of the step without any force of a joint there."""
    components, modes = at.components, at.modes
    for k in range(modes):
        x0, x1, before = load(w, at.x + k), load(w, at.x + modes + k), load(w, at.f + k)
        for c in range(components):
            row = k * components + c
            a = at.a + row * components
            total = load(w, a) * x0 + load(w, a + 1) * x1 + load(w, at.old + row) * before
            if components == 3:
                total = total + load(w, a + 2) * load(w, at.x + 2 * modes + k)
            if len(force):
                total = total + load(w, at.new + row) * _applied(force, i, k)
            store(w, at.y + c * modes + k, total)


@inline
def _correct(at: At, w: np.ndarray, b: np.ndarray, force: np.ndarray, i: int) -> None:
    """Finish the step with the joint forces g."""
    components, modes = at.components, at.modes
    for k in range(modes):
        back = spread(0.0)
        for r in range(at.joints):
            back = back + b[r, k] * load(w, at.g + r)
        for c in range(components):
            row = c * modes + k
            store(w, at.x + row, load(w, at.y + row) - load(w, at.new + k * components + c) * back)
        if len(force):
            store(w, at.f + k, _applied(force, i, k) - back)
        else:
            store(w, at.f + k, 0.0 - back)


# --- Newton in one lane -------------------------------------------------------------------------------------------------------


@inner
def _eliminate(a: np.ndarray, b: np.ndarray, count: int) -> None:
    """Solve a x = b in place of b, with pivoting; a zero pivot leaves the entry as it is."""
    for i in range(count):
        best = i
        for j in range(i + 1, count):
            if abs(a[j, i]) > abs(a[best, i]):
                best = j
        if a[best, i] == 0.0:
            continue
        if best != i:
            for k in range(count):
                a[i, k], a[best, k] = a[best, k], a[i, k]
            b[i], b[best] = b[best], b[i]
        for j in range(i + 1, count):
            factor = a[j, i] / a[i, i]
            for k in range(i, count):
                a[j, k] -= factor * a[i, k]
            b[j] -= factor * b[i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            b[i] -= a[i, k] * b[k]
        if a[i, i] != 0.0:
            b[i] /= a[i, i]


@inner
def _residual(at: At, w: np.ndarray, walks: Walks, n: int, g: np.ndarray, out: np.ndarray) -> None:
    """out (4, R): e = f − g, its slopes by q and v, and the force f itself, in lane n at the joint forces g (R,)."""
    joints = at.joints
    for i in range(4):
        for r in range(joints):
            out[i, r] = 0.0
    for e in range(at.entries):
        r = walks.table[e, ROW]
        q, v = w[at.q0 + r, n], w[at.v0 + r, n]
        for t in range(joints):
            q -= w[at.sq + r * joints + t, n] * g[t]
            v -= w[at.sv + r * joints + t, n] * g[t]
        f, fq, fv = one_entry(at, w, walks, e, n, q, v, 0.0)
        out[3, r] += f
        out[1, r] += fq
        out[2, r] += fv
    for r in range(joints):
        out[0, r] = out[3, r] - g[r]


@inner
def _excess(at: At, w: np.ndarray, n: int, out: np.ndarray) -> float:
    """Largest change of q or v that e = out[0] would make, relative to the largest motion so far (R,)."""
    worst, joints = 0.0, at.joints
    for r in range(joints):
        dq, dv = 0.0, 0.0
        for t in range(joints):
            dq += w[at.sq + r * joints + t, n] * out[0, t]
            dv += w[at.sv + r * joints + t, n] * out[0, t]
        if abs(dq) > 0.0:
            worst = max(worst, abs(dq) / max(w[at.scale_q + r, n], 1e-300))
        if at.velocity and abs(dv) > 0.0:
            worst = max(worst, abs(dv) / max(w[at.scale_v + r, n], 1e-300))
    return worst


@inner
def _newton(at: At, w: np.ndarray, walks: Walks, n: int) -> None:
    """Converged Newton with line search in lane n; the rows ``fresh`` enter as the guess and leave as the solution."""
    joints = at.joints
    here, change, attempt, out, tried, matrix = (walks.work[1], walks.work[2], walks.work[3], walks.work[4:8], walks.work[8:12],
                                                 walks.work[12:])
    for r in range(joints):
        here[r], change[r] = w[at.fresh + r, n], 0.0
    merit, small = math.inf, False
    for iteration in range(MOST_ITERATIONS + 1):
        # the first pass only evaluates at the guess; one place that evaluates keeps the compiled code short
        if iteration > 0:
            walks.counts[0, n] += 1
            merit = 0.0
            for r in range(joints):
                change[r] = out[0, r]
                merit += out[0, r] ** 2
                for t in range(joints):
                    at_rt = r * joints + t
                    matrix[r, t] = out[1, r] * w[at.sq + at_rt, n] + out[2, r] * w[at.sv + at_rt, n] + (1.0 if r == t else 0.0)
            _eliminate(matrix, change, joints)
        length = 1.0
        for _search in range(12):
            total = 0.0
            for r in range(joints):
                attempt[r] = here[r] + length * change[r]
            _residual(at, w, walks, n, attempt, tried)
            for r in range(joints):
                total += tried[0, r] ** 2
            small = iteration > 0 and (_excess(at, w, n, tried) <= CONVERGED or not math.isfinite(total))
            if small or not total > merit * (1 - 1e-4 * length):
                break
            length *= 0.5
        for r in range(joints):
            here[r] = attempt[r]
            for i in range(4):
                out[i, r] = tried[i, r]
        if small:
            break
    else:
        walks.counts[1, n] += 1
    for r in range(joints):
        w[at.fresh + r, n] = here[r]


@inner
def _doubted(at: At, w: np.ndarray, walks: Walks, again: int) -> None:
    """Lanes in doubt: take the corrected forces as the next guess, or with ``again`` > 0 let Newton's method find them."""
    for n in range(WIDTH):
        if w[at.doubt, n] > 0.0 and again == 0:
            for r in range(at.joints):
                w[at.g + r, n] = w[at.fresh + r, n]
        elif w[at.doubt, n] > 0.0 and n < at.filled:
            for r in range(at.joints):
                w[at.fresh + r, n] = w[at.g + r, n]
            _newton(at, w, walks, n)
    for n in range(at.filled, WIDTH):
        for r in range(at.joints):
            w[at.fresh + r, n] = w[at.fresh + r, at.filled - 1]


# --- the loop -----------------------------------------------------------------------------------------------------------------


@inline
def _attempt(at: At, w: np.ndarray, walks: Walks, table: np.ndarray) -> bool:
    """One evaluation at the guess g with a first-order correction into the rows ``fresh``; whether any lane is in doubt."""
    joints = at.joints
    for r in range(joints):
        store(w, at.q + r, load(w, at.q0 + r) - _given(w, at.sq, r, at.g, joints))
        if at.velocity:
            store(w, at.v + r, load(w, at.v0 + r) - _given(w, at.sv, r, at.g, joints))
    evaluate(at, w, walks, table, at.q, at.v, at.force, at.slope_q, at.slope_v)
    steep_q, steep_v = spread(0.0), spread(0.0)
    for r in range(joints):
        store(w, at.error + r, load(w, at.force + r) - load(w, at.g + r))
        steep_q, steep_v = larger(size(load(w, at.slope_q + r)), steep_q), larger(size(load(w, at.slope_v + r)), steep_v)
    contraction = steep_q * load(w, at.reach) + steep_v * load(w, at.reach + 1)
    limit = ACCEPT / larger(contraction, spread(SMALLEST_CONTRACTION))
    doubt = spread(0.0)
    for r in range(joints):
        moved = _given(w, at.sq, r, at.error, joints)
        fresh = load(w, at.force + r) - load(w, at.slope_q + r) * moved
        scale = larger(size(load(w, at.q + r)), load(w, at.scale_q + r))
        store(w, at.scale_q + r, scale)
        doubt = larger(size(moved) - limit * scale, doubt)
        if at.velocity:
            moved = _given(w, at.sv, r, at.error, joints)
            fresh = fresh - load(w, at.slope_v + r) * moved
            scale = larger(size(load(w, at.v + r)), load(w, at.scale_v + r))
            store(w, at.scale_v + r, scale)
            doubt = larger(size(moved) - limit * scale, doubt)
        store(w, at.fresh + r, fresh)
    store(w, at.doubt, doubt)
    return bool(lanes_of(doubt > 0.0) != 0)


@inline
def _guess(at: At, w: np.ndarray, extrapolate: bool) -> None:
    """Extrapolate the joint forces through the last three steps, once there are three."""
    for r in range(at.joints):
        third, second, first = load(w, at.before + r), load(w, at.last_g + r), load(w, at.g + r)
        store(w, at.older + r, third)
        store(w, at.before + r, second)
        store(w, at.last_g + r, first)
        if extrapolate:
            store(w, at.g + r, 3.0 * (first - second) + third)


@inline
def _store(at: At, w: np.ndarray, rows: np.ndarray, to: int, u: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
    """Write rows @ (displacement, velocity, acceleration) where they are wanted."""
    if len(u):
        _rows(rows, w, at.x, u, to)
    if len(v):
        _rows(rows, w, at.x + at.modes, v, to)
    if len(a):
        for m in range(at.modes):
            rest = load(w, at.damping + m) * load(w, at.x + at.modes + m) + load(w, at.stiffness + m) * load(w, at.x + m)
            store(w, at.y + m, load(w, at.f + m) - rest)
        _rows(rows, w, at.y, a, to)


@inner
def _begin(at: At, w: np.ndarray, walks: Walks, table: np.ndarray) -> None:
    """Load every history from rest to the rows q0 along a straight path; the rows g become the force at q0, v0."""
    for i in range(1, PRELOAD_STEPS + 1):
        for r in range(at.joints):
            store(w, at.q + r, load(w, at.q0 + r) * (i / PRELOAD_STEPS))
            store(w, at.v + r, load(w, at.v0 + r) * (1.0 if i == PRELOAD_STEPS else 0.0))
        commit(at, w, walks, table, at.q, at.v)
    evaluate(at, w, walks, table, at.q0, at.v0, at.g, at.slope_q, at.slope_v)


@kernel
def advance(at: At, w: np.ndarray, walks: Walks, b: np.ndarray, first: int, last: int, force: np.ndarray, rows: np.ndarray, every: int,
            u: np.ndarray, v: np.ndarray, a: np.ndarray) -> int:
    """Steps ``first`` to ``last`` of a call; returns where it stopped, before ``last`` only if a stack of reversals needs more room.

    ``force`` (last, m, 1 or 8), empty for none; ``u``, ``v``, ``a``: (stored, L, 8), empty where not wanted. With ``first`` below 0 the
    histories are loaded instead, see ``_begin``.
    """
    table, clock, room = walks.table, walks.clock, walks.ends.shape[2]
    if first < 0:
        _begin(at, w, walks, table)
        return last
    age, deepest = clock[0], clock[1]
    for i in range(first, last):
        if deepest + 4 > room:
            clock[0], clock[1] = age, deepest
            return i
        _predict(at, w, force, i)
        if at.joints:
            _rows(b, w, at.y, w, at.q0)
            if at.velocity:
                _rows(b, w, at.y + at.modes, w, at.v0)
            _guess(at, w, age > 2)
            age += 1
            for again in range(2):
                if not _attempt(at, w, walks, table):
                    break
                _doubted(at, w, walks, again)
            for r in range(at.joints):
                store(w, at.g + r, load(w, at.fresh + r))
            if at.memory:
                for r in range(at.joints):
                    store(w, at.q + r, load(w, at.q0 + r) - _given(w, at.sq, r, at.g, at.joints))
                    store(w, at.v + r, load(w, at.v0 + r) - _given(w, at.sv, r, at.g, at.joints))
                deepest = max(deepest, commit(at, w, walks, table, at.q, at.v))
        _correct(at, w, b, force, i)
        if (i + 1) % every == 0:
            _store(at, w, rows, (i // every) * len(rows), u, v, a)
    clock[0], clock[1] = age, deepest
    return last


def ready() -> bool:
    """Whether the loop was compiled before, in this process or on disk for these very sources and this Python."""
    kept = advance.stats.cache_path
    tag = f"py{sys.version_info.major}{sys.version_info.minor}."
    return bool(advance.signatures) or (kept is not None and any(tag in path.name for path in Path(kept).glob("*.advance-*.nbc")))
