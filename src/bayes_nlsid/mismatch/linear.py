"""The nominal model as a family: stiffness and mass parts scaled, modes detuned, local dynamic stiffness added.

All receptances come from a fixed Ritz basis (lowest modes and static shapes of every named direction), so that one evaluation costs
an eigenvalue problem of some sixty unknowns however large the nominal model is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case import Case

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@final
@dataclass(frozen=True)
class Family:
    """Reduced parts, directions and priors.

    Parameters
    ----------
    names : tuple of str
        Scale parameters (log multipliers): stiffness parts, then mass parts.
    K_parts, M_parts : ndarray (P, n, n), (Q, n, n)
    K_rest, M_rest : ndarray (n, n)
        What no part covers.
    sensors : ndarray (S, n)
        Usable channels.
    shaker, base : ndarray (n,)
        ``base`` is the force per unit base acceleration, minus M times the rigid motion.
    base_direct : ndarray (S,)
        Rigid motion at the sensors.
    places, points : dict of str to ndarray (n,)
    scale_sd : ndarray (P + Q,)
        Prior standard deviations of the log multipliers.
    modes : int
        Modes that get their own frequency and damping deviation (those up to a quarter above the band).
    damping : float
    single : dict of int to ndarray (n,)
        Stiffness parts of rank one, as b with part = b bᵀ.
    silent : ndarray (S', n)
        Channels that were left out of the analysis; their motion can be predicted all the same.
    mode_sd, damping_sd, shape_sd : float
        Log-frequency deviation of one mode; log damping; relative error of one mode at one sensor.
    """

    names: tuple[str, ...]
    K_parts: Array
    M_parts: Array
    K_rest: Array
    M_rest: Array
    sensors: Array
    shaker: Array
    base: Array
    base_direct: Array
    places: dict[str, Array]
    points: dict[str, Array]
    scale_sd: Array
    modes: int
    damping: float
    single: dict[int, Array]
    silent: Array
    mode_sd: float = 0.003
    damping_sd: float = 0.25
    shape_sd: float = 0.004

    @property
    def size(self) -> int:
        """Number of linear parameters: scales, log-frequency deviations, log-damping deviations."""
        return len(self.names) + 2 * self.modes

    @property
    def prior_sd(self) -> Array:
        """(size,)."""
        return np.concatenate([self.scale_sd, np.full(self.modes, self.mode_sd), np.full(self.modes, self.damping_sd)])


@final
@dataclass(frozen=True)
class Modes:
    """A member of the family in its own modes.

    Parameters
    ----------
    omega, zeta : ndarray (m,)
        rad/s (deviations included), ratio.
    basis : ndarray (n, m)
        Mass-normalised modes in Ritz coordinates.
    undisturbed : ndarray (m,)
        rad/s without the deviations of single modes.
    """

    omega: Array
    zeta: Array
    basis: Array
    undisturbed: Array

    def denominators(self, s: Complex) -> Complex:
        """(L, m): s² + 2 ζ ω s + ω²."""
        return np.asarray(s[:, None] ** 2 + 2 * self.zeta * self.omega * s[:, None] + self.omega ** 2)


def family(case: Case) -> Family:
    """Reduce the nominal model of a case to its Ritz basis."""
    import scipy.linalg as la

    size = len(case.M)
    keep = min(size, 40)
    factor = la.cho_factor(case.K)
    _, low = la.eigh(case.K, case.M, subset_by_index=[0, keep - 1])
    directions = [case.shaker, *case.places.values(), *case.sensor_rows]
    static = la.cho_solve(factor, np.array(directions).T)
    static -= low @ (low.T @ (case.M @ static))
    norms = np.sqrt(np.einsum("ij,ij->j", static, case.M @ static))
    values, vectors = la.eigh((static / norms).T @ case.M @ (static / norms))
    extra = (static / norms) @ (vectors[:, values > 1e-6] / np.sqrt(values[values > 1e-6]))
    T = np.concatenate([low, extra], axis=1)
    reduce = {key: {name: T.T @ part @ T for name, part in parts.items()}
              for key, parts in (("K", case.K_parts), ("M", case.M_parts))}
    names = tuple(reduce["K"]) + tuple(f"M:{n}" for n in reduce["M"])
    K_parts, M_parts = np.array(list(reduce["K"].values())), np.array(list(reduce["M"].values()))
    frequencies = np.sqrt(la.eigh(case.K, case.M, eigvals_only=True, subset_by_index=[0, keep - 1])) / (2 * np.pi)
    modes = int(np.searchsorted(frequencies, 1.25 * case.band[1]))
    sd = np.array([_scale_sd(case, n) for n in case.K_parts] + [case.tolerances["rho_rel_sd"]] * len(M_parts))
    rows = case.sensor_rows[case.usable]
    return Family(names, K_parts, M_parts, T.T @ case.K @ T - K_parts.sum(0), T.T @ case.M @ T - M_parts.sum(0), rows @ T,
                  case.shaker @ T, -(case.M @ case.base) @ T, rows @ case.base,
                  {k: v @ T for k, v in case.places.items()}, {k: v @ T for k, v in case.mass_points.items()},
                  sd, max(1, min(modes, T.shape[1])), case.damping, _single(K_parts),
                  case.sensor_rows[~case.usable] @ T,
                  damping_sd=max(0.25, case.tolerances["damping_rel_sd"]))


def _single(parts: Array) -> dict[int, Array]:
    out = {}
    for i, part in enumerate(parts):
        j = int(np.argmax(np.diag(part)))
        if part[j, j] > 0:
            b = part[j] / np.sqrt(part[j, j])
            if np.abs(part - np.outer(b, b)).max() < 1e-8 * np.abs(part).max():
                out[i] = b
    return out


def _scale_sd(case: Case, name: str) -> float:
    tolerance = case.tolerances
    if name in case.places:
        return tolerance["joint_stiffness_log_sd"]
    if "root" in name.lower() or "fix" in name.lower() or "support" in name.lower():
        return tolerance["root_fix_log_sd"]
    return tolerance["E_rel_sd"]


def solve(fam: Family, theta: Array) -> Modes:
    """Modes for log multipliers and deviations ``theta`` (size,)."""
    import scipy.linalg as la

    count_k, count = len(fam.K_parts), len(fam.names)
    scale = np.exp(np.clip(theta[:count], -6, 6))
    K = np.tensordot(scale[:count_k], fam.K_parts, 1) + fam.K_rest
    M = np.tensordot(scale[count_k:], fam.M_parts, 1) + fam.M_rest
    values, basis = la.eigh(K, M)
    omega = np.sqrt(np.maximum(values, 1e-6))
    undisturbed = omega.copy()
    zeta = np.full(len(omega), fam.damping)
    omega[:fam.modes] *= np.exp(np.clip(theta[count:count + fam.modes], -0.3, 0.3))
    zeta[:fam.modes] *= np.exp(np.clip(theta[count + fam.modes:], -4, 4))
    return Modes(omega, zeta, basis, undisturbed)


@final
@dataclass(frozen=True)
class Attachment:
    """A local dynamic stiffness z(s) (L,) N/m acting along a direction (n,): mass m s², spring k, resonator, relaxing branch."""

    direction: Array
    z: Complex


@final
@dataclass(frozen=True)
class Fields:
    """Everything about the linear model that regression needs, on given lines.

    Parameters
    ----------
    H : ndarray complex (L, S)
        Accelerance to the force.
    right : ndarray complex (L, m)
        Modal response to the force.
    left : ndarray complex (L, S, m)
        Modal rows of the sensors over the denominators.
    modes : Modes
    """

    H: Complex
    right: Complex
    left: Complex
    modes: Modes


def fields(fam: Family, modes: Modes, s: Complex, attach: tuple[Attachment, ...] = (), most: int = 45) -> Fields:
    """Accelerance and the modal vectors to both sides of it (exact with attachments, by the Woodbury identity)."""
    D = modes.denominators(s)
    f, S = fam.shaker @ modes.basis, fam.sensors @ modes.basis
    right = f / D
    if not attach:
        H = s[:, None] ** 2 * (right @ S.T)
        return Fields(H, right[:, :most], S[None, :, :most] / D[:, None, :most], modes)
    left = S[None] / D[:, None, :]
    b = np.array([a.direction for a in attach]) @ modes.basis
    gain = coupling(modes, s, attach)
    back = gain @ (b[None] / D[:, None, :])                                        # (L, K, m)
    right, left = right - ((right @ b.T)[:, None, :] @ back)[:, 0], left - (left @ b.T) @ back
    H = s[:, None] ** 2 * (right @ S.T)
    return Fields(H, right[:, :most], left[:, :, :most], modes)


def coupling(modes: Modes, s: Complex, attach: tuple[Attachment, ...]) -> Complex:
    """(L, K, K): (I + Z R)⁻¹ Z of K attachments, R their receptances: force they return per free motion of their points."""
    b = np.array([a.direction for a in attach]) @ modes.basis
    R = np.einsum("lm,im,jm->lij", 1 / modes.denominators(s), b, b, optimize=True)
    Z = np.array([a.z for a in attach]).T[:, :, None] * np.eye(len(attach))
    return np.asarray(np.linalg.solve(np.eye(len(attach)) + Z @ R, Z))


def receptances(modes: Modes, s: Complex, to: Array, at: Array, attach: tuple[Attachment, ...] = ()) -> Complex:
    """Displacement (L, A, B) at rows ``to`` (A, n) per force along rows ``at`` (B, n), attachments included, m/N."""
    inverse = 1 / modes.denominators(s)
    t, a = to @ modes.basis, at @ modes.basis
    out = _through(inverse, t, a)
    if attach:
        b = np.array([c.direction for c in attach]) @ modes.basis
        out = out - _through(inverse, t, b) @ coupling(modes, s, attach) @ _through(inverse, b, a)
    return out


def _through(inverse: Complex, left: Array, right: Array) -> Complex:
    products = left[:, None, :] * right[None, :, :]
    return np.asarray((inverse @ products.reshape(-1, products.shape[-1]).T).reshape(len(inverse), len(left), len(right)))


def jacobian(fam: Family, theta: Array, fld: Fields, s: Complex) -> Complex:
    """dH/dtheta (size, L, S), exact: modal damping ratios and detunings follow the modes as they turn.

    With dynamic stiffness D_i = s² + a_i s + w_i of mode i and eigenvalues l_i, a change A of stiffness (in modes) changes H by
    −s² left (W ∘ A) right with W_ij = (D_j − D_i)/(l_j − l_i); a change of mass by the same with
    W_ij = (l_j D_i − l_i D_j)/(l_j − l_i). Both are 1 (or s²) but for damping and detuning, which count among low modes only.
    """
    count_k, count = len(fam.K_parts), len(fam.names)
    most = fld.right.shape[1]
    basis = fld.modes.basis[:, :most]
    scale = np.exp(np.clip(theta[:count], -6, 6))
    out = np.empty((fam.size, len(s), fld.left.shape[1]), dtype=complex)
    s2 = (s ** 2)[:, None]
    near = min(fam.modes + 4, most)
    turned = _turning(fam, fld.modes, near)
    left, right = fld.left[:, :, :near], fld.right[:, :near]
    for i in range(count):
        if i in fam.single:
            b = fam.single[i] @ basis
            inner = scale[i] * (fld.right @ b)[:, None] * (fld.left @ b)
        else:
            part = fam.K_parts[i] if i < count_k else fam.M_parts[i - count_k]
            inner = (fld.left @ (fld.right @ (scale[i] * (basis.T @ part @ basis)))[:, :, None])[:, :, 0]
        part = fam.K_parts[i] if i < count_k else fam.M_parts[i - count_k]
        A = scale[i] * (basis[:, :near].T @ part @ basis[:, :near])
        still, moving = turned[0 if i < count_k else 1]
        more = (left @ (right @ (A * still) + s[:, None] * (right @ (A * moving)))[:, :, None])[:, :, 0]
        out[i] = -s2 * ((inner if i < count_k else s2 * inner) + more)
    own = fld.right[:, :fam.modes, None] * np.swapaxes(fld.left[:, :, :fam.modes], 1, 2)
    omega, zeta = fld.modes.omega[:fam.modes], fld.modes.zeta[:fam.modes]
    detune = 2 * omega ** 2 + 2 * zeta * omega * s[:, None]
    damp = 2 * zeta * omega * s[:, None]
    out[count:count + fam.modes] = np.moveaxis(-s2[:, None] * detune[:, :, None] * own, 1, 0)
    out[count + fam.modes:] = np.moveaxis(-s2[:, None] * damp[:, :, None] * own, 1, 0)
    return out


def _turning(fam: Family, modes: Modes, near: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """For stiffness and mass: what W has beyond 1 (or s²), as constant and as factor of s, (near, near) each."""
    w, a = modes.omega[:near] ** 2, 2 * modes.zeta[:near] * modes.omega[:near]
    e = modes.undisturbed[:near] ** 2
    gap = e[None, :] - e[:, None]
    same = np.abs(gap) < 1e-9 * e[:, None]
    gap = np.where(same, 1.0, gap)
    ratio = w / e
    k_still = np.where(same, np.diag(ratio), (w[None, :] - w[:, None]) / gap) - np.where(same, np.eye(near), 1.0)
    k_moving = np.where(same, np.diag(ratio * a / (2 * w)), (a[None, :] - a[:, None]) / gap)
    m_still = np.where(same, 0.0, (e[None, :] * w[:, None] - e[:, None] * w[None, :]) / gap)
    m_moving = np.where(same, np.diag(a / 2), (e[None, :] * a[:, None] - e[:, None] * a[None, :]) / gap)
    return (k_still, k_moving), (m_still, m_moving)


def shape_columns(fam: Family, fld: Fields, s: Complex) -> Complex:
    """Contribution (modes, L, S) of each mode to each channel: what a relative error of the mode shape there changes."""
    S = fam.sensors @ fld.modes.basis[:, :fam.modes]
    return np.asarray(np.moveaxis((s ** 2)[:, None, None] * fld.right[:, :fam.modes, None] * S.T[None], 1, 0))
