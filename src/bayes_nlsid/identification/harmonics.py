"""What a band cuts off: motion that the force laws themselves make above it, and so never see."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.identification.problem import Problem
from bayes_nlsid.structure.modal import ModalData


def lost_motion(problem: Problem, theta: ArrayLike) -> float:
    """Motion above the band that the forces of a model would cause in its main mode, over the motion inside.

    A cubic spring in motion at f makes motion at 3f. Where the recordings were filtered below it, Eq. 13 evaluates every law along a
    motion that lacks it. The share ε found here moves forces like qⁿ by about n ε, and then their coefficients, whatever the noise.

    Parameters
    ----------
    problem : Problem
    theta : array_like (P,)

    Returns
    -------
    float
        Ratio of rms displacements, the largest of all recordings; 0 without elements or where the force cannot be computed.
    """
    values, model = np.asarray(theta, dtype=float), problem.model
    if not model.elements or not np.isfinite(values).all():
        return 0.0
    omega, zeta = model.linear_values(values)
    k, worst = problem.scenario.main, 0.0
    for entry in problem.data:
        force = _modal_force(problem, values, entry, k)
        if not np.isfinite(force).all():
            continue
        n = len(force)
        window = np.ones(n) if entry.periodic else np.hanning(n)
        w = 2 * np.pi * np.fft.rfftfreq(n, entry.dt)
        above = w > 2 * np.pi * entry.band[1]
        stiffness = omega[k] ** 2 - w[above] ** 2 + 2j * zeta[k] * omega[k] * w[above]
        lost = np.linalg.norm(np.fft.rfft(force * window)[above] / stiffness)
        seen = np.linalg.norm(np.fft.rfft(entry.u[:, entry.modes.index(k)] * window))
        worst = max(worst, float(lost / seen) if seen > 0 else 0.0)
    return worst


def _modal_force(problem: Problem, theta: NDArray[np.float64], entry: ModalData, k: int) -> NDArray[np.float64]:
    """Force (n,) of all elements on mode k along one recording, all frequencies."""
    model, out = problem.model, np.zeros(len(entry.u))
    for e, element in enumerate(model.elements):
        for place, row in zip(element.locations, model.linear.rows(element.locations), strict=True):
            j = entry.locations.index(place)
            path = motion(entry.q[:, j], entry.qd[:, j], entry.dt)
            out += row[k] * force_along(element.term, path, model.element_values(theta, e, place), element.excess)
    return out
