"""The time loop compiled: the same scheme as ``stepping.py`` step by step, for samples side by side in lanes.

Import this module only where compiled code is about to run: it brings numba with it. Arrays end in the lane axis; ``W`` is the number of
lanes, or 1
where all lanes share the linear part. What each array means stands in ``lanes.py``, which builds them.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from bayes_nlsid.simulation.compiled import commit, evaluate, inner, kernel, one_entry
from bayes_nlsid.simulation.lanes import Elements, Linear, Memory, Motion
from bayes_nlsid.simulation.stepping import ACCEPT, CONVERGED, MOST_ITERATIONS, SMALLEST_CONTRACTION

# --- the linear part ----------------------------------------------------------------------------------------------------------


@inner
def _predict(shared: bool, a: np.ndarray, old: np.ndarray, x: np.ndarray, f: np.ndarray, y: np.ndarray) -> None:
    components, modes, lanes = x.shape
    for k in range(modes):
        for i in range(components):
            if shared:
                a0, a1, o = a[k, i, 0, 0], a[k, i, 1, 0], old[k, i, 0]
                for n in range(lanes):
                    y[i, k, n] = a0 * x[0, k, n] + a1 * x[1, k, n] + o * f[k, n]
                if components == 3:
                    a2 = a[k, i, 2, 0]
                    for n in range(lanes):
                        y[i, k, n] += a2 * x[2, k, n]
            else:
                for n in range(lanes):
                    y[i, k, n] = a[k, i, 0, n] * x[0, k, n] + a[k, i, 1, n] * x[1, k, n] + old[k, i, n] * f[k, n]
                if components == 3:
                    for n in range(lanes):
                        y[i, k, n] += a[k, i, 2, n] * x[2, k, n]


@inner
def _push(lin: Linear, p: np.ndarray, y: np.ndarray) -> None:
    """Add the applied modal force p (m, 1 or lanes) at the end of the step."""
    components, modes, lanes = y.shape
    for k in range(modes):
        for i in range(components):
            for n in range(lanes):
                y[i, k, n] += lin.new[k, i, 0 if lin.shared else n] * p[k, 0 if p.shape[1] == 1 else n]


@inner
def _rows(b: np.ndarray, x: np.ndarray, out: np.ndarray) -> None:
    """out = b x, five columns at a time."""
    rows, columns = b.shape
    lanes = out.shape[1]
    for r in range(rows):
        for n in range(lanes):
            out[r, n] = 0.0
        k = 0
        while k + 5 <= columns:
            b0, b1, b2, b3, b4 = b[r, k], b[r, k + 1], b[r, k + 2], b[r, k + 3], b[r, k + 4]
            for n in range(lanes):
                out[r, n] += b0 * x[k, n] + b1 * x[k + 1, n] + b2 * x[k + 2, n] + b3 * x[k + 3, n] + b4 * x[k + 4, n]
            k += 5
        while k + 2 <= columns:
            b0, b1 = b[r, k], b[r, k + 1]
            for n in range(lanes):
                out[r, n] += b0 * x[k, n] + b1 * x[k + 1, n]
            k += 2
        if k < columns:
            b0 = b[r, k]
            for n in range(lanes):
                out[r, n] += b0 * x[k, n]


@inner
def _give(shared: bool, s: np.ndarray, square: np.ndarray, g: np.ndarray, out: np.ndarray) -> None:
    """out = S g."""
    if shared:
        _rows(square, g, out)
        return
    for r in range(len(s)):
        for n in range(g.shape[1]):
            out[r, n] = 0.0
        for t in range(len(s)):
            for n in range(g.shape[1]):
                out[r, n] += s[r, t, n] * g[t, n]


@inner
def _moved(shared: bool, s: np.ndarray, square: np.ndarray, start: np.ndarray, g: np.ndarray, q: np.ndarray) -> None:
    """q = start − S g."""
    _give(shared, s, square, g, q)
    for r in range(q.shape[0]):
        for n in range(q.shape[1]):
            q[r, n] = start[r, n] - q[r, n]


@inner
def _correct(shared: bool, new: np.ndarray, y: np.ndarray, back: np.ndarray, p: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
    components, modes, lanes = x.shape
    for k in range(modes):
        for i in range(components):
            if shared:
                c = new[k, i, 0]
                for n in range(lanes):
                    x[i, k, n] = y[i, k, n] - c * back[k, n]
            else:
                for n in range(lanes):
                    x[i, k, n] = y[i, k, n] - new[k, i, n] * back[k, n]
        for n in range(lanes):
            f[k, n] = -back[k, n]
        if len(p):
            for n in range(lanes):
                f[k, n] += p[k, 0 if p.shape[1] == 1 else n]


@inner
def _copy(source: np.ndarray, target: np.ndarray) -> None:
    for r in range(source.shape[0]):
        for n in range(source.shape[1]):
            target[r, n] = source[r, n]


# --- Newton in one lane -------------------------------------------------------------------------------------------------------


@inner
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


@inner
def _residual(lin: Linear, el: Elements, mem: Memory, n: int, q0: np.ndarray, v0: np.ndarray, g: np.ndarray, at: np.ndarray) -> None:
    """at (4, R): e = f − g, its slopes by q and v, and the force f itself, in lane n at the joint forces g (R,)."""
    for i in range(4):
        for r in range(len(g)):
            at[i, r] = 0.0
    w = 0 if lin.shared else n
    size = len(g)
    for e in range(len(el.kind)):
        r = el.row[e]
        q, v = q0[r, n], v0[r, n]
        for t in range(size):
            q -= lin.sq[r, t, w] * g[t]
            v -= lin.sv[r, t, w] * g[t]
        f, fq, fv = one_entry(el, mem, e, n, q, v, 0.0)
        at[3, r] += f
        at[1, r] += fq
        at[2, r] += fv
    for r in range(size):
        at[0, r] = at[3, r] - g[r]


@inner
def _excess(lin: Linear, mot: Motion, n: int, at: np.ndarray) -> float:
    """Largest change of q or v that e = at[0] would make, relative to the largest motion so far (R,)."""
    w = 0 if lin.shared else n
    worst = 0.0
    size = at.shape[1]
    for r in range(size):
        dq, dv = 0.0, 0.0
        for t in range(size):
            dq += lin.sq[r, t, w] * at[0, t]
            dv += lin.sv[r, t, w] * at[0, t]
        if abs(dq) > 0.0:
            worst = max(worst, abs(dq) / max(mot.scale_q[r, n], 1e-300))
        if lin.velocity and abs(dv) > 0.0:
            worst = max(worst, abs(dv) / max(mot.scale_v[r, n], 1e-300))
    return worst


@inner
def _newton(lin: Linear, el: Elements, mem: Memory, mot: Motion, n: int, q0: np.ndarray, v0: np.ndarray, g: np.ndarray) -> None:
    """Converged Newton with line search in lane n; g (R, lanes) enters as the guess and leaves as the solution."""
    size, w = len(g), 0 if lin.shared else n
    here, change, attempt = np.empty(size), np.zeros(size), np.empty(size)
    at, tried, matrix = np.zeros((4, size)), np.empty((4, size)), np.empty((size, size))
    for r in range(size):
        here[r] = g[r, n]
    merit, small = math.inf, False
    for iteration in range(MOST_ITERATIONS + 1):
        # the first pass only evaluates at the guess; one place that evaluates keeps the compiled code short
        if iteration > 0:
            mot.iterations[n] += 1
            merit = 0.0
            for r in range(size):
                change[r] = at[0, r]
                merit += at[0, r] ** 2
                for t in range(size):
                    matrix[r, t] = at[1, r] * lin.sq[r, t, w] + at[2, r] * lin.sv[r, t, w] + (1.0 if r == t else 0.0)
            _eliminate(matrix, change)
        length = 1.0
        for _search in range(12):
            total = 0.0
            for r in range(size):
                attempt[r] = here[r] + length * change[r]
            _residual(lin, el, mem, n, q0, v0, attempt, tried)
            for r in range(size):
                total += tried[0, r] ** 2
            small = iteration > 0 and (_excess(lin, mot, n, tried) <= CONVERGED or not math.isfinite(total))
            if small or not total > merit * (1 - 1e-4 * length):
                break
            length *= 0.5
        for r in range(size):
            here[r] = attempt[r]
        _copy(tried, at)
        if small:
            break
    else:
        mot.failures[n] += 1
    for r in range(size):
        g[r, n] = here[r]


# --- the loop -----------------------------------------------------------------------------------------------------------------


@inner
def _doubts(lin: Linear, mot: Motion, q: np.ndarray, v: np.ndarray, fq: np.ndarray, fv: np.ndarray, eq: np.ndarray, ev: np.ndarray) -> bool:
    """Bring the scales up to date, mark lanes whose residual is too large for the first-order correction."""
    size, lanes = q.shape
    scale_q, scale_v, steep_q, steep_v, doubt = mot.scale_q, mot.scale_v, mot.steep_q, mot.steep_v, mot.doubt
    for n in range(lanes):
        steep_q[n], steep_v[n], doubt[n] = 0.0, 0.0, 0.0
    for r in range(size):
        for n in range(lanes):
            scale_q[r, n] = max(scale_q[r, n], abs(q[r, n]))
        for n in range(lanes):
            steep_q[n] = max(steep_q[n], abs(fq[r, n]))
        if lin.velocity:
            for n in range(lanes):
                scale_v[r, n] = max(scale_v[r, n], abs(v[r, n]))
            for n in range(lanes):
                steep_v[n] = max(steep_v[n], abs(fv[r, n]))
    for n in range(lanes):
        contraction = steep_q[n] * lin.reach_q[0 if lin.shared else n] + steep_v[n] * lin.reach_v[0 if lin.shared else n]
        steep_q[n] = ACCEPT / max(contraction, SMALLEST_CONTRACTION)
    worst = 0.0
    for r in range(size):
        for n in range(lanes):
            doubt[n] = max(doubt[n], abs(eq[r, n]) - steep_q[n] * scale_q[r, n])
        if lin.velocity:
            for n in range(lanes):
                doubt[n] = max(doubt[n], abs(ev[r, n]) - steep_q[n] * scale_v[r, n])
    for n in range(lanes):
        worst = max(worst, doubt[n])
    return worst > 0.0


@inner
def _attempt(lin: Linear, el: Elements, mem: Memory, mot: Motion, work: np.ndarray) -> bool:
    """One evaluation at the guess mot.g with a first-order correction into mot.new; whether any lane is in doubt."""
    q0, v0, q, v, f, fq, fv, e, eq, ev = work[0], work[1], work[2], work[3], work[4], work[5], work[6], work[7], work[8], work[9]
    size, lanes = q.shape
    _moved(lin.shared, lin.sq, lin.square_q, q0, mot.g, q)
    if lin.velocity:
        _moved(lin.shared, lin.sv, lin.square_v, v0, mot.g, v)
    evaluate(el, mem, q, v, f, fq, fv, mot.scratch)
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


@inner
def _guess(mot: Motion) -> None:
    """Extrapolate the joint forces through the last three steps, once there are three."""
    _copy(mot.before, mot.older)
    _copy(mot.old, mot.before)
    _copy(mot.g, mot.old)
    if mot.age[0] > 2:
        g, old, before, older = mot.g, mot.old, mot.before, mot.older
        for r in range(g.shape[0]):
            for n in range(g.shape[1]):
                g[r, n] = 3.0 * (old[r, n] - before[r, n]) + older[r, n]
    mot.age[0] += 1


@inner
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


@kernel
def advance(lin: Linear, el: Elements, mem: Memory, mot: Motion, work: np.ndarray, first: int, last: int, force: np.ndarray,
            rows: np.ndarray,
            every: int, outs: tuple[Any, ...]) -> int:
    """Steps ``first`` to ``last`` of a call; returns where it stopped, before ``last`` only if a stack of reversals needs more room.

    ``force`` (last, m, 1 or lanes), empty for none; ``outs``: three arrays (stored, L, lanes), empty where not wanted.
    """
    y, back, size = mot.y, mot.back, len(mot.g)
    q0, v0, q, v = work[0], work[1], work[2], work[3]
    for i in range(first, last):
        if mem.deepest[0] + 4 > mem.ends.shape[2]:
            return i
        p = force[i] if len(force) else back[:0]
        _predict(lin.shared, lin.a, lin.old, mot.x, mot.f, y)
        if len(p):
            _push(lin, p, y)
        if size:
            _rows(lin.b, y[0], q0)
            if lin.velocity:
                _rows(lin.b, y[1], v0)
            _guess(mot)
            for attempt in range(2):
                if not _attempt(lin, el, mem, mot, work):
                    break
                for n in range(len(mot.doubt)):
                    if mot.doubt[n] > 0.0 and attempt == 0:
                        for r in range(size):
                            mot.g[r, n] = mot.new[r, n]
                    elif mot.doubt[n] > 0.0:
                        for r in range(size):
                            mot.new[r, n] = mot.g[r, n]
                        _newton(lin, el, mem, mot, n, q0, v0, mot.new)
            _copy(mot.new, mot.g)
            if mem.present:
                _moved(lin.shared, lin.sq, lin.square_q, q0, mot.g, q)
                _moved(lin.shared, lin.sv, lin.square_v, v0, mot.g, v)
                mem.deepest[0] = max(mem.deepest[0], commit(el, mem, q, v, mot.scratch[4]))
            _rows(lin.bt, mot.g, back)
        _correct(lin.shared, lin.new, y, back, p, mot.x, mot.f)
        if (i + 1) % every == 0:
            _store(lin, mot, rows, i // every, outs, mot.acceleration)
    return last


def ready() -> bool:
    """Whether the loop was compiled before, in this process or on disk for these very sources and this Python."""
    kept = advance.stats.cache_path
    tag = f"py{sys.version_info.major}{sys.version_info.minor}."
    return bool(advance.signatures) or (kept is not None and any(tag in path.name for path in Path(kept).glob("*.advance-*.nbc")))
