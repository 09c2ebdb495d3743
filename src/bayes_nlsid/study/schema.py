"""What a study file says, checked and in SI: plain frozen records, one for each table."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, final

from bayes_nlsid.recordings.reading import RecordingSpec

StructureKind = Literal["beam", "matrices", "oscillator"]
STAGES = ("read", "linear", "identify", "posterior", "predict", "report")
EXTRAS = ("frf", "montecarlo", "compare")
"""Stages with commands of their own, computed from a finished run."""


@final
@dataclass(frozen=True)
class StructureEntry:
    """``[structure]``: ``values`` are the parameters of the builder of ``kind``, in SI."""

    kind: StructureKind
    values: tuple[tuple[str, Any], ...] = ()
    files: tuple[tuple[str, Path], ...] = ()

    @property
    def parameters(self) -> dict[str, Any]:
        """``values`` as a dictionary."""
        return dict(self.values)


@final
@dataclass(frozen=True)
class ReductionEntry:
    """``[reduction]``: ``masters`` are groups (``"sensors"``, ``"inputs"``, ``"joints"``) or names of degrees of freedom.

    ``damping`` is the ratio of modes that are not measured; by default that of the damping matrix, or 0.1 % and free within a factor of 30.
    """

    method: Literal["none", "guyan", "iirs"] = "none"
    masters: tuple[str, ...] = ("sensors", "inputs", "joints")
    modes: int | None = None
    iterations: int = 30
    damping: float | None = None


@final
@dataclass(frozen=True)
class LinearEntry:
    """``[linear]``: where modes are measured and which parts of the structure are updated to them.

    ``modes`` are 1-based; ``update`` names parts of the structure, or groups of parts that share one factor; ``damping`` overrides what
    is measured, mode by mode; ``use_measured`` puts the measured frequencies into the model for identification. ``file`` holds modes that
    a test program found, in place of a recording; ``sensors`` are names in that file by location.
    """

    recording: str | None = None
    window: tuple[float, float] | None = None
    modes: tuple[int, ...] = ()
    update: tuple[tuple[str, tuple[str, ...]], ...] = ()
    damping: tuple[float, ...] = ()
    use_measured: bool = True
    file: Path | None = None
    sensors: tuple[tuple[str, str], ...] = ()


@final
@dataclass(frozen=True)
class ElementEntry:
    """``[[identification.elements]]``: a term whose form and place are known; only its parameters are estimated."""

    term: str
    locations: tuple[str, ...]
    tied: bool = False
    excess: bool = True
    fixed: tuple[tuple[str, float], ...] = ()


@final
@dataclass(frozen=True)
class AlternativeEntry:
    """``[[identification.alternatives]]``: another set of candidates, selected and predicted beside the main one."""

    name: str
    candidates: tuple[str, ...] = ()
    elements: tuple[ElementEntry, ...] = ()


@final
@dataclass(frozen=True)
class IdentificationEntry:
    """``[identification]``: Sections 2.2 and 2.3.

    ``modes``, ``main`` and ``free_modes`` are 1-based. ``candidates`` are names of terms with groups already spelled out; empty means
    that the form is known (``elements``). ``band`` (Hz) bounds the residual, ``rate`` (Hz) lowers the sampling, ``mode_bands`` gives
    each mode a filter of its own. ``frequency_widening`` and ``damping_widening``
    multiply the ±5 % and ±20 % of the linear bounds. ``places`` is the number of displacements between which force laws are interpolated
    while searching, 0 for none. ``most`` is the largest number of terms that a selection may keep. ``settle`` (s) is the start of every
    training record that enters the memory of the joints but not the residual. ``output_error`` refines the regression by least squares
    on the simulated response. ``free_gain`` estimates one factor on all recorded forces along.
    """

    scenario: str = "S2"
    main: int = 1
    modes: tuple[int, ...] = (1,)
    free_modes: tuple[int, ...] = ()
    band: tuple[float, float] | None = None
    joints: tuple[str, ...] = ()
    candidates: tuple[str, ...] = ()
    elements: tuple[ElementEntry, ...] = ()
    alternatives: tuple[AlternativeEntry, ...] = ()
    tied: bool = False
    excess: bool = True
    widening: float = 1.0
    eps1: float | None = None
    eps2: float | None = None
    starts: int = 50
    rate: float | None = None
    mode_bands: tuple[tuple[float, float], ...] = ()
    static_correction: bool = False
    settle: float = 0.0
    most: int = 6
    frequency_widening: float = 1.0
    damping_widening: float = 1.0
    places: int = 192
    output_error: bool = False
    free_gain: bool = False


@final
@dataclass(frozen=True)
class UserTermEntry:
    """``[[terms]]``: a term of the user's own, from a checked expression.

    ``params``: name and (unit, rule) or (unit, rule, lower, upper) of each coefficient.
    """

    name: str
    formula: str
    params: tuple[tuple[str, tuple[Any, ...]], ...]
    memory: Literal["none", "masing"] = "none"
    meaning: str = ""


@final
@dataclass(frozen=True)
class PriorEntry:
    """``[[posterior.priors]]``: what is known of a parameter before the recording, in physical units.

    ``parameter`` may hold ``*`` for any part of a name. ``a`` and ``b`` are what ``Prior`` takes for ``kind``; ``lower`` and ``upper`` cut
    it, by default at the bounds of the identification.
    """

    parameter: str
    kind: Literal["normal", "lognormal", "uniform", "loguniform", "halfnormal", "logitnormal"]
    a: float = 0.0
    b: float = 1.0
    lower: float | None = None
    upper: float | None = None


@final
@dataclass(frozen=True)
class GroupEntry:
    """``[[posterior.groups]]``: one parameter of nominally equal joints, whose values scatter around a common one that is not known.

    ``parameters`` are names or patterns with ``*``. ``scatter`` is the scale of the half-normal prior of the standard deviation between the
    joints: of the natural logarithm for log-normal and log-uniform priors, of the logit for logit-normal ones, else in the unit of the
    parameter; None takes 0.3, or 0.3 standard deviations of the prior of the common value.
    """

    parameters: tuple[str, ...]
    scatter: float | None = None


@final
@dataclass(frozen=True)
class PosteriorEntry:
    """``[posterior]``: ``steps`` after burn-in, or None to go on until converged; ``most`` limits them, burn-in included.

    ``stage``: the residual of Eq. 13 ("regression"), the measured channels through simulation ("forward"), or one after the other
    ("both"); None takes both where the recordings are short enough.
    """

    likelihood: str = "whittle"
    ensembles: int = 4
    steps: int | None = None
    most: int | None = None
    walkers: int | None = None
    priors: tuple[PriorEntry, ...] = ()
    stage: Literal["regression", "forward", "both"] | None = None
    groups: tuple[GroupEntry, ...] = ()


@final
@dataclass(frozen=True)
class PredictionEntry:
    """``[prediction]``: the backbone (release from a mode shape, zero crossings) and records kept for judging.

    ``at`` names the location whose amplitude is meant, ``amplitude`` (m) where the release starts, ``mode`` is 1-based, ``seconds``
    the length of the decay, ``samples`` the number of posterior draws. ``score`` says where records kept for judging are compared:
    ``"band"``, that of the identification, or ``"all"`` frequencies, zero included; ``tolerance`` is the relative error of the
    integrator accepted for them (by default a fifth of the noise).
    """

    at: str
    amplitude: float
    mode: int = 1
    samples: int = 100
    seconds: float | None = None
    fs: float | None = None
    scheme: Literal["hht", "exponential"] = "hht"
    amplitudes: tuple[float, ...] = ()
    measured: str | None = None
    band: tuple[float, float] | None = None
    heldout: tuple[str, ...] = ()
    draws: int = 100
    score: Literal["band", "all"] = "band"
    tolerance: float | None = None


@final
@dataclass(frozen=True)
class CompareEntry:
    """``[compare]``: which scenarios the main form is fitted in, and the number of posterior draws of each alternative."""

    scenarios: tuple[str, ...] = ("S1", "S2", "S3")
    samples: int = 100


@final
@dataclass(frozen=True)
class FrfEntry:
    """``[frf]``: stepped-sine response curves of ``nlsid frf``.

    ``drive`` (``input`` in the file) and ``at`` (``output``) name locations, ``levels`` are amplitudes of the force (N), ``band`` is in Hz,
    ``harmonics`` the highest, None to find how many are needed; ``samples`` is the number of posterior draws.
    """

    drive: str
    at: str
    levels: tuple[float, ...]
    band: tuple[float, float]
    harmonics: int | None = None
    samples: int = 100


@final
@dataclass(frozen=True)
class SpreadEntry:
    """``[[montecarlo.parameters]]``: the distribution of a parameter, which may hold ``*`` for any part of a name.

    ``centre`` is the mean (normal) or median (lognormal), None for the value of the fit; ``spread`` the standard deviation, of the natural
    logarithm for lognormal; ``relative`` says that it is a share of the centre. Uniform kinds use ``lower`` and ``upper`` only; they cut
    the others.
    """

    parameter: str
    kind: Literal["normal", "lognormal", "uniform", "loguniform"] = "normal"
    centre: float | None = None
    spread: float = 0.0
    relative: bool = False
    lower: float | None = None
    upper: float | None = None


@final
@dataclass(frozen=True)
class MonteCarloEntry:
    """``[montecarlo]``: backbones of many parameter samples, for ``nlsid montecarlo``.

    ``source`` is ``"posterior"`` (draws as they are) or ``"fit"`` (independent distributions around or beside the fit: ``spreads``).
    ``at``, ``amplitude``, ``mode`` and ``amplitudes`` are those of ``[prediction]`` where not given. ``indices``: whether Sobol indices are
    wanted. ``path``: averaging ("fast"), time integration, or averaging with time integration where that refuses ("auto").
    """

    source: Literal["posterior", "fit"]
    at: str
    amplitude: float
    mode: int = 1
    amplitudes: tuple[float, ...] = ()
    spreads: tuple[SpreadEntry, ...] = ()
    samples: int = 1000
    indices: bool = True
    path: Literal["auto", "fast", "time"] = "auto"


@final
@dataclass(frozen=True)
class PublishedEntry:
    """``[[report.published]]``: a figure from the literature to stand beside ours; spans of frequency (Hz) and damping ratio."""

    label: str
    frequency: tuple[float, float] | None = None
    damping: tuple[float, float] | None = None
    text: str = ""


@final
@dataclass(frozen=True)
class ReportEntry:
    """``[report]``: ``notes`` are sentences that belong into the story."""

    notes: tuple[str, ...] = ()
    published: tuple[PublishedEntry, ...] = ()
    window: tuple[float, float] | None = None


@final
@dataclass(frozen=True)
class PlanJointEntry:
    """``[[plan.joints]]``: a suspected joint with assumed values of its parameters, SI."""

    term: str
    locations: tuple[str, ...]
    values: tuple[tuple[str, float], ...]
    tied: bool = False
    excess: bool = True


@final
@dataclass(frozen=True)
class PlanEntry:
    """``[plan]``: places for sensors and shaker, band (Hz), rms levels (N), rms noise of a sensor in the band (SI), record length (s)."""

    sensors: tuple[str, ...]
    inputs: tuple[str, ...]
    band: tuple[float, float]
    levels: tuple[float, ...]
    noise: float
    seconds: float
    quantity: str
    joints: tuple[PlanJointEntry, ...]


@final
@dataclass(frozen=True)
class Study:
    """A whole study file.

    Parameters
    ----------
    file : Path
    title : str
    seed : int
    structure : StructureEntry
    reduction : ReductionEntry
    recordings : tuple of RecordingSpec
    linear : LinearEntry
    identification, posterior, prediction : entries or None
        A stage whose table is missing is not run.
    frf, montecarlo, compare : entries or None
        What the commands of these names compute.
    terms : tuple of UserTermEntry
    report : ReportEntry
    locations : tuple of str
        Every location the structure knows.
    inputs : tuple of (str, str)
        Files the study reads, relative to it where possible, with their SHA-256.
    """

    file: Path
    title: str
    seed: int
    structure: StructureEntry
    reduction: ReductionEntry = field(default_factory=ReductionEntry)
    recordings: tuple[RecordingSpec, ...] = ()
    linear: LinearEntry = field(default_factory=LinearEntry)
    identification: IdentificationEntry | None = None
    terms: tuple[UserTermEntry, ...] = ()
    posterior: PosteriorEntry | None = None
    prediction: PredictionEntry | None = None
    report: ReportEntry = field(default_factory=ReportEntry)
    frf: FrfEntry | None = None
    montecarlo: MonteCarloEntry | None = None
    locations: tuple[str, ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()
    plan: PlanEntry | None = None
    compare: CompareEntry | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages this study names, in order."""
        asked = {"identify": self.identification, "posterior": self.posterior, "predict": self.prediction}
        return tuple(stage for stage in STAGES if stage not in asked or asked[stage] is not None)

    def recording(self, name: str) -> RecordingSpec:
        """The specification of a recording.

        Raises
        ------
        ValueError
            If there is none of that name.
        """
        for entry in self.recordings:
            if entry.name == name:
                return entry
        raise ValueError(f"no recording {name!r}; known are {[r.name for r in self.recordings]}")
