"""Compiled kernels: the force laws of the truth and the time stepper that couples them to the complex modes.

A law is a number, up to eight parameters and up to twenty memory values; ``law`` returns the force *resisting* the relative motion.
The formulas are deliberately not the ones found in textbook libraries.
"""

from __future__ import annotations

import math

import numba
import numpy as np

MEMORY = 20
SLIDERS = 14


@numba.njit(cache=True)
def _elastic(kind, p, d):
    """Laws of the displacement alone (kinds 1-29); ``p[0]`` scales, ``p[1]`` is a length (m)."""
    a, x = p[0], d / p[1]
    if kind == 1:  # sinh excess
        y = min(max(x, -6.0), 6.0)
        return a * p[1] * (math.sinh(y) - y + (x - y) * 200.0)
    if kind == 2:  # stiffening that saturates
        return a * d * x * x / (1.0 + x * x)
    if kind == 3:  # fractional power
        return a * p[1] * math.copysign(abs(x) ** p[2], x)
    if kind == 4:
        return a * d * math.log(1.0 + x * x)
    if kind == 10:  # softening: stiffness lost with amplitude, p[0] is the stiffness that can be lost
        return -a * d * (1.0 - 1.0 / math.sqrt(1.0 + x * x))
    if kind == 11:
        return -a * (d - p[1] * math.atan(x))
    if kind == 12:
        return -a * d * (1.0 - math.exp(-abs(x)))
    if kind == 13:
        return -a * (d - p[1] * math.copysign(math.log(1.0 + abs(x)), x))
    if kind == 20:  # contact rounded over p[2] gaps, two sided
        w = p[2] * p[1]
        return a * w * (_softplus((d - p[1]) / w) - _softplus((-d - p[1]) / w))
    if kind == 21:  # round body against a stop, one sided, beyond the gap p[1]
        return a * p[1] * max(x - 1.0, 0.0) ** 1.5
    if kind == 22:  # two stops at unequal distances and stiffnesses
        return a * (max(d - p[1], 0.0) - p[3] * max(-d - p[2] * p[1], 0.0))
    if kind == 27:  # round bodies on both sides
        return a * p[1] * math.copysign(max(abs(x) - 1.0, 0.0) ** 1.5, x)
    if kind == 24:  # bilinear, rounded over p[1], about an offset p[2]
        y = d - p[2]
        return a * 0.5 * (math.sqrt(y * y + p[1] * p[1]) - math.sqrt(p[2] * p[2] + p[1] * p[1]))
    if kind == 25:  # exponential closing of rough surfaces
        y = min(max(x, -8.0), 3.0)
        return a * p[1] * (math.exp(y) - 1.0 - y + (x - y) * (math.exp(y) - 1.0))
    if kind == 26:  # even law that saturates
        return a * d * x / (1.0 + abs(x))
    return 0.0


@numba.njit(cache=True)
def _softplus(y):
    if y > 30.0:
        return y
    return math.log(1.0 + math.exp(y))


@numba.njit(cache=True)
def _dissipative(kind, p, v):
    """Laws of the velocity (kinds 30-49); ``p[1]`` is a velocity (m/s)."""
    a, x = p[0], v / p[1]
    if kind == 30:
        return a * 0.6366197723675814 * math.atan(x)
    if kind == 31:  # falling friction
        return a * x / math.sqrt(1.0 + x * x) * (1.0 + p[2] * math.exp(-abs(x) / p[3]))
    if kind == 32:
        return a * math.erf(x)
    if kind == 33:
        return a * x / (1.0 + abs(x))
    if kind == 40:
        return a * p[1] * math.copysign(abs(x) ** p[2], x)
    if kind == 41:
        return a * v * (math.sqrt(1.0 + x * x) - 1.0)
    if kind == 42:
        return a * v * abs(x) / (1.0 + p[2] / (abs(x) + 1e-9))
    return 0.0


