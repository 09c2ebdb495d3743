"""The nominal model of a case, reduced to the Ritz basis on which its family lives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.case import Case
from bayes_nlsid.mismatch.linear import ABOVE, Family

Array = NDArray[np.float64]


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
    own = max(1, min(int(np.searchsorted(frequencies, ABOVE * case.band[1])), T.shape[1]))
    sd = np.array([_scale_sd(case, n) for n in case.K_parts] + [case.tolerances["rho_rel_sd"]] * len(M_parts))
    rows = case.sensor_rows[case.usable]
    single = _single(K_parts)
    links = np.array([case.places[names[i]] @ T for i in single if names[i] in case.places]).reshape(-1, T.shape[1])
    return Family(names, K_parts, M_parts, T.T @ case.K @ T - K_parts.sum(0), T.T @ case.M @ T - M_parts.sum(0), rows @ T,
                  case.shaker @ T, -(case.M @ case.base) @ T, rows @ case.base,
                  {k: v @ T for k, v in case.places.items()}, {k: v @ T for k, v in case.mass_points.items()},
                  sd, own, case.damping, single,
                  case.sensor_rows[~case.usable] @ T, _mixing(T.T @ case.M @ low, frequencies, own), links,
                  _doubling(case, frequencies, links @ (T.T @ case.M @ low)),
                  damping_sd=max(0.25, case.tolerances["damping_rel_sd"]))


def _mixing(rows: Array, frequencies: Array, modes: int) -> Array:
    """(n, modes + 1): M φ ω; zero where there is no further mode."""
    out = np.zeros((len(rows), modes + 1))
    known = min(modes + 1, rows.shape[1])
    out[:, :known] = rows[:, :known] * (2 * np.pi * frequencies[:known])
    return out


def _doubling(case: Case, frequencies: Array, rows: Array) -> Array:
    """(D,): N s/m at which a dashpot along each row (D, modes) doubles the nominal damping of the mode in the band it affects most."""
    inside = frequencies < ABOVE * case.band[1]
    added = rows[:, inside] ** 2 / (4 * np.pi * frequencies[inside])
    return np.asarray(case.damping / np.maximum(added.max(axis=1, initial=0.0), 1e-300))


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
