"""Errors of the mode shapes at the sensors: what they change of the response to the shaker, and to forces elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.linear import BEYOND, Attachment, Family, Fields, Modes, receptances, shape_sizes

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def accelerance(fam: Family, modes: Modes, s: Complex, rows: Array, errors: Array | None, attach: tuple[Attachment, ...] = ()
                ) -> Complex:
    """(L, S, J) from forces along ``rows`` to the channels, shape errors included."""
    out = receptances(modes, s, fam.sensors, rows, attach)
    if errors is not None:
        m = fam.modes
        S, b = shape_sizes(fam, modes) * errors[:, :m], (rows @ modes.basis)[:, :m]
        products = (S[:, None, :] * b[None]).reshape(-1, m)
        out = out + ((1 / modes.denominators(s)[:, :m]) @ products.T).reshape(out.shape)
    return np.asarray(s[:, None, None] ** 2 * out)


def shape_columns(fam: Family, fld: Fields, s: Complex) -> Complex:
    """What an error of each mode's shape at each channel changes there (modes + BEYOND, L, S), modes beyond the band in groups.

    Errors of modes in the band are in units of the mode's rms over the sensors, those of groups beyond it relative.
    """
    m = fam.modes
    S = fam.sensors @ fld.modes.basis[:, :fld.right.shape[1]]
    S[:, :m] = shape_sizes(fam, fld.modes)
    each = np.moveaxis((s ** 2)[:, None, None] * fld.right[:, :, None] * S.T[None], 1, 0)
    rest = [each[m + i] if m + i < len(each) else np.zeros_like(each[0]) for i in range(BEYOND - 1)]
    return np.concatenate([each[:m], np.stack([*rest, each[m + BEYOND - 1:].sum(axis=0)])])


def with_shape_errors(fam: Family, fld: Fields, s: Complex, errors: Array) -> Complex:
    """(L, S): accelerance to the shaker's force with errors (S, modes + BEYOND) of the shapes at the sensors."""
    return np.asarray(fld.H + np.einsum("mls,sm->ls", shape_columns(fam, fld, s), errors, optimize=True))
