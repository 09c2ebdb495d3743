"""Are scenarios told apart where they differ, and left together where they do not?

Data with S3-type coupling: three modes in motion at once, five joints that couple them (``assembly``). One record is fitted, two with
other phases are kept. Compared on them: S1 (one equation, one mode), S3, and S3 with a term that is not there, drawn from a list and
put at one of the joints. Counted: how often S1 is excluded, and how often the irrelevant term is preferred by more than two standard
errors.

``python -m studies.calibration.scenarios``; results/scenarios.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from studies.calibration import truth
from studies.calibration.assembly import BAND
from studies.calibration.cases import CASES
from studies.calibration.five_joints import NAMES, FiveJoints
from studies.calibration.run import interval, stored

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import fit
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.inference.prior import default_priors
from bayes_nlsid.inference.reweighting import WORST_SHAPE, around_fit
from bayes_nlsid.model import Element
from bayes_nlsid.prediction.comparison import SURE, Alternative, compare
from bayes_nlsid.recordings.noise import noise_psd
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.study.store import versions

NOISE = truth.Scenario("one per cent", noise=(0.01,))
IRRELEVANT = ("cubic", "v^3", "q|q|^0.5", "quintic", "q^2v", "coulomb")
HELD = (1, 2)           # phases of the records kept
DRAWS = 40
Array = np.ndarray


def alternative(case: FiveJoints, name: str, scheme: str, elements: tuple[Element, ...], train: Recording, seed: int) -> Alternative:
    """Draws of the regression's posterior around its fit; the fit alone where their weights are not to be trusted."""
    problem = case.problem(train, scheme, elements)
    found = fit(problem, starts=1 if not problem.pieces else 8, seed=seed)
    weighted = around_fit(WhittleLikelihood(found), default_priors(problem), draws=600, seed=seed)
    if weighted.shape > WORST_SHAPE:
        return Alternative(name, problem.model, found.theta[None], weighted.shape, "the fit stands for its draws")
    return Alternative(name, problem.model, weighted.resampled(DRAWS, np.random.default_rng(seed)), weighted.shape)


def one_test(case: FiveJoints, train: Recording, held: list[Recording], number: int, seed: int) -> dict[str, Any]:
    """Three alternatives on one set of records."""
    term, place = IRRELEVANT[number % len(IRRELEVANT)], NAMES[number % len(NAMES)]
    more = (*case.elements, Element(LIBRARY[term], (place,)))
    given = [alternative(case, "S1", "S1", case.elements, train, seed), alternative(case, "S3", "S3", case.elements, train, seed),
             alternative(case, "S3 and more", "S3", more, train, seed)]
    found = compare(given, [(train, noise_psd(train))], [(r, noise_psd(r)) for r in held], band=BAND, seed=seed)
    better, error = found.difference(2, 1)
    return {"term": f"{term} at {place}", "blocks": len(found.blocks), "elpd": found.elpd.tolist(), "nrmse": found.nrmse.tolist(),
            "s1": found.difference(0), "s1_excluded": found.best != 0 and found.told_apart(0), "s1_chance": found.chance(0),
            "more": [better, error], "more_preferred": better > SURE * error and better > 0,
            "more_told": found.best == 2 and found.told_apart(1), "k_hat": list(found.k_hat), "sentence": found.sentence}


def run(count: int, seed: int, tell: Callable[[str], None] | None = None) -> dict[str, Any]:
    """``count`` virtual tests."""
    case = CASES["five S3"]
    assert isinstance(case, FiveJoints)
    first, *noises, last = np.random.SeedSequence([seed, 83]).spawn(3 + len(HELD))
    theta = case.draw(count, np.random.default_rng(first))
    phases = (0, *HELD)
    channels = [case.measure(NOISE, theta, np.random.default_rng(s), phase) for s, phase in zip(noises, phases, strict=True)]
    seeds = np.random.default_rng(last).integers(0, 2**31, count)
    tests = []
    for i in range(count):
        train, *held = (case.recording(NOISE, x[i], phase, f"phases {phase}") for x, phase in zip(channels, phases, strict=True))
        tests.append(one_test(case, train, held, i, int(seeds[i])))
        if tell is not None:
            tell(f"{i + 1} of {count}: {tests[-1]['sentence']}")
    excluded, preferred = (sum(t[key] for t in tests) for key in ("s1_excluded", "more_preferred"))
    return {"count": count, "seed": seed, "versions": versions(), "s1_excluded": excluded, "s1_excluded_90": interval(excluded, count),
            "s1_beyond_two_se": sum(-t["s1"][0] > SURE * t["s1"][1] for t in tests), "irrelevant_preferred": preferred,
            "irrelevant_preferred_90": interval(preferred, count), "irrelevant_told": sum(t["more_told"] for t in tests), "tests": tests}


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m studies.calibration.scenarios", description=__doc__)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-store", action="store_true", help="print only")
    options = parser.parse_args()
    result = run(options.count, options.seed, lambda text: print(text, file=sys.stderr, flush=True))
    if not options.no_store:
        stored(result, "scenarios")
    print(f"S1 excluded in {result['s1_excluded']} of {result['count']} (beyond two standard errors in {result['s1_beyond_two_se']}); an "
          f"irrelevant term preferred by more than two standard errors in {result['irrelevant_preferred']}, told apart in "
          f"{result['irrelevant_told']}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
