"""Rivals on one scale: linear effects estimated with the linear model, laws fitted where joint estimation (``joint``) begins.

Given the linear model, the law's parameters move so that the simulated force explains the projected residual (Gauss–Newton with derivatives
of the self-consistent simulation); what it leaves of the transfer function is for the linear model to explain. Both costs are parts of
one −2 log likelihood, on which all rivals are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.mismatch.calibrate import Chain, Extension, LinearFit, coarse, descend, finish, floored, predict, strained
from bayes_nlsid.mismatch.effects import Effect, LinearKind, extension, law_of, linear_kind, pack, packed, unpack, weakened
from bayes_nlsid.mismatch.evidence import Evidence
from bayes_nlsid.mismatch.explain import Candidate
from bayes_nlsid.mismatch.laws import Size
from bayes_nlsid.mismatch.linear import Attachment, Family
from bayes_nlsid.mismatch.motion import settle
from bayes_nlsid.mismatch.paths import MARCHED, Bed, bed
from bayes_nlsid.mismatch.shapes import accelerance
from bayes_nlsid.mismatch.spectra import Spectra, repeats

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
FAINT, FAINT_CHARGE = 0.01, 20.0  # change of response below which a linear effect is charged, and how much
FAINT_LEAK = 0.03  # the same of crosstalk: a sensor some millimetres off its place picks up its neighbour's motion too
POOR = 1.2  # cost per value from which a linear fit is no place to begin from
FOLLOWED, THIN = 10, 4  # steps from each of several starts, and of how many lines one counts there
HOPELESS = 4.0  # times the cost of a rival
WEAKER = 4  # starts that are tried, each half as strong as the one before
WIDENING = 5.0  # a place with a missing effect may have a linear stiffness far outside its tolerance


@final
@dataclass(frozen=True)
class Bench:
    """What every estimation of one case shares."""

    family: Family
    evidence: Evidence
    channels: tuple[str, ...]
    mass: float
    stiffness: dict[str, float]
    sizes: dict[str, Size]

    @property
    def marched(self) -> tuple[int, int]:
        """Steps per sample of a march, and of one for derivatives: what a strong law does to sharp resonances asks for short ones."""
        return (MARCHED, MARCHED // 2) if self.evidence.strong else (MARCHED // 2, 1)


@final
@dataclass(frozen=True)
class Hypothesis:
    """Up to two effects with estimated parameters.

    Parameters
    ----------
    effects : tuple of Effect
    kinds : tuple of LinearKind
        Of the linear effects among them, in order.
    fit : LinearFit
        Linear model beside the effects.
    misfit_records : float
        −2 log likelihood of the projected residual.
    cost : float
        ``misfit_records`` + cost of the linear fit + what its parameters are charged.
    curvature : ndarray
        Curvature of cost/2 in the force parameters (search coordinates).
    status : str
    strengths : tuple of float
        What each effect changes, relative to the response at the highest level (faults of one channel: of that channel).
    """

    effects: tuple[Effect, ...]
    kinds: tuple[LinearKind, ...]
    fit: LinearFit
    misfit_records: float
    cost: float
    curvature: Array
    residual: Complex
    status: str
    strengths: tuple[float, ...] = ()

    @property
    def forces(self) -> tuple[Effect, ...]:
        """Effects that are forces depending on motion."""
        return tuple(e for e in self.effects if e.is_force)

    def parts(self, channels: int) -> Callable[[Complex], tuple[tuple[Attachment, ...], Chain | None]]:
        """``s -> (attachments, chain)`` at the estimated parameters."""
        ext = extension(self.kinds, channels)
        x = self.fit.x
        return lambda s: ((), None) if ext is None else ext.parts(x, s)


def day(spectra: Spectra, starts: Array) -> Array:
    """Times of records on the scale of drifts: −1 to 1 over the fitted records."""
    middle = spectra.starts.mean()
    return np.asarray((starts - middle) / max(np.abs(spectra.starts - middle).max(), 1e-9))


@final
@dataclass(frozen=True)
class Simulated:
    """Forces at the places on the analysed lines (R, L, J) and the motions they came from, for warm starts."""

    lines: Complex
    motions: tuple[Complex, ...]
    status: str


def simulate(paths: Bed, spectra: Spectra, effects: tuple[Effect, ...], unique: list[int], start: tuple[Complex, ...] | None,
             tolerance: float = 1e-5, most: int = 40, march_only: bool = False) -> Simulated:
    """Steady forces of all effects in every record; records with one force history are computed once (``unique``)."""
    times = day(spectra, spectra.starts)
    drifting = any(e.law is None for e in effects)
    out = np.zeros((len(unique), len(spectra.lines), len(effects)), dtype=complex)
    motions: list[Complex] = []
    status = "ok"
    for r, same in enumerate(unique):
        if same < r and not drifting:
            out[r] = out[same]
            motions.append(motions[same])
            continue
        laws = tuple(law_of(e, times[r], paths.periodic) for e in effects)
        D, G, state = settle(paths, r, laws, None if start is None else start[r], tolerance=tolerance, most=most, march_only=march_only)
        status = status if state == "ok" else state
        out[r] = G[spectra.lines]
        motions.append(D)
    return Simulated(out, tuple(motions), status)


def everywhere(bench: Bench, h: Hypothesis, places: list[str]) -> tuple[Bed, list[Complex]]:
    """Bed of all ``places`` and the motions (K, J) there per record, with the forces of ``h`` acting."""
    fam, spectra, channels = bench.family, bench.evidence.spectra, len(bench.channels)
    rows = np.array([fam.places[p] for p in places])
    paths = bed(h.fit.fields.modes, spectra, rows, fam.shaker, lambda s: h.parts(channels)(s)[0])
    at = [places.index(e.place) for e in h.forces]
    own = paths.at(at)
    times = day(spectra, spectra.starts)
    found = simulate(own, spectra, h.forces, repeats(spectra), None)
    out = []
    for r, D in enumerate(found.motions):
        g = np.concatenate([force_in_time(own.at([j]), e, D[:, j:j + 1], times[r]) for j, e in enumerate(h.forces)], axis=1)
        out.append(np.asarray(paths.linear(r) - np.einsum("kjp,kp->kj", paths.among[:, :, at], own.to_lines(g), optimize=True)))
    return paths, out


def force_in_time(paths: Bed, effect: Effect, D: Complex, time: float) -> Array:
    """(n, 1): force of an effect along the motion (K, 1) of the only place of ``paths``, in a record taken at ``time`` (−1 to 1)."""
    d, v = paths.in_time(D)
    return np.asarray(law_of(effect, time, paths.periodic).force(d[:, 0], v[:, 0], paths.dt))[:, None]


def widened(fam: Family, sd: Array, places: set[str]) -> Array:
    """Prior ``sd`` (P,) with the stiffness of these places released, and of no others."""
    sd = np.concatenate([fam.scale_sd, sd[len(fam.names):]])
    for i, name in enumerate(fam.names[:len(fam.K_parts)]):
        if name in places:
            sd[i] = WIDENING * fam.prior_sd[i]
    return sd


def paths_to_sensors(bench: Bench, fit: LinearFit, places: list[str], s: Complex, parts: tuple[tuple[Attachment, ...], Chain | None]
                     ) -> Complex:
    """Accelerance (L, S, J) from forces at places to the channels as reported."""
    fam, modes = bench.family, fit.fields.modes
    rows = np.array([fam.places[p] for p in places])
    attach, chain = parts
    out = accelerance(fam, modes, s, rows, fit.shape_errors, attach)
    return np.asarray(out if chain is None else np.moveaxis(chain.apply(np.moveaxis(out, 2, 0)), 0, 2))


def estimate_linear(bench: Bench, start: LinearFit, candidates: tuple[Candidate, ...], beat: float = np.inf) -> Hypothesis:
    """Estimation of effects none of which is a force, together with the linear model.

    Parameters
    ----------
    start : linear fit to begin from.
    candidates : effects with starting values from the first search; none for the linear model alone.
    beat : cost of a rival's linear fit; what starts from a fit that is no good and stays far above it is left there.
    """
    fam, evidence = bench.family, bench.evidence
    effects, kinds, ext, sd, x = _prepared(bench, start, candidates)
    s, variance = evidence.spectra.s[evidence.excited], floored(evidence.H, evidence.variance)
    spread = start.spread if start.status == "ok" else fam.error_sd    # a fit that failed has taken what it lacks for errors of form
    begin = [(start.theta, x), _moved(start, x, candidates)]
    if ext is not None and (start.cost > POOR * start.dof or strained(fam, start.theta, sd)):
        begin.append(coarse(fam, np.zeros(fam.size), s, evidence.H, variance, ext, x)[:2])

    def onward(at: tuple[Array, Array], steps: int, every: int = 1) -> tuple[Array, Array, float]:
        thin = slice(None, None, every)
        return descend(fam, at[0], s[thin], evidence.H[thin], variance[thin], steps, prior_sd=sd, extension=ext, x=at[1], tol=0.03,
                       spread=spread)

    # from a fit that is sound the nearest start leads on; where it is not, each is followed some way on some of the lines
    sound = start.status == "ok"
    first = sorted((onward(at, 0 if sound else FOLLOWED, 1 if sound else THIN) for at in begin), key=lambda e: e[2])
    if not sound and THIN * first[0][2] > HOPELESS * beat:
        fit = finish(fam, first[0][0], s, evidence.H, variance, ext, first[0][1], sd, spread=spread, rounds=0)
        return hypothesis(bench, effects, kinds, fit, evidence.chi2, np.zeros((0, 0)), evidence.residual, "ok")
    end = onward(first[0][:2], 30)
    if sound and not end[2] < start.cost:
        end = min((end, *(onward(at[:2], 30) for at in first[1:])), key=lambda e: e[2])
    theta, x, _ = end
    fit = finish(fam, theta, s, evidence.H, variance, ext, x, sd, spread=spread)
    return hypothesis(bench, effects, kinds, fit, evidence.chi2, np.zeros((0, 0)), evidence.residual, "ok")


def _moved(start: LinearFit, x: Array, candidates: tuple[Candidate, ...]) -> tuple[Array, Array]:
    """Parameters of the linear fit and of its extension where the last candidate's column promised to lead."""
    theta, moves = start.theta, candidates[-1].moves if candidates else np.zeros(0)
    if len(moves) == len(theta) + len(start.x):
        theta, x = theta + moves[:len(theta)], x.copy()
        x[:len(start.x)] += moves[len(theta):]
    return theta, x


