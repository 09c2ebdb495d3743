"""Priors, stated in the physical parameter and its unit, truncated at the bounds.

The search coordinate (symlog, log10) is only a coordinate: a density that is flat in symlog would depend on the unit through its
constant c. So every prior is a density of the physical parameter, and ``log_prior`` adds log |dtheta/ds|; the posterior then does not
depend on c. Parameters of nominally equal joints may share a common value that is not known either (``pooling``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, log_ndtr, logit, ndtr, ndtri

from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.inference.pooling import Pool
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
    group : str
        Name shared by the same parameter of nominally equal joints; the above then is the prior of their common value. Density and
        quantiles of such a prior are those of one joint by itself; ``log_prior`` knows the group.
    scatter : float
        Scale of the half-normal prior of the standard deviation between the joints of a group: of the natural logarithm (lognormal,
        loguniform), of the logit (logitnormal), else in the unit of the parameter. 0 outside groups.

    Raises
    ------
    ValueError
        If the kind is unknown, the bounds are empty or do not suit it, b is not positive where needed, or group and scatter do not come
        together.
    """

    name: str
    unit: str
    kind: Kind
    lower: float
    upper: float
    a: float = 0.0
    b: float = 1.0
    group: str = ""
    scatter: float = 0.0

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
        if not 0 <= self.scatter < np.inf or bool(self.group) != (self.scatter > 0):
            raise ValueError(f"prior of {self.name!r}: a group needs a positive scatter and a scatter a group, got {self.group!r}, "
                             f"{self.scatter}")
        low, high = self._edges
        if self.kind not in ("uniform", "loguniform") and ndtr(high) - ndtr(low) < 1e-12 and log_ndtr(-abs(low)) < -30:
            raise ValueError(f"prior of {self.name!r}: almost all of it lies outside its bounds [{self.lower}, {self.upper}]")

    def variable(self, p: Array) -> Array:
        """The variable in which the density is normal or uniform: the parameter, its logarithm or its logit."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind in ("lognormal", "loguniform"):
                return np.asarray(np.log(p))
            return np.asarray(logit((p - self.lower) / (self.upper - self.lower))) if self.kind == "logitnormal" else np.asarray(p)

    def value(self, z: Array) -> Array:
        """The parameter of that variable, within the bounds."""
        if self.kind == "logitnormal":
            return np.asarray(self.lower + (self.upper - self.lower) * expit(z))
        return np.clip(np.exp(z) if self.kind in ("lognormal", "loguniform") else z, self.lower, self.upper)

    def log_slope(self, p: Array) -> Array:
        """log |dz/dp| of that variable."""
        with np.errstate(divide="ignore", invalid="ignore"):
            match self.kind:
                case "lognormal" | "loguniform":
                    return np.asarray(-np.log(p))
                case "logitnormal":
                    return np.asarray(-np.log((p - self.lower) * (self.upper - p) / (self.upper - self.lower)))
        return np.zeros(np.shape(p))

    def _forward(self, p: Array) -> Array:
        """The variable in which the density is normal or uniform, standardised."""
        z = self.variable(p)
        return z if self.kind in ("uniform", "loguniform") else (z - self.middle) / self.b

    @property
    def middle(self) -> float:
        """Mean of a normal distribution in that variable, before the bounds cut it."""
        if self.kind == "lognormal":
            return float(np.log(self.a))
        return 0.0 if self.kind == "halfnormal" else self.a

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
        if self.scatter:
            log = pool((self,)).log_density(self.variable(safe)[..., None])
        elif self.kind in ("uniform", "loguniform"):
            log = np.full(values.shape, self._constant)
        else:
            with np.errstate(divide="ignore", invalid="ignore"):
                log = self._constant - 0.5 * self._forward(safe) ** 2
        log = log + self.log_slope(safe)
        return np.where(inside & np.isfinite(log), log, -np.inf)

    def quantile(self, probability: ArrayLike) -> Array:
        """Parameter value below which the given share of the prior lies."""
        share = np.asarray(probability, dtype=float)
        if self.scatter:
            return self.value(pool((self,)).quantile(share))
        low, high = self._edges
        if self.kind in ("uniform", "loguniform"):
            return self.value(low + share * (high - low))
        if low > 0:     # work in the far tail where the normal distribution has digits
            z = -ndtri(ndtr(-low) + share * (ndtr(-high) - ndtr(-low)))
        else:
            z = ndtri(ndtr(low) + share * (ndtr(high) - ndtr(low)))
        return self.value(self.middle + self.b * z)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draws (count,)."""
        return self.quantile(rng.uniform(size=count))

    @property
    def sentence(self) -> str:
        """The prior in words, with its 5 % and 95 % points in SI."""
        low, high = self.quantile([0.05, 0.95])
        # digits enough to show the width of a narrow one
        digits = int(np.clip(np.ceil(np.log10(max(abs(low), abs(high)) / max(high - low, 1e-300))) + 2, 3, 9))
        said = f"{self.name}: {self.kind}, 90 % between {low:.{digits}g} and {high:.{digits}g} {self.unit}".rstrip()
        return f"{said}; scatters around a value common to {self.group}" if self.group else said


