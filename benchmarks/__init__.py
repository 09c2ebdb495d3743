"""How fast the hot paths are: ``python -m benchmarks`` writes RESULTS.md."""
