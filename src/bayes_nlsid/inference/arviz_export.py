"""Export to ArviZ InferenceData; the only module that imports arviz."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.inference.likelihood import Likelihood
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.inference.prior import SPACE


@contextmanager
def _quiet() -> Iterator[None]:
    """arviz 0.23 announces its successor on import, and xarray what it will rename; neither concerns a user of this package."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def to_inference_data(posterior: Posterior, likelihood: Likelihood | None = None, *, blocks_of: int = 400) -> Any:
    """Posterior as InferenceData.

    Chains are walkers: ``chain`` counts the walkers of the first ensemble, then of the second, and so on; ``sample_stats`` says which
    ensemble a chain belongs to. Walkers of one ensemble are not independent, so R-hat and ESS of arviz are optimistic about them:
    the figures of ``Posterior.convergence`` stand in ``constant_data``.

    Parameters
    ----------
    posterior : Posterior
    likelihood : Likelihood or None
        For the groups ``log_likelihood`` (by block, on thinned draws) and ``observed_data``.
    blocks_of : int
        Draws, at most, for which the log-likelihood by block is worked out.

    Returns
    -------
    arviz.InferenceData

    Raises
    ------
    ValueError
        If the posterior holds no draws, or ``likelihood`` belongs to another model.
    """
    m, n, w, _ = posterior.theta.shape
    if n == 0:
        raise ValueError(f"the posterior holds no draws ({'; '.join(posterior.reasons)})")
    if likelihood is not None and likelihood.problem.names != posterior.names:
        raise ValueError(f"likelihood is of {likelihood.problem.names}, posterior of {posterior.names}")
    with _quiet():
        import arviz
        import xarray

        chains = _by_chain(posterior.theta)
        groups: dict[str, Any] = {"posterior": _variables(posterior, chains, xarray)}
        ensemble = np.repeat(np.arange(m), w)
        groups["sample_stats"] = xarray.Dataset({
            "lp": (("chain", "draw"), posterior.log_prob.transpose(0, 2, 1).reshape(m * w, n)),
            "ensemble": (("chain",), ensemble),
            "acceptance_rate": (("chain",), posterior.convergence.acceptance.reshape(-1)),
        }, coords={"chain": np.arange(m * w), "draw": np.arange(n)})
        groups["constant_data"] = _constant(posterior, xarray)
        if likelihood is not None:
            groups |= _likelihood_groups(likelihood, chains, blocks_of, xarray)
        attributes = {"seed": posterior.seed, "likelihood": posterior.likelihood, "status": posterior.status,
                      "reasons": "; ".join(posterior.reasons),
                      "burn": posterior.burn}
        return arviz.InferenceData(attrs=attributes, **groups)


def pareto_smoothed(log_weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Normalised importance weights (S,), the largest smoothed by a generalised Pareto distribution, and its shape k-hat.

    Above 0.7 the weights cannot be relied on (Vehtari, Simpson, Gelman, Yao and Gabry, J. Mach. Learn. Res. 25 (2024) 72). Points of zero
    weight have log weight −inf.
    """
    log_weights = np.asarray(log_weights, dtype=float)
    out = np.zeros(log_weights.shape)
    alive = np.isfinite(log_weights)
    if alive.sum() < 25:
        return out, float("inf")
    if np.ptp(log_weights[alive]) < 1e-9:
        out[alive] = 1 / alive.sum()
        return out, float("-inf")
    with _quiet(), np.errstate(all="ignore"):
        import arviz

        smoothed, shape = arviz.psislw(log_weights[alive] - log_weights[alive].max())
    weights = np.exp(smoothed - np.max(smoothed))
    out[alive] = weights / weights.sum()
    return out, float(shape)


def comparison_bytes(names: tuple[str, ...], theta: NDArray[np.float64], log_density: NDArray[np.float64], blocks: tuple[str, ...],
                     title: str) -> bytes:
    """One alternative of a comparison as InferenceData in netCDF: draws (S, P) and log density (S, B) of held-out blocks.

    The densities are of data that were not fitted: their log mean over draws is the score, and no leave-one-out is due.
    """
    from tempfile import TemporaryDirectory

    with _quiet():
        import arviz
        import xarray

        draws = xarray.Dataset({name: (("chain", "draw"), theta[None, :, i]) for i, name in enumerate(names)})
        scores = xarray.Dataset({"heldout": (("chain", "draw", "block"), log_density[None])}, coords={"block": list(blocks)})
        with TemporaryDirectory() as folder:
            path = Path(folder) / "one.nc"
            write_netcdf(arviz.InferenceData(attrs={"alternative": title}, posterior=draws, log_likelihood=scores), path)
            return path.read_bytes()


def write_netcdf(data: Any, path: Path | str) -> None:
    """Write InferenceData to netCDF with h5netcdf, at once or not at all."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.part")
    try:
        with _quiet():
            data.to_netcdf(str(temporary), engine="h5netcdf")
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def _by_chain(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    m, n, w, p = theta.shape
    return theta.transpose(0, 2, 1, 3).reshape(m * w, n, p)


def _variables(posterior: Posterior, chains: NDArray[np.float64], xarray: Any) -> Any:
    coords = {"chain": np.arange(chains.shape[0]), "draw": np.arange(chains.shape[1])}
    return xarray.Dataset({name: xarray.DataArray(chains[..., i], dims=("chain", "draw"), coords=coords, attrs={"units": unit})
                           for i, (name, unit) in enumerate(zip(posterior.names, posterior.units, strict=True))})


def _constant(posterior: Posterior, xarray: Any) -> Any:
    c = posterior.convergence
    rows = {"nested_rhat": c.rhat, "tau": c.tau, "ess": c.ess, "contraction": c.contraction, "near_bound": c.piled,
            "identifiable": c.identifiable.astype(int), "prior_lower": np.array([p.lower for p in posterior.priors]),
            "prior_upper": np.array([p.upper for p in posterior.priors]), "prior_a": np.array([p.a for p in posterior.priors]),
            "prior_b": np.array([p.b for p in posterior.priors])}
    data = {k: (("parameter",), v) for k, v in rows.items()}
    return xarray.Dataset(data, coords={"parameter": list(posterior.names)},
                          attrs={"prior_kinds": ",".join(p.kind for p in posterior.priors), "prior_space": SPACE})


def _likelihood_groups(likelihood: Likelihood, chains: NDArray[np.float64], most: int, xarray: Any) -> dict[str, Any]:
    count = chains.shape[0] * chains.shape[1]
    thin = max(1, -(-count // most))
    step = min(thin, chains.shape[1])
    walkers = max(1, thin // step)
    some = chains[::walkers, step - 1::step]
    values = likelihood.by_block(some.reshape(-1, chains.shape[2])).reshape(*some.shape[:2], -1)
    problem = likelihood.problem
    coords = {"chain": np.arange(0, chains.shape[0], walkers), "draw": np.arange(step - 1, chains.shape[1], step),
              "block": list(likelihood.blocks)}
    entry = {"frequency": ("entry", problem.frequency), "equation": ("entry", problem.equation), "record": ("entry", problem.record)}
    return {"log_likelihood": xarray.Dataset({"blocks": (("chain", "draw", "block"), values)}, coords=coords),
            "observed_data": xarray.Dataset({"inertia_less_force": ("entry", problem.observed.inertia)}, coords=entry,
                                            attrs={"meaning": "in-band real Fourier coefficients of a - force, Eq. 13",
                                                   "units": "kg^0.5 m/s^2"})}
