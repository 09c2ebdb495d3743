"""Priors, stated in the physical parameter and its unit, truncated at the bounds.

The search coordinate (symlog, log10) is only a coordinate: a density that is flat in symlog would depend on the unit through its
constant c. So every prior is a density of the physical parameter, and ``log_prior`` adds log |dtheta/ds|; the posterior then does not
depend on c.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, log_ndtr, logit, ndtr, ndtri

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.structure.modal import ASSUMED

Kind = Literal["normal", "lognormal", "uniform", "loguniform", "halfnormal", "logitnormal"]
KINDS = ("normal", "lognormal", "uniform", "loguniform", "halfnormal", "logitnormal")
SPACE = "density of the physical parameter in its unit, cut at its bounds; search coordinates (symlog, log10) bring their Jacobian along"
SHARE = 0.1        # a term as large as a tenth of the whole linear force, one standard deviation
Array = NDArray[np.float64]


@final
@dataclass(frozen=True)
class Prior:
    """Prior of one parameter.

    Parameters
    ----------
    name, unit : str
    kind : str
        ``normal`` (mean a, sd b), ``lognormal`` (median a, sd of the natural logarithm b), ``uniform`` and ``loguniform`` (over the
        bounds), ``halfnormal`` (scale b, from 0), ``logitnormal`` (of (p − lower)/(upper − lower): logit has mean a, sd b).
    lower, upper : float
        Bounds at which the density is cut and renormalised.
    a, b : float

    Raises
    ------
    ValueError
        If the kind is unknown, the bounds are empty or do not suit it, or b is not positive where needed.
    """

    name: str
    unit: str
    kind: Kind
    lower: float
    upper: float
    a: float = 0.0
    b: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"prior of {self.name!r}: kind must be one of {KINDS}, not {self.kind!r}")
        if not (np.isfinite([self.lower, self.upper]).all() and self.lower < self.upper):
            raise ValueError(f"prior of {self.name!r}: bounds {self.lower}, {self.upper} must be finite and ascending")
        if self.kind in ("lognormal", "loguniform") and not (self.lower > 0 and (self.kind == "loguniform" or self.a > 0)):
            raise ValueError(f"prior of {self.name!r}: {self.kind} needs a positive lower bound and median, got {self.lower}, {self.a}")
        if self.kind == "halfnormal" and self.lower < 0:
            raise ValueError(f"prior of {self.name!r}: halfnormal needs a lower bound of at least 0, got {self.lower}")
        if not self.b > 0:
            raise ValueError(f"prior of {self.name!r}: b must be positive, got {self.b}")
        low, high = self._edges
        if self.kind not in ("uniform", "loguniform") and ndtr(high) - ndtr(low) < 1e-12 and log_ndtr(-abs(low)) < -30:
            raise ValueError(f"prior of {self.name!r}: almost all of it lies outside its bounds [{self.lower}, {self.upper}]")

    def _forward(self, p: Array) -> Array:
        """The variable in which the density is normal or uniform, standardised."""
        with np.errstate(divide="ignore", invalid="ignore"):
            match self.kind:
                case "normal" | "halfnormal":
                    return (p - (self.a if self.kind == "normal" else 0.0)) / self.b
                case "lognormal":
                    return (np.log(p) - np.log(self.a)) / self.b
                case "loguniform":
                    return np.log(p)
                case "logitnormal":
                    return (logit((p - self.lower) / (self.upper - self.lower)) - self.a) / self.b
        return p

    @cached_property
    def _edges(self) -> tuple[float, float]:
        low, high = self._forward(np.array([self.lower, self.upper]))
        return float(low), float(high)

    @cached_property
    def _constant(self) -> float:
        """Logarithm of what normalises the density in the standardised variable."""
        low, high = self._edges
        if self.kind in ("uniform", "loguniform"):
            return float(-np.log(high - low))
        return float(-0.5 * np.log(2 * np.pi) - np.log(self.b) - _log_mass(low, high))

    def log_density(self, p: ArrayLike) -> Array:
        """Natural logarithm of the density, 1/unit; −inf outside the bounds."""
        values = np.asarray(p, dtype=float)
        inside = (values >= self.lower) & (values <= self.upper)
        safe = np.where(inside, values, 0.5 * (self.lower + self.upper))
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind in ("uniform", "loguniform"):
                log = np.full(values.shape, self._constant)
            else:
                log = self._constant - 0.5 * self._forward(safe) ** 2
            if self.kind in ("lognormal", "loguniform"):
                log = log - np.log(safe)
            if self.kind == "logitnormal":
                log = log - np.log((safe - self.lower) * (self.upper - safe) / (self.upper - self.lower))
        return np.where(inside & np.isfinite(log), log, -np.inf)

    def quantile(self, probability: ArrayLike) -> Array:
        """Parameter value below which the given share of the prior lies."""
        share = np.asarray(probability, dtype=float)
        low, high = self._edges
        if self.kind in ("uniform", "loguniform"):
            z = low + share * (high - low)
        elif low > 0:     # work in the far tail where the normal distribution has digits
            z = -ndtri(ndtr(-low) + share * (ndtr(-high) - ndtr(-low)))
        else:
            z = ndtri(ndtr(low) + share * (ndtr(high) - ndtr(low)))
        back: dict[str, Callable[[Array], Array]] = {
            "normal": lambda x: self.a + self.b * x, "halfnormal": lambda x: self.b * x, "uniform": lambda x: x, "loguniform": np.exp,
            "lognormal": lambda x: self.a * np.exp(self.b * x),
            "logitnormal": lambda x: self.lower + (self.upper - self.lower) * expit(self.a + self.b * x)}
        return np.clip(back[self.kind](z), self.lower, self.upper)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draws (count,)."""
        return self.quantile(rng.uniform(size=count))

    @property
    def sentence(self) -> str:
        """The prior in words, with its 5 % and 95 % points in SI."""
        low, high = self.quantile([0.05, 0.95])
        # digits enough to show the width of a narrow one
        digits = int(np.clip(np.ceil(np.log10(max(abs(low), abs(high)) / max(high - low, 1e-300))) + 2, 3, 9))
        return f"{self.name}: {self.kind}, 90 % between {low:.{digits}g} and {high:.{digits}g} {self.unit}".rstrip()


