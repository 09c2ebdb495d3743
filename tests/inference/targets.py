"""Targets whose posterior is known: a problem that only lends its parameters, and likelihoods written by hand."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.identification.fit import Fit, fit
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.identification.scenario import scenario
from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.model import Element, Model
from tests.identification.truth import beam, prescribed

TERMS = ("q|q|", "v|v|", "cubic", "v^3", "quintic")


@lru_cache
def run(noise: float = 0.05, seed: int = 0, seconds: float = 2.0):
    """A softening joint under white unmeasured force."""
    from dataclasses import replace
    data = prescribed(beam(), lambda q, v: np.stack([-4e5 * q[:, 0] * np.abs(q[:, 0]), 0 * q[:, 1]], axis=-1), seconds=seconds)
    return replace(data, force=data.force + np.random.default_rng(seed).normal(scale=noise, size=data.force.shape))


@lru_cache
def lend(count: int = 2, c: float = 1.0) -> Fit:
    """A fitted problem with ``count`` signed coefficients."""
    elements = tuple(Element(LIBRARY[name], ("J1",)) for name in TERMS[:count])
    return fit(Problem(Model(beam(), elements), (run(),), scenario("S2", 3, 0), c=c))


class Written(Likelihood):
    """Log-likelihood from a function of theta over the upper bounds, so that parameters are of order one."""

    def __init__(self, start: Fit, function) -> None:
        self.fit, self.function = start, function

    @property
    def problem(self) -> Problem:
        return self.fit.problem

    @property
    def weights(self):
        return np.zeros(self.problem.size)

    @property
    def blocks(self):
        return ("all",)

    def log_likelihood(self, theta):
        return self.function(np.asarray(theta) / self.problem.bounds[:, 1])

    def by_block(self, theta):
        return self.log_likelihood(theta)[:, None]

    def describe(self) -> str:
        return "written by hand"