def _prepared(bench: Bench, start: LinearFit, candidates: tuple[Candidate, ...]
              ) -> tuple[tuple[Effect, ...], tuple[LinearKind, ...], Extension | None, Array, Array]:
    """Effects, their linear kinds and extension, prior of the linear model beside them, starting values of the extension."""
    effects = tuple(c.effect for c in candidates)
    kinds = tuple(kind_of(bench, c) for c in candidates if not c.effect.is_force and c.effect.cls != "linear_stiffness")
    ext = extension(kinds, len(bench.channels))
    sizes = start.sd if start.status == "ok" else bench.family.prior_sd
    sd = widened(bench.family, sizes, {e.place for e in effects if e.is_force or e.cls == "linear_stiffness"})
    x = np.zeros(0) if ext is None else ext.x
    if ext is not None and len(start.x) and len(start.x) <= len(x):
        x = np.concatenate([start.x, x[len(start.x):]])
    return effects, kinds, ext, sd, x


def begin(bench: Bench, start: LinearFit, candidates: tuple[Candidate, ...], steps: int = 2, weaker: int = WEAKER) -> Hypothesis:
    """Laws fitted to the projected residual with the linear model held at ``start``: where joint estimation begins.

    ``weaker``: how often weaker starts are tried.
    """
    fam, evidence = bench.family, bench.evidence
    effects, kinds, ext, sd, x = _prepared(bench, start, candidates)
    forces = tuple(e for e in effects if e.is_force)
    spectra = evidence.spectra
    s, variance = spectra.s[spectra.excited], floored(evidence.H, evidence.variance)
    forces, misfit, normal, lines, h, status = _fit_laws(bench, start, ext, x, forces, repeats(spectra), steps, weaker)
    shadow = np.stack([evidence.shadow(lines[:, :, j]) for j in range(len(forces))], axis=-1)[spectra.excited]
    cleaned = evidence.H + np.einsum("lsj,lj->ls", h[spectra.excited], shadow)
    fit = finish(fam, start.theta, s, cleaned, variance, ext, x, sd, spread=start.spread, rounds=0)
    residual = evidence.residual + np.einsum(
        "lsj,rlj->rls", h, np.stack([evidence.project(lines[:, :, j]) for j in range(len(forces))], axis=-1), optimize=True)
    return hypothesis(bench, _merge(effects, forces), kinds, fit, misfit, normal, residual, status, force_strengths(bench, h, lines))


