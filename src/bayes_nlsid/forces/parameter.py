"""A parameter of a force law: its unit, its sign, and the rule that bounds it (Section 2.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np

BoundRule = Literal["coefficient", "stiffness", "force", "displacement", "velocity", "range"]


@final
@dataclass(frozen=True)
class Param:
    """One parameter of a force law.

    Parameters
    ----------
    name : str
        Name within the term, e.g. ``"f_s"``.
    unit : str
        SI unit, ``""`` if dimensionless, e.g. ``"N/m^3"``.
    rule : str
        How bounds follow from the data: ``coefficient`` (signed: ± largest linear force over largest value of the term),
        ``stiffness`` and ``force`` (positive, up to the stiffness or force that the linear motion carries), ``displacement`` and
        ``velocity`` (positive, up to the largest relative motion at the element), ``range`` (``lower`` to ``upper`` as given).
    lower, upper : float
        Used by ``range``; for positive rules ``lower`` is the smallest admissible fraction of the upper bound.
    meaning : str
        In words, for tables and reports.

    Raises
    ------
    ValueError
        If the rule is unknown, or a ``range`` is empty.
    """

    name: str
    unit: str
    rule: BoundRule
    lower: float = 1e-6
    upper: float = 1.0
    meaning: str = ""

    def __post_init__(self) -> None:
        if self.rule not in ("coefficient", "stiffness", "force", "displacement", "velocity", "range"):
            raise ValueError(f"parameter {self.name!r}: unknown bound rule {self.rule!r}")
        if not (np.isfinite([self.lower, self.upper]).all() and self.lower < self.upper):
            raise ValueError(f"parameter {self.name!r}: lower {self.lower} must be finite and below upper {self.upper}")

    @property
    def signed(self) -> bool:
        """Whether the parameter may be negative."""
        return self.rule == "coefficient" or (self.rule == "range" and self.lower < 0)
