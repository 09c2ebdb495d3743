"""The honest rival: the best linear re-tuning of the nominal model, with the answer sheet's own starting point.

Stiffness and mass parts (priors from the stated tolerances), damping and a small frequency correction per mode are fitted to the
measured frequency responses by Levenberg-Marquardt, started at the true factors, so that it cannot be stuck in a wrong optimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

FUDGE_SD = 0.003


@dataclass(frozen=True)
class Retuned:
    """Accelerance by modes: ``frequency`` (m,) rad/s, ``ratio`` (m,), ``left`` (s, m), ``right`` (m,); ``misfit`` over noise;
    ``cost``: chi-square of the fit with its prior terms."""

    omega: np.ndarray
    ratio: np.ndarray
    left: np.ndarray
    right: np.ndarray
    misfit: float
    cost: float = float("nan")

    def accelerance(self, s: np.ndarray) -> np.ndarray:
        """(f, sensors) at complex frequencies ``s`` (f,) rad/s."""
        G = 1.0 / (self.omega**2 + s[:, None] ** 2 + 2 * self.ratio * self.omega * s[:, None])
        return (s**2)[:, None] * ((G * self.right) @ self.left.T)

    def predict(self, force: np.ndarray, fs: float, periods: int) -> np.ndarray:
        """Acceleration (n, s): exact steady state for ``periods`` > 0, else from rest."""
        n = force.size
        if periods:
            spectrum = np.fft.rfft(force.reshape(periods, -1).mean(axis=0))
            s = 2j * np.pi * np.arange(spectrum.size) * fs * periods / n
            return np.tile(np.fft.irfft(self.accelerance(s) * spectrum[:, None], n // periods, axis=0), (periods, 1))
        shift, padded = 0.5, int(n + 6 * fs)
        time = np.arange(n) / fs
        spectrum = np.fft.rfft(force * np.exp(-shift * time), padded)
        s = shift + 2j * np.pi * np.arange(spectrum.size) * fs / padded
        return np.fft.irfft(self.accelerance(s) * spectrum[:, None], padded, axis=0)[:n] * np.exp(shift * time)[:, None]


def prior_sd(name: str, tolerances: dict[str, float]) -> float:
    """Standard deviation of the logarithm of a part's factor."""
    if name.startswith("E_"):
        return tolerances["E_rel_sd"]
    if name.startswith("rho_"):
        return tolerances["rho_rel_sd"]
    return tolerances["root_fix_log_sd"] if name == "root_fix" else tolerances["joint_stiffness_log_sd"]


def retune(
    nominal: dict[str, np.ndarray],
    tolerances: dict[str, float],
    ratio: float,
    hz: np.ndarray,
    H: np.ndarray,
    variance: np.ndarray,
    start: dict[str, float],
    iterations: int = 12,
) -> Retuned:
    """Fit to measured accelerances ``H`` (f, s) with ``variance`` (f, s) at ``hz`` (f,); ``start`` gives factors by part name."""
    names = [*map(str, nominal["K_part_names"]), *map(str, nominal["M_part_names"])]
    parts = np.concatenate([nominal["K_parts"], nominal["M_parts"]])
    is_mass = np.arange(len(names)) >= len(nominal["K_part_names"])
    rest = nominal["M"] - nominal["M_parts"].sum(axis=0)
    p = np.array([np.log(start.get(n, 1.0)) for n in names])
    sd = np.array([prior_sd(n, tolerances) for n in names])
    modes = int(np.sum(la.eigh(nominal["K"], nominal["M"], eigvals_only=True) < (2 * np.pi * hz[-1] * 1.3) ** 2))
    x = np.concatenate([p, np.zeros(2 * modes)])
    sds = np.concatenate([sd, np.full(modes, FUDGE_SD), np.full(modes, 1.5 * tolerances["damping_rel_sd"])])
    iw = 2j * np.pi * hz
    weight = 1.0 / np.sqrt(variance)

    def build(x: np.ndarray):
        factor = np.exp(x[: len(names)])
        K = np.einsum("p,pij->ij", factor[~is_mass], parts[~is_mass])
        M = rest + np.einsum("p,pij->ij", factor[is_mass], parts[is_mass])
        w2, shapes = la.eigh(K, M)
        omega, zeta = np.sqrt(np.maximum(w2, 1.0)), np.full(w2.size, ratio)
        omega[:modes] *= np.exp(x[len(names) : len(names) + modes])
        zeta[:modes] *= np.exp(x[len(names) + modes :])
        return Retuned(omega, zeta, nominal["sensor_select"] @ shapes, shapes.T @ nominal["shaker_vector"], 0.0), shapes, factor

    def residual(model: Retuned) -> np.ndarray:
        return ((H - model.accelerance(iw)) * weight).ravel()

    model, shapes, factor = build(x)
    r = residual(model)
    cost, damp = float(np.sum(np.abs(r) ** 2) + np.sum(((x) / sds) ** 2)), 1e-3
    for _ in range(iterations):
        J = _jacobian(model, shapes, factor, parts, is_mass, modes, iw) * weight[:, :, None]
        J = J.reshape(-1, x.size)
        A = (J.conj().T @ J).real + np.diag(1 / sds**2)
        g = (J.conj().T @ r).real - x / sds**2
        for _ in range(6):
            new = x + np.clip(la.solve(A + damp * np.diag(np.diag(A)), g, assume_a="pos"), -0.7, 0.7)
            trial, shapes_new, factor_new = build(new)
            r_new = residual(trial)
            cost_new = float(np.sum(np.abs(r_new) ** 2) + np.sum((new / sds) ** 2))
            if cost_new < cost:
                break
            damp *= 8
        else:
            break
        gain = cost - cost_new
        x, model, shapes, factor, r, cost, damp = new, trial, shapes_new, factor_new, r_new, cost_new, max(damp / 6, 1e-7)
        if gain < 1e-4 * cost:
            break
    return Retuned(model.omega, model.ratio, model.left, model.right, float(np.sqrt(np.mean(np.abs(r) ** 2))), cost)


def _jacobian(
    model: Retuned, shapes: np.ndarray, factor: np.ndarray, parts: np.ndarray, is_mass: np.ndarray, modes: int, iw: np.ndarray
) -> np.ndarray:
    """d accelerance / d x (f, s, parameters); the parts act through the lowest modes, which is where they matter."""
    keep = min(model.omega.size, modes + 15)
    w, z, left, right = model.omega[:keep], model.ratio[:keep], model.left[:, :keep], model.right[:keep]
    phi = shapes[:, :keep]
    G = 1.0 / (w**2 + iw[:, None] ** 2 + 2 * z * w * iw[:, None])
    scale = (iw**2)[:, None]
    columns = []
    for part, f, mass in zip(parts, factor, is_mass, strict=True):
        inner = G * ((G * right) @ (phi.T @ part @ phi).T) * f
        columns.append(-scale * ((inner * iw[:, None] ** 2 if mass else inner) @ left.T))
    for k in range(modes):
        columns.append((-scale[:, 0] * G[:, k] ** 2 * (2 * w[k] ** 2 + 2 * z[k] * w[k] * iw) * right[k])[:, None] * left[:, k])
    for k in range(modes):
        columns.append((-scale[:, 0] * G[:, k] ** 2 * 2 * z[k] * w[k] * iw * right[k])[:, None] * left[:, k])
    return np.array(columns).transpose(1, 2, 0)
