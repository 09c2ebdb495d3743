"""What recordings give to Eq. 13 once and for all: in-band columns of the linear part, motion of the locations, noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import Motion, force_along, motion
from bayes_nlsid.forces.term import Memory, Term
from bayes_nlsid.identification.scenario import Scenario
from bayes_nlsid.identification.spectrum import Spectrum
from bayes_nlsid.identification.table import ForceTable, Kind, Symmetry, build, kind_of
from bayes_nlsid.structure.modal import ModalData, ModalModel

SPRING = LIBRARY["spring"]
BLOCK = 2_000_000  # samples of force held at once, about 16 MB per array


@final
@dataclass(frozen=True)
class Cell:
    """One equation of one recording: where its entries lie in the residual.

    ``entries`` are ``2 bins`` numbers: real parts of all in-band frequencies, then imaginary parts.
    """

    record: int
    equation: int
    entries: slice
    bins: int


@final
@dataclass(frozen=True)
class Part:
    """Which table: of which locations, how many places, in displacement or in velocity, closer around which displacement (0: none)."""

    locations: tuple[str, ...]
    memory: Memory
    symmetry: Symmetry
    places: int
    rate: bool
    kink: float = 0.0


@final
@dataclass(frozen=True, eq=False)
class Observed:
    """Recordings in the form that the residual of Eq. 13 needs; independent of the elements tried on them.

    Parameters
    ----------
    linear : ModalModel
    data : tuple of ModalData
        Separate recordings; they are never joined end to end, so no memory crosses from one to the next.
    scenario : Scenario
    band : tuple of float or None
        Hz; None takes the band of each recording.
    taper : float
        Fraction of a transient under cosine edges.

    Raises
    ------
    ValueError
        If there are no recordings, one lacks a mode of the scenario, or ``band`` leaves the band of a recording.
    """

    linear: ModalModel
    data: tuple[ModalData, ...]
    scenario: Scenario
    band: tuple[float, float] | None = None
    taper: float = 0.1
    spectra: tuple[Spectrum, ...] = field(init=False, repr=False)
    cells: tuple[Cell, ...] = field(init=False, repr=False)
    inertia: NDArray[np.float64] = field(init=False, repr=False)
    velocity: NDArray[np.float64] = field(init=False, repr=False)
    displacement: NDArray[np.float64] = field(init=False, repr=False)
    frequency: NDArray[np.float64] = field(init=False, repr=False)
    equation: NDArray[np.intp] = field(init=False, repr=False)
    record: NDArray[np.intp] = field(init=False, repr=False)
    linear_force: NDArray[np.float64] = field(init=False, repr=False)
    _motions: dict[tuple[int, str, bool], Motion] = field(init=False, repr=False, default_factory=dict)
    _kinds: dict[tuple[str, str, bool], Kind | None] = field(init=False, repr=False, default_factory=dict)
    _columns: dict[tuple[int, str, str, str, bool], NDArray[np.float64]] = field(init=False, repr=False, default_factory=dict)
    _linear_parts: dict[tuple[int, ...], NDArray[np.float64]] = field(init=False, repr=False, default_factory=dict)
    _peaks: dict[str, tuple[float, float]] = field(init=False, repr=False, default_factory=dict)
    _tables: dict[Part, tuple[tuple[ForceTable, ...], ...]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("data holds no recordings")
        if max(self.scenario.coupled) >= self.linear.modes:
            raise ValueError(f"scenario {self.scenario.name!r} names mode {max(self.scenario.coupled)}, the model has {self.linear.modes}")
        spectra = []
        for entry in self.data:
            missing = set(self.scenario.coupled) - set(entry.modes)
            if missing:
                raise ValueError(f"recording {entry.name!r} was not observed in modes {sorted(missing)} of scenario "
                                 f"{self.scenario.name!r}; "
                                 "observe them in modal_data or take them out of the scenario")
            spectra.append(Spectrum(entry.n, entry.dt, entry.valid, self._band(entry), entry.periodic, self.taper))
        object.__setattr__(self, "spectra", tuple(spectra))
        self._lay_out()
        self._transform()

    def _band(self, entry: ModalData) -> tuple[float, float]:
        if self.band is None:
            return entry.band
        low, high = self.band
        if not entry.band[0] * (1 - 1e-9) <= low < high <= entry.band[1] * (1 + 1e-9):
            raise ValueError(f"band {self.band} Hz must lie inside {entry.band} Hz, where recording {entry.name!r} is to be trusted")
        return self.band

    def _lay_out(self) -> None:
        cells, at = [], 0
        for r, spectrum in enumerate(self.spectra):
            for k in self.scenario.equations:
                cells.append(Cell(r, k, slice(at, at + 2 * spectrum.bins), spectrum.bins))
                at += 2 * spectrum.bins
        object.__setattr__(self, "cells", tuple(cells))
        object.__setattr__(self, "frequency", np.concatenate([np.tile(self.spectra[c.record].frequency, 2) for c in cells]))
        object.__setattr__(self, "equation", np.concatenate([np.full(2 * c.bins, c.equation) for c in cells]))
        object.__setattr__(self, "record", np.concatenate([np.full(2 * c.bins, c.record) for c in cells]))

    def _transform(self) -> None:
        columns = np.empty((3, self.size))
        peak = np.zeros(len(self.scenario.equations))
        for cell in self.cells:
            entry, spectrum = self.data[cell.record], self.spectra[cell.record]
            i, part = entry.modes.index(cell.equation), spectrum.samples
            a, v, u = entry.a[part, i], entry.v[part, i], entry.u[part, i]
            columns[0, cell.entries] = spectrum.apply(a - entry.force[part, i])
            columns[1, cell.entries] = spectrum.apply(v)
            columns[2, cell.entries] = spectrum.apply(u)
            omega, zeta = self.linear.omega[cell.equation], self.linear.zeta[cell.equation]
            at = self.scenario.equations.index(cell.equation)
            peak[at] = max(peak[at], np.max(np.abs(a)) + 2 * zeta * omega * np.max(np.abs(v)) + omega**2 * np.max(np.abs(u)))
        for name, value in (("inertia", columns[0]), ("velocity", columns[1]), ("displacement", columns[2]), ("linear_force", peak)):
            if not np.isfinite(value).all():
                raise ValueError("the recordings hold NaN or infinite samples among those to be fitted")
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of entries N of a residual."""
        return self.cells[-1].entries.stop

    @property
    def samples(self) -> int:
        """Number n of samples per equation, over all recordings."""
        return sum(s.count for s in self.spectra)

    @cached_property
    def largest(self) -> NDArray[np.float64]:
        """(N,) squares of inertia and stiffness forces, what rounding is measured by."""
        return np.asarray(self.inertia**2 + (self.linear.omega[self.equation] ** 2 * self.displacement) ** 2)

    def linear_part(self, free_modes: tuple[int, ...]) -> NDArray[np.float64]:
        """(N,) a − φᵀF, with damping and stiffness of the modes that are not free."""
        if free_modes not in self._linear_parts:
            omega, zeta = self.linear.omega[self.equation], self.linear.zeta[self.equation]
            known = ~np.isin(self.equation, free_modes)
            self._linear_parts[free_modes] = self.inertia + known * (2 * zeta * omega * self.velocity + omega**2 * self.displacement)
        return self._linear_parts[free_modes]

    def leverage(self, location: str) -> NDArray[np.float64]:
        """Row b (len(equations),) of a location in the fitted equations."""
        return self.linear.rows((location,))[0, list(self.scenario.equations)]

    def path(self, record: int, location: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Relative displacement (n,) m and velocity (n,) m/s of a location as the scenario sees it."""
        entry, coupled = self.data[record], self.scenario.coupled
        if set(coupled) == set(entry.modes) and location in entry.locations:
            i = entry.locations.index(location)
            return entry.q[:, i], entry.qd[:, i]
        row = self.linear.rows((location,))[0, list(coupled)]
        at = [entry.modes.index(k) for k in coupled]
        return entry.u[:, at] @ row, entry.v[:, at] @ row

    def peak(self, location: str) -> tuple[float, float]:
        """Largest |q| (m) and |v| (m/s) of a location over the fitted samples of all recordings."""
        if location not in self._peaks:
            q, v = 0.0, 0.0
            for r, spectrum in enumerate(self.spectra):
                path = self.path(r, location)
                q, v = max(q, float(np.max(np.abs(path[0][spectrum.samples])))), max(v, float(np.max(np.abs(path[1][spectrum.samples]))))
            self._peaks[location] = q, v
        return self._peaks[location]

    def force_samples(self, term: Term, record: int, location: str, p: ArrayLike, excess: bool) -> NDArray[np.float64]:
        """Force (..., count), N, of a term along the recorded motion, at the samples that are fitted."""
        memory = term.memory != "none"
        key = (record, location, memory)
        part = self.spectra[record].samples
        path = self._motions.get(key)
        if path is None:
            q, v = self.path(record, location)
            # Memory starts at the first sample of the recording; a static law needs only the samples that are fitted.
            path = motion(q, v, self.data[record].dt) if memory else motion(q[part], v[part], self.data[record].dt)
            self._motions[key] = path
        force = force_along(term, path, p, excess)
        return force[..., part] if memory else force

    def force(self, term: Term, locations: Sequence[str], p: ArrayLike, excess: bool, places: int = 0,
              kink: float = 0.0) -> NDArray[np.float64]:
        """In-band contribution (..., N) of a term to the residual, Σ b_l f(q_l, v_l; p) over locations that share p (..., n_p).

        With ``places`` the law is interpolated between so many displacements where it allows that (see ``table``); 0 is exact.
        Around a ``kink`` (m) they stand closer.
        """
        parts = self.parts(term, locations, places, kink=kink)
        if not parts:
            return np.asarray(sum(self._exact_force(term, name, p, excess) for name in locations))
        values = np.asarray(p, dtype=float)
        out = np.zeros((*values.shape[:-1], self.size))
        for part in parts:
            for name, tables in zip(part.locations, self.tables(part), strict=True):
                for record, table in enumerate(tables):
                    self._spread(name, record, table.force(term, values), out)
        if excess and term.stiffness is not None:
            stiffness = np.asarray(term.stiffness(*np.moveaxis(values, -1, 0)), dtype=float)
            out -= stiffness[..., None] * self.stuck(locations)
        return out

    def parts(self, term: Term, locations: Sequence[str], places: int, rough: bool = False, kink: float = 0.0) -> tuple[Part, ...]:
        """Tables that hold the force of a term at locations with common parameters; none if it must be evaluated along the recordings.

        ``rough``: jumps may be blurred.
        """
        kind = self._kind(term, rough) if places else None
        if kind is None:
            return ()
        group = tuple(locations)
        if kind == "sum":
            return Part(group, "none", "odd", places, False), Part(group, "none", "odd", places, True)
        return (Part(group, term.memory, kind, places, False, kink),)

    def tables(self, part: Part) -> tuple[tuple[ForceTable, ...], ...]:
        """One table for each location and recording, worked out when first asked for."""
        if part not in self._tables:
            # Memory runs through all samples, also those that are not fitted.
            column = 1 if part.rate else 0
            reach = max(float(np.max(np.abs(self.path(r, name)[column]))) for r in range(len(self.data)) for name in part.locations)

            def table(record: int, name: str) -> ForceTable:
                return build(lambda law, x: self._transform_of(law, record, name, x, False), part.memory, part.symmetry, reach, part.places,
                             part.rate, part.kink)

            self._tables[part] = tuple(tuple(table(r, name) for r in range(len(self.data))) for name in part.locations)
        return self._tables[part]

    def column(self, term: Term, locations: Sequence[str], excess: bool) -> NDArray[np.float64]:
        """Contribution (N,) of a term that is linear in its coefficient, per unit of it; each location is walked through once."""
        out = np.zeros(self.size)
        for name in locations:
            for record in range(len(self.data)):
                self._spread(name, record, self.transformed(term, name, excess, record), out)
        return out

    def transformed(self, term: Term, location: str, excess: bool, record: int) -> NDArray[np.float64]:
        """In-band transform (2 bins,) of the force of such a term itself along one recording."""
        key = (record, location, term.name, term.formula, excess)
        if key not in self._columns:
            self._columns[key] = self._transform_of(term, record, location, np.ones((1, 1)), excess)[0]
        return self._columns[key]

    def stuck(self, locations: Sequence[str]) -> NDArray[np.float64]:
        """Contribution (N,) of a spring of 1 N/m at each of the locations."""
        return self.column(SPRING, locations, False)

    def _spread(self, location: str, record: int, part: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """Add the in-band force (..., 2 bins) at a location along one recording to every equation (..., N)."""
        lever = dict(zip(self.scenario.equations, self.leverage(location), strict=True))
        for cell in self.cells:
            if cell.record == record and lever[cell.equation] != 0.0:
                out[..., cell.entries] += lever[cell.equation] * part

    def _kind(self, term: Term, rough: bool) -> Kind | None:
        """What table the law allows, found out once for each law: it takes thousands of evaluations of it."""
        key = (term.name, term.formula, rough)
        if key not in self._kinds:
            self._kinds[key] = kind_of(term, 1.0, rough)
        return self._kinds[key]

    def _transform_of(self, term: Term, record: int, location: str, rows: NDArray[np.float64], excess: bool) -> NDArray[np.float64]:
        """In-band transform (B, 2 bins) of the force itself along one recording, of parameters (B, n_p)."""
        step = max(1, BLOCK // self.data[record].n)
        parts = [self.spectra[record].apply(self.force_samples(term, record, location, rows[i:i + step], excess))
                 for i in range(0, len(rows), step)]
        return np.concatenate(parts)

    def _exact_force(self, term: Term, location: str, p: ArrayLike, excess: bool) -> NDArray[np.float64]:
        values = np.asarray(p, dtype=float)
        rows = values.reshape(-1, values.shape[-1])
        out = np.zeros((len(rows), self.size))
        for record in range(len(self.data)):
            self._spread(location, record, self._transform_of(term, record, location, rows, excess), out)
        return out.reshape(*values.shape[:-1], self.size)

    def noise_variance(self, least: float = 0.0) -> NDArray[np.float64]:
        """Variance (N,) that sensor noise alone gives every entry: S_a |Z_k|² with Z_k = 1 + 2ζω/(iΩ) − ω²/Ω² of the linear equation.

        The transform is orthonormal, so white noise of one-sided density S has variance S fs/2 in every entry. Velocity and displacement
        come from the same sensor by integration, hence one noise through the dynamic stiffness, not three independent ones.
        |Z_k| counts as at least ``least``.
        """
        out = np.empty(self.size)
        for cell in self.cells:
            entry = self.data[cell.record]
            omega, zeta = self.linear.omega[cell.equation], self.linear.zeta[cell.equation]
            w = 2 * np.pi * self.frequency[cell.entries]
            gain = np.maximum(np.abs(1 + 2 * zeta * omega / (1j * w) - omega**2 / w**2), least) ** 2
            density = entry.noise_density(cell.equation, self.frequency[cell.entries])
            out[cell.entries] = density * 0.5 / entry.dt * gain
        return out