def kind_of(bench: Bench, candidate: Candidate) -> LinearKind:
    """Parametrisation of a linear candidate on this bench."""
    e = candidate.effect
    channel = bench.channels.index(e.place) if e.place in bench.channels else -1
    return linear_kind(bench.family, e.cls, e.place, channel, bench.mass, candidate.frequency, e.kind,
                       bench.stiffness.get(e.place, 1.0), candidate.other, candidate.start)


def _merge(effects: tuple[Effect, ...], forces: tuple[Effect, ...]) -> tuple[Effect, ...]:
    found = list(forces)
    return tuple(found.pop(0) if e.is_force else e for e in effects)


def hypothesis(bench: Bench, effects: tuple[Effect, ...], kinds: tuple[LinearKind, ...], fit: LinearFit, misfit: float, curvature: Array,
               residual: Complex, status: str, forces: Array | None = None) -> Hypothesis:
    """Put an estimate together; ``forces`` are the strengths of the effects that are forces, in their order."""
    free = sum(len(pack(e)) for e in effects if e.is_force) + len(fit.x) + sum(e.cls == "linear_stiffness" for e in effects)
    linear = _linear_strengths(bench, kinds, effects, fit)
    limits = np.array([FAINT_LEAK if k.other >= 0 else FAINT for k in kinds])
    faint = FAINT_CHARGE * np.maximum(np.log(limits / np.maximum(linear, 1e-9)), 0.0) ** 2
    chosen = sum(k.other >= 0 for k in kinds) * np.log(max(len(bench.channels) - 1, 1))    # the leaking one, among all others
    charge = free * np.log(max(bench.evidence.H.size, 2)) + 2 * chosen + float(faint.sum())
    named, edges, strengths = [], 0, []
    remaining, pushing, pulling = list(kinds), list(() if forces is None else forces), list(linear)
    for e in effects:
        if not e.is_force and e.cls != "linear_stiffness":
            k = remaining.pop(0)
            part = fit.x[edges:edges + len(k.start)]
            edges += len(k.start)
            e = replace(e, values=np.asarray(k.natural(part)), names=k.names, units=k.units)
        elif e.cls == "linear_stiffness":
            i = bench.family.names.index(e.place)
            e = replace(e, values=np.array([np.exp(fit.theta[i])]), names=("stiffness over nominal",), units=("",))
        named.append(e)
        strengths.append(_stiffness_strength(bench, kinds, fit, e.place) if e.cls == "linear_stiffness" else
                         float(pushing.pop(0)) if e.is_force and pushing else float(pulling.pop(0)) if not e.is_force else 0.0)
    return Hypothesis(tuple(named), kinds, fit, misfit, misfit + fit.cost + charge, curvature, residual, status, tuple(strengths))