def _log_mass(low: float, high: float) -> float:
    """log of the standard normal probability between two points."""
    if low > 0:
        low, high = -high, -low
    top, bottom = float(log_ndtr(high)), float(log_ndtr(low))
    return top + float(np.log1p(-np.exp(bottom - top))) if np.isfinite(bottom) else top


def default_priors(problem: Problem) -> tuple[Prior, ...]:
    """A prior for every entry of theta.

    Frequencies and damping ratios: normal around the modal test with its own standard deviation (``omega_sd``, ``zeta_sd``), or half the
    bound where none is stated, and log-uniform where the value was only assumed. The gain of the force: log-uniform. Signed
    coefficients: normal around 0 with a tenth of the bound, i.e. a force of a tenth of the whole linear force; the bound alone, a force as
    large as everything linear, is far too generous. Stiffnesses, forces, displacements and velocities: log-uniform over the bounds. Ranges:
    uniform if they include 0 or span less than two decades, else log-uniform.
    """
    linear = problem.model.linear
    out = []
    for parameter, (low, high) in zip(problem.model.parameters, problem.bounds.tolist(), strict=True):
        name, unit = parameter.name, parameter.unit
        if name == "gain":
            out.append(Prior(name, unit, "loguniform", low, high))
        elif parameter.param is None:
            damping = name.startswith("zeta")
            nominal = float((linear.zeta if damping else linear.frequency)[parameter.mode])
            relative = float((linear.zeta_sd if damping else linear.omega_sd)[parameter.mode])
            if relative >= ASSUMED:
                out.append(Prior(name, unit, "loguniform", low, high))
                continue
            out.append(Prior(name, unit, "normal", low, high, nominal, relative * nominal if relative > 0 else (high - low) / 4))
        elif parameter.param.rule == "coefficient":
            out.append(Prior(name, unit, "normal", low, high, 0.0, SHARE * high))
        elif low > 0 and (parameter.param.rule != "range" or high > 100 * low):
            out.append(Prior(name, unit, "loguniform", low, high))
        else:
            out.append(Prior(name, unit, "uniform", low, high))
    return tuple(out)


def check_priors(problem: Problem, priors: Sequence[Prior]) -> tuple[Prior, ...]:
    """Priors in the order of theta.

    Raises
    ------
    ValueError
        If one is missing, unknown or reaches outside the bounds of its parameter.
    """
    named = {p.name: p for p in priors}
    if len(named) != len(priors) or set(named) != set(problem.names):
        raise ValueError(f"priors are given for {sorted(p.name for p in priors)}, but theta is {', '.join(problem.names)}")
    for name, (low, high) in zip(problem.names, problem.bounds.tolist(), strict=True):
        slack = 1e-9 * (high - low)
        if named[name].lower < low - slack or named[name].upper > high + slack:
            raise ValueError(f"prior of {name!r} reaches outside its bounds [{low}, {high}]; widen the problem or cut the prior")
    return tuple(named[name] for name in problem.names)


def log_prior(coordinates: Coordinates, priors: Sequence[Prior], s: ArrayLike, theta: Array | None = None) -> Array:
    """Log density (...) of search coordinates s (..., P): priors of theta plus log |dtheta/ds|. ``theta`` saves working it out again."""
    values = np.asarray(s, dtype=float)
    physical = coordinates.to_theta(values) if theta is None else theta
    out = np.sum(coordinates.log_jacobian(values), axis=-1)
    for i, prior in enumerate(priors):
        p = physical[..., i]
        # Rounding on the way back from s must not throw a point out that sits on its bound.
        slack = 1e-12 * (prior.upper - prior.lower)
        inside = (p >= prior.lower - slack) & (p <= prior.upper + slack)
        out = out + np.where(inside, prior.log_density(np.clip(p, prior.lower, prior.upper)), -np.inf)
    return np.asarray(out)


def sampling_coordinates(problem: Problem, priors: Sequence[Prior]) -> Coordinates:
    """Coordinates to sample in: those of the problem, but with c of a signed parameter at least the standard deviation of its prior.

    The posterior does not depend on c, the sampler does: with a small c a coefficient that may be zero has two branches, many decades of
    emptiness apart, where in these coordinates it is one bell.
    """
    wide = np.array([float(p.quantile((np.arange(256) + 0.5) / 256).std()) for p in priors])
    return Coordinates(np.where(problem.scale > 0, np.maximum(problem.scale, wide), 0.0))
