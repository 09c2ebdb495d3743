"""Compiled loops and scalar building blocks, made from the very functions of ``forces/laws.py``, ``forces/joint_laws.py``
and ``forces/memory.py``.

Import this module only where compiled code is about to run: it imports numba (0.3 s).
"""

from __future__ import annotations

import hashlib
import inspect
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numba.extending
import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces import joint_laws, laws, memory
from bayes_nlsid.forces.term import Term


def cache_directory(source: str) -> str:
    """A writable directory for compiled code of these very sources, or "" if there is none.

    numba looks at the age of one file only; a law edited elsewhere would leave stale code. The name of the directory therefore
    holds a hash of all sources that compiled code is made from, and of numba's version.

    Parameters
    ----------
    source : str
        File of the function to compile.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for module in (laws.__file__, joint_laws.__file__, memory.__file__, __file__, source):
        digest.update(Path(module).read_bytes())
    beside, home = Path(__file__).parent / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "bayes_nlsid"
    given = os.environ.get("NUMBA_CACHE_DIR")
    for base in ([Path(given)] if given else [beside, home]):
        directory = base / f"compiled-{digest.hexdigest()[:16]}"
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(directory, os.W_OK):
            return str(directory)
    return ""


def compiled(function: Callable[..., Any], **options: Any) -> Any:
    """The function compiled by numba (with more of its options), kept on disk if a directory can be written, else compiled anew in each
    process."""
    directory = cache_directory(inspect.getfile(function))
    settings: Any = numba.config
    before, settings.CACHE_DIR = settings.CACHE_DIR, directory
    try:
        return numba.njit(cache=bool(directory), error_model="numpy", **options)(function)
    finally:
        settings.CACHE_DIR = before


@numba.extending.overload(laws.where, strict=False)
def _scalar_where(condition: Any, yes: Any, no: Any) -> Any:
    """``laws.where`` for numbers; numba's own ``np.where`` would make an array of each."""
    return lambda condition, yes, no: yes if condition else no


for _block in (memory.turning_point, memory.slider_step, memory.bouc_wen_form, memory.bouc_wen_piece, memory.bouc_wen_step,
               memory.bouc_wen_slope):
    numba.extending.register_jitable(_block)  # compiled code may call it, and compiles it from here

# --- laws by number -----------------------------------------------------------------------------------------------------------

_FAMILIES: tuple[Callable[..., Any], ...] = (laws.displacement_odd, laws.displacement_even, laws.mixed_odd, laws.mixed_even,
                                             laws.velocity_odd, laws.velocity_even)
_PLAIN: tuple[Callable[..., Any], ...] = (laws.spring, laws.dashpot, laws.jenkins, laws.jenkins_prager, laws.clearance, laws.iwan4,
                                          laws.iwan5)
_OF_JOINTS: tuple[Callable[..., Any], ...] = (
    joint_laws.power_spring, joint_laws.falling_spring, joint_laws.levelling, joint_laws.saturating, joint_laws.rounded_gap,
    joint_laws.one_stop, joint_laws.two_stops, joint_laws.one_sided, joint_laws.bent, joint_laws.closing, joint_laws.rounded_friction,
    joint_laws.falling_friction, joint_laws.power_damper, joint_laws.exponential_spring, joint_laws.round_stops,
    joint_laws.loosening, joint_laws.lossy_stop, joint_laws.lossy_stops, joint_laws.levelling_damper)
for _part in (joint_laws.soft, joint_laws.step):
    numba.extending.register_jitable(_part)
for _module, _group in ((laws, (*_FAMILIES, *_PLAIN)), (joint_laws, _OF_JOINTS)):
    for _law in _group:
        numba.extending.register_jitable(_law)
        numba.extending.register_jitable(getattr(_module, f"{_law.__name__}_slope"))


def law_code(term: Term) -> tuple[int, float] | None:
    """Number of the law (or backbone) of a term, and its exponent, for ``law_value``.

    Parameters
    ----------
    term : Term

    Returns
    -------
    tuple of (int, float) or None
        None if the law is neither of ``forces/laws.py`` nor of ``forces/joint_laws.py``: a user's own, which runs in numpy.
    """
    law = term.law
    if isinstance(law, partial) and law.func in _FAMILIES and set(law.keywords) == {"power"}:
        return _FAMILIES.index(law.func), float(law.keywords["power"])
    single = (*_PLAIN, *_OF_JOINTS)
    return (len(_FAMILIES) + single.index(law), 0.0) if law in single else None


