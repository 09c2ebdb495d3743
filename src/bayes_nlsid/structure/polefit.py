"""Poles and residues from the discrete Fourier transform of a short stretch of data, leakage included exactly.

Over N samples the transform of a decaying exponential r exp(s t) is r (1 − e^{sNΔt}) / (1 − e^{(s − iω)Δt}) at every line, with no
window and no bias; modes and transients outside the band add something smooth, a low polynomial in ω. A measured force adds its
transform times 1/(iω − s) and times a low polynomial. All of this is linear in everything but the poles, so the fit is a variable
projection over two numbers per mode, and noise enters line by line, independent and, over a narrow band, white.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
SMOOTH = 3  # coefficients of the polynomial for what lies outside the band
FORCED_SMOOTH = 2  # and of the one that multiplies each force


@final
@dataclass(frozen=True)
class Lines:
    """Spectra on the lines of one band.

    Parameters
    ----------
    omega : ndarray (b,)
        rad/s.
    response : complex ndarray (b, s)
    force : complex ndarray (b, k)
        k = 0 for a free decay.
    dt : float
    transient : bool
        Whether the stretch may begin or end in motion (anything but whole steady periods).
    """

    omega: NDArray[np.float64]
    response: Complex
    force: Complex
    dt: float
    transient: bool

    @property
    def columns(self) -> int:
        """Number of smooth columns."""
        return (SMOOTH if self.transient else 0) + FORCED_SMOOTH * self.force.shape[1]

    def per_mode(self) -> int:
        """Number of columns for each pole."""
        return int(self.transient) + self.force.shape[1]


@final
@dataclass(frozen=True)
class PoleFit:
    """Poles of one band.

    Parameters
    ----------
    frequency, zeta : ndarray (m,)
        Undamped natural frequency (Hz), damping ratio.
    frequency_sd, zeta_sd : ndarray (m,)
    residues, residues_sd : ndarray (m, s)
        Of the free decay at the first sample, or of the strongest force; in the channels' own quantity.
    strongest : int
        Index of that force, −1 for a free decay.
    noise : ndarray (s,)
        rms of what is left per line and channel.
    cost : float
        Weighted sum of squares.
    status : str
    """

    frequency: NDArray[np.float64]
    zeta: NDArray[np.float64]
    frequency_sd: NDArray[np.float64]
    zeta_sd: NDArray[np.float64]
    residues: Complex
    residues_sd: NDArray[np.float64]
    strongest: int
    noise: NDArray[np.float64]
    cost: float
    status: str = "ok"


def fit_poles(lines: Lines, starts: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> PoleFit:
    """Least squares over the poles of a band, from several starts.

    Parameters
    ----------
    lines : Lines
    starts : list of (frequency (m,) Hz, zeta (m,))

    Returns
    -------
    PoleFit
        The best one; ``status`` says if no start converged to something usable.
    """
    best: tuple[float, NDArray[np.float64]] | None = None
    weight = np.ones(lines.response.shape[1])
    for _ in range(2):  # once with equal channels, once weighted by what the first left over
        trials = [_search(lines, _pack(f, z), weight) for f, z in starts] if best is None else [_search(lines, best[1], weight)]
        best = min(trials, key=lambda trial: trial[0])
        residual, _, freedom = _project(lines, best[1])
        weight = 1 / np.maximum(np.sqrt(np.sum(np.abs(residual) ** 2, axis=0) / freedom), _tiny(lines))
    return _summary(lines, best[1], weight, best[0])  # type: ignore[index]


def criterion(lines: Lines, fit: PoleFit) -> float:
    """Bayesian information criterion of a fit (smaller is better), noise per channel unknown."""
    b, s = lines.response.shape
    residual = _project(lines, _pack(fit.frequency, fit.zeta))[0]
    left = np.maximum(np.mean(np.abs(residual) ** 2, axis=0), _tiny(lines) ** 2)
    free = len(fit.frequency) * (2 + 2 * s * lines.per_mode()) + 2 * s * lines.columns
    return float(2 * b * np.sum(np.log(left)) + free * np.log(2 * b * s))


def least_distance(lines: Lines, fit: PoleFit) -> float:
    """Smallest distance between two resonances, in lines."""
    return float(np.diff(fit.frequency).min(initial=np.inf)) * 2 * np.pi / _line_spacing(lines)


def with_another(lines: Lines, fit: PoleFit) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Starts with one pole more, where the residual stands highest over the band and beside the present poles."""
    residual = np.sum(np.abs(_project(lines, _pack(fit.frequency, fit.zeta))[0] / np.maximum(fit.noise, _tiny(lines))) ** 2, axis=1)
    f, spacing = lines.omega / (2 * np.pi), _line_spacing(lines) / (2 * np.pi)
    new = [f[int(np.argmax(residual))], *(fit.frequency + spacing), *(fit.frequency - spacing)]
    width = float(np.exp(np.mean(np.log(fit.zeta))))
    return [(np.append(fit.frequency, x), np.append(fit.zeta, width)) for x in np.clip(new, f[0] + 0.1 * spacing, f[-1] - 0.1 * spacing)]


