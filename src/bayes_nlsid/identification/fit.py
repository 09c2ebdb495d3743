"""Multi-start fit of Eq. 13: bounded Levenberg–Marquardt over what is nonlinear, closed form over what is linear."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.condensed import Condensed, Regression, regression, tabled
from bayes_nlsid.identification.descent import Descent, Points
from bayes_nlsid.identification.problem import Problem

TABLE_TOLERANCE = 0.01   # share of the mean square that a force table may change before it is mentioned
SCREENING, SURVIVORS = 7, 8    # iterations given to every start, starts that go on to convergence
POLISHED, POLISHING = 1, 5     # points and iterations with the laws as they are, after a search with blurred jumps
ENOUGH = 1e-3                  # gain of such an iteration, relative, at which it ends
SIDE_BY_SIDE = 4_000_000       # numbers in the derivatives of the starts that are followed at once


@final
@dataclass(frozen=True, eq=False)
class Start:
    """What became of one start: ``status`` is "converged", "iteration limit", "dropped after screening" or what failed."""

    theta: NDArray[np.float64]
    mse: float
    status: str
    evaluations: int
    seconds: float


@final
@dataclass(frozen=True, eq=False)
class Fit:
    """Best point of a multi-start fit with everything that was tried.

    Parameters
    ----------
    theta, s : ndarray (P,)
        Physical and search coordinates.
    mse : float
        Weighted mean square, (kg^1/2 m/s²)²; ``problem.mse(theta)`` is that of Eq. 13a.
    covariance : ndarray (P, P)
        Of s, eliminated entries included: inverse of the information of the residual (taken as white after weighting) plus that of
        the box, 12/width² per entry, so that it exists in every direction. An order of magnitude for starting a sampler, not
        an uncertainty: the residual is neither white nor free of bias (see ``inference``).
    rank : int
        Directions in which the recordings say more than the box.
    starts : tuple of Start
        In the order in which they were drawn.
    status : str
        ``"ok"``, ``"iteration limit"`` or ``"failed"`` (no start could be evaluated; theta is then NaN).
    reasons : tuple of str
        What a reader should know: rank lost, parameters at their bounds.
    problem : Problem
    weights : ndarray (N,)
    seed : int
    """

    theta: NDArray[np.float64]
    s: NDArray[np.float64]
    mse: float
    covariance: NDArray[np.float64] = field(repr=False)
    rank: int
    starts: tuple[Start, ...] = field(repr=False)
    status: str
    reasons: tuple[str, ...]
    problem: Problem = field(repr=False)
    weights: NDArray[np.float64] = field(repr=False)
    seed: int

    @property
    def values(self) -> dict[str, float]:
        """Theta by name."""
        return dict(zip(self.problem.names, (float(x) for x in self.theta), strict=True))

    @property
    def ok(self) -> bool:
        """Whether the best start converged."""
        return self.status == "ok"

    def optima(self, distance: float = 0.02, count: int = 12) -> tuple[Start, ...]:
        """Distinct converged points, best first: more than ``distance`` of the box (in s) apart in some entry."""
        box = self.problem.to_s(self.problem.bounds.T)
        found: list[Start] = []
        for start in sorted((x for x in self.starts if x.status == "converged"), key=lambda x: x.mse):
            at = self.problem.to_s(start.theta)
            if all(np.max(np.abs(at - self.problem.to_s(x.theta)) / (box[1] - box[0])) > distance for x in found):
                found.append(start)
        return tuple(found[:count])


def fit(problem: Problem, *, starts: int = 50, seed: int = 0, weights: NDArray[np.float64] | None = None,
        warm: Mapping[str, float] | ArrayLike | None = None, iterations: int = 200, shared: Condensed | None = None,
        checked: bool = True, gain: float = 1e-9) -> Fit:
    """Fit all parameters of a problem.

    Parameters
    ----------
    problem : Problem
    starts : int
        Random starts, uniform within the bounds in search coordinates. Without parameters that need them one closed-form solve is made.
    seed : int
        Each start draws from its own spawned child, so that start 7 is the same whether 10 or 50 are made.
    weights : ndarray (N,) or None
        Weights of the squared entries; None is ``problem.default_weight``, ``problem.weight`` is Eq. 13a.
    warm : mapping of name to value, array (P,), or None
        Values from an earlier fit, which replace the random ones. If all are known the first start is exactly there, the others stay
        random; otherwise every start takes the known ones and draws the rest.
    iterations : int
        Limit per start.
    shared : Condensed or None
        Columns of this and other problems under the same weights, condensed once for all (see ``condensed``).
    checked : bool
        Whether to walk along the recordings at the end and say in ``reasons`` if interpolating the laws has changed the mean square.
    gain : float
        Share of the mean square that an iteration must win; a start ends after two that do not.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If ``starts`` is not positive, or ``warm`` has the wrong shape.
    """
    if starts < 1:
        raise ValueError(f"starts must be at least 1, got {starts}")
    chosen = problem.default_weight if weights is None else np.asarray(weights, dtype=float)
    began = time.perf_counter()
    rough = not tabled(problem) and tabled(problem, rough=True)
    descent = Descent(regression(problem, chosen, shared, rough))
    known = _known(problem, warm)
    first = np.array(_first_points(descent, starts, seed, known))
    points = _run(descent, first, iterations, ~np.isfinite(known[descent.free]), gain)
    if descent.regression.root is None and rough and _blurred(problem, chosen, points):
        points = _polished(problem, chosen, points, iterations)
    used = descent.regression
    share = (time.perf_counter() - began) / len(points.cost)
    tried = tuple(Start(points.theta[i], float(points.cost[i]) / problem.samples, str(points.status[i]), int(points.evaluations[i]), share)
                  for i in range(len(points.cost)))
    return _result(used, chosen, tried, seed, checked)


def _known(problem: Problem, warm: Mapping[str, float] | ArrayLike | None) -> NDArray[np.float64]:
    if warm is None:
        return np.full(len(problem.names), np.nan)
    if isinstance(warm, Mapping):
        return np.array([warm.get(name, np.nan) for name in problem.names], dtype=float)
    values = np.asarray(warm, dtype=float)
    if values.shape != (len(problem.names),):
        raise ValueError(f"warm has shape {values.shape}, expected {(len(problem.names),)}: {', '.join(problem.names)}")
    return values


def _first_points(descent: Descent, starts: int, seed: int, known: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    count = len(descent.free)
    if count == 0:
        return [np.zeros(0)]
    given = np.isfinite(known[descent.free])
    filled = np.where(np.isfinite(known), known, descent.problem.to_theta(0.5 * (descent.low + descent.high)))
    warm = descent.x_of(filled)
    out = []
    for i, child in enumerate(np.random.SeedSequence(seed).spawn(starts)):
        drawn = np.random.default_rng(child).uniform(size=count)
        out.append(drawn if given.all() and i > 0 else np.where(given, warm, drawn))
    return out


def _run(descent: Descent, first: NDArray[np.float64], iterations: int, new: NDArray[np.bool_], gain: float) -> Points:
    """All starts through the screening, the best of them to the end; as many side by side as fit into memory.

    Where some parameters are known from an earlier fit, the screening moves the others (``new``) only: it asks which start is best beside
    what is known, and everything moves afterwards.
    """
    side = max(1, int(SIDE_BY_SIDE // (descent.regression.size * (1 + len(descent.free)))))
    screened = replace(descent, moving=new) if new.any() and not new.all() and len(first) > SURVIVORS else descent
    parts = [_screened(screened, first[i:i + side], min(SCREENING, iterations), gain) for i in range(0, len(first), side)]
    points = parts[0]
    for part in parts[1:]:
        points = points.joined(part)
    order = np.argsort(points.cost, kind="stable")
    running = order[points.status[order] == "running"]
    ahead = np.array([i for i in order[:SURVIVORS] if points.status[i] == "running"], dtype=np.intp)
    for i in range(0, len(ahead), side):
        chosen = ahead[i:i + side]
        points = points.put(chosen, descent.advance(points.take(chosen), max(0, iterations - SCREENING), gain))
    status = points.status.copy()
    left = np.setdiff1d(running, ahead)
    status[left] = "dropped after screening"
    status[ahead] = np.where(status[ahead] == "running", "iteration limit", status[ahead])
    return replace(points, status=status)


def _screened(descent: Descent, first: NDArray[np.float64], iterations: int, gain: float) -> Points:
    """Some iterations; what has settled while parameters were held is not there yet."""
    points = descent.advance(descent.at(first), iterations, gain)
    if descent.moving is None:
        return points
    again = np.where(points.status == "converged", "running", points.status)
    return replace(points, status=again, quiet=np.zeros_like(points.quiet))


def _blurred(problem: Problem, weights: NDArray[np.float64], points: Points) -> bool:
    """Whether blurring the jumps of laws has changed the best mean square so far that it matters."""
    best = int(np.argmin(points.cost))
    if not np.isfinite(points.cost[best]):
        return False
    exact = float(np.sum(weights * problem.residual(points.theta[best]) ** 2))
    return abs(exact - points.cost[best]) > TABLE_TOLERANCE * exact


def _polished(problem: Problem, weights: NDArray[np.float64], points: Points, iterations: int) -> Points:
    """The best points that blurred jumps led to, brought down once more on the laws as they are; all others only began the search."""
    exact = Descent(regression(problem, weights))
    best = np.argsort(points.cost, kind="stable")[:POLISHED]
    fine = exact.advance(exact.at(points.x[best]), min(iterations, POLISHING), ENOUGH)
    status = np.where(fine.status == "running", "converged" if POLISHING < iterations else "iteration limit", fine.status)
    others = np.setdiff1d(np.arange(len(points.cost)), best)
    begun = points.take(others)
    begun = replace(begun, cost=np.full(len(others), np.inf), status=np.full(len(others), "dropped after screening", dtype="<U32"))
    empty = np.zeros((len(others), exact.regression.size if len(fine.cost) else 0))
    return replace(fine, status=status).joined(replace(begun, residual=empty)) if len(others) else replace(fine, status=status)


def _result(used: Regression, weights: NDArray[np.float64], tried: tuple[Start, ...], seed: int, checked: bool) -> Fit:
    problem = used.problem
    best = min(tried, key=lambda x: x.mse)
    size = len(problem.names)
    if not np.isfinite(best.mse):
        nothing = np.full(size, np.nan)
        reason = f"none of {len(tried)} starts could be evaluated: {sorted({x.status for x in tried})}"
        return Fit(nothing, nothing, np.inf, np.full((size, size), np.nan), 0, tried, "failed", (reason,), problem, weights, seed)
    covariance, rank = covariance_at(used, best.theta, weights, best.mse)
    reasons = []
    if rank < size:
        reasons.append(f"the recordings inform {rank} of {size} directions; the others keep the width of their bounds")
    if checked and problem.places and tabled(problem) and problem.pieces:
        exact = float(np.sum(weights * problem.exact_residual(best.theta) ** 2) / problem.samples)
        if abs(exact - best.mse) > TABLE_TOLERANCE * exact:
            reasons.append(f"interpolating the force laws between {problem.places} displacements changes the mean square from {exact:.3g} "
                           f"to {best.mse:.3g}")
    if piled := problem.piled(best.theta):
        reasons.append(f"at a bound: {', '.join(piled)}")
    status = "ok" if best.status == "converged" else best.status if best.status == "iteration limit" else "iteration limit"
    return Fit(best.theta, problem.to_s(best.theta), best.mse, covariance, rank, tried, status, tuple(reasons), problem, weights, seed)


def covariance_at(used: Regression, theta: NDArray[np.float64], weights: NDArray[np.float64],
                  mse: float) -> tuple[NDArray[np.float64], int]:
    """Covariance (P, P) in s and the number of informed directions, see ``Fit.covariance``."""
    problem = used.problem
    size = len(problem.names)
    if size == 0:
        return np.zeros((0, 0)), 0
    low, high = problem.to_s(problem.bounds.T)
    width = (high - low) / np.sqrt(12.0)      # standard deviation of a uniform density over the box
    slope = used.slope(theta) * width
    slope = np.where(np.isfinite(slope), slope, 0.0)
    # Mean square of one weighted entry, with the degrees of freedom of the fit taken off; noise-free data are not trusted beyond rounding.
    variance = max(mse, problem.rounding(weights), 1e-300) * problem.samples / max(1, problem.size - size)
    values, vectors = np.linalg.eigh(slope.T @ slope / variance)
    covariance = (vectors / (1 + np.maximum(values, 0.0))) @ vectors.T
    return covariance * np.outer(width, width), int(np.sum(values > 1))