@numba.njit(cache=True)
def law(kind, p, d, v, modulation, h, old, new):
    """Force (N) at motion ``d``, ``v``; writes trial memory to ``new``.  ``old[0]`` is the motion at the last step."""
    new[0] = d
    if kind == 0:
        return p[0] * modulation * d
    if kind == 23 or kind == 28:  # one stop, or one on each side, with loss: contact force grows with approach speed
        side = math.copysign(1.0, d) if kind == 28 else 1.0
        x = side * d / p[1] - 1.0
        if x <= 0.0:
            return 0.0
        return side * p[0] * p[1] * x**1.5 * max(1.0 + side * p[2] * v, 0.0)
    if kind < 30:
        return _elastic(kind, p, d)
    if kind < 50:
        return _dissipative(kind, p, v)
    step = d - old[0]
    excess = -p[7] * p[0] * d  # p[7] = 1: the stuck stiffness is already in the linear model
    if kind == 50:  # sliders with a power-law spread p[2], widest p[1]
        return _sliders(p, step, old, new) + excess
    if kind == 51 or kind == 52 or kind == 53:
        return _rate_law(kind, p, step, old, new) + excess
    if kind == 60:  # two relaxing branches (p[1], p[2] s), no static share
        force = 0.0
        rate = step / h
        for i in range(2):
            tau = p[1 + i]
            e = math.exp(-h / tau)
            new[1 + i] = old[1 + i] * e + tau * (1.0 - e) * rate
            force += p[0] * p[3 + i] * new[1 + i]
        return force
    return 0.0


@numba.njit(cache=True)
def _sliders(p, step, old, new):
    force, total = 0.0, 0.0
    for i in range(SLIDERS):
        limit = p[1] * math.exp(-4.5 * (SLIDERS - 1 - i) / (SLIDERS - 1))
        weight = math.exp(p[2] * 4.5 * (i - SLIDERS + 1) / (SLIDERS - 1))
        stretch = min(max(old[1 + i] + step, -limit), limit)
        new[1 + i] = stretch
        force += weight * stretch
        total += weight
    return p[0] * force / total


@numba.njit(cache=True)
def _rate_law(kind, p, step, old, new):
    """Rate-type memory laws, advanced over ``step`` in small parts; ``z`` (m) is the elastic stretch, p[1] its limit."""
    z = old[1]
    parts = min(int(abs(step) / (0.04 * p[1])) + 1, 60)
    dx = step / parts
    for _ in range(parts):
        middle = z + 0.5 * dx * _slope(kind, p, z, dx)
        z += dx * _slope(kind, p, middle, dx)
        z = min(max(z, -1.2 * p[1]), 1.2 * p[1])
    new[1] = z
    return p[0] * z


@numba.njit(cache=True)
def _slope(kind, p, z, dx):
    """dz/dx of a memory law."""
    s = 1.0 if dx >= 0.0 else -1.0
    y = z / p[1]
    if kind == 51:  # friction interpolated with a fractional exponent
        u = 1.0 - s * y
        return max(u, 0.0) ** p[2]
    if kind == 52:  # smooth hysteron with fractional order and unequal loop shape
        share = p[3] + (1.0 - p[3]) * s * (1.0 if y >= 0 else -1.0)
        return 1.0 - share * abs(y) ** p[2]
    # intrinsic-time law whose yield hardens slowly
    return 1.0 - s * y / (1.0 + p[2] * abs(y))


