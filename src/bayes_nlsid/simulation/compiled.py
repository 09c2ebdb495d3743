"""Compiled forces of all elements for samples side by side in lanes; the loop over them stands in ``compiled_loop.py``.

Import this module only where compiled code is about to run: it imports numba. Arrays end in the lane axis; what each means stands in
``lanes.py``.
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
import numba.extending
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types

from bayes_nlsid.forces import compiled as forces
from bayes_nlsid.simulation.lanes import Elements, Memory

STATIC, MASING, SLIDERS, BOUC_WEN = 0, 1, 2, 3
law_value, masing_walk, sliders_walk, bouc_wen_walk = forces.law_value, forces.masing_walk, forces.sliders_walk, forces.bouc_wen_walk


def _cache_directory(function: Callable[..., Any]) -> str:
    """Where compiled code of these very sources is kept, or "" if nothing can be written."""
    base = forces.cache_directory(inspect.getfile(function))
    if not base:
        return ""
    digest = hashlib.sha256()
    for name in ("compiled.py", "compiled_loop.py", "lanes.py", "stepping.py"):
        digest.update((Path(__file__).parent / name).read_bytes())
    directory = Path(base) / digest.hexdigest()[:16]
    try:
        directory.mkdir(exist_ok=True)
    except OSError:
        return ""
    return str(directory)


def kernel(function: Callable[..., Any], **more: Any) -> Any:
    """The function compiled with fused multiply-add, kept on disk where a directory can be written."""
    directory = _cache_directory(function)
    config: Any = numba.core.config
    before, config.CACHE_DIR = config.CACHE_DIR, directory
    try:
        return numba.njit(cache=bool(directory), error_model="numpy", fastmath={"contract"}, nogil=True, **more)(function)
    finally:
        config.CACHE_DIR = before


def inner(function: Callable[..., Any]) -> Any:
    """As ``kernel`` for what only other kernels call: without the wrappers for Python, which take longer to compile than the function."""
    return kernel(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


_intrinsic: Any = numba.extending.intrinsic


@_intrinsic
def _bits(context: Any, value: Any) -> Any:
    """The 64 bits of a number as an integer."""
    return types.int64(types.float64), lambda c, builder, signature, args: builder.bitcast(args[0], ir.IntType(64))


@_intrinsic
def _number(context: Any, value: Any) -> Any:
    """The number with these 64 bits."""
    return types.float64(types.int64), lambda c, builder, signature, args: builder.bitcast(args[0], ir.DoubleType())


@numba.extending.register_jitable
def _power(r: float, m: float) -> float:
    """r^m for 1e-300 ≤ r ≤ 2 and m ≥ 0 without a call, so that a loop over lanes becomes vector code; relative error below 2e-13."""
    bits = _bits(r)
    # mantissa between sqrt(1/2) and sqrt(2), log2 by the series of artanh
    exponent = ((bits + (0x3FF0000000000000 - 0x3FE6A09E667F3BCD)) >> 52) & 0xFFF
    whole = _number(exponent | 0x4330000000000000) - (4503599627370496.0 + 1023.0)
    mantissa = _number(bits - ((exponent - 1023) << 52))
    s = (mantissa - 1.0) / (mantissa + 1.0)
    z = s * s
    series = 1.0 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * (1 / 9 + z * (1 / 11 + z * (1 / 13 + z * (1 / 15 + z / 17)))))))
    x = max(m * (whole + s * series * 2.8853900817779268), -1000.0)
    # adding 1.5 * 2^52 rounds to an integer and leaves it in the low bits
    shifted = x + 6755399441055744.0
    t = (x - (shifted - 6755399441055744.0)) * 0.6931471805599453
    e = 1.0 + t * (1.0 + t * (1 / 2 + t * (1 / 6 + t * (1 / 24 + t * (1 / 120 + t * (1 / 720 + t * (1 / 5040 + t * (1 / 40320 + t * (
        1 / 362880 + t * (1 / 3628800 + t * (1 / 39916800 + t / 479001600)))))))))))
    return _number(_bits(e) + (_bits(shifted) << 52))


@kernel
def power_of(r: np.ndarray, m: np.ndarray, out: np.ndarray) -> None:
    """Element by element r^m, for tests."""
    for i in range(len(r)):
        out[i] = _power(r[i], m[i])


# --- forces -------------------------------------------------------------------------------------------------------------------


@inner
def _iwan(e: int, c: np.ndarray, x: np.ndarray, bent: np.ndarray, f: np.ndarray, slope: np.ndarray) -> None:
    """Backbone and slope of four- and five-parameter Iwan laws in lanes; c (E, 5, lanes): k_t, share, exponent, 1/phi_max, sliding force.

    Three short loops: one with all these arrays would need more checks for overlap than the compiler is willing to make.
    """
    for n in range(len(x)):
        bent[n] = c[e, 1, n] * _power(min(max(abs(x[n]) * c[e, 3, n], 1e-300), 1.0), c[e, 2, n])
    for n in range(len(x)):
        f[n] = c[e, 0, n] * x[n] * (1.0 - bent[n]) if abs(x[n]) * c[e, 3, n] < 1.0 else math.copysign(c[e, 4, n], x[n])
    for n in range(len(x)):
        slope[n] = c[e, 0, n] * (1.0 - (c[e, 2, n] + 1.0) * bent[n]) if abs(x[n]) * c[e, 3, n] < 1.0 else 0.0


@inner
def one_entry(el: Elements, mem: Memory, e: int, n: int, q: float, v: float, writing: float) -> tuple[float, float, float]:
    """Force and slopes of one entry in one lane by the scalar blocks; with ``writing`` > 0 the history goes on to here.

    ``writing`` is no bool because numba compiles a function anew for each constant bool.
    """
    kind, fv, write = el.kind[e], 0.0, writing > 0.0
    last = np.empty(4)
    for i in range(4):
        last[i] = mem.last[i, e, n]
    if kind == STATIC:
        f, fq, fv = law_value(el.code[e], el.power[e], q, v, el.p[e, n])
    elif kind == MASING:
        origin, base, doubled = mem.origin[e, n], mem.base[e, n], 1.0 / mem.half[e, n]
        # the force at the last instant is only looked up at a reversal, so it is brought up to date here
        last[2] = base + doubled * law_value(el.code[e], el.power[e], (last[0] - origin) / doubled, 0.0, el.p[e, n])[0]
        f, fq, depth, overflow = masing_walk(el.code[e], el.power[e], el.p[e, n], last, mem.depth[e, n], mem.ends[e, n], mem.forces[e, n],
                                             q, v, mem.dt, write)
        if write:
            mem.depth[e, n] = depth
            origin, base, half, far = 0.0, 0.0, 1.0, math.inf * last[3]
            if depth > 0:
                origin, base, half = mem.ends[e, n, depth - 1], mem.forces[e, n, depth - 1], 0.5
                far = mem.ends[e, n, depth - 2] if depth > 1 else -origin
            mem.origin[e, n], mem.base[e, n], mem.half[e, n], mem.far[e, n] = origin, base, half, far
    elif kind == SLIDERS:
        s = mem.slot[e]
        f, fq = sliders_walk(mem.theta[s, n], mem.stiffness[s, n], mem.slip[s, n], last, mem.stretch[s, n], mem.sliding[s, n], q, v, mem.dt,
                             write)
    else:
        f, fq = bouc_wen_walk(el.p[e, n], last, q, v, mem.dt, write)
    if write:
        for i in range(4):
            mem.last[i, e, n] = last[i]
    return f - el.spring[e, n] * q, fq - el.spring[e, n], fv


@inner
def _off_branch(e: int, last: np.ndarray, far: np.ndarray, q: np.ndarray, v: np.ndarray, off: np.ndarray) -> int:
    """Mark the lanes in which a Masing entry leaves its branch by a reversal or by closing a loop; returns how many."""
    count = 0.0
    for n in range(len(q)):
        heading = last[3, e, n]
        on = (heading * (q[n] - last[0, e, n]) > 0.0) & (heading * (q[n] - far[e, n]) < 0.0) & (last[1, e, n] * v[n] >= 0.0)
        off[n] = 0.0 if on else 1.0
    for n in range(len(q)):
        count += off[n]
    return int(count)


@kernel
def evaluate(el: Elements, mem: Memory, q: np.ndarray, v: np.ndarray, f: np.ndarray, fq: np.ndarray, fv: np.ndarray,
              work: np.ndarray) -> None:
    """All entries in all lanes."""
    lanes = q.shape[1]
    for r in range(q.shape[0]):
        for n in range(lanes):
            f[r, n] = 0.0
            fq[r, n] = 0.0
            fv[r, n] = 0.0
    x, a, b, bent, off = work[0], work[1], work[2], work[3], work[4]
    for e in range(len(el.kind)):
        r = el.row[e]
        single = lanes
        if not el.fast[e]:
            for n in range(lanes):
                off[n] = 1.0
        elif el.kind[e] == STATIC:
            single = 0
            _iwan(e, el.coefficient, q[r], bent, a, b)
            for n in range(lanes):
                a[n] -= el.spring[e, n] * q[r, n]
        else:
            for n in range(lanes):
                x[n] = (q[r, n] - mem.origin[e, n]) * mem.half[e, n]
            _iwan(e, el.coefficient, x, bent, a, b)
            for n in range(lanes):
                a[n] = mem.base[e, n] + a[n] / mem.half[e, n] - el.spring[e, n] * q[r, n]
            single = _off_branch(e, mem.last, mem.far, q[r], v[r], off)
        if el.fast[e]:
            for n in range(lanes):
                b[n] -= el.spring[e, n]
        if single:
            for n in range(lanes):
                if off[n] > 0.0:
                    a[n], b[n], slope = one_entry(el, mem, e, n, q[r, n], v[r, n], 0.0)
                    fv[r, n] += slope
        for n in range(lanes):
            f[r, n] += a[n]
        for n in range(lanes):
            fq[r, n] += b[n]


@kernel
def commit(el: Elements, mem: Memory, q: np.ndarray, v: np.ndarray, off: np.ndarray) -> int:
    """Carry the histories on; returns the deepest stack."""
    deepest, last = 0, mem.last
    for e in range(len(el.kind)):
        if el.kind[e] == STATIC:
            continue
        r = el.row[e]
        if el.kind[e] != MASING or _off_branch(e, last, mem.far, q[r], v[r], off):
            for n in range(q.shape[1]):
                if el.kind[e] != MASING or off[n] > 0.0:
                    one_entry(el, mem, e, n, q[r, n], v[r, n], 1.0)
                    deepest = max(deepest, mem.depth[e, n])
        if el.kind[e] == MASING:  # harmless where the scalar step has done it already
            for n in range(q.shape[1]):
                last[0, e, n] = q[r, n]
            for n in range(q.shape[1]):
                last[1, e, n] = v[r, n]
    return deepest
