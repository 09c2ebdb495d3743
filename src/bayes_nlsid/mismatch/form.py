"""How large the errors of the nominal model's form are: estimated by the marginal likelihood, so that a good model is trusted and a bad
one is not, and differences of cost between hypotheses mean what they say.

Errors of single mode shapes at single sensors have a size mode by mode; detunings, errors at the shaker, dashpots at joints and stiffness
between modes one size each. EM (Dempster, Laird and Rubin 1977) on the equations linearised at the optimum, inverse-gamma priors around
the usual sizes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.linear import Family

Array = NDArray[np.float64]
PSEUDO = 3.0        # sensors that the usual size of shape errors counts for
GROUP_PSEUDO = 1.0  # errors that the usual size of a group counts for
LARGEST = 10.0      # times the usual size of a group: what is larger is no error of form, however well it would fit
LARGEST_SHAPE = 30.0    # the same of one mode's shape: some per cent, as a sensor in the wrong place makes them


def groups(fam: Family) -> tuple[slice, ...]:
    """Where in theta the detunings, errors at the shaker, dashpots and stiffnesses between modes stand; groups without members left out."""
    first, modes = len(fam.names), fam.modes
    edges = [first + 2 * modes, first + 3 * modes, first + 3 * modes + len(fam.dashpots), fam.size]
    found = (slice(first, first + modes), *(slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)))
    return tuple(g for g in found if g.stop > g.start)


def likeliest_groups(fam: Family, theta: Array, normal: Array, gradient: Array, sd: Array, rounds: int = 20) -> Array:
    """Prior sd (P,) of theta with the likeliest size in every group (EM), the rest as it is.

    Parameters
    ----------
    normal : (P + X, P + X), gradient : (P + X,)
        Of the data at ``theta``, priors apart; X further parameters whose prior precision is in ``normal`` already.
    sd : (P,) where to begin.
    """
    count, usual, sd = len(theta), fam.prior_sd, sd.copy()
    target = normal[:, :count] @ theta + gradient
    for _ in range(rounds):
        precision = np.zeros(len(normal))
        precision[:count] = 1 / sd ** 2
        inverse = np.linalg.inv(normal + np.diag(precision))
        best, variance = inverse @ target, np.maximum(np.diag(inverse), 0.0)   # rounding, where a parameter hardly matters
        for g in groups(fam):
            n = g.stop - g.start
            size = np.sqrt((GROUP_PSEUDO * usual[g] ** 2 + (best[g] ** 2 + variance[g]).sum()) / (GROUP_PSEUDO + n))
            sd[g] = np.minimum(size, LARGEST * usual[g])
    return sd


def groups_price(fam: Family, normal: Array, sd: Array) -> float:
    """What sizes other than the usual ones cost: ratio of determinants and the prior of each size; ``normal`` and ``sd`` as above."""
    usual, count = sd.copy(), len(sd)
    price = 0.0
    for g in groups(fam):
        usual[g] = fam.prior_sd[g]
        ratio = float((usual[g.start] / sd[g.start]) ** 2)
        price += GROUP_PSEUDO * (ratio - np.log(ratio) - 1) - (g.stop - g.start) * np.log(ratio)
    if np.array_equal(usual, sd):
        return 0.0
    after, before = normal.copy(), normal.copy()
    after[np.arange(count), np.arange(count)] += 1 / sd ** 2
    before[np.arange(count), np.arange(count)] += 1 / usual ** 2
    return float(price + np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1])


def likeliest_shapes(gram: Array, right: Array, spread: Array, usual: Array, rounds: int = 8) -> Array:
    """Likeliest sd (m,) of shape errors mode by mode (EM), the rest of the model held.

    Parameters
    ----------
    gram : (S, m, m), right : (S, m) of each sensor's columns and residual. spread : (m,) where to begin. usual : (m,).
    """
    for _ in range(rounds):
        inverse = np.linalg.inv(gram + np.eye(len(usual)) / spread ** 2)
        squares = (inverse @ right[..., None])[..., 0] ** 2 + np.einsum("smm->sm", inverse)
        spread = np.minimum(np.sqrt((PSEUDO * usual ** 2 + squares.sum(axis=0)) / (PSEUDO + len(gram))), LARGEST_SHAPE * usual)
    return np.asarray(spread)


def shapes_price(gram: Array, C: Array, spread: Array, usual: Array) -> float:
    """What errors of shapes larger or smaller than usual cost: ratio of determinants and the prior of each variance."""
    if np.array_equal(spread, usual):
        return 0.0
    ratio = (usual / spread) ** 2
    before = np.linalg.slogdet(gram + np.eye(len(usual)) / usual ** 2)[1].sum() + 2 * len(gram) * np.log(usual).sum()
    after = np.linalg.slogdet(C)[1].sum() + 2 * len(gram) * np.log(spread).sum()
    return float(after - before + PSEUDO * (ratio - np.log(ratio) - 1).sum())
