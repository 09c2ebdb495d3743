"""Terms at locations: the nonlinear part of a model, its parameter names and their packing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Term
from bayes_nlsid.structure.modal import ModalModel


@final
@dataclass(frozen=True)
class Element:
    """A term at one or more locations.

    Parameters
    ----------
    term : Term
    locations : tuple of str
    tied : bool
        One set of parameters for all locations, or one for each.
    excess : bool
        Apply ``f − f'(0) q``, because the linear part already contains the stuck spring (see docs/architecture.md).
    fixed : tuple of (str, float)
        Parameters of the term that are known, by name, in SI; they are not estimated.

    Raises
    ------
    ValueError
        If a location repeats, none is given, or a fixed name is not a parameter of the term.
    """

    term: Term
    locations: tuple[str, ...]
    tied: bool = False
    excess: bool = True
    fixed: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        if not self.locations or len(set(self.locations)) != len(self.locations):
            raise ValueError(f"element {self.term.name!r}: locations must be given and distinct, got {self.locations}")
        unknown = {name for name, _ in self.fixed} - {p.name for p in self.term.params}
        if unknown:
            raise ValueError(f"element {self.term.name!r}: cannot fix unknown parameters {sorted(unknown)}")

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Locations that share one set of parameters."""
        return (self.locations,) if self.tied else tuple((name,) for name in self.locations)

    @property
    def free(self) -> tuple[Param, ...]:
        """Parameters of the term that are estimated."""
        known = {name for name, _ in self.fixed}
        return tuple(p for p in self.term.params if p.name not in known)


@final
@dataclass(frozen=True)
class Parameter:
    """One entry of theta: its full name, unit, and where it belongs.

    ``element`` is −1 for linear parameters (``param`` None; ``mode`` set), else the index in ``Model.elements``.
    """

    name: str
    unit: str
    element: int = -1
    group: int = 0
    param: Param | None = None
    mode: int = -1


@final
@dataclass(frozen=True)
class Model:
    """Linear part plus elements.

    Parameters
    ----------
    linear : ModalModel
    elements : tuple of Element
    free_modes : tuple of int
        Modes whose frequency and damping are parameters; all others keep the values of ``linear``.
    free_gain : bool
        One factor on all recorded forces is a parameter, ``gain``: for a force cell, an amplifier or a modal mass that is known roughly.
        The equations of motion are then driven by gain · φᵀF.

    Raises
    ------
    ValueError
        If an element sits at an unknown location, two elements share a term and a location, or a free mode does not exist.
    """

    linear: ModalModel
    elements: tuple[Element, ...] = ()
    free_modes: tuple[int, ...] = ()
    free_gain: bool = False

    def __post_init__(self) -> None:
        seen: set[tuple[str, str]] = set()
        for element in self.elements:
            self.linear.rows(element.locations)
            for location in element.locations:
                if (element.term.name, location) in seen:
                    raise ValueError(f"term {element.term.name!r} stands twice at location {location!r}")
                seen.add((element.term.name, location))
        if any(not 0 <= k < self.linear.modes for k in self.free_modes) or len(set(self.free_modes)) != len(self.free_modes):
            raise ValueError(f"free_modes {self.free_modes} must be distinct indices below {self.linear.modes}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every entry of theta in order: frequencies (Hz), damping ratios, the gain of the force, then the elements group by group."""
        out = [Parameter(f"f[{k + 1}]", "Hz", mode=k) for k in self.free_modes]
        out += [Parameter(f"zeta[{k + 1}]", "", mode=k) for k in self.free_modes]
        out += [Parameter("gain", "")] if self.free_gain else []
        for i, element in enumerate(self.elements):
            for g, group in enumerate(element.groups):
                place = "+".join(group)
                out += [Parameter(f"{element.term.name}[{place}].{p.name}", p.unit, i, g, p) for p in element.free]
        return tuple(out)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of theta, e.g. ``f[1]`` (Hz), ``zeta[1]``, ``iwan4[J1].f_s`` (N)."""
        return tuple(p.name for p in self.parameters)

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return len(self.parameters)

    def linear_values(self, theta: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Natural frequencies (rad/s) and damping ratios of all modes, each (..., m), with the free ones taken from theta (..., P)."""
        values = self._checked(theta)
        count = len(self.free_modes)
        omega = np.broadcast_to(self.linear.omega, (*values.shape[:-1], self.linear.modes)).copy()
        zeta = np.broadcast_to(self.linear.zeta, omega.shape).copy()
        omega[..., list(self.free_modes)] = 2 * np.pi * values[..., :count]
        zeta[..., list(self.free_modes)] = values[..., count:2 * count]
        return omega, zeta

    def gain(self, theta: ArrayLike) -> NDArray[np.float64] | None:
        """Factor (...) on recorded forces; None where it is not a parameter."""
        return self._checked(theta)[..., 2 * len(self.free_modes)] if self.free_gain else None

    def element_values(self, theta: ArrayLike, element: int, location: str) -> NDArray[np.float64]:
        """All parameters (..., n_p) of one element at one of its locations, fixed ones included, SI."""
        values = self._checked(theta)
        entry = self.elements[element]
        group = next(g for g, names in enumerate(entry.groups) if location in names)
        out = np.empty((*values.shape[:-1], len(entry.term.params)))
        known = dict(entry.fixed)
        where = {(p.element, p.group, p.param.name): i for i, p in enumerate(self.parameters) if p.param is not None}
        for j, param in enumerate(entry.term.params):
            out[..., j] = known[param.name] if param.name in known else values[..., where[element, group, param.name]]
        return out

    def start(self, nonlinear: Sequence[float] = ()) -> NDArray[np.float64]:
        """Theta (P,) with the linear parameters of ``linear`` and the given nonlinear ones.

        Raises
        ------
        ValueError
            If the number of nonlinear values is wrong.
        """
        modes = list(self.free_modes)
        linear = [self.linear.frequency[modes], self.linear.zeta[modes], np.ones(int(self.free_gain))]
        theta = np.concatenate([*linear, np.asarray(nonlinear, dtype=float)])
        if theta.shape != (self.size,):
            raise ValueError(f"{len(nonlinear)} nonlinear values given, the model has {self.size - sum(map(len, linear))}")
        return theta

    def _checked(self, theta: ArrayLike) -> NDArray[np.float64]:
        values = np.asarray(theta, dtype=float)
        if values.shape[-1:] != (self.size,):
            raise ValueError(f"theta has shape {values.shape}, its last axis must be {self.size}: {', '.join(self.names)}")
        return values
