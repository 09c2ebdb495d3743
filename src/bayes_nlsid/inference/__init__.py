"""Priors, likelihood, sampling and its convergence."""
