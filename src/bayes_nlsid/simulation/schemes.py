"""One step of every mode as numbers: HHT-alpha and the exponential step in the same form.

Both schemes advance the components x of one mode (displacement, velocity and, for HHT-alpha, its own acceleration) by

    x(n+1) = A x(n) + a f(n) + b f(n+1),        f = modal force: applied minus nonlinear,

so that everything behind this page (condensed Newton, batches, compiled loops) is written once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

SchemeName = Literal["hht", "exponential"]
Array = NDArray[np.float64]


@final
@dataclass(frozen=True)
class Steps:
    """Coefficients of one time step.

    Parameters
    ----------
    name : {"hht", "exponential"}
    step : float
        h, s.
    amplification : ndarray (..., m, c, c)
        A; c = 3 components (displacement, velocity, acceleration) for HHT-alpha, 2 for the exponential step.
    old, new : ndarray (..., m, c)
        a and b: weights of the modal force at the start and at the end of the step.

    Raises
    ------
    ValueError
        If shapes disagree.
    """

    name: SchemeName
    step: float
    amplification: Array
    old: Array
    new: Array

    def __post_init__(self) -> None:
        c = self.components
        if self.amplification.shape[-2:] != (c, c) or self.old.shape != self.amplification.shape[:-1] or self.new.shape != self.old.shape:
            raise ValueError(f"steps: amplification {self.amplification.shape}, old {self.old.shape} and new {self.new.shape} must be "
                             f"(..., m, {c}, {c}), (..., m, {c}) and (..., m, {c})")

    @property
    def components(self) -> int:
        """Numbers carried per mode."""
        return 3 if self.name == "hht" else 2


def steps(omega: ArrayLike, zeta: ArrayLike, step: float, scheme: SchemeName = "hht", alpha: float = -0.05) -> Steps:
    """Coefficients of one step for modes of the given frequencies and damping ratios.

    Parameters
    ----------
    omega, zeta : array_like (..., m)
        rad/s (positive) and ratio.
    step : float
        Time step h, s.
    scheme : {"hht", "exponential"}
        Hilber, Hughes and Taylor (1977) with beta = (1 − alpha)²/4, gamma = 1/2 − alpha; or the exact propagator of the linear part
        with the force taken as linear in time over the step (first-order hold).
    alpha : float
        HHT only, −1/3 ≤ alpha ≤ 0.

    Raises
    ------
    ValueError
        If the step is not positive, alpha is out of range, or the scheme is unknown.
    """
    if not (np.isfinite(step) and step > 0):
        raise ValueError(f"step must be a positive number of seconds, got {step}")
    w, z = np.broadcast_arrays(np.asarray(omega, dtype=float), np.asarray(zeta, dtype=float))
    if scheme == "hht":
        return _hht(w, z, step, alpha)
    if scheme == "exponential":
        return _exponential(w, z, step)
    raise ValueError(f"scheme must be 'hht' or 'exponential', not {scheme!r}")


def _hht(omega: Array, zeta: Array, h: float, alpha: float) -> Steps:
    if not -1 / 3 <= alpha <= 0:
        raise ValueError(f"alpha must lie between -1/3 and 0, got {alpha}")
    beta, gamma = (1 - alpha) ** 2 / 4, 0.5 - alpha
    c, k = 2 * zeta * omega, omega**2
    share = 1 + alpha
    denominator = 1 + share * (gamma * h * c + beta * h * h * k)
    # Newmark predictors as rows over (u, v, a); the new acceleration then enters with (beta h², gamma h, 1)
    u_row, v_row = np.array([1.0, h, h * h * (0.5 - beta)]), np.array([0.0, 1.0, h * (1 - gamma)])
    weight = np.array([beta * h * h, gamma * h, 1.0])
    balance = (-share * (c[..., None] * v_row + k[..., None] * u_row)
               + alpha * (c[..., None] * np.array([0.0, 1.0, 0.0]) + k[..., None] * np.array([1.0, 0.0, 0.0]))) / denominator[..., None]
    predictors = np.stack([u_row, v_row, np.zeros(3)])
    amplification = predictors + weight[:, None] * balance[..., None, :]
    return Steps("hht", h, amplification, -alpha * weight / denominator[..., None], share * weight / denominator[..., None])


def _exponential(omega: Array, zeta: Array, h: float) -> Steps:
    """Exact propagator from the exponential of the system augmented by a constant and a ramp (Van Loan 1978)."""
    generator = np.zeros((*omega.shape, 4, 4))
    # components (omega u, v) keep the matrix balanced at every frequency
    generator[..., 0, 1] = omega * h
    generator[..., 1, 0] = -omega * h
    generator[..., 1, 1] = -2 * zeta * omega * h
    generator[..., 1, 2] = h
    generator[..., 2, 3] = 1.0
    full = _exponential_of(generator)
    amplification = full[..., :2, :2].copy()
    amplification[..., 0, 1] /= omega
    amplification[..., 1, 0] *= omega
    constant, ramp = full[..., :2, 2].copy(), full[..., :2, 3].copy()
    constant[..., 0] /= omega
    ramp[..., 0] /= omega
    return Steps("exponential", h, amplification, constant - ramp, ramp)


def _exponential_of(matrices: Array) -> Array:
    """Matrix exponential of a stack (..., n, n): Taylor series of order 18 after scaling below 1/2, then squaring."""
    largest = float(np.abs(matrices).sum(axis=-1).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(largest / 0.5)))) if largest > 0.5 else 0
    scaled = matrices / 2.0**squarings
    identity = np.eye(matrices.shape[-1])
    result = np.broadcast_to(identity, matrices.shape)
    for order in range(18, 0, -1):
        result = identity + scaled @ result / order
    for _ in range(squarings):
        result = result @ result
    return result


def spectrum(coefficients: Steps, omega: ArrayLike, zeta: ArrayLike) -> tuple[Array, Array]:
    """What the step does to each linear mode: relative period error and damping added, from the eigenvalues of A.

    Parameters
    ----------
    coefficients : Steps
        For one set of modes, (m, c, c).
    omega, zeta : array_like (m,)
        The true values, rad/s and ratio.

    Returns
    -------
    period_error : ndarray (m,)
        Numerical damped period over the true one, minus 1; NaN where the true mode does not oscillate.
    false_damping : ndarray (m,)
        Numerical damping ratio minus the true one.
    """
    w, z = np.asarray(omega, dtype=float), np.asarray(zeta, dtype=float)
    values = np.linalg.eigvals(coefficients.amplification)
    # the principal pair is the largest in modulus among the complex ones
    rank = np.where(values.imag > 1e-14, np.abs(values), -1.0)
    principal = np.take_along_axis(values, rank.argmax(axis=-1)[..., None], axis=-1)[..., 0]
    h = coefficients.step
    with np.errstate(invalid="ignore", divide="ignore"):
        true = w * np.sqrt(np.where(z < 1, 1 - z**2, np.nan)) * h
    angle = np.angle(principal)
    if coefficients.name == "exponential":  # exact, so only the branch of the angle is open
        turns = np.nan_to_num(true) / (2 * np.pi)
        up, down = angle + 2 * np.pi * np.round(turns - angle / (2 * np.pi)), -angle + 2 * np.pi * np.round(turns + angle / (2 * np.pi))
        angle = np.where(np.abs(up - true) <= np.abs(down - true), up, down)
    decay = -np.log(np.abs(principal))
    with np.errstate(invalid="ignore", divide="ignore"):
        period_error = true / angle - 1
        false_damping = decay / np.hypot(decay, angle) - z
    return period_error, np.where(np.isfinite(period_error), false_damping, np.nan)
