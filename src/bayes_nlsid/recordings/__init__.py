"""Test runs in SI units: reading, checking, integrating, and the backbone of a decay."""
