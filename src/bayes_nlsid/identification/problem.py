"""Waist 2: the residual of Eq. 13 in-band, its bounds and coordinates, for any elements at any locations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.identification.bounds import FREQUENCY, bounds
from bayes_nlsid.identification.coordinates import Coordinates
from bayes_nlsid.identification.observed import Cell, Observed
from bayes_nlsid.identification.scenario import Scenario
from bayes_nlsid.identification.table import kink_of
from bayes_nlsid.model import Element, Model
from bayes_nlsid.structure.modal import ModalData


@final
@dataclass(frozen=True, eq=False)
class Piece:
    """An element's group of locations whose force is not linear in its free parameters."""

    element: Element
    locations: tuple[str, ...]
    columns: tuple[int, ...]            # entries of theta that it takes, in the order of ``slots``
    slots: tuple[int, ...]              # parameters of the term that they fill
    fixed: NDArray[np.float64] = field(repr=False)   # (n_p,), NaN where free

    def values(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Parameters of the term (..., n_p) from theta (..., P)."""
        out = np.broadcast_to(self.fixed, (*theta.shape[:-1], len(self.fixed))).copy()
        out[..., list(self.slots)] = theta[..., list(self.columns)]
        return out


@final
@dataclass(frozen=True, eq=False)
class Problem:
    """Regression of Eq. 13c on recordings: r_k = a_k + 2ζω v_k + ω² u_k + Σ b_lk f_l(q_l, v_l, history) − φ_kᵀF, in-band.

    Parameters
    ----------
    model : Model
        Linear part, elements, and which modes are free; free modes must be among the fitted equations.
    data : tuple of ModalData
        Recordings; each keeps its own time axis and memory.
    scenario : Scenario
    band : tuple of float or None
        Hz; None takes each recording's own band.
    widening : float
        Factor ≥ 1 on the bounds of nonlinear parameters.
    linear_widening : (float, float)
        Factors ≥ 1 on the ± 5 % of frequencies and the ± 20 % of damping ratios. A joint that adds damping at low level can drive
        the ratio into its bound; ``piled`` reports it.
    c : float
        Symlog constant of signed parameters (Eq. 14), in their own SI unit. Positive parameters use log10.
    taper : float
        Fraction of a transient under cosine edges; steady periods are never tapered.
    places : int
        Displacements between which force laws are interpolated (see ``table``), 0 for none: each evaluation then walks through all samples.
    kinks : dict
        Displacement (m) around which places stand closer, by term and locations; see ``with_kinks``.
    observed : Observed or None
        Prepared recordings to share between problems that differ in their elements only.

    Raises
    ------
    ValueError
        If a free mode has no fitted equation, recordings lack modes of the scenario, a bound cannot be derived, or ``excess``
        leaves nothing of a linear term.

    Notes
    -----
    The acceleration has the coefficient 1, so u = 0 is no solution even for a free decay without measured force.

    Columns of everything linear in its coefficient (2ζω, ω², coefficients of linear terms) are transformed once; ``residual`` adds them
    and calls the force laws for the other parameters only.
    """

    model: Model
    data: tuple[ModalData, ...]
    scenario: Scenario
    band: tuple[float, float] | None = None
    widening: float = 1.0
    linear_widening: tuple[float, float] = (1.0, 1.0)
    c: float = 1.0
    taper: float = 0.1
    places: int = 0
    kinks: dict[tuple[str, tuple[str, ...]], float] = field(default_factory=dict, repr=False)
    observed: Observed = field(default=None, repr=False)  # type: ignore[assignment]
    bounds: NDArray[np.float64] = field(init=False, repr=False)
    coordinates: Coordinates = field(init=False, repr=False)
    linear_index: tuple[int, ...] = field(init=False, repr=False)
    pieces: tuple[Piece, ...] = field(init=False, repr=False)
    _linear: tuple[Piece, ...] = field(init=False, repr=False)
    _constant: tuple[Piece, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", tuple(self.data))
        astray = set(self.model.free_modes) - set(self.scenario.equations)
        if astray:
            raise ValueError(f"free modes {sorted(astray)} have no equation in scenario {self.scenario.name!r}; free only "
                             f"{self.scenario.equations}")
        if self.observed is None:
            object.__setattr__(self, "observed", Observed(self.model.linear, self.data, self.scenario, self.band, self.taper))
        if not (np.isfinite(self.c) and self.c > 0):
            raise ValueError(f"c must be positive and finite, got {self.c}")
        object.__setattr__(self, "bounds", bounds(self.model, self.observed, self.widening, self.linear_widening))
        signed = [p.param is not None and (p.param.signed or low <= 0)
                  for p, low in zip(self.model.parameters, self.bounds[:, 0], strict=True)]
        object.__setattr__(self, "coordinates", Coordinates(np.where(signed, self.c, 0.0)))
        self._split()

    def _split(self) -> None:
        """Sort the elements into constant parts, columns and pieces that need the force laws."""
        where = {(p.element, p.group, p.param.name): i for i, p in enumerate(self.model.parameters) if p.param is not None}
        linear, index, pieces, constant = [], [], [], []
        if self.model.free_gain:
            self._force()
            index.append(2 * len(self.model.free_modes))
        for e, element in enumerate(self.model.elements):
            known = dict(element.fixed)
            fixed = np.array([known.get(p.name, np.nan) for p in element.term.params])
            open_slots = tuple(int(i) for i in np.flatnonzero(np.isnan(fixed)))
            own = [Piece(element, group, tuple(where[e, g, element.term.params[i].name] for i in open_slots), open_slots, fixed)
                   for g, group in enumerate(element.groups)]
            if element.term.linear and open_slots:
                linear += own
                index += [piece.columns[0] for piece in own]
                if element.excess and not any(self._moves(piece) for piece in own):
                    raise ValueError(f"element {element.term.name!r}: excess=True leaves nothing of it at {element.locations}; use "
                                     f"excess=False")
            elif open_slots:
                pieces += own
            else:
                constant += own
        for name, value in (("linear_index", tuple(index)), ("pieces", tuple(pieces)), ("_linear", tuple(linear)),
                            ("_constant", tuple(constant))):
            object.__setattr__(self, name, value)

    def _moves(self, piece: Piece) -> bool:
        """Whether anything is left of a linear term."""
        seen, element = self.observed, piece.element
        return any(np.any(seen.transformed(element.term, name, element.excess, record))
                   for record in range(len(self.data)) for name in piece.locations)

    @cached_property
    def base(self) -> NDArray[np.float64]:
        """(N,) what no parameter changes; with a free gain the recorded force stands in a column of its own instead."""
        out = self.observed.linear_part(self.model.free_modes)
        if self.model.free_gain:
            out = out + self._force()
        return np.asarray(sum((self._piece_force(piece, np.zeros(self.model.size)) for piece in self._constant), out))

    @cached_property
    def columns(self) -> NDArray[np.float64]:
        """(L, N) of everything linear in a coefficient of its own, in the order of ``linear_index``."""
        seen = self.observed
        gain = [-self._force()] if self.model.free_gain else []
        columns = [*gain, *(seen.column(x.element.term, x.locations, x.element.excess) for x in self._linear)]
        return np.array(columns).reshape(len(columns), seen.size)

    def _force(self) -> NDArray[np.float64]:
        """In-band modal force (N,) as recorded.

        Raises
        ------
        ValueError
            If there is none.
        """
        seen, out = self.observed, np.zeros(self.observed.size)
        for cell in seen.cells:
            entry, spectrum = self.data[cell.record], seen.spectra[cell.record]
            out[cell.entries] = spectrum.apply(entry.force[spectrum.samples, entry.modes.index(cell.equation)])
        if not np.any(out):
            raise ValueError("free_gain: no recording holds a force, so its gain is not a parameter; use free_gain=False")
        return out

    def _piece_force(self, piece: Piece, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        values = piece.values(theta)
        return self.observed.force(piece.element.term, piece.locations, values, piece.element.excess, self.places, self.kink(piece))

    # -- the residual ------------------------------------------------------------------------------------------------------------

    def nonlinear_force(self, theta: ArrayLike) -> NDArray[np.float64]:
        """In-band modal force (..., N) of all elements that are not linear in their parameters."""
        values = self._checked(theta)
        return sum((self._piece_force(piece, values) for piece in self.pieces), np.zeros((*values.shape[:-1], self.size)))

    def exact_residual(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Residual (N,) of theta (P,) with every force law evaluated along the recordings, whatever ``places`` is."""
        values = self._checked(theta)
        out = self.residual(values)
        for piece in self.pieces:
            element, p = piece.element, piece.values(values)
            if self.observed.parts(element.term, piece.locations, self.places):
                out += self.observed.force(element.term, piece.locations, p, element.excess) - self._piece_force(piece, values)
        return out

    def residual(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Residual (..., N) of Eq. 13c, kg^1/2 m/s², of theta (..., P): in-band real DFT of every equation of every recording.

        NaN or infinite entries mean that a force law failed for these parameters; callers turn them into a status.

        Raises
        ------
        ValueError
            If the last axis of theta is not the number of parameters.
        """
        values = self._checked(theta)
        out = self.base + self.nonlinear_force(values)
        omega, zeta = self.model.linear_values(values)
        for k in self.model.free_modes:
            for cell in self.cells:
                if cell.equation == k:
                    part = cell.entries
                    out[..., part] += (2 * zeta * omega)[..., k, None] * self.observed.velocity[part]
                    out[..., part] += (omega**2)[..., k, None] * self.observed.displacement[part]
        if self.linear_index:
            if values.ndim > 1 or "columns" in self.__dict__:
                out += values[..., list(self.linear_index)] @ self.columns
            else:   # one point: columns need not be laid out
                coefficients = values[list(self.linear_index)]
                if self.model.free_gain:
                    out -= coefficients[0] * self._force()
                for piece, c in zip(self._linear, coefficients[len(coefficients) - len(self._linear):], strict=True):
                    out += c * self.observed.column(piece.element.term, piece.locations, piece.element.excess)
        return out

    def mse(self, theta: ArrayLike, weights: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Mean square (...) of Eq. 13a: main equation plus mean over the coupled ones, per sample; or with other weights (N,)."""
        return np.asarray(np.sum((self.weight if weights is None else weights) * self.residual(theta) ** 2, axis=-1) / self.samples)

    def _checked(self, theta: ArrayLike) -> NDArray[np.float64]:
        values = np.asarray(theta, dtype=float)
        if values.shape[-1:] != (self.model.size,):
            raise ValueError(f"theta has shape {values.shape}, its last axis must be {self.model.size}: {', '.join(self.names)}")
        return values

    # -- where entries sit -------------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of theta."""
        return self.model.names

    @property
    def size(self) -> int:
        """Number of entries N of a residual."""
        return self.observed.size

    @property
    def samples(self) -> int:
        """Number n of fitted samples per equation, all recordings together."""
        return self.observed.samples

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Equation by recording, in the order of the residual."""
        return self.observed.cells

    @property
    def frequency(self) -> NDArray[np.float64]:
        """(N,) Hz of every entry."""
        return self.observed.frequency

    @property
    def equation(self) -> NDArray[np.intp]:
        """(N,) mode whose equation an entry belongs to."""
        return self.observed.equation

    @property
    def record(self) -> NDArray[np.intp]:
        """(N,) index of the recording an entry belongs to."""
        return self.observed.record

    @property
    def weight(self) -> NDArray[np.float64]:
        """(N,) weights of Eq. 13a: 1 for the main equation, 1/n_c for each of the n_c coupled ones."""
        coupled = max(1, len(self.scenario.equations) - 1)
        return np.where(self.equation == self.scenario.main, 1.0, 1.0 / coupled)

    @property
    def noise_variance(self) -> NDArray[np.float64]:
        """(N,) variance that sensor noise alone gives every entry; 0 where no noise was stated."""
        return self.observed.noise_variance()

    @property
    def noise_weight(self) -> NDArray[np.float64]:
        """(N,) weights 1/variance, scaled so that noise alone gives the same mean square as with the weights of Eq. 13a.

        The linear dynamic stiffness almost vanishes at resonance, that of the real structure does so somewhere within the bounds of
        its frequency; so |Z|² counts as at least 0.05².

        Raises
        ------
        ValueError
            If a recording states no noise.
        """
        variance = self.observed.noise_variance(least=FREQUENCY)
        if not (variance > 0).all():
            raise ValueError("noise weights need the noise of every recording and mode (ModalData.noise is 0)")
        return np.asarray(self.floor * self.samples / (self.size * variance))

    @property
    def default_weight(self) -> NDArray[np.float64]:
        """(N,) ``noise_weight`` where every recording states its noise, else ``weight``.

        Unweighted, the noise of a mode far above the excitation is amplified by (ω/Ω)⁴ in its stiffness force and drowns the rest.
        """
        stated = all((entry.noise[[entry.modes.index(k) for k in self.scenario.equations]] > 0).all() for entry in self.data)
        return self.noise_weight if stated else self.weight

    @property
    def floor(self) -> float:
        """Mean square (Eq. 13a) that sensor noise alone gives."""
        return float(np.sum(self.weight * self.noise_variance) / self.samples)

    @property
    def rounding_floor(self) -> float:
        """Mean square (Eq. 13a) below which nothing is claimed, see ``rounding``."""
        return self.rounding(self.weight)

    def rounding(self, weights: NDArray[np.float64]) -> float:
        """Weighted mean square of a residual of 1e-8 of the inertia and stiffness forces: what sampling and integration leave at best."""
        return float(1e-16 * np.sum(weights * self.observed.largest) / self.samples)

    # -- coordinates and variants --------------------------------------------------------------------------------------------------

    @property
    def scale(self) -> NDArray[np.float64]:
        """(P,) symlog constant of each parameter; 0 where the coordinate is log10."""
        return self.coordinates.scale

    def to_s(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Search coordinates (..., P)."""
        return self.coordinates.to_s(theta)

    def to_theta(self, s: ArrayLike) -> NDArray[np.float64]:
        """Physical parameters (..., P)."""
        return self.coordinates.to_theta(s)

    def piled(self, theta: ArrayLike, fraction: float = 0.01) -> tuple[str, ...]:
        """Names of parameters within ``fraction`` of their range (in s) from a bound."""
        low, high = self.to_s(self.bounds[:, 0]), self.to_s(self.bounds[:, 1])
        position = (self.to_s(self._checked(theta)) - low) / (high - low)
        return tuple(name for name, x in zip(self.names, position, strict=True) if not fraction < x < 1 - fraction)

    def kink(self, piece: Piece) -> float:
        """Where places of a piece's table stand closer, m; 0 for nowhere."""
        return self.kinks.get((piece.element.term.name, piece.locations), 0.0)

    def with_kinks(self, theta: NDArray[np.float64]) -> Problem:
        """The same with tables that stand closest where the laws bend sharply at theta (P,): for what stays near it."""
        found = {}
        for piece in self.pieces:
            reach = max(self.observed.peak(name)[0] for name in piece.locations)
            if self.places and (at := kink_of(piece.element.term, piece.values(theta), reach)):
                found[piece.element.term.name, piece.locations] = at
        return replace(self, kinks=found) if found else self

    def with_elements(self, elements: Sequence[Element]) -> Problem:
        """The same recordings and linear part with other elements; the transformed recordings are shared."""
        return replace(self, model=replace(self.model, elements=tuple(elements)))
