"""Physics hidden from the model: is it flagged, or covered?

The truth has dry friction, a cubic spring, or modes that the model does not have; the model is the right one for everything else.
"Weak" draws the strength log-uniformly from a range that begins far below what can be seen. A quiet record with the shaker off gives
the sensor noise, so that the innovation test has a standard. A parameter is wrong where its true value lies outside its 99.9 %
interval that allows for one unseen force (``adequacy.Unseen``); counted beside it: outside the interval given the form, and the
same of the backbone (frequency, damping ratio, five amplitudes). Silently wrong is a test in which no test of adequacy speaks and
a parameter is wrong. Where nothing is hidden, false alarms are counted.

``python -m studies.calibration.misfit`` runs all of it; results/misfit-*.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from studies.calibration import truth
from studies.calibration.cases import CASES, Case
from studies.calibration.five_joints import FiveJoints
from studies.calibration.run import interval, stored

from bayes_nlsid.inference.adequacy import TAIL, adequacy
from bayes_nlsid.inference.forward import forward_likelihood
from bayes_nlsid.inference.reweighting import WORST_SHAPE, around_optimum
from bayes_nlsid.recordings.noise import noise_psd
from bayes_nlsid.study.store import versions

NOISE = truth.Scenario("one per cent", noise=(0.01,))
SIMULATED = 300
QUIET = 4096            # samples of the record with the shaker off
EDGE = 0.02             # m/s below which friction is not yet dry
Array = np.ndarray


class Hidden(truth.Static):
    """Static law with dry friction (N) and a cubic spring (N/m³) that the model does not have: parameters (R, 6)."""

    def __init__(self, parameters: Array) -> None:
        super().__init__(parameters)
        self.dry, self.cubic = parameters[:, 4], parameters[:, 5]

    def force(self, u: Array, v: Array) -> Array:
        """N."""
        return super().force(u, v) + self.dry * np.tanh(v / EDGE) + self.cubic * u**3

    @staticmethod
    def secant(parameters: Array, a: Array) -> Array:
        """First harmonic over amplitude, N/m."""
        return truth.Static.secant(parameters, a) + 0.75 * parameters[..., 5:6] * a**2

    @staticmethod
    def lost(parameters: Array, a: Array, square: Array) -> Array:
        """Energy per cycle, J."""
        phase = np.linspace(0, 2 * np.pi, 256, endpoint=False)
        speed = np.sqrt(square) * a
        work = np.mean(np.tanh(speed[..., None] * np.cos(phase) / EDGE) * np.cos(phase), axis=-1) * speed * 2 * np.pi / np.sqrt(square)
        return truth.Static.lost(parameters, a, square) + parameters[..., 4:5] * work


@dataclass(frozen=True)
class Trial:
    """What is hidden: ``low`` and ``high`` of the log-uniform strength; ``column`` of the law, or modes."""

    name: str
    strength: str
    low: float = 0.0
    high: float = 0.0
    column: int | None = None
    modes: bool = False


TRIALS = {t.name: t for t in (
    Trial("nothing", "-"),
    Trial("coulomb", "N, dry friction; the drive has 1.6 N", 0.03, 0.03, 4),
    Trial("cubic", "N/m^3; 0.3 % of the linear force at 0.7 mm", 1.5e9, 1.5e9, 5),
    Trial("coulomb weak", "N, dry friction; the drive has 1.6 N", 1e-4, 0.1, 4),
    Trial("cubic weak", "N/m^3; softening of 2.4e6 N/m^2 beside it", 1e7, 1e10, 5),
    Trial("truncated modes", "two modes above the band of three that are modelled, at five joints", modes=True))}


def _posterior(case: Case | FiveJoints, channels: Array, rms: Array, seed: int) -> dict[str, Any]:
    """Adequacy and posterior of one test with a quiet record beside it."""
    rng = np.random.default_rng([seed, 1])
    recording = case.recording(NOISE, channels)
    shape = (QUIET, channels.shape[1])
    quiet = replace(recording, name="quiet", role="noise", response=0.01 * rms * rng.normal(size=shape), force=np.zeros((QUIET, 1)))
    floor = noise_psd(recording, quiet)
    found = case.regression(recording, seed)
    priors = case.priors(found.problem)
    likelihood = forward_likelihood(found, [recording], priors, floors=(floor,))
    tested = adequacy(likelihood, (floor,), priors=priors)
    weighted = around_optimum(likelihood, priors, SIMULATED, seed)
    return {"tested": tested, "draws": weighted.resampled(2000, rng), "shape": weighted.shape}


def _one(case: Case | FiveJoints, hidden: Case | FiveJoints, theta: Array, channels: Array, seed: int) -> dict[str, Any]:
    """Flagged or not, and where the truth lies."""
    rms = np.sqrt(np.mean(channels**2, axis=0) / (1 + 0.01**2))
    found = _posterior(case, channels, rms, seed)
    draws = found["draws"]
    own = theta[:draws.shape[1]]
    model, true = np.concatenate(case.backbone(draws), axis=1), np.concatenate([x[0] for x in hidden.backbone(theta[None])])
    z = np.concatenate([(model.mean(axis=0) - true) / model.std(axis=0), (draws.mean(axis=0) - own) / draws.std(axis=0)])
    allowing = np.abs(z[len(true):]) / [x.widening for x in found["tested"].unseen]
    low, high = np.quantile(np.concatenate([model, draws], axis=1), [0.05, 0.95], axis=0)
    inside = (low <= np.concatenate([true, own])) & (np.concatenate([true, own]) <= high)
    tested = found["tested"]
    return {"flagged": tested.misfit, "innovation": bool(tested.innovation is not None and tested.innovation > tested.innovation_limit),
            "refused": found["shape"] > WORST_SHAPE, "worst": float(np.abs(z[len(true):]).max()), "worst_allowing": float(allowing.max()),
            "worst_backbone": float(np.abs(z[:len(true)]).max()), "widening": [x.widening for x in tested.unseen],
            "inside90": float(inside.mean()), "reasons": list(tested.reasons)}


def run(trial: Trial, count: int, seed: int, tell: Callable[[str], None] | None = None) -> dict[str, Any]:
    """``count`` tests of one kind of hidden physics."""
    first, second, third = (np.random.default_rng(s) for s in np.random.SeedSequence([seed, *trial.name.encode()]).spawn(3))
    case: Case | FiveJoints = CASES["five S3"] if trial.modes else CASES["static"]
    hidden: Case | FiveJoints = replace(case, hidden=2) if isinstance(case, FiveJoints) else replace(case, law=Hidden)
    theta = case.draw(count, first)
    strength = np.exp(first.uniform(np.log(trial.low), np.log(trial.high), count)) if trial.column is not None else np.zeros(count)
    if not trial.modes:
        theta = np.concatenate([theta, np.zeros((count, 2))], axis=1)
        if trial.column is not None:
            theta[:, trial.column] = strength
    channels = hidden.measure(NOISE, theta, second)
    seeds = third.integers(0, 2**31, count)
    tests = []
    for i in range(count):
        tests.append({"strength": float(strength[i]), **_one(case, hidden, theta[i], channels[i], int(seeds[i]))})
        if tell is not None:
            tell(f"{trial.name}: {i + 1} of {count}")
    return {"hidden": trial.name, "strength": trial.strength, "count": count, "seed": seed, "versions": versions(), **summarise(tests),
            "tests": tests}


def summarise(tests: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of tests flagged (by any test, by innovation alone), refused, silently wrong, with Clopper–Pearson 90 % intervals."""
    n = len(tests)
    silent = [t for t in tests if not t["flagged"] and not t["refused"]]
    wrong = sum(t["worst_allowing"] > TAIL for t in silent)
    honest = n - wrong
    return {"flagged": sum(t["flagged"] for t in tests), "by_innovation": sum(t["innovation"] for t in tests),
            "refused": sum(t["refused"] and not t["flagged"] for t in tests), "silently_wrong": wrong,
            "silently_wrong_given_form": sum(t["worst"] > TAIL for t in silent),
            "silently_wrong_backbone": sum(t["worst_backbone"] > TAIL for t in silent),
            "flagged_or_covered": honest / n,
            "median_widening": np.median([t["widening"] for t in tests], axis=0).tolist(), "flagged_or_covered_90": interval(honest, n),
            "cover90_where_silent": float(np.mean([t["inside90"] for t in silent])) if silent else None}


def line(result: dict[str, Any]) -> str:
    """One result as a row of text."""
    cover = result["cover90_where_silent"]
    return (f"{result['hidden']:16s} n={result['count']}  flagged {result['flagged']} (innovation {result['by_innovation']})  "
            f"refused {result['refused']}  silently wrong {result['silently_wrong']} "
            f"(given the form {result['silently_wrong_given_form']}, backbone {result['silently_wrong_backbone']})  "
            f"flagged or covered {100 * result['flagged_or_covered']:.1f} %  cover of 90 % where silent "
            f"{'-' if cover is None else f'{100 * cover:.0f} %'}")


def main() -> int:
    """Run what is asked for and print one row for each."""
    parser = argparse.ArgumentParser(prog="python -m studies.calibration.misfit", description=__doc__)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hidden", choices=tuple(TRIALS), action="append")
    parser.add_argument("--no-store", action="store_true", help="print only")
    options = parser.parse_args()
    for name in options.hidden or list(TRIALS):
        result = run(TRIALS[name], options.count, options.seed)
        if not options.no_store:
            stored(result, f"misfit-{name}")
        print(line(result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
