"""Force laws of joints, stops and slides that the catalogue of missing physics tries, each written once in the style of ``laws.py``.

They differ from the paper's table in having a scale of motion of their own, so that shape and strength are separate numbers.
"""

from __future__ import annotations

import numpy as np

from bayes_nlsid.forces.laws import Value, where


def soft(y: Value) -> Value:
    """log(1 + exp(y)), which cannot overflow."""
    return np.maximum(y, 0.0) + np.log1p(np.exp(-np.abs(y)))


def step(y: Value) -> Value:
    """1/(1 + exp(−y)), which cannot overflow."""
    return 1.0 / (1.0 + np.exp(-np.minimum(np.maximum(y, -700.0), 700.0)))


def power_spring(q: Value, v: Value, f: Value, d: Value, n: Value) -> Value:
    """f sgn(q)(|q|/d)^n."""
    return f * np.sign(q) * (np.abs(q) / d) ** n


def power_spring_slope(q: Value, v: Value, f: Value, d: Value, n: Value) -> Value:
    """f n/d (|q|/d)^(n−1), for n > 1."""
    return f * n / d * (np.abs(q) / d) ** (n - 1.0), 0.0


def falling_spring(q: Value, v: Value, f: Value, d: Value, n: Value) -> Value:
    """−f sgn(q)(|q|/d)^n."""
    return -power_spring(q, v, f, d, n)


def falling_spring_slope(q: Value, v: Value, f: Value, d: Value, n: Value) -> Value:
    """−f n/d (|q|/d)^(n−1), for n > 1."""
    return -power_spring_slope(q, v, f, d, n)[0], 0.0


def levelling(q: Value, v: Value, k: Value, d: Value, m: Value) -> Value:
    """k q r/(1 + r) with r = (|q|/d)^m."""
    r = (np.abs(q) / d) ** m
    return k * q * r / (1.0 + r)


def levelling_slope(q: Value, v: Value, k: Value, d: Value, m: Value) -> Value:
    """k r (1 + m + r)/(1 + r)²."""
    r = (np.abs(q) / d) ** m
    return k * r * (1.0 + m + r) / (1.0 + r) ** 2, 0.0


def exponential_spring(q: Value, v: Value, k: Value, d: Value) -> Value:
    """k (d sinh(q/d) − q), continued with its slope beyond 30 d, so that it cannot overflow."""
    y = np.minimum(np.maximum(q / d, -30.0), 30.0)
    return k * d * (np.sinh(y) - y + (q / d - y) * np.cosh(y))


def exponential_spring_slope(q: Value, v: Value, k: Value, d: Value) -> Value:
    """k (cosh(q/d) − 1)."""
    y = np.minimum(np.maximum(q / d, -30.0), 30.0)
    return k * (np.cosh(y) - where(np.abs(q / d) < 30.0, 1.0, 0.0)), 0.0


def saturating(q: Value, v: Value, k: Value, d: Value, m: Value) -> Value:
    """−k q r/(1 + r) with r = (|q|/d)^m."""
    return -levelling(q, v, k, d, m)


def saturating_slope(q: Value, v: Value, k: Value, d: Value, m: Value) -> Value:
    """−k r (1 + m + r)/(1 + r)²."""
    return -levelling_slope(q, v, k, d, m)[0], 0.0


def loosening(q: Value, v: Value, k: Value, d: Value, m: Value, p: Value) -> Value:
    """−k q (1 − (1 + r)^−p) with r = (|q|/d)^m."""
    return -k * q * (1.0 - (1.0 + (np.abs(q) / d) ** m) ** -p)


def loosening_slope(q: Value, v: Value, k: Value, d: Value, m: Value, p: Value) -> Value:
    """−k (1 − (1 + r)^−p + p m r (1 + r)^(−p−1))."""
    r = (np.abs(q) / d) ** m
    return -k * (1.0 - (1.0 + r) ** -p + p * m * r * (1.0 + r) ** (-p - 1.0)), 0.0


def rounded_gap(q: Value, v: Value, k: Value, e: Value, w: Value) -> Value:
    """A gap e on both sides, rounded over w e."""
    return k * w * e * (soft((q - e) / (w * e)) - soft((-q - e) / (w * e)))


def rounded_gap_slope(q: Value, v: Value, k: Value, e: Value, w: Value) -> Value:
    """k times the share in contact."""
    return k * (step((q - e) / (w * e)) + step((-q - e) / (w * e))), 0.0


def one_stop(q: Value, v: Value, k: Value, e: Value, n: Value) -> Value:
    """k e max(sgn(k) q/e − 1, 0)^n."""
    return k * e * np.maximum(np.sign(k) * q / e - 1.0, 0.0) ** n


def one_stop_slope(q: Value, v: Value, k: Value, e: Value, n: Value) -> Value:
    """|k| n max(sgn(k) q/e − 1, 0)^(n−1)."""
    y = np.sign(k) * q / e - 1.0
    return np.abs(k) * n * where(y > 0.0, np.maximum(y, 1e-12) ** (n - 1.0), 0.0), 0.0


def round_stops(q: Value, v: Value, k: Value, e: Value, n: Value) -> Value:
    """k e sgn(q) max(|q|/e − 1, 0)^n."""
    return k * e * np.sign(q) * np.maximum(np.abs(q) / e - 1.0, 0.0) ** n


def round_stops_slope(q: Value, v: Value, k: Value, e: Value, n: Value) -> Value:
    """k n max(|q|/e − 1, 0)^(n−1)."""
    y = np.abs(q) / e - 1.0
    return k * n * where(y > 0.0, np.maximum(y, 1e-12) ** (n - 1.0), 0.0), 0.0


