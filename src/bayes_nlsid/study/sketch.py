"""Where the places of a case folder lie on its structure, as far as ``geometry`` in ``case.json`` tells; for drawing only."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final


@final
@dataclass(frozen=True)
class Sketch:
    """Two lapped beams seen from the side.

    Parameters
    ----------
    beams : tuple of (name, left, right, bottom, top), m
    points : dict of str to (x, y), m
        Every place that could be found: joints, root, tip, shaker, sensors, points that carry mass.
    """

    beams: tuple[tuple[str, float, float, float, float], ...]
    points: dict[str, tuple[float, float]]

    @property
    def length(self) -> float:
        """m."""
        return max(b[2] for b in self.beams)


def sketch_of(folder: Path) -> Sketch | None:
    """The sketch of a case folder; None where the geometry is missing or of another kind."""
    try:
        said = json.loads((folder / "case.json").read_text(encoding="utf-8"))
        return _lapped(said["geometry"], said.get("locations") or {})
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        return None


def _lapped(g: Mapping[str, Any], locations: Mapping[str, Any]) -> Sketch:
    """From lengths, heights and positions along the beams, m."""
    first, second = float(g["L_A"]), float(g["L_B"])
    start = first - float(g["overlap"])
    low, high = float(g["h_A"]), float(g["h_B"])
    beams = (("A", 0.0, first, 0.0, low), ("B", start, start + second, low, low + high))
    middle = {name: (bottom + top) / 2 for name, _, _, bottom, top in beams}
    points: dict[str, tuple[float, float]] = {"TIP_w": (start + second, middle["B"]), "ROOT_rot": (0.0, middle["A"]),
                                             "BASE": (0.0, middle["A"])}
    for s in g["sensors"]:
        at = (float(s["x"]), low + high if s["beam"] == "B" else low)
        points[str(s["name"])] = at
        if "mass_point" in s:
            points[str(s["mass_point"])] = at
    if "shaker" in g:
        points["SHAKER"] = points["FORCE"] = (float(g["shaker"]["x"]), 0.0 if g["shaker"]["beam"] == "A" else low)
    for name in locations.get("joints", ()):
        joint = re.match(r"J(\d+)_", str(name))
        if joint:
            points[str(name)] = (float(g["joints"][int(joint.group(1)) - 1]), low)
    return Sketch(beams, points)
