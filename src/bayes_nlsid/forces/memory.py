"""Building blocks of the forces with memory, as plain element-by-element functions (same rules as ``forces/laws.py``).

All memory here is rate-independent: between two samples only the turning points of the path matter, not the time at which they
are passed. The path of a joint is therefore a chain of straight, monotone pieces between *nodes*: the samples, and one turning
point wherever the velocity changes sign between two samples (``turning_point``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.laws import Value, where

SLIDERS = 160  # finite sliders that stand for the distribution on (0, phi_max); one more carries the jump at phi_max
SUBSTEPS = 2  # steps of a Bouc–Wen loop on each monotone piece
NEAR, FAR = 0.1127016653792583, 0.8872983346207417  # outer nodes of three-point Gauss quadrature on (0, 1)
CEILING = 1e50  # N; only a loop whose parameters give it no bound gets there


def turning_point(q0: Value, v0: Value, q1: Value, v1: Value, dt: Value) -> tuple[Value, Value]:
    """Where a motion turned round between two samples.

    Parameters
    ----------
    q0, q1 : float or ndarray
        Displacement at both samples, m.
    v0, v1 : float or ndarray
        Velocity there, m/s.
    dt : float
        Time between them, s.

    Returns
    -------
    turned : bool or ndarray of bool
        Whether the velocity changed sign.
    q : float or ndarray
        Extremum of the cubic that has these values and slopes (error O(dt⁴), against O(dt²) for the larger sample); q1 if not turned.
    """
    a, b, rise = v0 * dt, v1 * dt, q1 - q0
    turned = ((a > 0.0) & (b < 0.0)) | ((a < 0.0) & (b > 0.0))
    # q'(s) = A s² + B s + a on 0 ≤ s ≤ 1 has exactly one root where a and b differ in sign.
    quadratic, linear = 3.0 * (a + b - 2.0 * rise), 2.0 * (3.0 * rise - 2.0 * a - b)
    root = np.sqrt(np.maximum(linear * linear - 4.0 * quadratic * a, 0.0))
    half = -0.5 * (linear + where(linear < 0.0, -root, root))
    near = a / where(half == 0.0, 1.0, half)
    # The other root may be far away; where it is not needed its divisor is replaced so that it cannot overflow.
    inside = (near >= 0.0) & (near <= 1.0)
    s = where(inside, near, half / where(inside | (quadratic == 0.0), 1.0, quadratic))
    s = np.minimum(np.maximum(s, 0.0), 1.0)
    extremum = q0 + s * (a + s * (3.0 * rise - 2.0 * a - b + s * (a + b - 2.0 * rise)))
    return turned, where(turned, extremum, q1)


def iwan_sliders(p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Finite sliders of a five-parameter Iwan element.

    Parameters
    ----------
    p : ndarray (..., 5)
        f_s (N), k_t (N/m), chi, beta, theta.

    Returns
    -------
    stiffness : ndarray (..., SLIDERS + 1)
        N/m; they sum to k_t.
    slip : ndarray (..., SLIDERS + 1)
        Displacement at which each slider breaks loose, m.
    theta : ndarray (..., 1)
        Sliding over breaking force.

    Notes
    -----
    Bins are fixed fractions of phi_max, (i/SLIDERS)²: small motions need narrow bins near zero. Each slider carries the exact
    stiffness and the exact slip force of its bin, so the parameters enter continuously. With theta = 1 the curve of first
    loading is within 2e-4 f_s of the closed form and the energy per cycle within 0.5 % for amplitudes above 0.02 phi_max. With
    theta < 1 the force falls in steps, slider by slider, of up to (1 − theta) 0.03 f_s, and energies are within 1.5 % at 0.3 phi_max.
    """
    f_s, k_t = p[..., 0:1], p[..., 1:2]
    m, b = np.maximum(p[..., 2:3] + 1.0, 1e-9), np.maximum(p[..., 3:4], 0.0)
    edges = (np.arange(SLIDERS + 1) / SLIDERS) ** 2
    low, high = edges[:-1], edges[1:]
    reach = f_s * (1.0 + b) / np.maximum(k_t * (b + m / (m + 1.0)), 1e-290)
    share = high ** m - low ** m
    moment = m / (m + 1.0) * (high ** (m + 1.0) - low ** (m + 1.0))
    centre = where(share > 1e-12, moment / np.maximum(share, 1e-12), 0.5 * (low + high))
    stiffness = np.concatenate([share, b], axis=-1) * k_t / (1.0 + b)
    slip = np.concatenate([centre, np.ones_like(b)], axis=-1) * reach
    return stiffness, slip, p[..., 4:5]