def lossy_stop(q: Value, v: Value, k: Value, e: Value, n: Value, u: Value) -> Value:
    """``one_stop`` times max(1 + sgn(k) v/u, 0) (Hunt and Crossley, J. Appl. Mech. 42, 1975)."""
    return one_stop(q, v, k, e, n) * np.maximum(1.0 + np.sign(k) * v / u, 0.0)


def lossy_stop_slope(q: Value, v: Value, k: Value, e: Value, n: Value, u: Value) -> Value:
    """Stiffness that grows with the speed of approach, damping that grows with the pressure."""
    loss = np.maximum(1.0 + np.sign(k) * v / u, 0.0)
    return one_stop_slope(q, v, k, e, n)[0] * loss, np.abs(one_stop(q, v, k, e, n)) / u * where(loss > 0.0, 1.0, 0.0)


def lossy_stops(q: Value, v: Value, k: Value, e: Value, n: Value, u: Value) -> Value:
    """``lossy_stop`` on the side to which q points."""
    return lossy_stop(q, v, k * np.sign(q), e, n, u)


def lossy_stops_slope(q: Value, v: Value, k: Value, e: Value, n: Value, u: Value) -> Value:
    """That of ``lossy_stop`` on the side to which q points."""
    return lossy_stop_slope(q, v, k * np.sign(q), e, n, u)


def two_stops(q: Value, v: Value, k: Value, e: Value, r: Value, u: Value) -> Value:
    """k beyond e, r k beyond −u e."""
    return k * (np.maximum(q - e, 0.0) - r * np.maximum(-q - u * e, 0.0))


def two_stops_slope(q: Value, v: Value, k: Value, e: Value, r: Value, u: Value) -> Value:
    """k or r k in contact."""
    return k * (where(q > e, 1.0, 0.0) + r * where(-q > u * e, 1.0, 0.0)), 0.0


def one_sided(q: Value, v: Value, k: Value, e: Value, d: Value) -> Value:
    """k (q − e d) where that is positive."""
    return k * np.maximum(q - e * d, 0.0)


def one_sided_slope(q: Value, v: Value, k: Value, e: Value, d: Value) -> Value:
    """k where the spring acts."""
    return k * where(q > e * d, 1.0, 0.0), 0.0


def bent(q: Value, v: Value, k: Value, e: Value, w: Value, d: Value) -> Value:
    """k d (√((q/d − e)² + w²) − √(e² + w²))/2: zero at rest."""
    return 0.5 * k * d * (np.sqrt((q / d - e) ** 2 + w ** 2) - np.sqrt(e ** 2 + w ** 2))


def bent_slope(q: Value, v: Value, k: Value, e: Value, w: Value, d: Value) -> Value:
    """±k/2 far from the bend."""
    return 0.5 * k * (q / d - e) / np.sqrt((q / d - e) ** 2 + w ** 2), 0.0


def closing(q: Value, v: Value, k: Value, d: Value) -> Value:
    """k |d| (exp(y) − 1 − y) with y = q/d, straight beyond y = 3."""
    x = q / d
    y = np.minimum(np.maximum(x, -30.0), 3.0)
    return k * np.abs(d) * (np.expm1(y) - y + (x - y) * np.expm1(y))


def closing_slope(q: Value, v: Value, k: Value, d: Value) -> Value:
    """k sgn(d) (exp(y) − 1)."""
    return k * np.sign(d) * np.expm1(np.minimum(np.maximum(q / d, -30.0), 3.0)), 0.0


def rounded_friction(q: Value, v: Value, f: Value, w: Value) -> Value:
    """f tanh(v/w)."""
    return f * np.tanh(v / w)


def rounded_friction_slope(q: Value, v: Value, f: Value, w: Value) -> Value:
    """f/w sech²(v/w)."""
    t = np.tanh(v / w)
    return 0.0, f / w * (1.0 - t * t)


def falling_friction(q: Value, v: Value, f: Value, w: Value, a: Value, s: Value) -> Value:
    """f v/√(v² + w²) (1 + a exp(−|v|/(s w)))."""
    return f * v / np.sqrt(v ** 2 + w ** 2) * (1.0 + a * np.exp(-np.abs(v) / (s * w)))


def falling_friction_slope(q: Value, v: Value, f: Value, w: Value, a: Value, s: Value) -> Value:
    """Steep within w of rest, falling slowly beyond it."""
    root, fall = np.sqrt(v ** 2 + w ** 2), a * np.exp(-np.abs(v) / (s * w))
    return 0.0, f * (w ** 2 / root ** 3 * (1.0 + fall) - np.abs(v) / root * fall / (s * w))


def power_damper(q: Value, v: Value, f: Value, w: Value, n: Value) -> Value:
    """f sgn(v)(|v|/w)^n."""
    return f * np.sign(v) * (np.abs(v) / w) ** n


def power_damper_slope(q: Value, v: Value, f: Value, w: Value, n: Value) -> Value:
    """f n/w (|v|/w)^(n−1), for n > 1."""
    return 0.0, f * n / w * (np.abs(v) / w) ** (n - 1.0)


def levelling_damper(q: Value, v: Value, c: Value, w: Value, m: Value) -> Value:
    """c v r/(1 + r) with r = (|v|/w)^m."""
    return levelling(v, q, c, w, m)


def levelling_damper_slope(q: Value, v: Value, c: Value, w: Value, m: Value) -> Value:
    """c r (1 + m + r)/(1 + r)²."""
    return 0.0, levelling_slope(v, q, c, w, m)[0]
