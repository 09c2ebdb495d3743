"""Parameters and motions that tests of force laws share."""

from __future__ import annotations

import numpy as np

from bayes_nlsid.forces.term import Term

# One admissible set for every term, away from its limits; coefficients are 1.
IWAN = {"f_s": 2000.0, "k_t": 1e8, "chi": -0.5, "beta": 0.1, "theta": 0.7}
OTHER = {"c": 1.0, "k": 3.0, "k_d": 5e6, "d": 2e-5, "sigma": 40.0, "alpha": 1e8, "gamma": 0.8, "delta": -0.3, "nu": 1.5}


def ordinary(term: Term) -> np.ndarray:
    """Parameters (n_p,) of a term, SI."""
    known = IWAN | OTHER | ({"beta": 2e3} if term.name == "bouc_wen" else {})
    return np.array([known[p.name] for p in term.params])


def phi_max(f_s: float, k_t: float, chi: float, beta: float, theta: float = 1.0) -> float:
    """Displacement at which the last slider of an Iwan element slips, m."""
    return f_s * (1 + beta) / (k_t * (beta + (chi + 1) / (chi + 2)))


def ringing(n: int, dt: float, size: float = 4e-5, decay: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Three decaying tones and their exact velocity, (n,) m and m/s."""
    t = dt * np.arange(n)
    q, v = np.zeros(n), np.zeros(n)
    for share, frequency, phase in ((1.0, 41.0, 0.0), (0.5, 173.0, 1.0), (0.3, 291.0, 2.0)):
        wave = size * share * np.exp((-decay + 2j * np.pi * frequency) * t + 1j * phase)
        q, v = q + wave.imag, v + ((-decay + 2j * np.pi * frequency) * wave).imag
    return q, v
