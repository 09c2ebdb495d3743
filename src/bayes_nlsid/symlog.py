"""Bi-symmetric logarithm: coordinates in which a parameter of any sign and size is of order one (Eq. 14)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def forward(p: ArrayLike, c: ArrayLike = 1.0) -> NDArray[np.float64]:
    """Symlog of a parameter, s = sign(p) log10(1 + |p|/c) (Eq. 14a).

    Parameters
    ----------
    p : array_like
        Parameters, any unit and any finite size.
    c : array_like
        Scale below which s is linear in p, same unit; positive, broadcasts against ``p``.

    Returns
    -------
    ndarray
        Dimensionless, broadcast shape.

    Raises
    ------
    ValueError
        If ``c`` is not positive and finite.

    Notes
    -----
    Where |p|/c would overflow, log10(|p|) − log10(c) is used: the 1 is then below rounding anyway.
    """
    value, scale = np.asarray(p, dtype=float), _scale(c)
    size = np.abs(value)
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        ratio = size / scale
        s = np.log1p(ratio) / np.log(10.0)
        huge = np.log10(size) - np.log10(scale)
    return np.asarray(np.copysign(np.where(np.isinf(ratio) & np.isfinite(size), huge, s), value))


def inverse(s: ArrayLike, c: ArrayLike = 1.0) -> NDArray[np.float64]:
    """Parameter of a symlog coordinate, p = sign(s) c (10^|s| − 1) (Eq. 14b).

    Parameters
    ----------
    s : array_like
        Dimensionless.
    c : array_like
        Scale, unit of the parameter; positive, broadcasts against ``s``.

    Returns
    -------
    ndarray
        Parameters; infinite beyond the range of double precision.

    Raises
    ------
    ValueError
        If ``c`` is not positive and finite.
    """
    value, scale = np.asarray(s, dtype=float), _scale(c)
    size = np.abs(value)
    with np.errstate(over="ignore", under="ignore"):
        plain = scale * np.expm1(size * np.log(10.0))
        # 10^s alone overflows at s = 308 even where a small c makes the product finite.
        shifted = 10.0 ** (size + np.log10(scale))
    return np.asarray(np.copysign(np.where(size < 300.0, plain, shifted), value))


def log_jacobian(s: ArrayLike, c: ArrayLike = 1.0) -> NDArray[np.float64]:
    """Log of the derivative, ln|dp/ds| = ln(c ln 10) + |s| ln 10: what a density must gain when it is written in s.

    Parameters
    ----------
    s : array_like
        Dimensionless.
    c : array_like
        Scale, unit of the parameter; positive, broadcasts against ``s``.

    Returns
    -------
    ndarray
        Natural logarithm, broadcast shape.

    Raises
    ------
    ValueError
        If ``c`` is not positive and finite.
    """
    ten = np.log(10.0)
    return np.asarray(np.log(_scale(c)) + np.log(ten) + np.abs(np.asarray(s, dtype=float)) * ten)


def _scale(c: ArrayLike) -> NDArray[np.float64]:
    scale = np.asarray(c, dtype=float)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise ValueError(f"c must be positive and finite everywhere, got {c!r}; it is the size below which symlog is linear")
    return scale
