"""Sizes of errors of the model's form: the likeliest ones by the marginal likelihood of a linear model, done by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from bayes_nlsid.mismatch.form import GROUP_PSEUDO, groups, groups_price, likeliest_groups

from .test_mathematics import chain_family


def test_groups_are_what_the_prior_says_they_are() -> None:
    fam = chain_family()
    sd = fam.prior_sd
    dashed = (fam.dashpot_sd,) if len(fam.dashpots) else ()
    for g, size in zip(groups(fam), (fam.mode_sd, fam.drive_sd, *dashed, fam.mixing_sd), strict=True):
        assert (sd[g] == size).all()
    assert sum(g.stop - g.start for g in groups(fam)) == fam.size - len(fam.names) - fam.modes


def test_price_and_sizes_are_those_of_the_marginal_likelihood() -> None:
    fam = chain_family()
    rng = np.random.default_rng(3)
    X = rng.normal(size=(60, fam.size + 1)) / np.append(fam.prior_sd, 0.2)      # one parameter beside the family, its prior in `normal`
    normal = X.T @ X + np.diag(np.append(np.zeros(fam.size), 25.0))
    data = X @ (rng.normal(size=fam.size + 1) * np.append(3 * fam.prior_sd, 0.2)) + rng.normal(size=60)
    theta = np.zeros(fam.size)
    found = likeliest_groups(fam, theta, normal, X.T @ data, fam.prior_sd, rounds=3000)

    def cost(logs: np.ndarray) -> float:
        sd = fam.prior_sd.copy()
        for g, x in zip(groups(fam), logs, strict=True):
            sd[g] *= np.exp(x)
        precision = normal + np.diag(np.append(1 / sd ** 2, 0.0))
        best = np.linalg.solve(precision, X.T @ data)
        fit = float(data @ data - X.T @ data @ best)
        return fit + groups_price(fam, normal, sd)

    def brute(logs: np.ndarray) -> float:
        sd = fam.prior_sd.copy()
        for g, x in zip(groups(fam), logs, strict=True):
            sd[g] *= np.exp(x)
        covariance = np.eye(60) + X @ np.diag(np.append(sd, 0.2) ** 2) @ X.T
        prior = sum(GROUP_PSEUDO * (np.exp(-2 * x) + 2 * x) for x in logs)
        return float(data @ np.linalg.solve(covariance, data) + np.linalg.slogdet(covariance)[1] + prior)

    count = len(groups(fam))
    here = np.array([np.log(found[g.start] / fam.prior_sd[g.start]) for g in groups(fam)])
    for x in (here, np.full(count, 0.7), np.linspace(-1, 1, count)):
        assert cost(x) - cost(np.zeros(count)) == pytest.approx(brute(x) - brute(np.zeros(count)), rel=1e-6)
    best = minimize(brute, here, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 4000}).x
    assert np.allclose(here, best, atol=5e-3)
    assert (np.abs(here) > 0.1).any()
