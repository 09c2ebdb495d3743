"""The time loop compiled: samples side by side in lanes, the same scheme as ``stepping.py`` step by step.

Import this module only where compiled code is about to run: it imports numba. Arrays end in the lane axis; ``W`` is the number of lanes, or 1 where
all lanes share the linear part. What each array means stands in ``lanes.py``, which builds them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numba.extending
import numpy as np
from llvmlite import ir
from numba.core import types

from bayes_nlsid.forces import compiled as forces
from bayes_nlsid.simulation.lanes import Elements, Linear, Memory, Motion
from bayes_nlsid.simulation.stepping import ACCEPT, CONVERGED, MOST_ITERATIONS, SMALLEST_CONTRACTION

STATIC, MASING, SLIDERS, BOUC_WEN = 0, 1, 2, 3
law_value, masing_walk, sliders_walk, bouc_wen_walk = forces.law_value, forces.masing_walk, forces.sliders_walk, forces.bouc_wen_walk


def _kernel(function: Callable[..., Any]) -> Any:
    """Compiled with fused multiply-add, kept on disk where a directory can be written."""
    directory = forces._cache_directory(__file__)
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, directory
    try:
        return numba.njit(cache=bool(directory), error_model="numpy", fastmath={"contract"}, nogil=True)(function)
    finally:
        numba.config.CACHE_DIR = before


@numba.extending.intrinsic
def _bits(context: Any, value: Any) -> Any:
    """The 64 bits of a number as an integer."""
    return types.int64(types.float64), lambda c, builder, signature, args: builder.bitcast(args[0], ir.IntType(64))


@numba.extending.intrinsic
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


@_kernel
def power_of(r: np.ndarray, m: np.ndarray, out: np.ndarray) -> None:
    """Element by element r^m, for tests."""
    for i in range(len(r)):
        out[i] = _power(r[i], m[i])


# --- the linear part ----------------------------------------------------------------------------------------------------------


@_kernel
def _predict(lin: Linear, x: np.ndarray, f: np.ndarray, y: np.ndarray) -> None:
    components, modes, lanes = x.shape
    for k in range(modes):
        fk, u, v, w = f[k], x[0, k], x[1, k], x[components - 1, k]
        for i in range(components):
            target, a, o = y[i, k], lin.a[k, i], lin.old[k, i]
            if lin.shared and components == 3:
                a0, a1, a2, o0 = a[0, 0], a[1, 0], a[2, 0], o[0]
                for n in range(lanes):
                    target[n] = a0 * u[n] + a1 * v[n] + a2 * w[n] + o0 * fk[n]
            elif lin.shared:
                a0, a1, o0 = a[0, 0], a[1, 0], o[0]
                for n in range(lanes):
                    target[n] = a0 * u[n] + a1 * v[n] + o0 * fk[n]
            elif components == 3:
                for n in range(lanes):
                    target[n] = a[0, n] * u[n] + a[1, n] * v[n] + a[2, n] * w[n] + o[n] * fk[n]
            else:
                for n in range(lanes):
                    target[n] = a[0, n] * u[n] + a[1, n] * v[n] + o[n] * fk[n]


@_kernel
def _push(lin: Linear, p: np.ndarray, y: np.ndarray) -> None:
    """Add the applied modal force p (m, 1 or lanes) at the end of the step."""
    components, modes, lanes = y.shape
    for k in range(modes):
        for i in range(components):
            for n in range(lanes):
                y[i, k, n] += lin.new[k, i, 0 if lin.shared else n] * p[k, 0 if p.shape[1] == 1 else n]


@_kernel
def _rows(b: np.ndarray, x: np.ndarray, out: np.ndarray) -> None:
    """out = b x, four columns at a time."""
    rows, columns = b.shape
    lanes = out.shape[1]
    for r in range(rows):
        target, k = out[r], columns % 4
        for n in range(lanes):
            target[n] = 0.0
        for j in range(k):
            b0, x0 = b[r, j], x[j]
            for n in range(lanes):
                target[n] += b0 * x0[n]
        while k < columns:
            b0, b1, b2, b3 = b[r, k], b[r, k + 1], b[r, k + 2], b[r, k + 3]
            x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            for n in range(lanes):
                target[n] += b0 * x0[n] + b1 * x1[n] + b2 * x2[n] + b3 * x3[n]
            k += 4


@_kernel
def _give(shared: bool, s: np.ndarray, square: np.ndarray, g: np.ndarray, out: np.ndarray) -> None:
    """out = S g."""
    if shared:
        _rows(square, g, out)
        return
    for r in range(len(s)):
        target = out[r]
        for n in range(g.shape[1]):
            target[n] = 0.0
        for t in range(len(s)):
            st, gt = s[r, t], g[t]
            for n in range(g.shape[1]):
                target[n] += st[n] * gt[n]


@_kernel
def _correct(lin: Linear, y: np.ndarray, back: np.ndarray, p: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
    components, modes, lanes = x.shape
    for k in range(modes):
        b, fk = back[k], f[k]
        for i in range(components):
            source, target = y[i, k], x[i, k]
            if lin.shared:
                c = lin.new[k, i, 0]
                for n in range(lanes):
                    target[n] = source[n] - c * b[n]
            else:
                for n in range(lanes):
                    target[n] = source[n] - lin.new[k, i, n] * b[n]
        for n in range(lanes):
            fk[n] = -b[n]
        if len(p):
            for n in range(lanes):
                fk[n] += p[k, 0 if p.shape[1] == 1 else n]


# --- forces -------------------------------------------------------------------------------------------------------------------


@_kernel
def _iwan(c: np.ndarray, x: np.ndarray, f: np.ndarray, slope: np.ndarray) -> None:
    """Backbone and slope of four- and five-parameter Iwan laws in lanes; c (5, lanes): k_t, share, exponent, 1/phi_max, sliding force."""
    k, share, m, inverse, slip = c[0], c[1], c[2], c[3], c[4]
    for n in range(len(x)):
        r = abs(x[n]) * inverse[n]
        bent = share[n] * _power(min(max(r, 1e-300), 1.0), m[n])
        inside = r < 1.0
        f[n] = k[n] * x[n] * (1.0 - bent) if inside else math.copysign(slip[n], x[n])
        slope[n] = k[n] * (1.0 - (m[n] + 1.0) * bent) if inside else 0.0


@_kernel
def _one(el: Elements, mem: Memory, e: int, n: int, q: float, v: float, write: bool) -> tuple[float, float, float]:
    """Force and slopes of one entry in one lane by the scalar blocks; with ``write`` the history goes on to here."""
    kind = el.kind[e]
    if kind == STATIC:
        f, fq, fv = law_value(el.code[e], el.power[e], q, v, el.p[e, n])
    elif kind == MASING:
        last, origin, base, doubled = mem.last[e, n], mem.origin[e, n], mem.base[e, n], mem.doubled[e, n]
        # the force at the last instant is only looked up at a reversal, so it is brought up to date here
        last[2] = base + doubled * law_value(el.code[e], el.power[e], (last[0] - origin) / doubled, 0.0, el.p[e, n])[0]
        f, fq, depth, overflow = masing_walk(el.code[e], el.power[e], el.p[e, n], last, mem.depth[e, n], mem.ends[e, n], mem.forces[e, n],
                                             q, v, mem.dt, write)
        fv = 0.0
        if write:
            mem.depth[e, n] = depth
            origin, base, doubled, far = 0.0, 0.0, 1.0, math.inf * last[3]
            if depth > 0:
                origin, base, doubled = mem.ends[e, n, depth - 1], mem.forces[e, n, depth - 1], 2.0
                far = mem.ends[e, n, depth - 2] if depth > 1 else -origin
            mem.origin[e, n], mem.base[e, n], mem.doubled[e, n], mem.far[e, n] = origin, base, doubled, far
    elif kind == SLIDERS:
        s = mem.slot[e]
        f, fq = sliders_walk(mem.theta[s, n], mem.stiffness[s, n], mem.slip[s, n], mem.last[e, n], mem.stretch[s, n], mem.sliding[s, n],
                             q, v, mem.dt, write)
        fv = 0.0
    else:
        f, fq = bouc_wen_walk(el.p[e, n], mem.last[e, n], q, v, mem.dt, write)
        fv = 0.0
    return f - el.spring[e, n] * q, fq - el.spring[e, n], fv


@_kernel
def _on_branch(mem: Memory, e: int, n: int, q: float, v: float) -> bool:
    """Whether a Masing entry goes on along its branch: no reversal, no loop closed."""
    last = mem.last[e, n]
    heading = last[3]
    return heading * (q - last[0]) > 0.0 and heading * (q - mem.far[e, n]) < 0.0 and last[1] * v >= 0.0


@_kernel
def _evaluate(el: Elements, mem: Memory, q: np.ndarray, v: np.ndarray, f: np.ndarray, fq: np.ndarray, fv: np.ndarray,
              work: np.ndarray) -> None:
    """All entries in all lanes."""
    f[:], fq[:], fv[:] = 0.0, 0.0, 0.0
    lanes = q.shape[1]
    x, a, b = work[0], work[1], work[2]
    for e in range(len(el.kind)):
        r, spring = el.row[e], el.spring[e]
        qr, vr, fr, fqr, fvr = q[r], v[r], f[r], fq[r], fv[r]
        if not el.fast[e]:
            for n in range(lanes):
                one = _one(el, mem, e, n, qr[n], vr[n], False)
                fr[n] += one[0]
                fqr[n] += one[1]
                fvr[n] += one[2]
        elif el.kind[e] == STATIC:
            _iwan(el.coefficient[e], qr, a, b)
            for n in range(lanes):
                fr[n] += a[n] - spring[n] * qr[n]
                fqr[n] += b[n] - spring[n]
        else:
            origin, base, doubled = mem.origin[e], mem.base[e], mem.doubled[e]
            for n in range(lanes):
                x[n] = (qr[n] - origin[n]) / doubled[n]
            _iwan(el.coefficient[e], x, a, b)
            for n in range(lanes):
                a[n] = base[n] + doubled[n] * a[n] - spring[n] * qr[n]
                b[n] -= spring[n]
            for n in range(lanes):
                if not _on_branch(mem, e, n, qr[n], vr[n]):
                    one = _one(el, mem, e, n, qr[n], vr[n], False)
                    a[n], b[n] = one[0], one[1]
            for n in range(lanes):
                fr[n] += a[n]
                fqr[n] += b[n]


@_kernel
def _commit(el: Elements, mem: Memory, q: np.ndarray, v: np.ndarray) -> int:
    """Carry the histories on; returns the deepest stack."""
    deepest = 0
    for e in range(len(el.kind)):
        if el.kind[e] == STATIC:
            continue
        r = el.row[e]
        for n in range(q.shape[1]):
            if el.kind[e] == MASING and _on_branch(mem, e, n, q[r, n], v[r, n]):
                mem.last[e, n, 0], mem.last[e, n, 1] = q[r, n], v[r, n]
            else:
                _one(el, mem, e, n, q[r, n], v[r, n], True)
                deepest = max(deepest, mem.depth[e, n])
    return deepest


# --- Newton in one lane -------------------------------------------------------------------------------------------------------


@_kernel
def _eliminate(a: np.ndarray, b: np.ndarray) -> None:
    """Solve a x = b in place of b, with pivoting; a zero pivot leaves the entry as it is."""
    size = len(b)
    for i in range(size):
        best = i
        for j in range(i + 1, size):
            if abs(a[j, i]) > abs(a[best, i]):
                best = j
        if a[best, i] == 0.0:
            continue
        if best != i:
            for k in range(size):
                a[i, k], a[best, k] = a[best, k], a[i, k]
            b[i], b[best] = b[best], b[i]
        for j in range(i + 1, size):
            factor = a[j, i] / a[i, i]
            for k in range(i, size):
                a[j, k] -= factor * a[i, k]
            b[j] -= factor * b[i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            b[i] -= a[i, k] * b[k]
        if a[i, i] != 0.0:
            b[i] /= a[i, i]


@_kernel
def _residual(lin: Linear, el: Elements, mem: Memory, n: int, q0: np.ndarray, v0: np.ndarray, g: np.ndarray, at: np.ndarray) -> None:
    """at (4, R): e = f − g, its slopes by q and v, and the force f itself, in lane n at the joint forces g (R,)."""
    at[:] = 0.0
    w = 0 if lin.shared else n
    size = len(g)
    for e in range(len(el.kind)):
        r = el.row[e]
        q, v = q0[r, n], v0[r, n]
        for t in range(size):
            q -= lin.sq[r, t, w] * g[t]
            v -= lin.sv[r, t, w] * g[t]
        f, fq, fv = _one(el, mem, e, n, q, v, False)
        at[3, r] += f
        at[1, r] += fq
        at[2, r] += fv
    for r in range(size):
        at[0, r] = at[3, r] - g[r]


@_kernel
def _excess(lin: Linear, mot: Motion, n: int, e: np.ndarray) -> float:
    """Largest change of q or v that e would make, relative to the largest motion so far (R,)."""
    w = 0 if lin.shared else n
    worst = 0.0
    for r in range(len(e)):
        dq, dv = 0.0, 0.0
        for t in range(len(e)):
            dq += lin.sq[r, t, w] * e[t]
            dv += lin.sv[r, t, w] * e[t]
        if abs(dq) > 0.0:
            worst = max(worst, abs(dq) / max(mot.scale_q[r, n], 1e-300))
        if lin.velocity and abs(dv) > 0.0:
            worst = max(worst, abs(dv) / max(mot.scale_v[r, n], 1e-300))
    return worst


@_kernel
def _newton(lin: Linear, el: Elements, mem: Memory, mot: Motion, n: int, q0: np.ndarray, v0: np.ndarray, g: np.ndarray) -> None:
    """Converged Newton with line search in lane n; g (R, lanes) enters as the guess and leaves as the solution."""
    size, w = len(g), 0 if lin.shared else n
    here, change, attempt = g[:, n].copy(), np.empty(size), np.empty(size)
    at, tried, matrix = np.empty((4, size)), np.empty((4, size)), np.empty((size, size))
    _residual(lin, el, mem, n, q0, v0, here, at)
    for _ in range(MOST_ITERATIONS):
        mot.iterations[n] += 1
        merit = 0.0
        for r in range(size):
            change[r] = at[0, r]
            merit += at[0, r] ** 2
            for t in range(size):
                matrix[r, t] = at[1, r] * lin.sq[r, t, w] + at[2, r] * lin.sv[r, t, w] + (1.0 if r == t else 0.0)
        _eliminate(matrix, change)
        length = 1.0
        small = False
        for _search in range(12):
            total = 0.0
            for r in range(size):
                attempt[r] = here[r] + length * change[r]
            _residual(lin, el, mem, n, q0, v0, attempt, tried)
            for r in range(size):
                total += tried[0, r] ** 2
            small = _excess(lin, mot, n, tried[0]) <= CONVERGED or not math.isfinite(total)
            if small or not total > merit * (1 - 1e-4 * length):
                break
            length *= 0.5
        here[:], at[:] = attempt, tried
        if small:
            break
    else:
        mot.failures[n] += 1
    for r in range(size):
        g[r, n] = here[r]


# --- the loop -----------------------------------------------------------------------------------------------------------------


@_kernel
def _doubts(lin: Linear, mot: Motion, q: np.ndarray, v: np.ndarray, fq: np.ndarray, fv: np.ndarray, eq: np.ndarray, ev: np.ndarray) -> bool:
    """Bring the scales up to date, mark lanes whose residual is too large for the first-order correction."""
    size, lanes = q.shape
    steep_q, steep_v, doubt = mot.steep_q, mot.steep_v, mot.doubt
    steep_q[:], steep_v[:], doubt[:] = 0.0, 0.0, 0.0
    for r in range(size):
        scale, qr, fr = mot.scale_q[r], q[r], fq[r]
        for n in range(lanes):
            scale[n] = max(scale[n], abs(qr[n]))
            steep_q[n] = max(steep_q[n], abs(fr[n]))
        if lin.velocity:
            for n in range(lanes):
                mot.scale_v[r, n] = max(mot.scale_v[r, n], abs(v[r, n]))
                steep_v[n] = max(steep_v[n], abs(fv[r, n]))
    for n in range(lanes):
        contraction = steep_q[n] * lin.reach_q[0 if lin.shared else n] + steep_v[n] * lin.reach_v[0 if lin.shared else n]
        steep_q[n] = ACCEPT / max(contraction, SMALLEST_CONTRACTION)
    for r in range(size):
        scale, er = mot.scale_q[r], eq[r]
        for n in range(lanes):
            doubt[n] = max(doubt[n], abs(er[n]) - steep_q[n] * scale[n])
        if lin.velocity:
            for n in range(lanes):
                doubt[n] = max(doubt[n], abs(ev[r, n]) - steep_q[n] * mot.scale_v[r, n])
    return doubt.max() > 0.0


@_kernel
def _attempt(lin: Linear, el: Elements, mem: Memory, mot: Motion, work: np.ndarray) -> bool:
    """One evaluation at the guess mot.g with a first-order correction into mot.new; whether any lane is in doubt."""
    q0, v0, q, v, f, fq, fv, e, eq, ev = work[0], work[1], work[2], work[3], work[4], work[5], work[6], work[7], work[8], work[9]
    size, lanes = q.shape
    _give(lin.shared, lin.sq, lin.square_q, mot.g, eq)
    q[:] = q0 - eq
    if lin.velocity:
        _give(lin.shared, lin.sv, lin.square_v, mot.g, ev)
        v[:] = v0 - ev
    _evaluate(el, mem, q, v, f, fq, fv, mot.scratch)
    for r in range(size):
        for n in range(lanes):
            e[r, n] = f[r, n] - mot.g[r, n]
    _give(lin.shared, lin.sq, lin.square_q, e, eq)
    for r in range(size):
        for n in range(lanes):
            mot.new[r, n] = f[r, n] - fq[r, n] * eq[r, n]
    if lin.velocity:
        _give(lin.shared, lin.sv, lin.square_v, e, ev)
        for r in range(size):
            for n in range(lanes):
                mot.new[r, n] -= fv[r, n] * ev[r, n]
    return _doubts(lin, mot, q, v, fq, fv, eq, ev)


@_kernel
def begin(lin: Linear, el: Elements, mem: Memory, q: np.ndarray, v: np.ndarray, parts: int, f: np.ndarray) -> None:
    """Load every history from rest to q along a straight path; f becomes the force at q, v (R, lanes)."""
    still = np.zeros_like(v)
    for i in range(parts):
        _commit(el, mem, q * ((i + 1) / parts), v if i + 1 == parts else still)
    f[:] = 0.0
    for e in range(len(el.kind)):
        r = el.row[e]
        for n in range(q.shape[1]):
            f[r, n] += _one(el, mem, e, n, q[r, n], v[r, n], False)[0]


@_kernel
def _store(lin: Linear, mot: Motion, rows: np.ndarray, k: int, outs: tuple[Any, ...], acceleration: np.ndarray) -> None:
    if len(outs[0]):
        _rows(rows, mot.x[0], outs[0][k])
    if len(outs[1]):
        _rows(rows, mot.x[1], outs[1][k])
    if len(outs[2]):
        for m in range(len(acceleration)):
            for n in range(acceleration.shape[1]):
                w = 0 if lin.shared else n
                acceleration[m, n] = mot.f[m, n] - lin.damping[m, w] * mot.x[1, m, n] - lin.stiffness[m, w] * mot.x[0, m, n]
        _rows(rows, acceleration, outs[2][k])


@_kernel
def advance(lin: Linear, el: Elements, mem: Memory, mot: Motion, work: np.ndarray, first: int, last: int, force: np.ndarray, rows: np.ndarray,
            every: int, outs: tuple[Any, ...]) -> int:
    """Steps ``first`` to ``last`` of a call; returns where it stopped, before ``last`` only if a stack of reversals needs more room.

    ``force`` (last, m, 1 or lanes), empty for none; ``outs``: three arrays (stored, L, lanes), empty where not wanted.
    """
    y, back, size = mot.y, mot.back, len(mot.g)
    q0, v0, q, v, eq, ev = work[0], work[1], work[2], work[3], work[8], work[9]
    for i in range(first, last):
        if mem.deepest[0] + 4 > mem.ends.shape[2]:
            return i
        p = force[i] if len(force) else back[:0]
        _predict(lin, mot.x, mot.f, y)
        if len(p):
            _push(lin, p, y)
        if size:
            _rows(lin.b, y[0], q0)
            if lin.velocity:
                _rows(lin.b, y[1], v0)
            if mot.age[0] > 2:
                mot.older[:], mot.before[:], mot.old[:] = mot.before, mot.old, mot.g
                mot.g[:] = 3 * (mot.old - mot.before) + mot.older
            else:
                mot.older[:], mot.before[:], mot.old[:] = mot.before, mot.old, mot.g
            mot.age[0] += 1
            if _attempt(lin, el, mem, mot, work):
                for n in range(len(mot.doubt)):
                    if mot.doubt[n] > 0.0:
                        mot.g[:, n] = mot.new[:, n]
                if _attempt(lin, el, mem, mot, work):
                    for n in range(len(mot.doubt)):
                        if mot.doubt[n] > 0.0:
                            mot.new[:, n] = mot.g[:, n]
                            _newton(lin, el, mem, mot, n, q0, v0, mot.new)
            mot.g[:] = mot.new
            if mem.present:
                _give(lin.shared, lin.sq, lin.square_q, mot.g, eq)
                q[:] = q0 - eq
                _give(lin.shared, lin.sv, lin.square_v, mot.g, ev)
                v[:] = v0 - ev
                mem.deepest[0] = max(mem.deepest[0], _commit(el, mem, q, v))
            _rows(lin.bt, mot.g, back)
        _correct(lin, y, back, p, mot.x, mot.f)
        if (i + 1) % every == 0:
            _store(lin, mot, rows, i // every, outs, mot.acceleration)
    return last
