"""Compiled forces of all elements for eight samples side by side; the loop over them stands in ``compiled_loop.py``.

Import this module only where compiled code is about to run: it imports numba. All numbers of a block stand in one array ``w`` (rows, 8),
and ``at`` says which row is what (``lanes.py``): handing many arrays from function to function would cost more than the arithmetic.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numba.core.config
import numpy as np

from bayes_nlsid.forces import compiled as forces
from bayes_nlsid.simulation.lanes import At, Walks
from bayes_nlsid.simulation.vector import WIDTH, choose, lanes_of, larger, load, power, signed, size, smaller, spread, store

STATIC, MASING, SLIDERS, BOUC_WEN = 0, 1, 2, 3
ALL = 2**WIDTH - 1
"""Every lane, as bits."""
KIND, CODE, ROW, QUICK, SLOT = range(5)
"""Columns of ``Walks.table``."""
law_value, masing_walk, sliders_walk, bouc_wen_walk = forces.law_value, forces.masing_walk, forces.sliders_walk, forces.bouc_wen_walk


def _cache_directory(function: Callable[..., Any]) -> str:
    """Where compiled code of these very sources is kept, or "" if nothing can be written."""
    base = forces.cache_directory(inspect.getfile(function))
    if not base:
        return ""
    digest = hashlib.sha256()
    for name in ("compiled.py", "compiled_loop.py", "lanes.py", "stepping.py", "vector.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    directory = Path(base) / digest.hexdigest()[:16]
    try:
        directory.mkdir(exist_ok=True)
    except OSError:
        return ""
    return str(directory)


def kernel(function: Callable[..., Any], **more: Any) -> Any:
    """The function compiled with fused multiply-add, kept on disk where a directory can be written.

    Nothing here makes arrays, so references are not counted: that would cost a third of a step.
    """
    directory = _cache_directory(function)
    config: Any = numba.core.config
    njit: Any = numba.njit
    before, config.CACHE_DIR = config.CACHE_DIR, directory
    try:
        return njit(cache=bool(directory), error_model="numpy", fastmath={"contract"}, nogil=True, _nrt=False, **more)(function)
    finally:
        config.CACHE_DIR = before


def inner(function: Callable[..., Any]) -> Any:
    """As ``kernel`` for what only other kernels call: without the wrappers for Python, which take longer to compile than the function."""
    return kernel(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def inline(function: Callable[..., Any]) -> Any:
    """As ``inner``, copied into every caller: for what runs in every step."""
    return kernel(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True)


@kernel
def power_of(r: np.ndarray, m: np.ndarray, out: np.ndarray) -> None:
    """Element by element r^m, for tests; lengths are multiples of eight."""
    for i in range(len(r) // WIDTH):
        store(out, i, power(load(r, i), load(m, i)))


# --- forces -------------------------------------------------------------------------------------------------------------------


@inline
def _iwan(w: np.ndarray, c: int, x: Any) -> tuple[Any, Any]:
    """Backbone and slope of four- and five-parameter Iwan laws; rows c to c + 4: k_t, share, exponent, 1/phi_max, sliding force."""
    stiffness, exponent = load(w, c), load(w, c + 2)
    r = size(x) * load(w, c + 3)
    bent = load(w, c + 1) * power(smaller(larger(r, spread(1e-300)), spread(1.0)), exponent)
    sticks = r < 1.0
    force = choose(sticks, stiffness * x * (1.0 - bent), signed(load(w, c + 4), x))
    return force, choose(sticks, stiffness * (1.0 - (exponent + 1.0) * bent), spread(0.0))


@inner
def one_entry(at: At, w: np.ndarray, walks: Walks, e: int, n: int, q: float, v: float, writing: float) -> tuple[float, float, float]:
    """Force and slopes of one entry in one lane by the scalar blocks; with ``writing`` > 0 the history goes on to here.

    ``writing`` is no bool because numba compiles a function anew for each constant bool.
    """
    kind, code, power_ = walks.table[e, KIND], walks.table[e, CODE], walks.power[e]
    p, fv, write = walks.p[e, n], 0.0, writing > 0.0
    spring = w[at.spring + e, n]
    if kind == STATIC:
        f, fq, fv = law_value(code, power_, q, v, p)
        return f - spring * q, fq - spring, fv
    last = walks.work[0]
    for i in range(4):
        last[i] = w[at.last + i * at.entries + e, n]
    if kind == MASING:
        ends, forces = walks.ends[e, n], walks.forces[e, n]
        doubled = 1.0 / w[at.half + e, n]
        # the force at the last instant is only looked up at a reversal, so it is brought up to date here
        last[2] = w[at.base + e, n] + doubled * law_value(code, power_, (last[0] - w[at.origin + e, n]) / doubled, 0.0, p)[0]
        f, fq, depth, overflow = masing_walk(code, power_, p, last, walks.depth[e, n], ends, forces, q, v, walks.dt, write)
        if write:
            walks.depth[e, n] = depth
            origin, base, half, far = 0.0, 0.0, 1.0, math.inf * last[3]
            if depth > 0:
                origin, base, half = ends[depth - 1], forces[depth - 1], 0.5
                far = ends[depth - 2] if depth > 1 else -origin
            w[at.origin + e, n], w[at.base + e, n], w[at.half + e, n], w[at.far + e, n] = origin, base, half, far
    elif kind == SLIDERS:
        s = walks.table[e, SLOT]
        f, fq = sliders_walk(walks.theta[s, n], walks.stiffness[s, :, n], walks.slip[s, :, n], last, walks.stretch[s, :, n],
                             walks.sliding[s, :, n], q, v, walks.dt, write)
    else:
        f, fq = bouc_wen_walk(p, last, q, v, walks.dt, write)
    if write:
        for i in range(4):
            w[at.last + i * at.entries + e, n] = last[i]
    return f - spring * q, fq - spring, fv


@inline
def _on_branch(at: At, w: np.ndarray, e: int, q: Any, v: Any) -> int:
    """Lanes, as bits, in which a Masing entry stays on its branch: no reversal, no loop closed."""
    heading = load(w, at.last + 3 * at.entries + e)
    ahead = heading * (q - load(w, at.last + e)) > 0.0
    open_ = heading * (q - load(w, at.far + e)) < 0.0
    return int(lanes_of(ahead & open_ & (load(w, at.last + at.entries + e) * v >= 0.0)))


@inline
def _runs_on(at: At, w: np.ndarray, e: int, v: Any) -> Any:
    """Lanes in which the motion at an entry does not turn round."""
    return load(w, at.last + at.entries + e) * v >= 0.0


@inline
def _slide(move: Any, stretch: Any, sliding: Any, slip: Any, theta: Any) -> tuple[Any, Any]:
    """``memory.slider_step`` in all lanes."""
    tried = stretch + move
    carries_on = (size(sliding) > 0.5) & (sliding * move >= 0.0)
    after = choose(carries_on, sliding, choose(size(tried) > slip, signed(spread(1.0), tried), spread(0.0)))
    return choose(size(after) > 0.5, after * (theta * slip), tried), after


@inner
def _sliders(at: At, w: np.ndarray, walks: Walks, e: int, q: int) -> None:
    """Force and tangent of all sliders of an entry into the spare rows, right where the motion does not turn; q: row of displacement."""
    s, count = walks.table[e, SLOT], walks.slip.shape[1]
    move, theta = load(w, q) - load(w, at.last + e), load(walks.theta, s)
    force, tangent = spread(0.0), spread(0.0)
    for j in range(s * count, (s + 1) * count):
        stiffness = load(walks.stiffness, j)
        there, way = _slide(move, load(walks.stretch, j), load(walks.sliding, j), load(walks.slip, j), theta)
        force = force + stiffness * there
        tangent = tangent + choose(size(way) > 0.5, spread(0.0), stiffness)
    store(w, at.spare, force)
    store(w, at.spare + 1, tangent)
    store(w, at.spare + 2, 0.0)


@inner
def _carry_sliders(at: At, w: np.ndarray, walks: Walks, e: int, q: int, v: int) -> int:
    """Carry the sliders of an entry on where the motion does not turn; returns those lanes as bits."""
    s, count = walks.table[e, SLOT], walks.slip.shape[1]
    move, theta, on = load(w, q) - load(w, at.last + e), load(walks.theta, s), _runs_on(at, w, e, load(w, v))
    for j in range(s * count, (s + 1) * count):
        stretch, sliding = load(walks.stretch, j), load(walks.sliding, j)
        there, way = _slide(move, stretch, sliding, load(walks.slip, j), theta)
        store(walks.stretch, j, choose(on, there, stretch))
        store(walks.sliding, j, choose(on, way, sliding))
    return int(lanes_of(on))


@inner
def _alone(at: At, w: np.ndarray, walks: Walks, e: int, on: int, q: int, v: int) -> None:
    """An entry's force and slopes into the spare rows, lane by lane where the bit of ``on`` is not set; q, v: rows of its motion."""
    for n in range(at.filled):
        if on & (1 << n) == 0:
            w[at.spare, n], w[at.spare + 1, n], w[at.spare + 2, n] = one_entry(at, w, walks, e, n, w[q, n], w[v, n], 0.0)
    for n in range(at.filled, WIDTH):
        for i in range(3):
            w[at.spare + i, n] = w[at.spare + i, at.filled - 1]