def slider_step(move: Value, stretch: Value, sliding: Value, slip: Value, theta: Value) -> tuple[Value, Value]:
    """Carry one slider over one monotone piece of the path, exactly.

    Parameters
    ----------
    move : float or ndarray
        Change of displacement, m.
    stretch : float or ndarray
        Stretch of its spring before, m.
    sliding : float or ndarray
        +1 or −1 while it slides, 0 while it sticks.
    slip, theta : float or ndarray
        Breaking displacement, m, and sliding over breaking force.

    Returns
    -------
    stretch, sliding
        After the piece. A slider that has broken loose slides at ``theta * slip`` until the velocity reverses; only then can it
        stick again. (Letting it stick anew at every step gives energies 10 % wrong.)
    """
    tried = stretch + move
    carries_on = (sliding != 0.0) & (sliding * move >= 0.0)
    breaks = np.abs(tried) > slip
    after = where(carries_on, sliding, where(breaks, np.sign(tried), 0.0))
    return where(after != 0.0, after * theta * slip, tried), after


def bouc_wen_step(z: Value, move: Value, alpha: Value, beta: Value, gamma: Value, delta: Value, nu: Value) -> Value:
    """Carry a Bouc–Wen force over one monotone piece of the path.

    ż = alpha v − beta (gamma |v| |z|^(nu−1) z + delta v |z|^nu) is rate-independent, so along a piece of direction d = ±1

        dz/dq = alpha − beta |z|^nu (gamma d sgn z + delta).

    Parameters
    ----------
    z : float or ndarray
        Force before, N.
    move : float or ndarray
        Change of displacement, m.
    alpha, beta, gamma, delta, nu : float or ndarray
        Parameters; nu ≥ 1.

    Returns
    -------
    float or ndarray
        Force after, N; held below CEILING where the parameters make the loop run away (gamma + delta < 0).

    Notes
    -----
    SUBSTEPS exponential Rosenbrock steps (two stages, third order; Hochbruck and Ostermann, Acta Numerica 2010). For nu = 1 they
    are exact at any step length, and for any nu they stay stable however fast the loop saturates. Where z passes through zero the
    right-hand side has a kink; the length up to the crossing is then taken from a quadrature of dq/dz and the step begins anew at
    z = 0, so that the order is kept. With 64 pieces per half-cycle of a well-rounded loop the largest error is 1e-6 (nu = 2) to
    1e-5 (nu = 1.5) of the largest force; with 16 it is 5e-5 to 2e-4.
    """
    power, above, below, fixed, near, half, far = bouc_wen_form(alpha, beta, gamma, delta, nu)
    return bouc_wen_piece(z, move, alpha, power, above, below, fixed, near, half, far)


def bouc_wen_form(alpha: Value, beta: Value, gamma: Value, delta: Value, nu: Value
                  ) -> tuple[Value, Value, Value, Value, Value, Value, Value]:
    """What ``bouc_wen_step`` needs of its parameters at every piece of a path.

    Returns
    -------
    power, above, below, fixed, near, half, far
        Exponent; how the loop bends for d z ≥ 0 and below; where it settles (1 if nowhere); the quadrature nodes to that exponent.
    """
    power = np.maximum(nu, 1.0)
    above, below = beta * (gamma + delta), beta * (delta - gamma)
    # Fixed point (alpha/bend)^(1/nu) for y ≥ 0, if the loop has one.
    bounded = (above > 0.0) & (alpha > 0.0)
    fixed = where(bounded, where(bounded, alpha / where(bounded, above, 1.0), 1.0) ** (1.0 / power), 1.0)
    return power, above, below, fixed, NEAR ** power, 0.5 ** power, FAR ** power