def force_strengths(bench: Bench, h: Complex, lines: Complex) -> Array:
    """(J,): response to each force over the response, in the record of the highest level.

    Parameters
    ----------
    h : (L, S, J) paths from the places to the channels. lines : (R, L, J) forces.
    """
    spectra = bench.evidence.spectra
    strongest = int(np.argmax(spectra.levels))
    moved = np.linalg.norm(h * lines[strongest][:, None, :], axis=(0, 1))
    return np.asarray(moved / max(float(np.linalg.norm(spectra.response[strongest])), 1e-300))


def _linear_strengths(bench: Bench, kinds: tuple[LinearKind, ...], effects: tuple[Effect, ...], fit: LinearFit) -> Array:
    """(kinds,): change of the transfer function by each linear effect, over the channel it belongs to or over all.

    Those below one per cent (three, of crosstalk) are charged: they are what errors of the nominal model look like, and nobody would
    call them missing physics without much evidence.
    """
    count = len(bench.channels)
    out, edge = [], 0
    owners = [e for e in effects if not e.is_force and e.cls != "linear_stiffness"]
    for i, k in enumerate(kinds):
        others = kinds[:i] + kinds[i + 1:]
        both = [_transfer(bench, fit, fit.theta, extension(some, count), x)
                for some, x in ((kinds, fit.x), (others, np.delete(fit.x, np.arange(edge, edge + len(k.start)))))]
        edge += len(k.start)
        place = owners[i].place
        own = [bench.channels.index(place)] if place in bench.channels else list(range(count))
        out.append(float(np.linalg.norm((both[0] - both[1])[:, own])) / max(float(np.linalg.norm(both[0][:, own])), 1e-300))
    return np.array(out)


