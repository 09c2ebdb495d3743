"""Forward–backward selection of force laws (Section 2.3) that stops where noise begins."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.condensed import Condensed, condense, tabled
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.noise import smoothed_variance
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.model import Element

Progress = Callable[[float, str], None]
ALPHA = 1e-3   # chance that noise alone adds a term in one round, all candidates together
GAIN = 1e-7      # share of the mean square that an iteration of a candidate must win
TENFOLD = 10.0   # times its limit at which a statistic is beyond doubt
KEPT = 40_000_000   # numbers in the residuals that are kept within a round
LEAST_GAIN = 0.05   # share of the mean square that a term of moderate significance must explain


@final
@dataclass(frozen=True)
class Trial:
    """One candidate in one round: its score and what became of it."""

    round: int
    action: Literal["add", "remove"]
    element: str
    mse: float
    statistic: float
    threshold: float
    status: str
    evaluations: int
    seconds: float


@final
@dataclass(frozen=True)
class Step:
    """One round: what was best, whether it was done, and why.

    ``aliases``: candidates whose score noise cannot tell from the winner's.
    """

    round: int
    action: Literal["add", "remove"]
    element: str
    mse: float
    accepted: bool
    reason: str
    aliases: tuple[str, ...] = ()


@final
@dataclass(frozen=True, eq=False)
class Selection:
    """Result of forward–backward selection.

    Parameters
    ----------
    forward, backward : tuple of Element
        Chosen going forward, in that order; what is left after going backward. Elements that the problem came with are not listed.
    path : tuple of Step
    tried : tuple of Trial
    fit : Fit
        Of the final model, all starts random again beside the warm one.
    mse_linear : float
        Before any term.
    """

    forward: tuple[Element, ...]
    backward: tuple[Element, ...]
    path: tuple[Step, ...]
    tried: tuple[Trial, ...] = field(repr=False)
    fit: Fit
    mse_linear: float

    @property
    def aliases(self) -> tuple[str, ...]:
        """Candidates that the recordings do not tell from a chosen one; what was dropped again has none."""
        kept = {key(element) for element in self.backward}
        return tuple(sorted({name for step in self.path if step.accepted and step.action == "add" and step.element in kept
                             for name in step.aliases}))


def key(element: Element) -> str:
    """Name of a candidate, e.g. ``cubic[J1,J2]``; tied locations are joined by ``+``."""
    return f"{element.term.name}[{','.join('+'.join(group) for group in element.groups)}]"


@final
@dataclass(frozen=True, eq=False)
class _Search:
    """What stays the same during one selection."""

    problem: Problem
    eps1: float | None
    eps2: float | None
    starts: int
    seed: int
    weights: NDArray[np.float64] | None
    workers: int
    progress: Progress | None
    shared: Condensed | None = None
    kept: dict[int, tuple[Fit, NDArray[np.float64]]] = field(default_factory=dict, repr=False)

    def attempt(self, elements: tuple[Element, ...], warm: dict[str, float], tag: str, starts: int, shared: Condensed | None) -> Fit | str:
        """Fit one set of elements, or say why it cannot be.

        Random starts explore what is new. Where all that is nonlinear is known from the last round, they would only repeat its search.
        """
        seed = int(np.random.SeedSequence([self.seed, zlib.crc32(tag.encode())]).generate_state(1)[0])
        try:
            problem = self.problem.with_elements(self.problem.model.elements + elements)
            known = all(problem.names[i] in warm for piece in problem.pieces for i in piece.columns)
            return fit(problem, starts=1 if known else starts, seed=seed, weights=self.weights, warm=warm, shared=shared,
                       checked=False, gain=GAIN)
        except ValueError as error:
            return str(error)

    def attempts(self, sets: dict[str, tuple[Element, ...]], warm: dict[str, float], tag: str, starts: int,
                 done: float) -> dict[str, tuple[Fit | str, float]]:
        """Fit several sets, in any number of threads; the answer does not depend on how many."""
        names = sorted(sets)
        # what all of them have in common is factored once
        common = tuple(e for e in next(iter(sets.values()), ()) if all(e in elements for elements in sets.values()))
        shared = None if self.shared is None else self.shared.around(self.problem.with_elements(self.problem.model.elements + common))

        def one(name: str) -> tuple[Fit | str, float]:
            began = time.perf_counter()
            found = self.attempt(sets[name], warm, f"{tag}:{name}", starts, shared)
            return found, time.perf_counter() - began

        if self.workers == 1:
            results = [one(name) for name in self._told(names, tag, done)]
        else:
            from concurrent.futures import ThreadPoolExecutor
            with ThreadPoolExecutor(self.workers) as pool:
                results = list(pool.map(one, names))
        return dict(zip(names, results, strict=True))

    def _told(self, names: list[str], tag: str, done: float) -> list[str]:
        if self.progress is not None:
            self.progress(done, f"{tag}: {len(names)} candidates")
        return names

    @cached_property
    def rounding(self) -> float:
        """Mean square below which nothing is claimed."""
        return self.problem.rounding_floor

    def residual(self, found: Fit) -> NDArray[np.float64]:
        """Residual (N,) of a fit, kept while its round lasts: long recordings are walked through once for each."""
        if id(found) not in self.kept:
            if len(self.kept) * found.problem.size > KEPT:
                self.kept.clear()
            self.kept[id(found)] = found, found.problem.residual(found.theta)
        return self.kept[id(found)][1]

    def statistic(self, with_it: Fit, without: Fit, variance: NDArray[np.float64]) -> float:
        """Drop of the sum of squares over the noise variance along it; chi-squared with the added parameters if there is only noise."""
        weighted = with_it.weights * (self.residual(without) - self.residual(with_it)) ** 2
        change = float(np.sum(weighted))
        if change == 0:
            return 0.0
        scale = float(np.sum(weighted * with_it.weights * variance)) / change
        drop = (without.mse - with_it.mse) * with_it.problem.samples
        return drop / scale if scale > 0 else np.inf

    def estimate(self, with_it: Fit, without: Fit, variance: NDArray[np.float64], limit: float) -> float:
        """``statistic``, from the mean noise where no other distribution of the change could bring it to the other side of its limit.

        Noise along a change lies between its least and its largest value, which spares walking through the recordings.
        """
        noise = with_it.weights * variance
        drop = (without.mse - with_it.mse) * with_it.problem.samples
        least, most = float(noise.min()), float(noise.max())
        if least > 0 and (drop <= limit * least or drop > TENFOLD * limit * most):
            return drop / float(noise.mean())
        return self.statistic(with_it, without, variance)

    def threshold(self, added: int, candidates: int) -> float:
        """Value that the statistic exceeds by noise with probability ``ALPHA`` in a round."""
        from scipy.special import chdtri
        return float(chdtri(max(1, added), ALPHA / max(1, candidates)))

    def variance(self, found: Fit) -> NDArray[np.float64]:
        """Noise (N,): the spectrum of what a fit leaves, but nowhere less than the stated sensor noise, and never less than rounding."""
        problem = found.problem
        rounding = self.rounding * problem.samples / float(np.sum(problem.weight))
        left = smoothed_variance(problem, self.residual(found))
        return np.maximum(np.maximum(left, problem.noise_variance), rounding)


def select(problem: Problem, candidates: Sequence[Element], *, eps1: float | None = None, eps2: float | None = None, starts: int = 50,
           seed: int = 0, weights: NDArray[np.float64] | None = None, most: int = 6, workers: int = 1,
           progress: Progress | None = None, shared: Condensed | None = None) -> Selection:
    """Choose elements one by one, then drop what is not needed.

    Forward: every remaining candidate is added to the current model, everything refitted from the last values, and the one
    with the lowest mean square is kept. Backward: elements are taken away one at a time while nothing is lost.

    Without ``eps1`` and ``eps2`` a round is accepted when noise would not explain it: the drop of the sum of squares, divided by the
    noise variance of the entries in which it happened, must exceed the chi-squared limit for the added parameters (0.1 % per round).
    The variance is the smoothed spectrum of what the best candidate leaves, at least the sensor noise of ``Problem.floor``, at least
    rounding. So a model at the noise floor gets no further term, nor does a linear recording. Noise also sits in the motion that
    the force laws are evaluated on, which favours terms that bend a true law a little; hence a term that exceeds its limit less than
    tenfold must also lower the mean square by 5 %. With ``eps1`` the search stops as soon as
    the mean square falls below it, with ``eps2`` when a round changes it by less (the paper's rules).

    Parameters
    ----------
    problem : Problem
        Its own elements are always kept.
    candidates : sequence of Element
        In any order; the result does not depend on it.
    eps1, eps2 : float or None
        (kg^1/2 m/s²)².
    starts : int
        Random starts for candidates with parameters that need them; others are solved in closed form.
    seed : int
    weights : ndarray (N,) or None
        As in ``fit``.
    most : int
        Largest number of elements to add.
    workers : int
        Threads; the result does not depend on it.
    progress : callable or None
        Called with the share done and a sentence.
    shared : Condensed or None
        What ``condensed_for`` gave for the same problem, candidates and weights; None works it out.

    Raises
    ------
    ValueError
        If two candidates have the same name.
    """
    named = {key(c): c for c in candidates}
    if len(named) != len(candidates):
        raise ValueError(f"two candidates share a name: {sorted(key(c) for c in candidates)}")
    weights = problem.default_weight if weights is None else weights
    shared = condensed_for(problem, candidates, weights) if shared is None else shared
    search = _Search(problem, eps1, eps2, starts, seed, weights, workers, progress, shared)
    linear = fit(problem, starts=starts, seed=seed, weights=weights, shared=shared)
    chosen, current, path, tried = _forward(search, named, linear, most)
    kept, current = _backward(search, chosen, current, path, tried)
    final_problem = problem.with_elements(problem.model.elements + tuple(named[name] for name in kept))
    final = fit(final_problem, starts=starts, seed=seed, weights=weights, warm=current.values, shared=shared)
    if progress is not None:
        progress(1.0, f"selected {', '.join(kept) or 'nothing'}")
    return Selection(tuple(named[x] for x in chosen), tuple(named[x] for x in kept), tuple(path), tuple(tried), final, linear.mse)


def condensed_for(problem: Problem, candidates: Sequence[Element], weights: NDArray[np.float64]) -> Condensed | None:
    """Columns of the problem and of all candidates that tables can hold, condensed once, so that no fit walks through the recordings."""
    known = {(e.term.name, name) for e in problem.model.elements for name in e.locations}
    fitting: list[Element] = []
    for candidate in sorted(candidates, key=key):
        if any((candidate.term.name, name) in known for name in candidate.locations):
            continue
        try:
            if tabled(problem.with_elements((*problem.model.elements, candidate)), rough=True):
                fitting.append(candidate)
                known |= {(candidate.term.name, name) for name in candidate.locations}
        except ValueError:
            continue
    return condense(problem.with_elements((*problem.model.elements, *fitting)), weights)


def _forward(search: _Search, named: dict[str, Element], linear: Fit, most: int) -> tuple[list[str], Fit, list[Step], list[Trial]]:
    chosen: list[str] = []
    path: list[Step] = []
    tried: list[Trial] = []
    current = linear
    while len(chosen) < most and len(chosen) < len(named):
        if search.eps1 is not None and current.mse < search.eps1:
            path.append(Step(len(chosen) + 1, "add", "", current.mse, False, f"mean square {current.mse:.3g} is below eps1"))
            break
        sets = {name: tuple(named[x] for x in (*chosen, name)) for name in sorted(named) if name not in chosen}
        found = search.attempts(sets, current.values, f"round {len(chosen) + 1}", search.starts, len(chosen) / (most + 1))
        step, fits = _judge(search, len(chosen) + 1, found, current, tried)
        path.append(step)
        if not step.accepted:
            break
        chosen.append(step.element)
        current = fits[step.element]
    return chosen, current, path, tried


def _judge(search: _Search, number: int, found: dict[str, tuple[Fit | str, float]], current: Fit,
           tried: list[Trial]) -> tuple[Step, dict[str, Fit]]:
    """Rank the candidates of a forward round; fill ``tried``."""
    fits = {name: f for name, (f, _) in found.items() if isinstance(f, Fit) and np.isfinite(f.mse)}
    limits = {name: search.threshold(len(f.theta) - len(current.theta), len(found)) for name, f in fits.items()}
    # Near ties go to the smaller model, then by name, so that the order of candidates never matters.
    order = sorted(fits, key=lambda name: (float(f"{fits[name].mse:.9e}"), len(fits[name].theta), name))
    variance = search.variance(fits[order[0]]) if order else np.zeros(0)
    # the first is told about; the others are only compared
    values = {name: search.statistic(f, current, variance) if name == order[0] else search.estimate(f, current, variance, limits[name])
              for name, f in fits.items()}
    for name, (f, seconds) in found.items():
        status, evaluations = (f.status, sum(s.evaluations for s in f.starts)) if isinstance(f, Fit) else (f, 0)
        tried.append(Trial(number, "add", name, f.mse if isinstance(f, Fit) else np.inf, values.get(name, 0.0), limits.get(name, np.inf),
                           status, evaluations, seconds))
    if not order:
        return Step(number, "add", "", current.mse, False, "no candidate could be fitted"), fits
    if search.eps2 is not None:
        best = order[0]
        change = current.mse - fits[best].mse
        accepted = change >= search.eps2
        reason = f"mean square {current.mse:.3g} -> {fits[best].mse:.3g}" + ("" if accepted else f", less than eps2 = {search.eps2:.3g}")
    else:
        clear = [name for name in order if _clear(values[name], limits[name], current.mse - fits[name].mse, current.mse)]
        best = _smallest(search, clear, fits, variance) if clear else order[0]
        accepted = bool(clear) and current.mse > search.rounding
        reason = f"mean square {current.mse:.3g} -> {fits[best].mse:.3g}; {values[best]:.3g} against {limits[best]:.3g} by noise"
        if not accepted:
            floor = max(search.problem.floor, search.rounding)
            reason += f"; noise floor {floor:.3g}" if floor else ""
    aliases = tuple(name for name in order if accepted and name != best
                    and _same(search, fits[name], fits[best], variance))
    return Step(number, "add", best, fits[best].mse, accepted, reason, aliases), fits


def _clear(statistic: float, limit: float, drop: float, mse: float) -> bool:
    """Whether a term does more than noise: above its limit, and by a twentieth of what was left or tenfold."""
    return statistic > limit and (drop > LEAST_GAIN * mse or statistic > TENFOLD * limit)


def _smallest(search: _Search, clear: list[str], fits: dict[str, Fit], variance: NDArray[np.float64]) -> str:
    """Of the candidates as good as the best (to a twentieth, or as far as noise can tell) the one with the fewest parameters."""
    first = fits[clear[0]]
    level = [name for name in clear if fits[name].mse <= (1 + LEAST_GAIN) * first.mse or _same(search, fits[name], first, variance)]
    return min(level, key=lambda name: (len(fits[name].theta), level.index(name)))


def _same(search: _Search, other: Fit, best: Fit, variance: NDArray[np.float64]) -> bool:
    """Whether noise explains the difference of two scores: the sum of squares differs by less than three of its standard deviations."""
    if other.mse > 2 * best.mse + search.rounding:   # no noise in sight; spares long recordings
        return False
    change = best.weights * (search.residual(other) - search.residual(best))
    spread = 2 * np.sqrt(float(np.sum(change**2 * variance))) / best.problem.samples
    return other.mse - best.mse <= 3 * spread + max(search.rounding, 1e-9 * best.mse)


def _backward(search: _Search, chosen: list[str], current: Fit, path: list[Step], tried: list[Trial]) -> tuple[list[str], Fit]:
    kept = list(chosen)
    base = len(search.problem.model.elements)
    number = len(path)
    while len(kept) > 1:
        number += 1
        elements = dict(zip(kept, current.problem.model.elements[base:], strict=True))
        sets = {name: tuple(e for x, e in elements.items() if x != name) for name in kept}
        found = search.attempts(sets, current.values, f"back {number}", max(1, search.starts // 10), 0.9)
        variance = search.variance(current)
        fits = {name: f for name, (f, _) in found.items() if isinstance(f, Fit) and np.isfinite(f.mse)}
        if not fits:
            break
        values = {name: search.statistic(current, f, variance) for name, f in fits.items()}
        limits = {name: search.threshold(len(current.theta) - len(f.theta), len(kept)) for name, f in fits.items()}
        for name, f in fits.items():
            tried.append(Trial(number, "remove", name, f.mse, values[name], limits[name], f.status, sum(s.evaluations for s in f.starts),
                               found[name][1]))
        best = min(fits, key=lambda name: (fits[name].mse, name))
        loss = fits[best].mse - current.mse
        dispensable = loss < search.eps2 if search.eps2 is not None else values[best] <= limits[best]
        reason = f"mean square {current.mse:.3g} -> {fits[best].mse:.3g} without it"
        path.append(Step(number, "remove", best, fits[best].mse, dispensable, reason))
        if not dispensable:
            break
        kept.remove(best)
        current = fits[best]
    return kept, current
