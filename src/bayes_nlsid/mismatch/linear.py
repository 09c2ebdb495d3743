"""The nominal model as a family: stiffness and mass parts scaled, modes detuned, mixed and coupled, local dynamic stiffness added.

What a nominal model has wrong beside its parameters is its form: beam theory, mesh, damping. It shows as modes that are detuned, that are
mixed with one another (stiffness between nominal modes, an exact part of the eigenvalue problem), that are coupled by dashpots at the
joints, and whose shapes are in error at the shaker and at the sensors. All that has a size stated beforehand; that of the shapes at the
sensors is corrected by the data.

All receptances come from a fixed Ritz basis (lowest modes and static shapes of every named direction), so that one evaluation costs
an eigenvalue problem of some sixty unknowns however large the nominal model is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
BEYOND = 3  # groups of modes beyond the band whose contribution may be in error: the next, the one after it, all others
ABOVE = 2.0  # times the end of the band, up to where a mode has its own frequency and damping


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
        Modes that get their own frequency and damping deviation (those up to ``ABOVE`` times the end of the band).
    damping : float
    single : dict of int to ndarray (n,)
        Stiffness parts of rank one, as b with part = b bᵀ.
    mixing : ndarray (n, modes + 1)
        M φ ω of the nominal modes: stiffness κ ω_i ω_j between two of them is what errors of the form of the model mix them by.
    dashpots : ndarray (D, n)
        Directions along which damping of a joint may couple the modes.
    dashpot : ndarray (D,)
        N s/m that would double the nominal damping of the mode most affected.
    silent : ndarray (S', n)
        Channels that were left out of the analysis; their motion can be predicted all the same.
    mode_sd, damping_sd, drive_sd, dashpot_sd : float
        Log-frequency deviation of one mode; log damping; error of one mode at the shaker over its rms at the sensors; strength of a
        dashpot.
    shape_sd, beyond_sd : float
        Error of one mode at one sensor over its rms at all of them, before the data have been seen; relative error of modes beyond the
        band.
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
    mixing: Array
    dashpots: Array
    dashpot: Array
    mode_sd: float = 0.001
    damping_sd: float = 0.25
    drive_sd: float = 0.001
    dashpot_sd: float = 0.05
    mixing_sd: float = 0.001
    shape_sd: float = 0.0015
    beyond_sd: float = 0.01

    @property
    def size(self) -> int:
        """Number of linear parameters: scales, log-frequency deviations, log-damping deviations, errors at the shaker, dashpots."""
        return self.moving + self.modes + len(self.dashpots) + len(self.pairs[0])

    @property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of modes that errors of the form of the stiffness may mix: those with a deviation of their own and the next one."""
        return np.triu_indices(self.modes + 1, 1)

    @property
    def moving(self) -> int:
        """Number of those that the motion of the structure depends on; the rest only correct its transfer function."""
        return len(self.names) + 2 * self.modes

    @property
    def prior_sd(self) -> Array:
        """(size,)."""
        return np.concatenate([self.scale_sd, np.full(self.modes, self.mode_sd), np.full(self.modes, self.damping_sd),
                               np.full(self.modes, self.drive_sd), np.full(len(self.dashpots), self.dashpot_sd),
                               np.full(len(self.pairs[0]), self.mixing_sd)])

    @property
    def error_sd(self) -> Array:
        """(modes + BEYOND,): of the errors of each mode at one sensor."""
        return np.concatenate([np.full(self.modes, self.shape_sd), np.full(BEYOND, self.beyond_sd)])


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
    driven : ndarray (modes,)
        Error of each shape at the shaker, in units of :func:`shape_sizes`.
    viscous : ndarray (D,)
        Dashpots that couple the modes, N s/m.
    """

    omega: Array
    zeta: Array
    basis: Array
    undisturbed: Array
    driven: Array
    viscous: Array

    def denominators(self, s: Complex) -> Complex:
        """(L, m): s² + 2 ζ ω s + ω²."""
        return np.asarray(s[:, None] ** 2 + 2 * self.zeta * self.omega * s[:, None] + self.omega ** 2)


def solve(fam: Family, theta: Array) -> Modes:
    """Modes for log multipliers and deviations ``theta`` (size,)."""
    import scipy.linalg as la

    count_k, count = len(fam.K_parts), len(fam.names)
    detuned, damped, driven, dashed, mixed = np.split(theta[count:], [*(np.arange(1, 4) * fam.modes), 3 * fam.modes + len(fam.dashpots)])
    scale = np.exp(np.clip(theta[:count], -6, 6))
    K = np.tensordot(scale[:count_k], fam.K_parts, 1) + fam.K_rest
    form = np.zeros((fam.modes + 1, fam.modes + 1))
    form[fam.pairs] = np.clip(mixed, -0.3, 0.3)
    K = K + fam.mixing @ (form + form.T) @ fam.mixing.T
    M = np.tensordot(scale[count_k:], fam.M_parts, 1) + fam.M_rest
    values, basis = la.eigh(K, M)
    basis[:, :fam.modes] *= _orientation(fam, basis)
    omega = np.sqrt(np.maximum(values, 1e-6))
    undisturbed = omega.copy()
    zeta = np.full(len(omega), fam.damping)
    omega[:fam.modes] *= np.exp(np.clip(detuned, -0.3, 0.3))
    zeta[:fam.modes] *= np.exp(np.clip(damped, -4, 4))
    return Modes(omega, zeta, basis, undisturbed, np.clip(driven, -0.5, 0.5), fam.dashpot * np.clip(dashed, -5, 5))


def _orientation(fam: Family, basis: Array) -> Array:
    """(modes,): signs that make the modes point as the nominal ones do, so that errors of their shapes keep their meaning."""
    alike = (fam.mixing.T @ basis[:, :fam.modes])
    own = np.diag(alike)
    most = alike[np.argmax(np.abs(alike), axis=0), np.arange(fam.modes)]
    return np.where(np.where(np.abs(own) > 0.1 * np.abs(most), own, most) < 0, -1.0, 1.0)


def shape_sizes(fam: Family, modes: Modes) -> Array:
    """(modes,): rms over the sensors of each mode in the band, the unit of errors of its shape, which do not vanish at its nodes."""
    return np.asarray(np.sqrt(np.mean((fam.sensors @ modes.basis[:, :fam.modes]) ** 2, axis=0)))


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
    f[:fam.modes] += modes.driven * shape_sizes(fam, modes)
    right = f / D
    if not attach:
        H = s[:, None] ** 2 * (right @ S.T)
        return _corrected(fam, Fields(H, right[:, :most], S[None, :, :most] / D[:, None, :most], modes), s)
    left = S[None] / D[:, None, :]
    b = np.array([a.direction for a in attach]) @ modes.basis
    gain = coupling(modes, s, attach)
    back = gain @ (b[None] / D[:, None, :])                                        # (L, K, m)
    right, left = right - ((right @ b.T)[:, None, :] @ back)[:, 0], left - (left @ b.T) @ back
    H = s[:, None] ** 2 * (right @ S.T)
    return _corrected(fam, Fields(H, right[:, :most], left[:, :, :most], modes), s)


def _corrected(fam: Family, fld: Fields, s: Complex) -> Fields:
    """Coupling of the modes by dashpots added to the accelerance, to first order."""
    if not fld.modes.viscous.any():
        return fld
    rows = fam.dashpots @ fld.modes.basis[:, :fld.right.shape[1]]
    between = (rows.T * fld.modes.viscous) @ rows
    np.fill_diagonal(between, 0.0)      # what they do to each mode's own damping has its own deviation already
    return replace(fld, H=fld.H - (s ** 3)[:, None] * (fld.left @ (fld.right @ between)[:, :, None])[:, :, 0])


def dashpot_columns(fam: Family, fld: Fields, s: Complex) -> Complex:
    """(D, L, S): change of the accelerance per N s/m of dashpots, what it does to each mode's own damping apart (that has its own
    deviation already)."""
    rows = fam.dashpots @ fld.modes.basis[:, :fld.right.shape[1]]
    through = (fld.right @ rows.T)[:, None, :] * (fld.left @ rows.T)                                     # (L, S, D)
    own = fld.left @ (fld.right[:, :, None] * (rows ** 2).T)
    return np.moveaxis(-(s ** 3)[:, None, None] * (through - own), 2, 0)


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
    out[count + fam.modes:fam.moving] = np.moveaxis(-s2[:, None] * damp[:, :, None] * own, 1, 0)
    pushed = fld.left[:, :, :fam.modes] * shape_sizes(fam, fld.modes)
    out[fam.moving:fam.moving + fam.modes] = np.moveaxis(s2[:, None] * pushed, 2, 0)
    if len(fam.dashpots):
        joined = fam.moving + fam.modes + np.arange(len(fam.dashpots))
        out[joined] = fam.dashpot[:, None, None] * dashpot_columns(fam, fld, s)
    out[fam.size - len(fam.pairs[0]):] = _mixing_columns(fam, fld, s, near, turned[0])
    return out


def _mixing_columns(fam: Family, fld: Fields, s: Complex, near: int, turned: tuple[Array, Array]) -> Complex:
    """(pairs, L, S): derivative to the stiffness between the nominal modes of each pair."""
    rows = fam.mixing.T @ fld.modes.basis[:, :fld.right.shape[1]]
    left, right = np.moveaxis(fld.left @ rows.T, 2, 0), (fld.right @ rows.T).T[:, :, None]
    i, j = fam.pairs
    out = left[i] * right[j] + left[j] * right[i]
    still, moving = turned
    low, low_right = fld.left[:, :, :near], fld.right[:, :near]
    A = rows[i, :near, None] * rows[j, None, :near]
    A = A + np.swapaxes(A, 1, 2)
    flat = np.concatenate([np.moveaxis(A * w, 0, 1).reshape(near, -1) for w in (still, moving)], axis=1)     # (near, 2 pairs near)
    turning, moved = np.split((low_right @ flat).reshape(len(s), 2 * len(i), near), 2, axis=1)
    out += np.moveaxis(low @ np.swapaxes(turning + s[:, None, None] * moved, 1, 2), 2, 0)
    return np.asarray(-(s ** 2)[:, None] * out)


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
