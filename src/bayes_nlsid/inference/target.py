"""The log posterior in search coordinates, and how it travels to another process."""

from __future__ import annotations

import io
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY, find_term
from bayes_nlsid.forces.term import Term
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.prior import Prior, check_priors, log_prior


@final
@dataclass(frozen=True, eq=False)
class Target:
    """Log posterior density of s, up to a constant.

    Parameters
    ----------
    likelihood : Likelihood
    priors : tuple of Prior
        In the order of theta.
    """

    likelihood: Likelihood
    priors: tuple[Prior, ...]
    box: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "priors", check_priors(self.problem, self.priors))
        support = np.array([[p.lower for p in self.priors], [p.upper for p in self.priors]]).reshape(2, len(self.priors))
        object.__setattr__(self, "box", self.problem.to_s(np.clip(support, *self.problem.bounds.T)))

    @property
    def problem(self) -> Problem:
        """Bounds, coordinates and names."""
        return self.likelihood.problem

    def parts(self, s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Log density (W,) of s (W, P), and where the likelihood failed although the prior allows the point."""
        out = np.full(len(s), -np.inf)
        failed = np.zeros(len(s), dtype=bool)
        inside = ((s >= self.box[0]) & (s <= self.box[1])).all(axis=1)
        prior = np.full(len(s), -np.inf)
        if inside.any():
            prior[inside] = log_prior(self.problem, self.priors, s[inside])
        allowed = np.isfinite(prior)
        if allowed.any():
            value = self.likelihood.log_likelihood(self.problem.to_theta(s[allowed]))
            failed[allowed] = ~np.isfinite(value)
            out[allowed] = np.where(np.isfinite(value), prior[allowed] + value, -np.inf)
        return out, failed

    def __call__(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (W,) of s (W, P)."""
        return self.parts(np.asarray(s, dtype=float))[0]


def prior_spread(problem: Problem, priors: Sequence[Prior], points: int = 512) -> NDArray[np.float64]:
    """Standard deviation (P,) of each prior in search coordinates, from its quantiles."""
    shares = (np.arange(points) + 0.5) / points
    return problem.to_s(np.stack([p.quantile(shares) for p in priors], axis=-1)).std(axis=0)


class _Pickler(pickle.Pickler):
    """Sends a term of the library as its name: its law may be a function made inside another, which pickle cannot name."""

    def reducer_override(self, obj: Any) -> Any:
        """Name instead of content for library terms."""
        if isinstance(obj, Term) and LIBRARY.get(obj.name) is obj:
            return find_term, (obj.name,)
        return NotImplemented


def pack(target: Target) -> bytes:
    """Bytes of a target for another process.

    Raises
    ------
    ValueError
        If a force law cannot be sent.
    """
    buffer = io.BytesIO()
    try:
        _Pickler(buffer).dump(target)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(f"the model cannot be sent to another process ({error}); use workers=1, or terms of the library") from error
    return buffer.getvalue()


def unpack(content: bytes) -> Target:
    """Target from ``pack``, in a process of this package's own making."""
    target = pickle.loads(content)
    if not isinstance(target, Target):
        raise ValueError(f"expected a Target, got {type(target).__name__}")
    return target
