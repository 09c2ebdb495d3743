"""The force laws themselves, each written once.

Every law is ``law(q, v, *p) -> force`` and every slope ``slope(q, v, *p) -> (df/dq, df/dv)`` in m, m/s, N. They use only numpy
functions that act element by element and never branch on data, so the same Python function broadcasts over any batch and
compiles as it stands for scalars (``forces/compiled.py``); all stand at module level, so that terms can be sent to other
processes. Monomials take their exponent last, and ``forces/library.py`` binds it. Slopes are finite everywhere: 0 where the
derivative is not. Either entry of a slope may be the plain number 0.0, which broadcasts.

Iwan laws are written with the slip ratio r = |q|/phi_max as load over capacity, never as a division by phi_max: with
beta → 0 and chi → −1 phi_max itself leaves the range of double precision while force and slope stay finite.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Value = Any  # a float or an array: the laws do not care


def where(condition: Value, yes: Value, no: Value) -> Value:
    """``np.where`` for the laws: compiled code has its own version of this one, which returns a number for numbers."""
    return np.where(condition, yes, no)


def displacement_odd(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c sgn(q)|q|^n."""
    return c * np.sign(q) * np.abs(q) ** power


def displacement_odd_slope(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c n |q|^(n−1)."""
    a = np.abs(q)
    return c * power * where(a > 0.0, where(a > 0.0, a, 1.0) ** (power - 1.0), where(power == 1.0, 1.0, 0.0)), 0.0


def displacement_even(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c |q|^n."""
    return c * np.abs(q) ** power


def displacement_even_slope(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c n sgn(q)|q|^(n−1)."""
    a = np.abs(q)
    return c * power * np.sign(q) * where(a > 0.0, a, 1.0) ** (power - 1.0), 0.0


def mixed_odd(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c sgn(q)|q|^n v: odd in q."""
    return c * np.sign(q) * np.abs(q) ** power * v


def mixed_odd_slope(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c n |q|^(n−1) v, c sgn(q)|q|^n."""
    a = np.abs(q)
    growth = where(a > 0.0, where(a > 0.0, a, 1.0) ** (power - 1.0), where(power == 1.0, 1.0, 0.0))
    return c * power * growth * v, c * np.sign(q) * a ** power


def mixed_even(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c |q|^n v: even in q."""
    return c * np.abs(q) ** power * v


def mixed_even_slope(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c n sgn(q)|q|^(n−1) v, c |q|^n."""
    a = np.abs(q)
    return c * power * np.sign(q) * where(a > 0.0, a, 1.0) ** (power - 1.0) * v, c * a ** power


def velocity_odd(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c sgn(v)|v|^n; n = 0 is dry friction."""
    return c * np.sign(v) * np.abs(v) ** power


def velocity_odd_slope(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c n |v|^(n−1)."""
    # For n = 0 the factor n is zero, but |v|^-1 might overflow: any other exponent will do.
    a, lower = np.abs(v), where(power > 0.0, power - 1.0, 0.0)
    return 0.0, c * power * where(a > 0.0, where(a > 0.0, a, 1.0) ** lower, where(power == 1.0, 1.0, 0.0))


def velocity_even(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c |v|^n."""
    return c * np.abs(v) ** power


def velocity_even_slope(q: Value, v: Value, c: Value, power: Value) -> Value:
    """c n sgn(v)|v|^(n−1)."""
    a = np.abs(v)
    return 0.0, c * power * np.sign(v) * where(a > 0.0, a, 1.0) ** (power - 1.0)


def spring(q: Value, v: Value, k: Value) -> Value:
    """k q."""
    return k * q


def spring_slope(q: Value, v: Value, k: Value) -> Value:
    """k."""
    return k, 0.0


def dashpot(q: Value, v: Value, c: Value) -> Value:
    """c v."""
    return c * v


def dashpot_slope(q: Value, v: Value, c: Value) -> Value:
    """c."""
    return 0.0, c


def jenkins(q: Value, v: Value, f_s: Value, k_t: Value) -> Value:
    """No. 42: a spring k_t until the force reaches ±f_s, then constant."""
    return np.minimum(np.maximum(k_t * q, -f_s), f_s)


def jenkins_slope(q: Value, v: Value, f_s: Value, k_t: Value) -> Value:
    """k_t while stuck, 0 while slipping."""
    return where(np.abs(k_t * q) < f_s, k_t, 0.0), 0.0


def jenkins_stiffness(f_s: Value, k_t: Value) -> Value:
    """k_t."""
    return k_t + 0.0 * f_s


def jenkins_prager(q: Value, v: Value, f_s: Value, k_t: Value, sigma: Value) -> Value:
    """No. 43: f_s (2/(1 + exp(−2 sigma v)) − 1) + k_t q, written as a tanh, which cannot overflow."""
    return f_s * np.tanh(sigma * v) + k_t * q


def jenkins_prager_slope(q: Value, v: Value, f_s: Value, k_t: Value, sigma: Value) -> Value:
    """k_t, and f_s sigma sech²(sigma v)."""
    t = np.tanh(sigma * v)
    return k_t, f_s * sigma * (1.0 - t * t)


def jenkins_prager_stiffness(f_s: Value, k_t: Value, sigma: Value) -> Value:
    """k_t."""
    return k_t + 0.0 * f_s


def clearance(q: Value, v: Value, k_d: Value, d: Value) -> Value:
    """No. 44: no force inside the gap |q| < d/2, a spring k_d beyond it."""
    return k_d * np.sign(q) * np.maximum(np.abs(q) - 0.5 * d, 0.0)


def clearance_slope(q: Value, v: Value, k_d: Value, d: Value) -> Value:
    """k_d outside the gap."""
    return where(np.abs(q) > 0.5 * d, k_d, 0.0), 0.0


def iwan5(q: Value, v: Value, f_s: Value, k_t: Value, chi: Value, beta: Value, theta: Value) -> Value:
    """No. 46: five-parameter Iwan backbone; sliders of density R phi^chi + S delta(phi − phi_max) that fall to theta when they slip."""
    m, b, a = np.maximum(chi + 1.0, 0.0), np.maximum(beta, 0.0), np.abs(q)
    load, capacity = k_t * a * (b + m / (m + 1.0)), f_s * (1.0 + b)
    r = load / np.maximum(np.maximum(load, capacity), 1e-300)
    stuck = k_t * a * (1.0 + (theta * m / (m + 1.0) - 1.0) / (1.0 + b) * r ** m)
    return np.sign(q) * where(load < capacity, stuck, theta * f_s)


def iwan5_slope(q: Value, v: Value, f_s: Value, k_t: Value, chi: Value, beta: Value, theta: Value) -> Value:
    """k_t [1 + (theta (chi+1) − (chi+2)) r^(chi+1) / (1+beta)]; 0 in macroslip."""
    m, b = np.maximum(chi + 1.0, 0.0), np.maximum(beta, 0.0)
    load, capacity = k_t * np.abs(q) * (b + m / (m + 1.0)), f_s * (1.0 + b)
    r = load / np.maximum(np.maximum(load, capacity), 1e-300)
    return where(load < capacity, k_t * (1.0 + (theta * m - m - 1.0) / (1.0 + b) * r ** m), 0.0), 0.0


def iwan5_stiffness(f_s: Value, k_t: Value, chi: Value, beta: Value, theta: Value) -> Value:
    """k_t."""
    return k_t + 0.0 * f_s


def iwan4(q: Value, v: Value, f_s: Value, k_t: Value, chi: Value, beta: Value) -> Value:
    """No. 45: four-parameter Iwan backbone (theta = 1): k_t q (1 − r^(chi+1)/((1+beta)(chi+2))) up to phi_max, then ±f_s."""
    m, b, a = np.maximum(chi + 1.0, 0.0), np.maximum(beta, 0.0), np.abs(q)
    load, capacity = k_t * a * (b + m / (m + 1.0)), f_s * (1.0 + b)
    r = load / np.maximum(np.maximum(load, capacity), 1e-300)
    stuck = k_t * a * (1.0 - r ** m / ((1.0 + b) * (m + 1.0)))
    return np.sign(q) * where(load < capacity, stuck, f_s)


def iwan4_slope(q: Value, v: Value, f_s: Value, k_t: Value, chi: Value, beta: Value) -> Value:
    """k_t [1 − r^(chi+1)/(1+beta)]; 0 in macroslip."""
    m, b = np.maximum(chi + 1.0, 0.0), np.maximum(beta, 0.0)
    load, capacity = k_t * np.abs(q) * (b + m / (m + 1.0)), f_s * (1.0 + b)
    r = load / np.maximum(np.maximum(load, capacity), 1e-300)
    return where(load < capacity, k_t * (1.0 - r ** m / (1.0 + b)), 0.0), 0.0


def iwan4_stiffness(f_s: Value, k_t: Value, chi: Value, beta: Value) -> Value:
    """k_t."""
    return k_t + 0.0 * f_s


def bouc_wen_start(q: Value, v: Value, alpha: Value, beta: Value, gamma: Value, delta: Value, nu: Value) -> Value:
    """First, elastic part alpha q of a Bouc–Wen loop, before any of its memory has built up."""
    return alpha * q


def bouc_wen_start_slope(q: Value, v: Value, alpha: Value, beta: Value, gamma: Value, delta: Value, nu: Value) -> Value:
    """alpha."""
    return alpha, 0.0


def bouc_wen_stiffness(alpha: Value, beta: Value, gamma: Value, delta: Value, nu: Value) -> Value:
    """alpha."""
    return alpha + 0.0 * beta