def _pack(frequency: NDArray[np.float64], zeta: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([np.log(frequency), np.log(np.maximum(zeta, 1e-6))])


def _unpack(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], Complex]:
    """Frequency (Hz), damping ratio, pole (rad/s)."""
    m = len(x) // 2
    frequency, zeta = np.exp(x[:m]), np.exp(np.minimum(x[m:], -0.1))
    return frequency, zeta, 2 * np.pi * frequency * (-zeta + 1j * np.sqrt(1 - zeta**2))


def _tiny(lines: Lines) -> float:
    """A residual that no rounding can undercut."""
    return float(1e-13 * np.sqrt(np.mean(np.abs(lines.response) ** 2)) + np.finfo(float).tiny)


def _basis(lines: Lines, x: NDArray[np.float64]) -> Complex:
    """Columns (b, p): for each mode its forces, then its transient; then the smooth parts."""
    _, _, poles = _unpack(x)
    jw = 1j * lines.omega
    span = (lines.omega - lines.omega.mean()) / max(np.ptp(lines.omega) / 2, 1e-300)
    columns: list[Complex] = []
    for pole in poles:
        columns += [f / (jw - pole) for f in lines.force.T]
        if lines.transient:
            columns.append(1 / (1 - np.exp((pole - jw) * lines.dt)))
    columns += [f * span**power for f in lines.force.T for power in range(FORCED_SMOOTH)]
    if lines.transient:
        columns += [(span**power).astype(complex) for power in range(SMOOTH)]
    return np.stack(columns, axis=1)