@inline
def evaluate(at: At, w: np.ndarray, walks: Walks, table: np.ndarray, q: int, v: int, f: int, fq: int, fv: int) -> None:
    """All entries in all lanes: from the rows q, v into the rows f, fq, fv."""
    for i in range(at.joints):
        store(w, f + i, 0.0)
        store(w, fq + i, 0.0)
        store(w, fv + i, 0.0)
    for e in range(at.entries):
        r, on = table[e, ROW], 0
        if table[e, QUICK]:
            here, spring = load(w, q + r), load(w, at.spring + e)
            if table[e, KIND] == STATIC:
                force, slope = _iwan(w, at.coefficient + 5 * e, here)
                on = ALL
            else:
                half = load(w, at.half + e)
                force, slope = _iwan(w, at.coefficient + 5 * e, (here - load(w, at.origin + e)) * half)
                force = load(w, at.base + e) + force * (3.0 - 2.0 * half)  # half is 1 on first loading, 1/2 afterwards
                on = _on_branch(at, w, e, here, load(w, v + r))
            force, slope = force - spring * here, slope - spring
            if on != ALL:
                store(w, at.spare, force)
                store(w, at.spare + 1, slope)
                store(w, at.spare + 2, 0.0)
        elif table[e, KIND] == SLIDERS:
            _sliders(at, w, walks, e, q + r)
            spring, on = load(w, at.spring + e), int(lanes_of(_runs_on(at, w, e, load(w, v + r))))
            force, slope = load(w, at.spare) - spring * load(w, q + r), load(w, at.spare + 1) - spring
            store(w, at.spare, force)
            store(w, at.spare + 1, slope)
        else:
            force, slope = spread(0.0), spread(0.0)
        if on != ALL:
            _alone(at, w, walks, e, on, q + r, v + r)
            force, slope = load(w, at.spare), load(w, at.spare + 1)
            store(w, fv + r, load(w, fv + r) + load(w, at.spare + 2))
        store(w, f + r, load(w, f + r) + force)
        store(w, fq + r, load(w, fq + r) + slope)