@numba.njit(cache=True)
def march(poles_decay, first, second, read_d, read_v, cross_d, cross_v, d_lin, v_lin, kinds, params, modulation, h, tolerance):
    """March the modes under local forces only; the response to the shaker is added from outside, exactly.

    Parameters
    ----------
    poles_decay : (n,) exp(pole h).  ``first``, ``second`` (n, m): first-order-hold weights of force at the start and end of a step.
    read_d, read_v : (m, n) complex read-out of local motion.  ``cross_d``, ``cross_v`` (m, m): instant response to an end force.
    d_lin, v_lin : (steps, m) local motion of the linear structure under the shaker alone.
    kinds (m,), params (m, 8), modulation (steps, m): laws.

    Returns
    -------
    force (steps, m) applied to the structure along each place (minus the resisting law), and the worst left-over of the local
    equation relative to the largest force.
    """
    steps, m = d_lin.shape
    n = poles_decay.size
    z = np.zeros(n, np.complex128)
    force = np.zeros((steps, m))
    old, new = np.zeros((m, MEMORY)), np.zeros((m, MEMORY))
    now, free_d, free_v = np.zeros(m), np.zeros(m), np.zeros(m)
    worst, peak = 0.0, 1e-30
    for t in range(steps):
        for i in range(m):
            free_d[i] = d_lin[t, i]
            free_v[i] = v_lin[t, i]
        for k in range(n):
            zk = poles_decay[k] * z[k]
            for i in range(m):
                zk += first[k, i] * now[i]
            z[k] = zk
            for i in range(m):
                free_d[i] += 2.0 * (read_d[i, k] * zk).real
                free_v[i] += 2.0 * (read_v[i, k] * zk).real
        left = _solve_local(free_d, free_v, cross_d, cross_v, kinds, params, modulation[t], h, old, new, now, tolerance)
        for i in range(m):
            peak = max(peak, abs(now[i]))
            force[t, i] = now[i]
            for k in range(n):
                z[k] += second[k, i] * now[i]
            for j in range(MEMORY):
                old[i, j] = new[i, j]
        worst = max(worst, left)
        if not math.isfinite(now[0]):
            break
    return force, worst / peak


@numba.njit(cache=True)
def _solve_local(free_d, free_v, cross_d, cross_v, kinds, params, modulation, h, old, new, now, tolerance):
    """Gauss-Seidel over places, guarded secant in each; ``now`` is start and answer.  Returns the largest residual (N)."""
    m = free_d.size
    left = 0.0
    for _ in range(20 if m > 1 else 1):
        change = 0.0
        left = 0.0
        for i in range(m):
            d, v = free_d[i], free_v[i]
            for j in range(m):
                if j != i:
                    d += cross_d[i, j] * now[j]
                    v += cross_v[i, j] * now[j]
            b, rb = _solve_one(now[i], d, v, cross_d[i, i], cross_v[i, i], kinds[i], params[i], modulation[i], h, old[i], new[i], tolerance)
            change = max(change, abs(b - now[i]))
            now[i] = b
            left = max(left, abs(rb))
        if change <= 10 * tolerance:
            break
    return left


@numba.njit(cache=True)
def _solve_one(a, d, v, cd, cv, kind, p, modulation, h, old, new, tolerance):
    """Root of ``f + law(d + cd f, v + cv f)``: secant, then bisection where the law has corners.  Returns the force and its residual."""
    start = a
    ra = a + law(kind, p, d + cd * a, v + cv * a, modulation, h, old, new)
    start_r = ra
    b = a - ra
    rb = 0.0
    for _ in range(25):
        rb = b + law(kind, p, d + cd * b, v + cv * b, modulation, h, old, new)
        if abs(rb) <= tolerance + 1e-9 * abs(b):
            return b, rb
        if b == a:
            break
        # The local equation rises with slope at least about one for a stable law; a smaller secant is not trusted.
        step = rb / max((rb - ra) / (b - a), 0.5)
        a, ra = b, rb
        b = b - step
    a, ra = start, start_r
    reach = -2.0 * start_r
    for _ in range(12):
        b = start + reach
        rb = b + law(kind, p, d + cd * b, v + cv * b, modulation, h, old, new)
        if (rb > 0.0) != (ra > 0.0):
            break
        reach *= 2.0
    for _ in range(70):
        middle = 0.5 * (a + b)
        rm = middle + law(kind, p, d + cd * middle, v + cv * middle, modulation, h, old, new)
        if (rm > 0.0) == (ra > 0.0):
            a, ra = middle, rm
        else:
            b, rb = middle, rm
        if abs(rb) <= tolerance + 1e-9 * abs(b):
            break
    # The last call decides the memory that is kept.
    rb = b + law(kind, p, d + cd * b, v + cv * b, modulation, h, old, new)
    return b, rb
