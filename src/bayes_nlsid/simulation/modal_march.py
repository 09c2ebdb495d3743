"""Local laws without memory on a structure in modal coordinates, solved in the order of time.

The response to everything but the laws is given, q° and v°. What the laws add is marched: every mode exactly for a force that is linear
within a step, so that no mode is too stiff, and at each step one small equation for the forces,

    g_n = f(q°_n − Σ_m b_m x_m(t_n), v°_n − Σ_m b_m ẋ_m(t_n)),

whose solution depends on the past only. Newton's method has that equation to solve where it would be lost in the whole record. Import this
module only where compiled code is about to run: it brings numba with it.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.compiled import compiled, law_value
from bayes_nlsid.simulation.schemes import steps

Array = NDArray[np.float64]
CLOSE = 1e-5    # last step of Newton's method over the largest force so far


def propagators(omega: Array, zeta: Array, dt: float) -> tuple[Array, Array]:
    """The exponential step of ``simulation.schemes`` (ẍ + 2 ζ ω ẋ + ω² x = u, u linear in time), laid out for ``march_modes``.

    Parameters
    ----------
    omega, zeta : ndarray (m,)
        rad/s, ratio.
    dt : float
        s.

    Returns
    -------
    own : ndarray (4, m)
        x and ẋ after the step per x before (rows 0, 2) and per ẋ before (rows 1, 3).
    forced : ndarray (4, m)
        x and ẋ per u before (rows 0, 2) and per u after (rows 1, 3).
    """
    one = steps(omega, zeta, dt, "exponential")
    own = one.amplification.reshape(-1, 4).T
    forced = np.stack([one.old[:, 0], one.new[:, 0], one.old[:, 1], one.new[:, 1]])
    return np.ascontiguousarray(own), forced


@compiled
def _add_force(state: np.ndarray, b: np.ndarray, forced: np.ndarray, force: np.ndarray, sign: float) -> None:
    """Add to (or take from) the state what the force after a step gives to it."""
    for j in range(len(b)):
        for m in range(b.shape[1]):
            state[0, m] += sign * forced[1, m] * b[j, m] * force[j]
            state[1, m] += sign * forced[3, m] * b[j, m] * force[j]


@partial(compiled, fastmath={"contract", "reassoc", "nsz"})
def march_modes(q0: np.ndarray, v0: np.ndarray, own: np.ndarray, forced: np.ndarray, b: np.ndarray, yielding: np.ndarray,
                dt: float, codes: np.ndarray, powers: np.ndarray, values: np.ndarray, g: np.ndarray, state: np.ndarray,
                before: np.ndarray) -> int:
    """Forces of the laws at every step.

    Parameters
    ----------
    q0, v0 : ndarray (n, J)
        Motion of the places without the laws, m and m/s; J is 1 or 2.
    own, forced : ndarray (4, m)
        From ``propagators``.
    b : ndarray (J, m)
        Mass-normalised modal rows of the places.
    yielding : ndarray (J, J)
        Static flexibility among the places of the modes that are too high to be marched, m/N. It yields to a force at once, and its
        speed is that of the force: the difference of second order backwards.
    dt : float
        Length of a step, s.
    codes, powers : ndarray (J,)
        From ``forces.compiled.law_code``.
    values : ndarray (J, p)
        Parameters of the laws.
    g : ndarray (n, J)
        Filled: N.
    state : ndarray (2, m)
        x and ẋ of the modes before the first step; brought up to date.
    before : ndarray (J,)
        Forces before the first step, N.

    Returns
    -------
    int
        Steps whose equation was not solved.
    """
    count, places = q0.shape
    modes = b.shape[1]
    last = places - 1
    direct_q, direct_v = np.zeros((2, 2)), np.zeros((2, 2))
    for j in range(places):
        for k in range(places):
            direct_q[j, k], direct_v[j, k] = yielding[j, k], 1.5 * yielding[j, k] / dt
            for m in range(modes):
                direct_q[j, k] += b[j, m] * b[k, m] * forced[1, m]
                direct_v[j, k] += b[j, m] * b[k, m] * forced[3, m]
    # the state is carried without what the last force adds to it, so that one sweep over the modes serves a step
    pushed, moved = np.empty(modes), np.empty(modes)
    for m in range(modes):
        pushed[m] = own[0, m] * forced[1, m] + own[1, m] * forced[3, m] + forced[0, m]
        moved[m] = own[2, m] * forced[1, m] + own[3, m] * forced[3, m] + forced[2, m]
    q, v, x, old, older = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for j in range(places):
        old[j] = older[j] = before[j]
    _add_force(state, b, forced, old, -1.0)
    lost, largest = 0, 1e-300
    for i in range(count):
        qa, va, qb, vb = 0.0, 0.0, 0.0, 0.0
        ua, ub = old[0], old[1]
        if last:
            for m in range(modes):
                u, a, c = b[0, m] * ua + b[1, m] * ub, state[0, m], state[1, m]
                here, speed = own[0, m] * a + own[1, m] * c + pushed[m] * u, own[2, m] * a + own[3, m] * c + moved[m] * u
                state[0, m], state[1, m] = here, speed
                qa += b[0, m] * here
                va += b[0, m] * speed
                qb += b[1, m] * here
                vb += b[1, m] * speed
        else:
            for m in range(modes):
                u, a, c = b[0, m] * ua, state[0, m], state[1, m]
                here, speed = own[0, m] * a + own[1, m] * c + pushed[m] * u, own[2, m] * a + own[3, m] * c + moved[m] * u
                state[0, m], state[1, m] = here, speed
                qa += b[0, m] * here
                va += b[0, m] * speed
        q[0], q[1], v[0], v[1] = qa, qb, va, vb
        for j in range(places):
            q[j], v[j], x[j] = q0[i, j] - q[j], v0[i, j] - v[j], 2.0 * old[j] - older[j]
            for k in range(places):
                v[j] += yielding[j, k] * (2.0 * old[k] - 0.5 * older[k]) / dt
        solved = False
        for _ in range(60):
            f0, k0, c0 = law_value(codes[0], powers[0], q[0] - direct_q[0, 0] * x[0] - direct_q[0, 1] * x[1],
                                   v[0] - direct_v[0, 0] * x[0] - direct_v[0, 1] * x[1], values[0])
            r0, a00 = f0 - x[0], 1.0 + k0 * direct_q[0, 0] + c0 * direct_v[0, 0]
            s0, s1 = r0 / max(a00, 0.2), 0.0
            if last:
                f1, k1, c1 = law_value(codes[1], powers[1], q[1] - direct_q[1, 0] * x[0] - direct_q[1, 1] * x[1],
                                       v[1] - direct_v[1, 0] * x[0] - direct_v[1, 1] * x[1], values[1])
                r1, a11 = f1 - x[1], 1.0 + k1 * direct_q[1, 1] + c1 * direct_v[1, 1]
                a01, a10 = k0 * direct_q[0, 1] + c0 * direct_v[0, 1], k1 * direct_q[1, 0] + c1 * direct_v[1, 0]
                determinant = a00 * a11 - a01 * a10
                s1 = r1 / max(a11, 0.2)
                if determinant > 0.1:
                    s0, s1 = (r0 * a11 - r1 * a01) / determinant, (r1 * a00 - r0 * a10) / determinant
            x[0] += s0
            x[1] += s1
            largest = max(largest, abs(x[0]), abs(x[1]))
            if abs(s0) + abs(s1) <= CLOSE * largest:    # what is left after this step is its square
                solved = True
                break
        lost += 0 if solved else 1
        for j in range(places):
            g[i, j], old[j], older[j] = x[j], x[j], old[j]
    _add_force(state, b, forced, old, 1.0)
    return lost
