"""Pictures of the commands beside the run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayes_nlsid.study.pictures import CAPTION_BAND, Picture
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.store import Saved


def response_curves(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    """Stepped-sine response curves with their bands, and where the peaks lie."""
    from bayes_nlsid.study.figures import png
    from bayes_nlsid.study.figures_response import response_curves as draw

    saved = done["frf"]
    arrays, summary = saved.arrays, saved.data["summary"]
    if not np.isfinite(arrays["up_q50"]).any() and not np.isfinite(arrays["down_q50"]).any():
        return []
    several = summary["samples"] > 1
    caption = (f"Response at {summary['output']} to a slowly stepped sine force at {summary['input']}, per force: lines are whole curves "
               "of the draw nearest to the median, parts between turning points included. "
               + (f"{CAPTION_BAND} Shaded: what sweeps upwards and downwards meet. " if several else "")
               + "Right: where the peak lies at each level.")
    return [Picture("response_curves", "frf", caption, "stages/frf, frf.npz", png(draw, arrays, summary))]
