"""Truth generator: finite elements, laws, integrator, channels and noise, written independently of the package under test."""
