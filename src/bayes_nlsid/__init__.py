"""Probabilistic identification of nonlinear structural dynamics."""

__version__ = "0.1.0"