def bouc_wen_piece(z: Value, move: Value, alpha: Value, power: Value, above: Value, below: Value, fixed: Value, near: Value, half: Value,
                   far: Value) -> Value:
    """``bouc_wen_step`` from the numbers of ``bouc_wen_form``, which paths of many pieces work out once."""
    direction = where(move < 0.0, -1.0, 1.0)
    step = np.abs(move) / SUBSTEPS
    # In y = d z, with d q growing: dy/dx = alpha − bend |y|^nu, where bend changes only with the sign of y.
    y = direction * z
    bounded = (above > 0.0) & (alpha > 0.0)
    for _ in range(SUBSTEPS):
        size = np.abs(y)
        steep = size ** (power - 1.0)
        # Three-point Gauss quadrature of dx = dy / (alpha − below |y|^nu) from y up to zero; no crossing if that is not positive.
        bent = below * size * steep
        one, two, three = alpha - bent * near, alpha - bent * half, alpha - bent * far
        rises = (one > 0.0) & (two > 0.0) & (three > 0.0)
        one, two, three = where(rises, one, 1.0), where(rises, two, 1.0), where(rises, three, 1.0)
        to_zero = size * (5.0 / one + 8.0 / two + 5.0 / three) / 18.0
        crosses = (y < 0.0) & rises & (to_zero < step)
        length, begin = where(crosses, step - to_zero, step), where(crosses, 0.0, y)
        positive = begin >= 0.0
        # f = alpha − bend |y|^nu and its derivative J; x is J times the step, held where exp is finite.
        bend = where(positive, above, below)
        steep = bend * where(crosses, where(power == 1.0, 1.0, 0.0), steep)
        f, jacobian = alpha - steep * np.abs(begin), power * steep * where(positive, -1.0, 1.0)
        x = np.minimum(np.maximum(jacobian * length, -700.0), 200.0)
        small = np.abs(x) < 0.02
        safe = where(small, 1.0, x)
        grown = np.expm1(safe)
        phi1 = where(small, 1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x / 120.0))), grown / safe)
        phi3 = where(small, 1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0 + x / 720.0)),
                        (grown - safe - 0.5 * safe * safe) / (safe * safe * safe))
        stage = np.minimum(np.maximum(begin + length * phi1 * f, -CEILING), CEILING)
        curvature = alpha - bend * np.abs(stage) ** power - f - jacobian * (stage - begin)
        end = stage + 2.0 * length * phi3 * curvature
        # f is concave in y ≥ 0, so the exact solution lies between that of the tangent (stage) and that of the chord from here to
        # the fixed point; these bounds take over where the loop saturates within one step.
        settles = bounded & positive
        gap = fixed - begin
        rate = where(settles & (np.abs(gap) > 1e-14 * fixed), f / where(gap == 0.0, 1.0, gap), 0.0)
        chord = fixed - gap * np.exp(-np.minimum(np.maximum(rate, 0.0) * length, 700.0))
        low = where(settles, chord, where(f < 0.0, -CEILING, begin))
        high = where(settles, np.maximum(np.minimum(stage, np.maximum(fixed, begin)), chord),
                     where(f < 0.0, begin, where(begin < 0.0, 0.0, CEILING)))
        y = np.minimum(np.maximum(end, low), high)
    return direction * y


def bouc_wen_slope(z: Value, move: Value, alpha: Value, beta: Value, gamma: Value, delta: Value, nu: Value) -> Value:
    """df/dq at the end of a piece travelled in the direction of ``move`` (loading direction of z if it did not move)."""
    loading = where(move == 0.0, 1.0, np.sign(move) * np.sign(z))
    return alpha - beta * np.abs(z) ** nu * (gamma * loading + delta)
