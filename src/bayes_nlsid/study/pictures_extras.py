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
               "of the draw nearest to the median, dotted where the motion is not stable. "
               + (f"{CAPTION_BAND} Shaded: what sweeps upwards and downwards meet. " if several else "")
               + "Right: where the peak lies at each level.")
    return [Picture("response_curves", "frf", caption, "stages/frf, frf.npz", png(draw, arrays, summary))]


def scatter(study: Study, done: Mapping[str, Saved]) -> list[Picture]:
    """The band, the parameters it comes from, who is to blame, and whether there are enough samples."""
    from bayes_nlsid.study import figures_scatter as draw
    from bayes_nlsid.study.figures import png

    saved = done["montecarlo"]
    arrays, data = saved.arrays, saved.data
    s, source = data["summary"], "stages/montecarlo, montecarlo.npz"
    if not np.isfinite(arrays["frequency_q50"]).any():
        return []
    meant = "draws of the posterior" if s["source"] == "posterior" else "independent scatter of the parameters, not a posterior"
    out = [Picture("scatter_band", "montecarlo", f"Backbones of {s['samples']} samples ({meant}): thin lines are single samples, the band "
                   "holds 90 % of them.", source, png(draw.band, arrays, s)),
           Picture("scatter_parameters", "montecarlo", "How the parameters were sampled; lines mark 5, 50 and 95 %.", source,
                   png(draw.parameters, arrays["samples_theta"], data["names"], data["units"]))]
    if s["sensitivity"]:
        out.append(Picture("sensitivity", "montecarlo", "Share of the variance that each parameter accounts for, along the amplitude: "
                           "alone (first order) and with all it takes part in (total); shaded: 90 % confidence.", source,
                           png(draw.shares, arrays, data["names"])))
    out.append(Picture("tornado", "montecarlo", "Swing of each parameter from its 5 % to its 95 % point with all others at their medians, "
                       "at the largest amplitude.", source, png(draw.tornado, arrays, data["names"])))
    if len(arrays["convergence_count"]) > 1:
        out.append(Picture("scatter_convergence", "montecarlo", "The band's edges and median at the largest amplitude against the number "
                           "of samples.", source, png(draw.settling, arrays)))
    return out
