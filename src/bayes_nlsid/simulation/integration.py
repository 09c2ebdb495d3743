"""Forward simulation of a model for a batch of parameters (Eq. 9-10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces.march import compiled_wanted
from bayes_nlsid.model import Model
from bayes_nlsid.simulation.joints import Joints
from bayes_nlsid.simulation.response import Response
from bayes_nlsid.simulation.schemes import SchemeName, Steps, spectrum, steps
from bayes_nlsid.simulation.stepping import NumpyStepper

Array = NDArray[np.float64]
QUANTITIES = ("displacement", "velocity", "acceleration")
BLOCK_BYTES = 2**25
LONG_RUN = 100_000
"""Steps of numpy (each at the price of one small batch) beyond which the compiled loop is worth loading."""
LOOP_PRICE = 10
"""Price of a numpy step of one joint with memory, in steps of a model without."""
EVEN_BATCH = 50
"""Samples at which a numpy step costs twice that of one sample."""


class Stepper(Protocol):
    """What the driver needs of a time loop; see ``stepping.NumpyStepper``."""

    @property
    def iterations(self) -> NDArray[np.int64]: ...

    @property
    def failures(self) -> NDArray[np.int64]: ...

    @property
    def displacement(self) -> Array: ...

    @property
    def velocity(self) -> Array: ...

    @property
    def acceleration(self) -> Array: ...

    def advance(self, count: int, force: Array | None, rows: Array, every: int, out: tuple[Array | None, ...]) -> None: ...


def simulate(model: Model, theta: ArrayLike, *, fs: float, samples: int, force: ArrayLike | None = None, u0: ArrayLike | None = None,
             v0: ArrayLike | None = None, scheme: SchemeName = "hht", alpha: float = -0.05, keep: tuple[str, ...] = (), every: int = 1,
             store: tuple[str, ...] = QUANTITIES, skip: int = 0, stop_amplitude: float | None = None,
             compiled: bool | None = None, progress: Callable[[str], None] | None = None) -> Response:
    """Integrate the modal equations of motion with all elements, for all samples of theta at once.

    Parameters
    ----------
    model : Model
    theta : array_like (S, P) or (P,)
        Physical parameters in the order of ``model.names``.
    fs : float
        Rate of integration, Hz.
    samples : int
        Instants at rate ``fs``, the one at t = 0 included.
    force : array_like (samples, k) or (S, samples, k) or None
        N at ``model.linear.inputs`` in their order, linear in time between samples; None: free motion.
    u0, v0 : array_like (m,) or (S, m) or None
        Modal displacement and velocity at t = 0; None: zero. Memory terms start as loaded from rest along a straight path.
    scheme : {"hht", "exponential"}
        HHT-alpha (period error (ωh)²/12, printed in the response), or the exact linear propagator.
    alpha : float
        Of HHT-alpha.
    keep : tuple of str
        Locations to store; all sensors if empty.
    every : int
        Store every this many instants.
    store : tuple of str
        Quantities to store.
    skip : int
        Integrate this many steps before the first instant that is stored.
    stop_amplitude : float or None
        Stop once the largest displacement (m) at ``keep[0]`` over at least one period of the first mode is below this in every sample.
    compiled : bool or None
        None: the compiled loop for long runs, numpy for short ones, for which compiling would take longer than running; True or False:
        as told. Both
        give the same numbers up to rounding. Laws of a user's own and laws that jump run in numpy always.
    progress : callable or None
        Told in a sentence before the first compilation.

    Returns
    -------
    Response

    Raises
    ------
    ValueError
        If an argument has the wrong shape or value.

    Notes
    -----
    The environment variable ``BAYES_NLSID_COMPILED=0`` switches compiled loops off.
    """
    request = _request(model, theta, fs, samples, force, u0, v0, keep, every, store, skip)
    omega, zeta = model.linear_values(request.theta)
    same = len(omega) == 1 or bool((omega == omega[0]).all() and (zeta == zeta[0]).all())
    coefficients = steps(omega[0], zeta[0], 1 / fs, scheme, alpha) if same else steps(omega, zeta, 1 / fs, scheme, alpha)
    first = coefficients if same else steps(omega[0], zeta[0], 1 / fs, scheme, alpha)
    period_error, false_damping = spectrum(first, omega[0], zeta[0])
    price = 1 + LOOP_PRICE * sum(len(element.locations) for element in model.elements if element.term.memory != "none")
    wanted = compiled if compiled is not None else samples * price * (1 + len(omega) / EVEN_BATCH) > LONG_RUN
    stepper, ran = _stepper(request, coefficients, omega[:1] if same else omega, zeta[:1] if same else zeta, progress if wanted else None,
                            wanted)
    window = int(np.ceil(fs / (omega.min() / (2 * np.pi)) / every)) * every
    stored, status = _drive(request, stepper, window, stop_amplitude, skip)
    final = tuple(np.ascontiguousarray(a.T) for a in (stepper.displacement, stepper.velocity))
    return Response(every / fs, request.keep, stored[0], stored[1], stored[2], status=status, iterations=stepper.iterations.copy(),
                    unconverged=stepper.failures.copy(),
                    scheme=scheme, period_error=period_error, false_damping=false_damping, final_displacement=final[0],
                    final_velocity=final[1], compiled=ran)


@final
@dataclass(frozen=True)
class _Request:
    """Checked arguments; modal quantities with the sample axis last."""

    model: Model
    theta: Array
    samples: int
    force: Array | None
    u0: Array
    v0: Array
    keep: tuple[str, ...]
    rows: Array
    every: int
    store: tuple[str, ...]

    def modal_force(self, start: int, stop: int) -> Array | None:
        """(stop − start, m) or (stop − start, m, S)."""
        if self.force is None:
            return None
        shapes = self.model.linear.rows(self.model.linear.inputs)
        gain = self.model.gain(self.theta)
        if self.force.ndim == 2:
            modal = self.force[start:stop] @ shapes
            return modal if gain is None else modal[..., None] * gain
        modal = np.ascontiguousarray(np.moveaxis(self.force[:, start:stop] @ shapes, 0, -1))
        return modal if gain is None else modal * gain


def _request(model: Model, theta: ArrayLike, fs: float, samples: int, force: ArrayLike | None, u0: ArrayLike | None, v0: ArrayLike | None,
             keep: tuple[str, ...], every: int, store: tuple[str, ...], skip: int) -> _Request:
    values = np.atleast_2d(np.asarray(theta, dtype=float))
    if values.ndim != 2 or values.shape[1] != model.size:
        raise ValueError(f"theta has shape {values.shape}, expected (S, {model.size}): {', '.join(model.names)}")
    if not np.isfinite(values).all():
        raise ValueError("theta holds NaN or infinite values")
    if not (np.isfinite(fs) and fs > 0):
        raise ValueError(f"fs must be a positive number of Hz, got {fs}")
    if samples < 2 or every < 1 or not 0 <= skip < samples:
        raise ValueError(f"samples must be at least 2, every at least 1 and skip from 0 below samples, got {samples}, {every} and {skip}")
    unknown = set(store) - set(QUANTITIES)
    if unknown or not store:
        raise ValueError(f"store must name some of {QUANTITIES}, got {store}")
    count, m = len(values), model.linear.modes
    applied = None
    if force is not None:
        applied = np.asarray(force, dtype=float)
        shape = (samples, len(model.linear.inputs))
        if applied.shape not in (shape, (count, *shape)):
            raise ValueError(f"force has shape {applied.shape}, expected {shape} or {(count, *shape)}: inputs {model.linear.inputs}")
        if not np.isfinite(applied).all():
            raise ValueError("force holds NaN or infinite values")
    start = []
    for name, array in (("u0", u0), ("v0", v0)):
        full = np.zeros((count, m)) if array is None else np.asarray(array, dtype=float)
        if full.shape not in ((m,), (count, m)):
            raise ValueError(f"{name} has shape {full.shape}, expected {(m,)} or {(count, m)}")
        start.append(np.ascontiguousarray(np.broadcast_to(full, (count, m)).T))
    names = tuple(keep) or model.linear.sensors
    if not names:
        raise ValueError("keep names no location and the model has no sensors; name at least one location to store")
    return _Request(model, values, samples, applied, start[0], start[1], names, model.linear.rows(names), every, tuple(store))


def _stepper(request: _Request, coefficients: Steps, omega: Array, zeta: Array, progress: Callable[[str], None] | None,
             wanted: bool) -> tuple[Stepper, bool]:
    joints = Joints(request.model, request.theta)
    first = request.modal_force(0, 1)
    start = ((2 * zeta * omega).T, (omega**2).T, request.u0, request.v0, None if first is None else first[0])
    if wanted and compiled_wanted() and not joints.jumping:
        from bayes_nlsid.forces.compiled import law_code
        from bayes_nlsid.simulation.compiled_loop import ready
        from bayes_nlsid.simulation.lanes import CompiledStepper

        # sliders and Bouc-Wen loops have a walk of their own and need no law
        codes = [law_code(entry.term) if entry.term.memory in ("none", "masing") else (0, 0.0) for entry in joints.entries]
        known = [code for code in codes if code is not None]
        if len(known) == len(codes):
            if progress is not None and not ready():
                progress("compiling the time loop, once on this computer: a quarter of a minute")
            return CompiledStepper(coefficients, joints, known, *start), True
    with np.errstate(over="ignore", invalid="ignore"):
        return NumpyStepper(coefficients, joints, *start), False


def _drive(request: _Request, stepper: Stepper, window: int, stop_amplitude: float | None,
           skip: int) -> tuple[list[Array], NDArray[np.str_]]:
    """Run block by block: store, watch for divergence, stop at the floor. Returns the three quantities (S, n, L) and the status (S,)."""
    rows, every = request.rows, request.every
    count, locations = request.theta.shape[0], len(request.keep)
    # a force of its own for every sample is held as modal forces
    single = request.force is not None and (request.force.ndim == 3 or request.model.free_gain)
    per_step = 8 * max(1, count) * max(1, request.model.linear.modes if single else locations)
    block = max(every, min(4096, BLOCK_BYTES // per_step) // every * every)
    if stop_amplitude is not None:
        block = max(block, window)
    done = 0
    while done < skip:
        size = min(block, skip - done)
        stepper.advance(size, request.modal_force(done + 1, done + size + 1), rows, every, (None, None, None))
        done += size
    blocks: list[list[Array]] = [[], [], []]
    for i, name in enumerate(QUANTITIES):
        if name in request.store:
            blocks[i].append((rows @ getattr(stepper, name))[None])
    status = np.full(count, "ok", dtype="<U8")
    while done < request.samples - 1:
        size = min(block, request.samples - 1 - done)
        kept = size // every
        out = tuple(np.empty((kept, locations, count)) if name in request.store else None for name in QUANTITIES)
        stepper.advance(size, request.modal_force(done + 1, done + size + 1), rows, every, out)
        for i, array in enumerate(out):
            if array is not None:
                blocks[i].append(array)
        done += size
        finite = np.asarray(np.isfinite(stepper.displacement).all(axis=0) & np.isfinite(stepper.acceleration).all(axis=0))
        status[~finite] = "diverged"
        if not finite.any():
            break
        if stop_amplitude is not None and _decayed(out[0], finite, stop_amplitude, window // every):
            break
    status[(stepper.failures > 0) & (status == "ok")] = "newton"
    empty = np.empty((count, 0, locations))
    return [np.ascontiguousarray(np.moveaxis(np.concatenate(b), -1, 0)) if b else empty for b in blocks], status


def _decayed(displacement: Array | None, finite: NDArray[np.bool_], floor: float, window: int) -> bool:
    if displacement is None:
        raise ValueError("stop_amplitude needs the displacement to be stored")
    if len(displacement) < window:
        return False
    return bool((np.abs(displacement[-window:, 0, :][:, finite]).max(axis=0) < floor).all())
