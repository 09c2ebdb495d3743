"""From a full or reduced structure to the modal model that identification works with (Eq. 8–11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.structure.modal import ASSUMED, ModalModel
from bayes_nlsid.structure.reduction import Reduced, dynamic_flexibility, static_flexibility
from bayes_nlsid.structure.structure import Modes, Structure
from bayes_nlsid.structure.structure import modes as full_modes

if TYPE_CHECKING:
    from bayes_nlsid.structure.identified import IdentifiedModes

UNKNOWN_DAMPING = 1e-3
"""Damping ratio of modes that were not measured (Section 3: 0.1 %)."""


def modal_model(source: Structure | Reduced, modes: int | Sequence[int] = 10, *,
                zeta: float | Sequence[float] | NDArray[np.float64] | IdentifiedModes | None = None, measured_frequencies: bool = False,
                residual: bool = True) -> ModalModel:
    """Elastic modes with the rows of every named location.

    Parameters
    ----------
    source : Structure or Reduced
        A reduced model contributes its own frequencies and shapes; what it lost against the full one is said in the notes.
    modes : int or sequence of int
        The lowest so many elastic modes, or 0-based indices of elastic modes.
    zeta : float, sequence (m,) or IdentifiedModes
        Damping ratios; by default those of the damping matrix C (its diagonal in modal coordinates) if there is one, else 0.1 %. Identified
        modes give theirs, with standard deviation, to the model modes they belong to; the others keep 0.1 %, marked as assumed.
    measured_frequencies : bool
        Take the frequencies of identified modes too, in place of the computed ones.
    residual : bool
        Give the static flexibility of everything outside the modes kept, so that joint motion can be corrected for it.

    Returns
    -------
    ModalModel

    Raises
    ------
    ValueError
        If a mode does not exist, the number of damping ratios differs, or measured frequencies would change the order of the modes.
    """
    index = np.arange(modes) if isinstance(modes, (int, np.integer)) else np.asarray(modes, dtype=int)
    if index.size == 0 or index.min() < 0 or len(set(index.tolist())) != index.size:
        raise ValueError(f"modes must be a positive number or distinct 0-based indices, got {modes}")
    found = _elastic(source, int(index.max()) + 1)
    if isinstance(modes, (int, np.integer)):
        index = index[:len(found.omega)]
    if index.max() >= len(found.omega):
        raise ValueError(f"mode index {index.max()} does not exist: {len(found.omega)} elastic modes were found")
    index = np.sort(index)
    structure = source.structure if isinstance(source, Reduced) else source
    names = tuple(structure.locations)
    rows = structure.rows(names)
    shapes = rows @ found.shapes[:, index]
    G = None
    if residual:
        total = static_flexibility(structure, rows, None if isinstance(source, Reduced) else found.rigid)
        G = total - (shapes / found.omega[index] ** 2) @ shapes.T
    notes = (*structure.notes, *(_reduction_notes(source) if isinstance(source, Reduced) else ()),
             *((f"{found.rigid.shape[1]} rigid-body modes removed",) if found.rigid.shape[1] else ()))
    model = ModalModel(found.omega[index], np.full(index.size, UNKNOWN_DAMPING), names, shapes, sensors=structure.sensors,
                       inputs=structure.inputs, joints=structure.joints, zeta_sd=np.full(index.size, ASSUMED), residual=G, notes=notes)
    if structure.joints and residual:
        model = _with_note(model, _lost_at_joints(structure, model))
    if zeta is None:
        if structure.C is None:
            return model
        phi = found.shapes[:, index]
        zeta = np.einsum("ij,ij->j", phi, structure.C @ phi) / (2 * found.omega[index])
    return with_damping(model, zeta, measured_frequencies)


def with_damping(model: ModalModel, zeta: float | Sequence[float] | NDArray[np.float64] | IdentifiedModes,
                 measured_frequencies: bool = False) -> ModalModel:
    """The model with other damping ratios, and optionally measured frequencies; see `modal_model`.

    Raises
    ------
    ValueError
        If the ratios are negative or not one for each mode, or measured frequencies are asked of plain numbers.
    """
    from bayes_nlsid.structure.identified import IdentifiedModes, pair

    if not isinstance(zeta, IdentifiedModes):
        values = np.broadcast_to(np.asarray(zeta, dtype=float), (model.modes,)) if np.ndim(zeta) == 0 else np.asarray(zeta, dtype=float)
        if values.shape != (model.modes,) or (values < 0).any():
            raise ValueError(f"zeta has shape {values.shape}, expected one non-negative ratio or {(model.modes,)}")
        if measured_frequencies:
            raise ValueError("measured_frequencies needs identified modes as zeta")
        return replace(model, zeta=values.copy(), zeta_sd=np.zeros(model.modes))
    omega, ratio = model.omega.copy(), model.zeta.copy()
    omega_sd, zeta_sd = model.omega_sd.copy(), model.zeta_sd.copy()
    pairs = pair(zeta, model)
    for measured, k in pairs:
        ratio[k], zeta_sd[k] = zeta.zeta[measured], zeta.zeta_sd[measured] / zeta.zeta[measured]
        if measured_frequencies:
            omega[k], omega_sd[k] = 2 * np.pi * zeta.frequency[measured], zeta.frequency_sd[measured] / zeta.frequency[measured]
    if (np.diff(omega) < 0).any():
        raise ValueError("measured frequencies would change the order of the modes; update the model first, or measure the missing modes")
    done = ", ".join(f"{k + 1}" for k in sorted(k for _, k in pairs))
    note = f"modes {done} have measured damping{' and frequency' if measured_frequencies else ''}, others keep theirs"
    return _with_note(replace(model, omega=omega, zeta=ratio, omega_sd=omega_sd, zeta_sd=zeta_sd), note)


def joint_flexibility_ratio(structure: Structure, model: ModalModel, frequency: float = 0.0) -> NDArray[np.float64]:
    """How much of each joint's own flexibility the modes carry: 1 is all of it, 10–12 modes often carry 0.2–0.4.

    Parameters
    ----------
    structure : Structure
    model : ModalModel
        Without its residual flexibility.
    frequency : float
        Hz, away from resonances; 0 for statics.

    Returns
    -------
    ndarray (number of joints,)
        Ratio of the diagonal of the flexibility, modes over full model; nan where a joint is rigid.
    """
    rows = structure.rows(structure.joints)
    full = static_flexibility(structure, rows) if frequency == 0 else dynamic_flexibility(structure, rows, frequency)
    shapes = model.rows(structure.joints)
    kept = np.einsum("jm,jm,m->j", shapes, shapes, 1 / (model.omega**2 - (2 * np.pi * frequency) ** 2))
    whole = np.diag(full)
    return np.divide(kept, whole, out=np.full(len(kept), np.nan), where=np.abs(whole) > 0)


def _elastic(source: Structure | Reduced, count: int) -> Modes:
    return source.modes(count) if isinstance(source, Reduced) else full_modes(source, count)


def _lost_at_joints(structure: Structure, model: ModalModel) -> str:
    residual = model.residual
    assert residual is not None
    shapes = model.rows(structure.joints)
    kept = np.einsum("jm,jm,m->j", shapes, shapes, 1 / model.omega**2)
    places = [model.locations.index(name) for name in structure.joints]
    share = kept / np.maximum(kept + residual[places, places], np.finfo(float).tiny)
    parts = ", ".join(f"{name} {100 * s:.0f} %" for name, s in zip(structure.joints, share, strict=True))
    return f"share of each joint's static flexibility carried by the {model.modes} modes: {parts}; the rest is in the residual flexibility"


def _reduction_notes(reduced: Reduced) -> tuple[str, ...]:
    last = reduced.history[-1]
    return (f"reduced to {reduced.size} coordinates by {reduced.method}: worst frequency error {100 * last.worst:.2g} %, least MAC "
            f"{last.mac.min():.4f}, condition {reduced.condition:.2g}, {reduced.status}", *reduced.notes)


def _with_note(model: ModalModel, note: str) -> ModalModel:
    return replace(model, notes=(*model.notes, note))
