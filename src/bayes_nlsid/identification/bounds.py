"""Bounds of theta from the recordings (Section 2.2)."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.term import Term
from bayes_nlsid.identification.observed import Observed
from bayes_nlsid.model import Element, Model
from bayes_nlsid.structure.modal import ASSUMED

FREQUENCY, DAMPING = 0.05, 0.20   # half widths of Section 2.2
SPREAD = 3.0                      # standard deviations of the modal test, where these are wider
GUESS = 30.0                      # a damping ratio that was only assumed lies within this factor
GAIN = 1.5                        # an unknown gain of the force lies within this factor of 1
LEVERAGE_FLOOR = 0.1              # of the largest leverage among the locations of an element
MOTION_FLOOR = 0.01               # of the largest motion among them


def bounds(model: Model, observed: Observed, widening: float, linear_widening: tuple[float, float]) -> NDArray[np.float64]:
    """Bounds (P, 2) of theta.

    Frequencies ± 5 % and damping ratios ± 20 % of their nominal value, times ``linear_widening``, or three standard deviations of the
    modal test if these are wider; a damping ratio that was neither measured nor stated within a factor of 30; a gain of the force between
    1/1.5 and 1.5. The largest force at a location is the one whose modal force equals the linear modal forces (inertia + damping +
    stiffness, each at its largest), over the fitted equations in the root-sum-square sense: F_l = ‖L‖ / ‖b_l‖. For one equation this is
    the paper's rule. A location that hardly moves or hardly acts on the fitted equations (the middle joint in mode 1) would get an
    infinite bound: its leverage and motion count as at least 10 % and 1 % of the largest among the locations of its element.

    Then: a coefficient within ± F_l over the largest value of its term; a force up to F_l; a stiffness up to F_l over the largest
    displacement; displacements and velocities up to the largest relative ones; a range as declared. All but ranges are multiplied by
    ``widening``.

    Parameters
    ----------
    model : Model
    observed : Observed
    widening : float
        Factor on nonlinear bounds, at least 1.
    linear_widening : (float, float)
        Factors on the half widths of frequency and damping.

    Raises
    ------
    ValueError
        If a factor is below 1 or makes a linear bound not positive, or an element does not move at any of its locations.
    """
    if widening < 1 or min(linear_widening) < 1:
        raise ValueError(f"widening {widening} and linear_widening {linear_widening} must be at least 1")
    out = np.empty((model.size, 2))
    sides = np.array([-1.0, 1.0])
    for i, parameter in enumerate(model.parameters):
        if parameter.name == "gain":
            out[i] = 1 / GAIN, GAIN
        elif parameter.element < 0:
            damping = parameter.name.startswith("zeta")
            nominal = (model.linear.zeta if damping else model.linear.frequency)[parameter.mode]
            half = DAMPING * linear_widening[1] if damping else FREQUENCY * linear_widening[0]
            half = max(half, SPREAD * float((model.linear.zeta_sd if damping else model.linear.omega_sd)[parameter.mode]))
            guessed = damping and model.linear.zeta_sd[parameter.mode] >= ASSUMED
            out[i] = nominal * (GUESS**sides if guessed else np.maximum(1 + half * sides, 0.01))
            if nominal <= 0:
                raise ValueError(f"{parameter.name} is {nominal}: a free damping ratio needs a positive nominal value")
    for e, element in enumerate(model.elements):
        for g, box in enumerate(_element_bounds(element, observed, widening)):
            for i, parameter in enumerate(model.parameters):
                if parameter.element == e and parameter.group == g and parameter.param is not None:
                    out[i] = box[parameter.param.name]
    return out


def _element_bounds(element: Element, observed: Observed, widening: float) -> list[dict[str, NDArray[np.float64]]]:
    """Bounds of every parameter by name, one dictionary per group of locations."""
    motion = {name: observed.peak(name) for name in element.locations}
    largest = np.max(list(motion.values()), axis=0)
    if not largest[0] > 0:
        raise ValueError(f"element {element.term.name!r}: none of {element.locations} moves in scenario {observed.scenario.name!r}")
    lever = {name: float(np.linalg.norm(observed.leverage(name))) for name in element.locations}
    top = max(lever.values())
    if top == 0:
        raise ValueError(f"element {element.term.name!r}: {element.locations} do not act on the equations of scenario "
                         f"{observed.scenario.name!r}")
    total = float(np.linalg.norm(observed.linear_force))
    out = []
    for group in element.groups:
        q = max(MOTION_FLOOR * largest[0], *(motion[name][0] for name in group))
        v = max(MOTION_FLOOR * largest[1], *(motion[name][1] for name in group))
        force = widening * total / max(LEVERAGE_FLOOR * top, min(lever[name] for name in group))
        box: dict[str, NDArray[np.float64]] = {}
        for p in element.term.params:
            upper = {"force": force, "stiffness": force / q, "displacement": widening * q, "velocity": widening * v}.get(p.rule)
            if p.rule == "range":
                box[p.name] = np.array([p.lower, p.upper])
            elif upper is not None:
                box[p.name] = upper * np.array([p.lower, 1.0])
        for p in element.term.params:
            if p.rule == "coefficient":
                limit = force / _largest(element.term, p.name, box, q, v)
                box[p.name] = np.array([-limit, limit])
        out.append(box)
    return out


def _largest(term: Term, name: str, box: dict[str, NDArray[np.float64]], q: float, v: float) -> float:
    """Largest |f| on the rectangle |q| ≤ q, |v| ≤ v with this coefficient 1, other coefficients 0, other parameters at their corners."""
    choices = [[1.0] if p.name == name else [0.0] if p.rule == "coefficient" else sorted(box[p.name]) for p in term.params]
    corners = np.array(list(itertools.product(*choices)))
    grid = np.linspace(-1.0, 1.0, 21)
    qs, vs = (x.ravel() for x in np.meshgrid(q * grid, v * grid))
    with np.errstate(all="ignore"):
        force = np.abs(term.static_force(qs, vs, corners))
    value = float(np.max(force[np.isfinite(force)], initial=0.0))
    if value <= 0:
        raise ValueError(f"term {term.name!r}: no force for any motion with {name} = 1; its bound cannot be derived")
    return value
