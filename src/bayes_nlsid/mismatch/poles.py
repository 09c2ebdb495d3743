"""Poles of a measured transfer function, and physical parameters that put the nominal modes there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.linear import Family, solve

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def modal_start(fam: Family, s: Complex, measured: Complex, variance: Array) -> Array | None:
    """Physical parameters from the poles of the measurement, paired with the nominal modes by MAC; None if no pole was found."""
    nominal = solve(fam, np.zeros(fam.size))
    inside = (nominal.omega < np.abs(s).max() * 1.02) & (nominal.omega > np.abs(s).min() * 0.6)
    index = np.flatnonzero(inside)
    if len(index) == 0:
        return None
    first = nominal.omega[index] * (-nominal.zeta[index] + 1j)
    poles, residues = vector_fit(s, measured / s[:, None] ** 2, variance / np.abs(s[:, None]) ** 4, first)
    pairs = pair(fam, poles, residues, nominal.omega[index], nominal.basis[:, index])
    if len(pairs) < max(2, len(index) // 3):
        return None
    theta = np.zeros(fam.size)
    count = len(fam.names)
    for _ in range(15):
        modes = solve(fam, theta)
        rows, errors = [], []
        for mode, pole in pairs:
            target = _follow(modes.basis, fam, nominal.basis[:, index[mode]], modes.omega)
            phi = modes.basis[:, target]
            scale = np.exp(theta[:count])
            k = np.einsum("pij,i,j->p", fam.K_parts, phi, phi)
            m = np.einsum("pij,i,j->p", fam.M_parts, phi, phi)
            rows.append(0.5 * scale * np.concatenate([k / modes.omega[target] ** 2, -m]))
            errors.append(np.log(np.abs(pole) / modes.omega[target]))
        A, e = np.array(rows), np.array(errors)
        weight = 1 / np.maximum(0.004, 0.1 * np.abs(e)) ** 2
        normal = (A.T * weight) @ A + np.diag(1 / fam.scale_sd ** 2)
        step = np.linalg.solve(normal, (A.T * weight) @ e - theta[:count] / fam.scale_sd ** 2)
        theta[:count] += np.clip(step, -0.7, 0.7)
        if np.abs(step).max() < 1e-3:
            break
    for mode, pole in pairs:
        if index[mode] < fam.modes:
            zeta = max(-pole.real / np.abs(pole), 1e-4)
            theta[count + fam.modes + index[mode]] = np.clip(np.log(zeta / fam.damping), -0.6, 0.6)
    return theta


def _follow(basis: Array, fam: Family, shape: Array, omega: Array) -> int:
    """The current mode that is most like a nominal one (over all Ritz coordinates; the basis is nearly orthonormal in mass)."""
    M = fam.M_parts.sum(0) + fam.M_rest
    return int(np.argmax(np.abs(basis.T @ (M @ shape))))


def vector_fit(s: Complex, H: Complex, variance: Array, poles: Complex, rounds: int = 12) -> tuple[Complex, Complex]:
    """Common poles and residues of receptances (Gustavsen and Semlyen 1999, relaxed real form by conjugate pairs).

    Returns
    -------
    poles (n,) with positive imaginary part, residues (n, S)
    """
    weight = 1 / np.sqrt(variance + (0.02 * np.abs(H)) ** 2)
    L, S = H.shape
    for _ in range(rounds):
        basis = _partial_fractions(s, poles)
        n = basis.shape[1]
        own = np.concatenate([basis, np.ones((L, 1)), 1 / s[:, None] ** 2], axis=1)
        blocks, rights = [], []
        for i in range(S):
            w = weight[:, i, None]
            A = np.concatenate([own * w, -basis * (H[:, i, None] * w)], axis=1)
            b = H[:, i] * weight[:, i]
            A, b = np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag])
            scale = np.linalg.norm(A, axis=0) + 1e-300
            q, r = np.linalg.qr(A / scale)
            keep = own.shape[1]
            blocks.append(r[keep:, keep:] / (1 / scale[keep:]))
            rights.append((q.T @ b)[keep:])
        A, b = np.concatenate(blocks), np.concatenate(rights)
        norm = np.linalg.norm(A, axis=0) + 1e-300
        c = np.linalg.lstsq(A / norm, b, rcond=None)[0] / norm
        companion = np.zeros((n, n))
        drive = np.zeros(n)
        for k, p in enumerate(poles):
            companion[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[p.real, p.imag], [-p.imag, p.real]]
            drive[2 * k] = 2
        roots = np.linalg.eigvals(companion - np.outer(drive, c))
        roots = roots[roots.imag > 1e-3 * np.abs(roots)]
        roots = -np.abs(roots.real) + 1j * roots.imag
        if len(roots) == 0:
            break
        moved = len(roots) == len(poles) and np.allclose(np.sort_complex(roots), np.sort_complex(poles), rtol=1e-6)
        poles = roots
        if moved:
            break
    basis = _partial_fractions(s, poles)
    own = np.concatenate([basis, np.ones((L, 1)), 1 / s[:, None] ** 2], axis=1)
    residues = np.empty((len(poles), S), dtype=complex)
    for i in range(S):
        w = weight[:, i]
        A, b = own * w[:, None], H[:, i] * w
        A, b = np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag])
        scale = np.linalg.norm(A, axis=0) + 1e-300
        x = np.linalg.lstsq(A / scale, b, rcond=None)[0] / scale
        residues[:, i] = x[:2 * len(poles):2] + 1j * x[1:2 * len(poles):2]
    return poles, residues


def _partial_fractions(s: Complex, poles: Complex) -> Complex:
    """(L, 2n): for every pair 1/(s−p) + 1/(s−p*) and i/(s−p) − i/(s−p*)."""
    a, b = 1 / (s[:, None] - poles), 1 / (s[:, None] - poles.conj())
    out = np.empty((len(s), 2 * len(poles)), dtype=complex)
    out[:, 0::2], out[:, 1::2] = a + b, 1j * a - 1j * b
    return out


def pair(fam: Family, poles: Complex, residues: Complex, omega: Array, basis: Array) -> list[tuple[int, complex]]:
    """Nominal mode (index into ``omega``) and pole of every pair that agrees in shape (MAC) and lies within 25 % in frequency."""
    shapes = (fam.sensors @ basis) * (fam.shaker @ basis)
    candidates = []
    for k, p in enumerate(poles):
        zeta = -p.real / np.abs(p)
        if zeta > 0.2:
            continue
        # residue of a mode is φ_s φ_f / (2 i ω): its imaginary part carries the shape
        measured = residues[k].imag
        for i in range(len(omega)):
            detune = np.log(np.abs(p) / omega[i])
            mac = (measured @ shapes[:, i]) ** 2 / max((measured @ measured) * (shapes[:, i] @ shapes[:, i]), 1e-300)
            if np.abs(detune) < 0.25 and mac > 0.5:
                candidates.append((mac - 2.0 * np.abs(detune), i, k))
    out, seen_i, seen_k = [], set(), set()
    for _, i, k in sorted(candidates, reverse=True):
        if i not in seen_i and k not in seen_k:
            out.append((i, complex(poles[k])))
            seen_i.add(i)
            seen_k.add(k)
    return out