@inner
def _turn(at: At, w: np.ndarray, walks: Walks, e: int, on: int, q: int, v: int) -> int:
    """Carry an entry's history on lane by lane where the bit of ``on`` is not set; returns the deepest stack."""
    deepest, together = 0, walks.table[e, KIND] != BOUC_WEN
    for n in range(WIDTH):
        # lanes that only fill the vector need no history but where all lanes go together
        if on & (1 << n) == 0 and (n < at.filled or together):
            one_entry(at, w, walks, e, n, w[q, n], w[v, n], 1.0)
            deepest = max(deepest, walks.depth[e, n])
    return deepest


@inline
def commit(at: At, w: np.ndarray, walks: Walks, table: np.ndarray, q: int, v: int) -> int:
    """Carry the histories on to the rows q, v; returns the deepest stack that was changed."""
    deepest = 0
    for e in range(at.entries):
        kind, r = table[e, KIND], table[e, ROW]
        if kind != STATIC:
            on = 0
            if kind == MASING:
                on = _on_branch(at, w, e, load(w, q + r), load(w, v + r))
            elif kind == SLIDERS:
                on = _carry_sliders(at, w, walks, e, q + r, v + r)
            if on != ALL:
                deepest = max(deepest, _turn(at, w, walks, e, on, q + r, v + r))
            if kind != BOUC_WEN:  # harmless where the scalar step has done it already
                store(w, at.last + e, load(w, q + r))
                store(w, at.last + at.entries + e, load(w, v + r))
    return deepest