def _log_mass(low: float, high: float) -> float:
    """log of the standard normal probability between two points."""
    if low > 0:
        low, high = -high, -low
    top, bottom = float(log_ndtr(high)), float(log_ndtr(low))
    return top + float(np.log1p(-np.exp(bottom - top))) if np.isfinite(bottom) else top


@lru_cache(maxsize=256)
def pool(members: tuple[Prior, ...]) -> Pool:
    """The joint prior of the parameters of one group."""
    first = members[0]
    box = np.array([p.variable(np.array([p.lower, p.upper])) for p in members])
    return Pool(first.scatter, box) if first.kind in ("uniform", "loguniform") else Pool(first.scatter, box, first.middle, first.b)


def groups(priors: Sequence[Prior]) -> dict[str, tuple[int, ...]]:
    """Places of the members of every group."""
    found: dict[str, list[int]] = {}
    for i, prior in enumerate(priors):
        if prior.group:
            found.setdefault(prior.group, []).append(i)
    return {name: tuple(places) for name, places in found.items()}


def sample_priors(priors: Sequence[Prior], count: int, rng: np.random.Generator) -> Array:
    """Draws (count, P) of all parameters; those of a group belong together."""
    out = np.empty((count, len(priors)))
    for i, prior in enumerate(priors):
        if not prior.group:
            out[:, i] = prior.sample(count, rng)
    for places in groups(priors).values():
        members = tuple(priors[i] for i in places)
        z = pool(members).sample(count, rng)
        out[:, places] = np.stack([p.value(x) for p, x in zip(members, z.T, strict=True)], axis=1)
    return out


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
        If one is missing, unknown or reaches outside the bounds of its parameter, or those of a group differ.
    """
    named = {p.name: p for p in priors}
    if len(named) != len(priors) or set(named) != set(problem.names):
        raise ValueError(f"priors are given for {sorted(p.name for p in priors)}, but theta is {', '.join(problem.names)}")
    for name, (low, high) in zip(problem.names, problem.bounds.tolist(), strict=True):
        slack = 1e-9 * (high - low)
        if named[name].lower < low - slack or named[name].upper > high + slack:
            raise ValueError(f"prior of {name!r} reaches outside its bounds [{low}, {high}]; widen the problem or cut the prior")
    for group, places in groups([named[name] for name in problem.names]).items():
        members = [named[problem.names[i]] for i in places]
        if len({(p.kind, p.a, p.b, p.scatter, p.unit, *((p.lower, p.upper) if p.kind == "logitnormal" else ())) for p in members}) > 1:
            raise ValueError(f"priors of group {group!r} differ; they are one prior, of the common value")
    return tuple(named[name] for name in problem.names)


def log_prior(coordinates: Coordinates, priors: Sequence[Prior], s: ArrayLike, theta: Array | None = None) -> Array:
    """Log density (...) of search coordinates s (..., P): priors of theta plus log |dtheta/ds|. ``theta`` saves working it out again."""
    values = np.asarray(s, dtype=float)
    physical = coordinates.to_theta(values) if theta is None else theta
    out = np.sum(coordinates.log_jacobian(values), axis=-1)
    low, high = np.array([p.lower for p in priors]), np.array([p.upper for p in priors])
    # Rounding on the way back from s must not throw a point out that sits on its bound.
    slack = 1e-12 * (high - low)
    inside = ((physical >= low - slack) & (physical <= high + slack)).all(axis=-1)
    held = np.clip(physical, low, high)
    for i, prior in enumerate(priors):
        if not prior.group:
            out = out + prior.log_density(held[..., i])
    for places in groups(priors).values():
        members = tuple(priors[i] for i in places)
        for i, p in zip(places, members, strict=True):
            out = out + p.log_slope(held[..., i])
        out = out + pool(members).log_density(np.stack([p.variable(held[..., i]) for i, p in zip(places, members, strict=True)], axis=-1))
    return np.asarray(np.where(inside, out, -np.inf))


def sampling_coordinates(problem: Problem, priors: Sequence[Prior]) -> Coordinates:
    """Coordinates to sample in: those of the problem, but with c of a signed parameter at least the standard deviation of its prior.

    The posterior does not depend on c, the sampler does: with a small c a coefficient that may be zero has two branches, many decades of
    emptiness apart, where in these coordinates it is one bell.
    """
    wide = np.array([float(p.quantile((np.arange(256) + 0.5) / 256).std()) for p in priors])
    return Coordinates(np.where(problem.scale > 0, np.maximum(problem.scale, wide), 0.0))