def _stiffness_strength(bench: Bench, kinds: tuple[LinearKind, ...], fit: LinearFit, place: str) -> float:
    """Change of the transfer function when the stiffness of one place goes back to nominal."""
    ext, theta = extension(kinds, len(bench.channels)), fit.theta.copy()
    theta[bench.family.names.index(place)] = 0.0
    here, back = (_transfer(bench, fit, t, ext, fit.x) for t in (fit.theta, theta))
    return float(np.linalg.norm(here - back) / max(float(np.linalg.norm(here)), 1e-300))


def _transfer(bench: Bench, fit: LinearFit, theta: Array, ext: Extension | None, x: Array) -> Complex:
    fld, chain = predict(bench.family, theta, fit.s, ext, x)
    return fld.H if chain is None else chain.apply(fld.H)


def _fit_laws(bench: Bench, fit: LinearFit, ext: Extension | None, x: Array, forces: tuple[Effect, ...], unique: list[int], steps: int,
              weaker: int) -> tuple[tuple[Effect, ...], float, Array, Complex, Complex, str]:
    """A few Gauss–Newton steps of the law parameters against the projected residual, the linear model held."""
    fam, evidence, reference, damping = bench.family, bench.evidence, forces, 1e-2
    spectra = evidence.spectra
    places = [e.place for e in forces]
    rows = np.array([fam.places[p] for p in places])
    parts = ((lambda s: ((), None)) if ext is None else partial(ext.parts, x))
    fine, quick = (replace(bed(fit.fields.modes, spectra, rows, fam.shaker, lambda s: parts(s)[0]), marched=m) for m in bench.marched)
    h = paths_to_sensors(bench, fit, places, spectra.s, parts(spectra.s))
    root = np.sqrt(2 * evidence.trust[:, None, None] * evidence.weight)
    data = evidence.residual * root

    def response(lines: Complex) -> Complex:
        projected = np.stack([evidence.project(lines[:, :, j]) for j in range(lines.shape[2])], axis=-1)
        return np.asarray(-np.einsum("lsj,rlj->rls", h, projected, optimize=True) * root)

    packs = [pack(e) for e in forces]
    edges = np.concatenate([[0], np.cumsum([len(p) for p in packs])]).astype(int)

    def effects_at(y: Array) -> tuple[Effect, ...]:
        return tuple(unpack(e, y[a:b], ref) for e, ref, a, b in zip(forces, reference, edges[:-1], edges[1:], strict=True))

    y = np.concatenate([packed(e, ref) for e, ref in zip(forces, reference, strict=True)])
    now = simulate(fine, spectra, forces, unique, None, march_only=True)
    rest = data - response(now.lines)
    cost = float((np.abs(rest) ** 2).sum())
    for _ in range(weaker):
        # the first search saw the law on the motion without it: a strong one moves its place less, or otherwise
        less_of_it = tuple(weakened(e, 0.5) for e in forces)
        there = simulate(fine, spectra, less_of_it, unique, None, march_only=True)
        left = data - response(there.lines)
        less = float((np.abs(left) ** 2).sum())
        if not less < cost:
            break
        forces, now, rest, cost = less_of_it, there, left, less
        y = np.concatenate([packed(e, ref) for e, ref in zip(forces, reference, strict=True)])
    normal = np.eye(len(y))
    for _ in range(steps):
        columns = np.empty((len(y), *rest.shape), dtype=complex)
        still = simulate(quick, spectra, effects_at(y), unique, now.motions, most=12, march_only=True)
        for i in range(len(y)):
            step = 1e-3
            beside = effects_at(y + step * (np.arange(len(y)) == i))
            moved = simulate(quick, spectra, beside, unique, now.motions, most=12, march_only=True)
            columns[i] = (response(moved.lines) - response(still.lines)) / step
        flat, r = columns.reshape(len(y), -1), rest.ravel()
        normal = (flat.conj() @ flat.T).real + 1e-2 * np.eye(len(y))
        gradient = (flat.conj() @ r).real
        accepted = False
        for _ in range(4):
            trial = y + np.clip(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), -0.7, 0.7)
            tried = simulate(fine, spectra, effects_at(trial), unique, now.motions, march_only=True)
            left = data - response(tried.lines)
            new = float((np.abs(left) ** 2).sum())
            if np.isfinite(new) and new < cost:
                accepted = True
                break
            damping = max(8 * damping, 1e-3)
        if not accepted:
            break
        gain, y, now, rest, damping = cost - new, trial, tried, left, max(damping / 8, 1e-6)
        cost = new
        if gain < 1e-3 * cost:
            break
    return effects_at(y), cost, normal, now.lines, h, now.status
