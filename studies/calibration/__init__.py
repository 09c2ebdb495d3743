"""Simulation-based calibration of the posterior on virtual tests whose truth is known."""
