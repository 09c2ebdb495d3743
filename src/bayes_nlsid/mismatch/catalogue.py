"""The catalogue of missing physics: one row for each class of effect that a nominal model and its recordings may lack.

A row says in words what it claims, which law carries the claim, where it can sit, how likely it is beforehand, what it is confused
with and which test would separate it. Adding a class means adding a row (and, for a new kind of law, one Term); `with_rows` adds
rows for the time of one diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, final

from bayes_nlsid.mismatch.laws import ASYMMETRIC, CLEARANCE, COULOMB, HARDENING, HYSTERESIS, QUADRATIC, SOFTENING, Law

Kind = Literal["none", "force", "drift", "attachment", "input", "channel", "output", "incoherent", "other"]


@final
@dataclass(frozen=True)
class Row:
    """One class of the catalogue.

    Parameters
    ----------
    name : str
        Class in the vocabulary of a diagnosis.
    kind : str
        How it enters: a force at a place, a stiffness that drifts there, a linear attachment, the input chain, a sensor channel, a
        distortion of a channel, an incoherent disturbance.
    claim : str
        In words, ``{place}`` filled in.
    sits : str
        ``joints``, ``points``, ``sensors``, ``force``, ``base``, ``any`` or ``-``.
    prior : float
        Relative weight of the class before the data.
    phase : str
        displacement, velocity, memory, acceleration, input or channel.
    confused : tuple of str
    test : str
        What would separate it from those.
    laws : tuple of Law
    """

    name: str
    kind: Kind
    claim: str
    sits: str
    prior: float
    phase: str
    confused: tuple[str, ...]
    test: str
    laws: tuple[Law, ...] = ()
    preferred: str = ""


CATALOGUE: tuple[Row, ...] = (
    Row("none", "none", "nothing is missing: the nominal model within its tolerances explains the recordings", "-", 6.0, "-", (),
        "more periods and a higher level would lower the smallest effect that can be seen"),
    Row("hardening", "force", "a spring at {place} stiffens with amplitude", "joints", 1.0, "displacement", ("clearance", "asymmetric"),
        "one more level: the onset of a gap is sharp, that of a hardening spring smooth", HARDENING),
    Row("softening", "force", "a spring at {place} softens with amplitude and returns on the same line", "joints", 1.0, "displacement",
        ("hysteresis", "stiffness_drift"), "a slow reversal test: loss per cycle of a pure spring is zero", SOFTENING),
    Row("clearance", "force", "a gap at {place} closes above a certain motion", "joints", 1.0, "displacement", ("hardening", "clipping"),
        "a slow sine at large level: contact begins at one displacement", CLEARANCE),
    Row("asymmetric", "force", "stiffness at {place} differs between the two directions (preload, one-sided contact)", "joints", 1.0,
        "displacement", ("clearance", "hardening"), "a change of static preload moves the even distortion", ASYMMETRIC, "_open"),
    Row("coulomb", "force", "dry friction at {place}", "joints", 1.0, "velocity", ("hysteresis", "quad_damping"),
        "a very low level, where dry friction sticks", COULOMB),
    Row("quad_damping", "force", "damping at {place} grows with amplitude", "joints", 1.0, "velocity", ("hysteresis", "coulomb"),
        "two levels a factor of ten apart: loss factor rises with velocity, falls for friction", QUADRATIC),
    Row("hysteresis", "force", "friction with memory (micro-slip loops) at {place}", "joints", 1.0, "memory", ("softening", "quad_damping"),
        "a slow reversal test: loops follow reversal curves and loss grows with a power of amplitude", HYSTERESIS),
    Row("stiffness_drift", "drift", "stiffness at {place} changes over the test day", "joints", 1.0, "displacement",
        ("softening", "hysteresis"), "a repeat of the low level at the end of the day"),
    Row("linear_stiffness", "attachment", "linear stiffness at {place} lies outside its tolerance", "joints", 1.0, "displacement",
        ("other", "added_mass"), "a local drive-point measurement at the joint"),
    Row("added_mass", "attachment", "mass is missing at {place}", "points", 1.0, "acceleration", ("unmodelled_mode", "sensor_gain"),
        "a second known mass there, or weighing"),
    Row("unmodelled_mode", "attachment", "an attachment that resonates at {place} is not in the model", "points", 1.0, "displacement",
        ("added_mass", "linear_stiffness"), "touch it: its notch disappears; or a sensor on it"),
    Row("force_gain", "input", "the force cell reads wrong by a factor", "force", 1.0, "input", ("added_mass",),
        "weigh the structure, or calibrate the force cell on a known mass"),
    Row("force_delay", "input", "the force channel is delayed", "force", 1.0, "input", ("sensor_delay",),
        "a calibration mass: its phase must be zero"),
    Row("sensor_gain", "channel", "the gain of channel {place} is wrong", "sensors", 1.0, "channel", ("added_mass", "sensor_delay"),
        "swap two channels: a wrong gain moves with its cable"),
    Row("sensor_delay", "channel", "channel {place} is delayed", "sensors", 1.0, "channel", ("sensor_gain",),
        "swap two channels: a delay moves with its channel"),
    Row("sensor_drift", "incoherent", "channel {place} wanders at low frequency", "sensors", 1.0, "channel", ("clipping", "mains_hum"),
        "a long record with the shaker off"),
    Row("clipping", "output", "channel {place} is clipped", "sensors", 1.0, "channel", ("clearance", "sensor_drift"), "raise its range"),
    Row("mains_hum", "incoherent", "mains hum on {place}", "sensors", 1.0, "channel", ("asymmetric",),
        "a record with the amplifier on and the shaker at rest"),
    Row("base_motion", "incoherent", "the floor moves", "base", 1.0, "input", ("other",), "an accelerometer on the floor"),
    Row("other", "other", "something outside the catalogue acts at {place}", "any", 2.0, "-", (),
        "the latent force plotted against motion at the place shows what kind it is"),
)

ROWS: dict[str, Row] = {row.name: row for row in CATALOGUE}
"""The catalogue by name, with the user's own rows while they count; only `with_rows` changes it."""


@contextmanager
def with_rows(rows: Sequence[Row]) -> Iterator[None]:
    """Rows of the user's own, searched, weighed and told like the others while the context lasts; for every thread of this process.

    Raises
    ------
    ValueError
        If a name is taken.
    """
    taken = [row.name for i, row in enumerate(rows) if row.name in ROWS or row.name in [other.name for other in rows[:i]]]
    if taken:
        raise ValueError(f"the catalogue has {', '.join(taken)} already; choose another name")
    ROWS.update((row.name, row) for row in rows)
    try:
        yield
    finally:
        for row in rows:
            del ROWS[row.name]


def catalogue_rows() -> list[dict[str, str]]:
    """The catalogue as a table, all cells text: class, claim, where it sits, phase, confused with, what separates it."""
    return [{"class": r.name, "claim": r.claim.format(place="a place"), "sits": r.sits, "phase": r.phase,
             "confused with": ", ".join(r.confused), "separated by": r.test,
             "laws": ", ".join(law.term.name for law in r.laws)} for r in ROWS.values()]
