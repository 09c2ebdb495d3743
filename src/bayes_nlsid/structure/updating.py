"""Linear updating: named parts of stiffness and mass scaled until the model's frequencies are those measured (Section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.structure.identified import IdentifiedModes, pair_modes
from bayes_nlsid.structure.structure import Modes, Structure, mac, modes

FREQUENCY_ERROR = 0.003
"""Relative standard deviation of a frequency that even a right model has: mesh, supports, cables. Added to the measured one."""
PRIOR = 1.0
"""Standard deviation of the logarithm of a multiplier before the data: a factor of e."""
LEARNED = 0.3
"""A parameter whose standard deviation the data reduced by less than this share is called unidentifiable."""


@final
@dataclass(frozen=True)
class Updated:
    """An updated structure.

    Parameters
    ----------
    structure : Structure
    names : tuple of str, length P
    values : ndarray (P,)
        Multipliers of the named parts.
    sd : ndarray (P,)
        Standard deviation of ln(value), from the Jacobian and the prior.
    frequency : ndarray (m,)
        Measured, Hz.
    before, after : ndarray (m,)
        Frequencies of the model, Hz.
    mac_before, mac_after : ndarray (m,)
    pairs : tuple of (int, int)
        Measured mode and elastic mode of the model after updating.
    unidentifiable : tuple of str
        Parameters about which the data say next to nothing.
    status : str
        ``"ok"``, or what to beware of, naming parameters.
    """

    structure: Structure
    names: tuple[str, ...]
    values: NDArray[np.float64]
    sd: NDArray[np.float64]
    frequency: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    mac_before: NDArray[np.float64]
    mac_after: NDArray[np.float64]
    pairs: tuple[tuple[int, int], ...]
    unidentifiable: tuple[str, ...] = ()
    status: str = "ok"


def update(structure: Structure, parameters: Sequence[str] | Mapping[str, Sequence[str]], measured: IdentifiedModes, *,
           prior_sd: float | Mapping[str, float] = PRIOR, frequency_error: float = FREQUENCY_ERROR, rounds: int = 30) -> Updated:
    """Gauss-Newton on logarithms of multipliers, with modes paired anew by frequency and MAC at every step.

    Parameters
    ----------
    structure : Structure
    parameters : sequence of str, or dict of str to sequence of str
        Parts, each with a multiplier of its own, or groups of parts that share one.
    measured : IdentifiedModes
        Their locations must be locations of the structure.
    prior_sd : float or dict
        Standard deviation of the logarithm of each multiplier about 0, for all or by name.
    frequency_error : float
        Relative error of frequencies added to the measured standard deviation.
    rounds : int
        At most so many steps.

    Returns
    -------
    Updated

    Raises
    ------
    ValueError
        If a part is unknown or named twice, or no measured mode has a partner.
    """
    grouped = parameters if isinstance(parameters, Mapping) else {name: (name,) for name in parameters}
    groups = {name: tuple(parts) for name, parts in grouped.items()}
    _check(structure, groups)
    prior = np.array([prior_sd[n] if isinstance(prior_sd, Mapping) else prior_sd for n in groups], dtype=float)
    if (prior <= 0).any() or frequency_error < 0:
        raise ValueError(f"prior_sd must be positive and frequency_error not negative, got {prior_sd} and {frequency_error}")
    rows = structure.rows(measured.locations)
    wanted = max(measured.nominal, default=measured.modes) + 4
    x = np.zeros(len(groups))
    current = structure
    state = _state(current, groups, measured, rows, wanted, frequency_error)
    first, damping = state, 1e-3
    for _ in range(rounds):
        information = state.jacobian.T @ state.jacobian + np.diag(prior**-2)
        gradient = state.jacobian.T @ state.residual + x / prior**2
        step = -np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
        step *= min(1.0, 2.0 / max(np.abs(step).max(), 1e-300))
        trial_structure = structure.scaled(_factors(groups, x + step))
        trial = _state(trial_structure, groups, measured, rows, wanted, frequency_error)
        if _cost(trial, x + step, prior) < _cost(state, x, prior):
            x, state, current, damping = x + step, trial, trial_structure, damping / 5
            if np.abs(step).max() < 1e-6:
                break
        elif np.abs(step).max() < 1e-6 or damping > 1e8:
            break
        else:
            damping *= 10
    return _result(current, groups, x, prior, measured, rows, first, state)


@final
@dataclass(frozen=True)
class _State:
    found: Modes
    pairs: tuple[tuple[int, int], ...]
    residual: NDArray[np.float64]  # (ln model − ln measured) / sd
    jacobian: NDArray[np.float64]  # with respect to ln multipliers


def _check(structure: Structure, groups: Mapping[str, tuple[str, ...]]) -> None:
    named = [part for parts in groups.values() for part in parts]
    unknown = set(named) - set(structure.K_parts) - set(structure.M_parts)
    if not named or unknown:
        raise ValueError(f"unknown parts {sorted(unknown)}; known are {sorted({*structure.K_parts, *structure.M_parts})}")
    if len(set(named)) != len(named):
        raise ValueError(f"parts stand in two groups: {sorted({p for p in named if named.count(p) > 1})}")


def _factors(groups: Mapping[str, tuple[str, ...]], x: NDArray[np.float64]) -> dict[str, float]:
    return {part: float(np.exp(value)) for parts, value in zip(groups.values(), x, strict=True) for part in parts}


def _state(structure: Structure, groups: Mapping[str, tuple[str, ...]], measured: IdentifiedModes, rows: NDArray[np.float64], wanted: int,
           error: float) -> _State:
    found = modes(structure, wanted)
    pairs = pair_modes(measured, found, rows)
    if not pairs:
        raise ValueError("no measured mode has a partner in the model within 30 % in frequency; bring the start values nearer")
    residual, jacobian = np.zeros(measured.modes), np.zeros((measured.modes, len(groups)))
    for i, k in pairs:
        sd = np.hypot(measured.frequency_sd[i] / measured.frequency[i], error)
        phi, square = found.shapes[:, k], found.omega[k] ** 2
        residual[i] = np.log(found.frequency[k] / measured.frequency[i]) / sd
        for j, parts in enumerate(groups.values()):
            # dω²/dx = φᵀ (dK − ω² dM) φ for mass-normalised φ; d ln ω = dω² / (2 ω²).
            change = sum(float(phi @ (structure.K_parts[p] @ phi)) for p in parts if p in structure.K_parts)
            change -= square * sum(float(phi @ (structure.M_parts[p] @ phi)) for p in parts if p in structure.M_parts)
            jacobian[i, j] = change / (2 * square) / sd
    return _State(found, pairs, residual, jacobian)


def _cost(state: _State, x: NDArray[np.float64], prior: NDArray[np.float64]) -> float:
    """Sum of squares; an unpaired mode costs as much as one that is 30 % off."""
    missing = len(state.residual) - len(state.pairs)
    return float(np.sum(state.residual**2) + np.sum((x / prior) ** 2)) + missing * 1e4


def _result(structure: Structure, groups: Mapping[str, tuple[str, ...]], x: NDArray[np.float64], prior: NDArray[np.float64],
            measured: IdentifiedModes, rows: NDArray[np.float64], first: _State, last: _State) -> Updated:
    names = tuple(groups)
    misfit = float(np.sum(last.residual**2)) / max(1, len(last.pairs) - len(names))
    # Where even the best fit misses by more than the stated errors, the errors were too small, and so would be the deviations.
    jacobian = last.jacobian / np.sqrt(max(1.0, misfit))
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.diag(prior**-2))
    sd = np.sqrt(np.diag(covariance))
    vague = tuple(name for name, s, p in zip(names, sd, prior, strict=True) if s > (1 - LEARNED) * p)
    remarks = []
    if vague:
        remarks.append(f"the modes say next to nothing about {', '.join(vague)}; fix or tie them, or measure more modes")
    twins = _collinear(names, covariance)
    if twins:
        remarks.append(f"only combinations are determined of {twins}")
    if misfit > 4:
        remarks.append(f"frequencies still miss by {np.sqrt(misfit):.1f} times their stated error: something else is wrong in the model")
    if len(last.pairs) < measured.modes:
        lost = [f"{measured.frequency[i]:.4g} Hz" for i in range(measured.modes) if i not in dict(last.pairs)]
        remarks.append(f"no partner in the model for {', '.join(lost)}")
    before, mac_before = _table(first, measured, rows)
    after, mac_after = _table(last, measured, rows)
    return Updated(structure, names, np.exp(x), sd, measured.frequency, before, after, mac_before, mac_after, last.pairs, vague,
                   "; ".join(remarks) or "ok")


def _collinear(names: tuple[str, ...], covariance: NDArray[np.float64]) -> str:
    size = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(size, size)
    found = [f"{names[i]} and {names[j]} (correlation {correlation[i, j]:.2f})" for i in range(len(names)) for j in range(i)
             if abs(correlation[i, j]) > 0.95]
    return ", ".join(found)


def _table(state: _State, measured: IdentifiedModes, rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequency (Hz) and MAC of the partner of each measured mode; nan where it has none."""
    frequency, likeness = np.full(measured.modes, np.nan), np.full(measured.modes, np.nan)
    table = mac(measured.shapes, rows @ state.found.shapes)
    for i, k in state.pairs:
        frequency[i], likeness[i] = state.found.frequency[k], table[i, k]
    return frequency, likeness