@compiled
def _joint_law_value(code: int, q: float, v: float, p: NDArray[np.float64]) -> tuple[float, float, float]:
    """As ``law_value`` for the laws of ``forces/joint_laws.py``, counted from their first."""
    if code == 0:
        slope = joint_laws.power_spring_slope(q, v, p[0], p[1], p[2])
        return joint_laws.power_spring(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 1:
        slope = joint_laws.falling_spring_slope(q, v, p[0], p[1], p[2])
        return joint_laws.falling_spring(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 2:
        slope = joint_laws.levelling_slope(q, v, p[0], p[1], p[2])
        return joint_laws.levelling(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 3:
        slope = joint_laws.saturating_slope(q, v, p[0], p[1], p[2])
        return joint_laws.saturating(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 4:
        slope = joint_laws.rounded_gap_slope(q, v, p[0], p[1], p[2])
        return joint_laws.rounded_gap(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 5:
        slope = joint_laws.one_stop_slope(q, v, p[0], p[1], p[2])
        return joint_laws.one_stop(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 6:
        slope = joint_laws.two_stops_slope(q, v, p[0], p[1], p[2], p[3])
        return joint_laws.two_stops(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    if code == 7:
        slope = joint_laws.one_sided_slope(q, v, p[0], p[1], p[2])
        return joint_laws.one_sided(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 8:
        slope = joint_laws.bent_slope(q, v, p[0], p[1], p[2], p[3])
        return joint_laws.bent(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    if code == 9:
        slope = joint_laws.closing_slope(q, v, p[0], p[1])
        return joint_laws.closing(q, v, p[0], p[1]), slope[0], slope[1]
    if code == 10:
        slope = joint_laws.rounded_friction_slope(q, v, p[0], p[1])
        return joint_laws.rounded_friction(q, v, p[0], p[1]), slope[0], slope[1]
    if code == 11:
        slope = joint_laws.falling_friction_slope(q, v, p[0], p[1], p[2], p[3])
        return joint_laws.falling_friction(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    if code == 12:
        slope = joint_laws.power_damper_slope(q, v, p[0], p[1], p[2])
        return joint_laws.power_damper(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 13:
        slope = joint_laws.exponential_spring_slope(q, v, p[0], p[1])
        return joint_laws.exponential_spring(q, v, p[0], p[1]), slope[0], slope[1]
    if code == 14:
        slope = joint_laws.round_stops_slope(q, v, p[0], p[1], p[2])
        return joint_laws.round_stops(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 15:
        slope = joint_laws.loosening_slope(q, v, p[0], p[1], p[2], p[3])
        return joint_laws.loosening(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    if code == 16:
        slope = joint_laws.lossy_stop_slope(q, v, p[0], p[1], p[2], p[3])
        return joint_laws.lossy_stop(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    if code == 17:
        slope = joint_laws.lossy_stops_slope(q, v, p[0], p[1], p[2], p[3])
        return joint_laws.lossy_stops(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    slope = joint_laws.levelling_damper_slope(q, v, p[0], p[1], p[2])
    return joint_laws.levelling_damper(q, v, p[0], p[1], p[2]), slope[0], slope[1]


@compiled
def law_value(code: int, power: float, q: float, v: float, p: NDArray[np.float64]) -> tuple[float, float, float]:
    """Force and both slopes of one law at one point: N, N/m, N s/m.

    Parameters
    ----------
    code, power : int, float
        From ``law_code``.
    q, v : float
        m, m/s.
    p : ndarray (at least n_p,)
        SI.
    """
    if code == 0:
        slope = laws.displacement_odd_slope(q, v, p[0], power)
        return laws.displacement_odd(q, v, p[0], power), slope[0], slope[1]
    if code == 1:
        slope = laws.displacement_even_slope(q, v, p[0], power)
        return laws.displacement_even(q, v, p[0], power), slope[0], slope[1]
    if code == 2:
        slope = laws.mixed_odd_slope(q, v, p[0], power)
        return laws.mixed_odd(q, v, p[0], power), slope[0], slope[1]
    if code == 3:
        slope = laws.mixed_even_slope(q, v, p[0], power)
        return laws.mixed_even(q, v, p[0], power), slope[0], slope[1]
    if code == 4:
        slope = laws.velocity_odd_slope(q, v, p[0], power)
        return laws.velocity_odd(q, v, p[0], power), slope[0], slope[1]
    if code == 5:
        slope = laws.velocity_even_slope(q, v, p[0], power)
        return laws.velocity_even(q, v, p[0], power), slope[0], slope[1]
    if code == 6:
        slope = laws.spring_slope(q, v, p[0])
        return laws.spring(q, v, p[0]), slope[0], slope[1]
    if code == 7:
        slope = laws.dashpot_slope(q, v, p[0])
        return laws.dashpot(q, v, p[0]), slope[0], slope[1]
    if code == 8:
        slope = laws.jenkins_slope(q, v, p[0], p[1])
        return laws.jenkins(q, v, p[0], p[1]), slope[0], slope[1]
    if code == 9:
        slope = laws.jenkins_prager_slope(q, v, p[0], p[1], p[2])
        return laws.jenkins_prager(q, v, p[0], p[1], p[2]), slope[0], slope[1]
    if code == 10:
        slope = laws.clearance_slope(q, v, p[0], p[1])
        return laws.clearance(q, v, p[0], p[1]), slope[0], slope[1]
    if code == 11:
        slope = laws.iwan4_slope(q, v, p[0], p[1], p[2], p[3])
        return laws.iwan4(q, v, p[0], p[1], p[2], p[3]), slope[0], slope[1]
    if code == 12:
        slope = laws.iwan5_slope(q, v, p[0], p[1], p[2], p[3], p[4])
        return laws.iwan5(q, v, p[0], p[1], p[2], p[3], p[4]), slope[0], slope[1]
    return _joint_law_value(code - 13, q, v, p)


# --- memory, one sample at a time ---------------------------------------------------------------------------------------------
# Each walk carries one location of one sample from (q0, v0) to (q1, v1) by way of a turning point inside the step, exactly as
# forces/stepping.py does for a batch. With write=False nothing that was given is changed: a trial of Newton's method.


@compiled
def masing_walk(code: int, power: float, p: NDArray[np.float64], last: NDArray[np.float64], depth: int, ends: NDArray[np.float64],
                forces: NDArray[np.float64], q1: float, v1: float, dt: float, write: bool) -> tuple[float, float, int, bool]:
    """Masing's rules over one step.

    Parameters
    ----------
    code, power : int, float
        Of the backbone, from ``law_code``.
    p : ndarray (n_p,)
        SI.
    last : ndarray (4,)
        Displacement (m), velocity (m/s), force (N) and heading (−1, 0, 1) after the last accepted step; zeros at the start.
    depth : int
        Number of open reversals.
    ends, forces : ndarray (capacity,)
        Displacement and force at the open reversals.
    q1, v1, dt : float
        m, m/s, s.
    write : bool
        Whether the step is accepted: ``last``, ``ends``, ``forces`` are brought up to date.

    Returns
    -------
    force, tangent : float
        N, N/m.
    depth : int
        Open reversals afterwards; keep it when the step was accepted.
    overflow : bool
        The stack was too small; nothing was written to it. Give it more room and start again.
    """
    turned, extremum = memory.turning_point(last[0], last[1], q1, v1, dt)
    q, force, heading, tangent = last[0], last[2], last[3], 0.0
    # Reversals met in this step, not yet on the stack: position (−1: none), displacement, force.
    first, first_end, first_force = -1, 0.0, 0.0
    second, second_end, second_force = -1, 0.0, 0.0
    for leg in range(2):
        if leg == 1 and not turned:
            break
        target = extremum if leg == 0 else q1
        move = 1.0 if target > q else (-1.0 if target < q else 0.0)
        if move * heading < 0.0:
            if leg == 0:
                first, first_end, first_force = depth, q, force
            else:
                second, second_end, second_force = depth, q, force
            depth += 1
        if move != 0.0:
            heading = move
        while depth > 0 and move != 0.0:
            where = max(depth - 2, 0)
            far = second_end if where == second else (first_end if where == first else ends[where])
            if depth == 1:
                far = -far
            if move * (target - far) < 0.0:
                break
            depth -= min(depth, 2)
        origin, base, doubled = 0.0, 0.0, 1.0
        if depth > 0:
            where, doubled = depth - 1, 2.0
            origin = second_end if where == second else (first_end if where == first else ends[where])
            base = second_force if where == second else (first_force if where == first else forces[where])
        value = law_value(code, power, (target - origin) / doubled, 0.0, p)
        q, force, tangent = target, base + doubled * value[0], value[1]
    overflow = depth > len(ends)
    if write and not overflow:
        if 0 <= first < depth:
            ends[first], forces[first] = first_end, first_force
        if 0 <= second < depth:
            ends[second], forces[second] = second_end, second_force
        last[0], last[1], last[2], last[3] = q1, v1, force, heading
    return force, tangent, depth, overflow


@compiled
def sliders_walk(theta: float, stiffness: NDArray[np.float64], slip: NDArray[np.float64], last: NDArray[np.float64],
                 stretch: NDArray[np.float64], sliding: NDArray[np.float64], q1: float, v1: float, dt: float,
                 write: bool) -> tuple[float, float]:
    """Finite sliders over one step: force (N) and tangent (N/m).

    ``stiffness`` (N/m), ``slip`` (m) from ``memory.iwan_sliders``; ``stretch`` (m), ``sliding`` (sliders,) zeros at the start;
    ``last`` (2,) displacement and velocity; the last three are brought up to date with ``write``.
    """
    turned, extremum = memory.turning_point(last[0], last[1], q1, v1, dt)
    force, tangent = 0.0, 0.0
    for j in range(len(slip)):
        there, way = memory.slider_step(extremum - last[0], stretch[j], sliding[j], slip[j], theta)
        if turned:
            there, way = memory.slider_step(q1 - extremum, there, way, slip[j], theta)
        force += stiffness[j] * there
        if way == 0.0:
            tangent += stiffness[j]
        if write:
            stretch[j], sliding[j] = there, way
    if write:
        last[0], last[1] = q1, v1
    return force, tangent


@compiled
def bouc_wen_walk(p: NDArray[np.float64], last: NDArray[np.float64], q1: float, v1: float, dt: float, write: bool) -> tuple[float, float]:
    """A Bouc–Wen loop over one step: force (N) and tangent (N/m); ``last`` (3,) displacement, velocity, force."""
    turned, extremum = memory.turning_point(last[0], last[1], q1, v1, dt)
    move = extremum - last[0]
    z = memory.bouc_wen_step(last[2], move, p[0], p[1], p[2], p[3], p[4])
    if turned:
        move = q1 - extremum
        z = memory.bouc_wen_step(z, move, p[0], p[1], p[2], p[3], p[4])
    if write:
        last[0], last[1], last[2] = q1, v1, z
    return z, memory.bouc_wen_slope(z, move, p[0], p[1], p[2], p[3], p[4])


# --- memory along a whole path ------------------------------------------------------------------------------------------------


@compiled
def march_sliders(moves: NDArray[np.float64], stiffness: NDArray[np.float64], slip: NDArray[np.float64],
                  theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slider forces (B, N) along moves (N,); stiffness, slip (B, sliders), theta (B,)."""
    batch, count = slip.shape
    force = np.empty((batch, len(moves)))
    for b in range(batch):
        stretch, sliding = np.zeros(count), np.zeros(count)
        for i in range(len(moves)):
            for j in range(count):
                stretch[j], sliding[j] = memory.slider_step(moves[i], stretch[j], sliding[j], slip[b, j], theta[b])
            total = 0.0
            for j in range(count):
                total += stiffness[b, j] * stretch[j]
            force[b, i] = total
    return force


@compiled
def march_bouc_wen(moves: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bouc–Wen forces (B, N) along moves (N,); p (B, 5)."""
    batch = len(p)
    force = np.empty((batch, len(moves)))
    for b in range(batch):
        z = 0.0
        power, above, below, fixed, near, half, far = memory.bouc_wen_form(p[b, 0], p[b, 1], p[b, 2], p[b, 3], p[b, 4])
        for i in range(len(moves)):
            z = memory.bouc_wen_piece(z, moves[i], p[b, 0], power, above, below, fixed, near, half, far)
            force[b, i] = z
    return force


@compiled
def march_bouc_wen_each(start: NDArray[np.float64], moves: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bouc–Wen forces (B, N + 1) from a force (B,) along moves of each sample's own (B, N); p (B, 5)."""
    batch, count = moves.shape
    force = np.empty((batch, count + 1))
    for b in range(batch):
        force[b, 0] = start[b]
        power, above, below, fixed, near, half, far = memory.bouc_wen_form(p[b, 0], p[b, 1], p[b, 2], p[b, 3], p[b, 4])
        for i in range(count):
            force[b, i + 1] = memory.bouc_wen_piece(force[b, i], moves[b, i], p[b, 0], power, above, below, fixed, near, half, far)
    return force
