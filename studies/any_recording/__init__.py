"""Simulated recordings of any kind with known answers: the truth shares no code with the package."""