def _project(lines: Lines, x: NDArray[np.float64]) -> tuple[Complex, Complex, int]:
    """Residual (b, s), coefficients (p, s), degrees of freedom per channel."""
    unit, _, coefficients = _solve(lines, x)
    residual = lines.response - unit @ (unit.conj().T @ lines.response)
    return residual, coefficients, max(1, unit.shape[0] - unit.shape[1] - len(x) // 2)


def _solve(lines: Lines, x: NDArray[np.float64]) -> tuple[Complex, Complex, Complex]:
    """Orthonormal basis (b, p) of the columns, the inverse (p, p) that leads back to them, coefficients (p, s)."""
    basis = _basis(lines, x)
    size = np.linalg.norm(basis, axis=0)
    size = np.where(size > 0, size, 1.0)
    left, values, right = np.linalg.svd(basis / size, full_matrices=False)
    inverse = np.where(values > 1e-12 * values[0], 1 / values, 0.0)
    mixing = (right.conj().T * inverse) / size[:, None]
    return np.asarray(left, complex), np.asarray(mixing, complex), mixing @ (left.conj().T @ lines.response)


def _jacobian(lines: Lines, x: NDArray[np.float64]) -> Complex:
    """Derivative (2m, b, s) of the projected residual, −P⊥ (dΦ/dx) Φ⁺ Y (Kaufman's form: exact up to second order of the residual)."""
    left, _, coefficients = _solve(lines, x)
    _, zeta, poles = _unpack(x)
    jw, each, m = 1j * lines.omega, lines.per_mode(), len(poles)
    slope = [poles, np.abs(poles) * zeta * (-1 - 1j * zeta / np.sqrt(1 - zeta**2))]  # d pole / d ln f, d ln zeta
    out = np.empty((2 * m, *lines.response.shape), dtype=complex)
    for k, pole in enumerate(poles):
        columns = [f / (jw - pole) ** 2 for f in lines.force.T]
        if lines.transient:
            turn = np.exp((pole - jw) * lines.dt)
            columns.append(lines.dt * turn / (1 - turn) ** 2)
        moved = np.stack(columns, axis=1) @ coefficients[k * each:(k + 1) * each]
        moved = moved - left @ (left.conj().T @ moved)
        for i in range(2):
            out[i * m + k] = -moved * slope[i][k]
    return out


def _search(lines: Lines, start: NDArray[np.float64], weight: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    from scipy.optimize import least_squares

    m = len(start) // 2
    low, high = np.log(lines.omega[[0, -1]] / (2 * np.pi))
    # Frequencies stay within the band, damping between 1e-6 and 0.5: outside these a "mode" only mimics the smooth part.
    bounds = np.array([[low, high]] * m + [[np.log(1e-6), np.log(0.5)]] * m).T
    scale = 1 / np.sqrt(np.sum(np.abs(lines.response * weight) ** 2))

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return _stack(_project(lines, x)[0] * weight * scale)

    def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([_stack(column * weight * scale) for column in _jacobian(lines, x)], axis=1)

    inside = np.clip(start, bounds[0] + 1e-9, bounds[1] - 1e-9)
    steps = np.concatenate([np.exp(start[m:]), np.ones(m)])  # a line is as wide as its damping ratio
    found = least_squares(residual, inside, jacobian, bounds=bounds, x_scale=np.maximum(steps, 1e-5), xtol=1e-10, ftol=1e-10, gtol=1e-14,
                          max_nfev=60)
    return 2 * float(found.cost) / scale**2, found.x


def _stack(values: Complex) -> NDArray[np.float64]:
    """Real and imaginary parts in one vector."""
    return np.concatenate([values.real.ravel(), values.imag.ravel()])


def _summary(lines: Lines, x: NDArray[np.float64], weight: NDArray[np.float64], cost: float) -> PoleFit:
    """Sorted result with standard deviations from the Jacobian of the projected residual."""
    m = len(x) // 2
    order = np.argsort(x[:m])
    x = np.concatenate([x[:m][order], x[m:][order]])
    frequency, zeta, _ = _unpack(x)
    residual, coefficients, freedom = _project(lines, x)
    noise = np.sqrt(np.sum(np.abs(residual) ** 2, axis=0) / freedom)
    jacobian = np.sqrt(2) * np.stack([_stack(column * weight) for column in _jacobian(lines, x)], axis=1)
    information = jacobian.T @ jacobian
    size = np.sqrt(np.diag(information))
    status = "ok"
    if (size > 0).all() and np.linalg.cond(information / np.outer(size, size)) < 1e12:
        sd = np.sqrt(np.diag(np.linalg.inv(information / np.outer(size, size)))) / size
    else:
        sd, status = np.full(2 * m, np.inf), "poles are not determined by the data"
    spread = np.linalg.norm(_solve(lines, x)[1], axis=1)  # root of the diagonal of (ΦᴴΦ)⁻¹
    each = lines.per_mode()
    inputs = lines.force.shape[1]
    strongest = -1
    if inputs:
        strength = [np.linalg.norm(coefficients[[k * each + j for k in range(m)]]) for j in range(inputs)]
        strongest = int(np.argmax(strength))
    pick = [k * each + max(strongest, 0) for k in range(m)]
    residues, residues_sd = coefficients[pick], spread[pick][:, None] * noise
    if not inputs:  # from the transform of N samples back to the first of them
        _, _, poles = _unpack(x)
        lost = 1 - np.exp(poles * 2 * np.pi / _line_spacing(lines))
        residues, residues_sd = residues / lost[:, None], residues_sd / np.abs(lost)[:, None]
    return PoleFit(frequency, zeta, frequency * sd[:m], zeta * sd[m:], residues, residues_sd, strongest, noise, cost, status)


def _line_spacing(lines: Lines) -> float:
    return float(np.min(np.diff(lines.omega)))
