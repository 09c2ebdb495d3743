"""Figures: right numbers in words, nothing lost between the samples, every picture drawn without a warning."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.study.axes import axis_label, brief, brief_names, digits_for, engineering, places, prefixed, unit_sign


@pytest.mark.parametrize(("value", "unit", "text"), [
    (0.0254, "m", "25.4 mm"), (2.05e11, "N/m", "205 GN/m"), (1.2e-7, "m", "120 nm"), (4.1e8, "N/m^3", "4.10·10⁸ N/m³"),
    (0.0, "m", "0 m"), (float("nan"), "N", "–"), (-1500.0, "N", "-1.50 kN"), (0.5, "", "0.500"), (80.03, "Hz", "80.0 Hz"),
])
def test_engineering(value: float, unit: str, text: str) -> None:
    assert engineering(value, unit) == text


def test_prefix_is_that_of_the_largest() -> None:
    assert prefixed([1e-6, 3e-3], "m") == (1e3, "mm")
    assert prefixed([5.0], "m/s^2") == (1.0, "m/s²")
    assert prefixed([np.nan, np.inf], "m") == (1.0, "m")
    assert unit_sign("N s^0.5/m^-2") == "N s⁰·⁵/m⁻²" and axis_label("chi", "") == "chi"


def test_tied_locations_are_abbreviated() -> None:
    tied = "iwan4_memory[J1_slip+J2_slip+J3_slip+J4_slip+J5_slip].chi"
    assert brief(tied) == "iwan4_memory[J1_slip … J5_slip].chi"
    assert brief(f"at a bound: {tied}, cubic[a+b+c].k") == "at a bound: iwan4_memory[J1_slip … J5_slip].chi, cubic[a … c].k"
    for untouched in ("cubic[J1+J2].k", "f[1]", "q^2v", "a + b + c", "[1.0 + 2 + 3]"):
        assert brief(untouched) == untouched
    assert places(["a", "b"]) == "a, b" and places(["a", "b", "c"]) == "a … c"


def test_abbreviated_names_stay_different() -> None:
    names = ["cubic[a+b+d].k", "cubic[a+c+d].k", "quintic[a+b+d].k", "f[1]"]
    assert brief_names(names) == ["cubic[a+b+d].k", "cubic[a+c+d].k", "quintic[a … d].k", "f[1]"]


@pytest.mark.parametrize("text", ["iwan4_memory[J1_slip … J5_slip].f_s", "W" * 90, "a label of many words that nobody shortened",
                                  "costs $5 and $6", "two\nlines of text"])
@pytest.mark.parametrize("width", [0.8, 1.5, 4.0])
def test_fitted_text_is_no_wider_than_asked(text: str, width: float) -> None:
    from bayes_nlsid.study.figures import fitted, text_width

    lines = fitted(text, width, 8)
    assert text_width(lines, 8) <= width
    kept = [c for c in text if not c.isspace()]
    assert [c for c in lines if not c.isspace()] in (kept, [c for c in text.replace("].", "]") if not c.isspace()])


@pytest.mark.parametrize("label", ["short", "resonance decay, read from figures of two papers, 2022", "W" * 90, "many words " * 12])
def test_legend_stays_inside_the_figure(label: str) -> None:
    from bayes_nlsid.study import figures as f

    figure, grid = f.canvas(1, 2, height=3.0)
    handles = [grid[0][0].plot([0, 1])[0] for _ in range(7)]
    f.legend_below(figure, handles, [f"{k} {label}" for k in range(7)])
    figure.canvas.draw()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y0 >= 0
    assert all(axes.get_window_extent().y0 > box.y1 and axes.get_window_extent().height > 1.5 * figure.dpi for axes in figure.axes)


def test_titles_of_tied_joints_do_not_overlap() -> None:
    from matplotlib import rc_context
    from matplotlib.text import Text

    from bayes_nlsid.study import figures_inference as i
    from bayes_nlsid.study.figures import STYLE

    names = [f"a_long_force_law[J1_slip+J2_slip+J3_slip+J4_slip].{k}" for k in ("f_s", "k_t", "chi", "beta", "x")]
    draws = np.random.default_rng(0).standard_normal((200, 5))
    with rc_context(STYLE):
        figure = i.posterior_marginals(draws, names, [""] * 5, identifiable=[True, False, True, False, True])
        figure.canvas.draw()
    drawn = [text for axes in figure.axes[:5] for text in axes.findobj(Text) if "force_law" in text.get_text()]
    boxes = [text.get_window_extent() for text in drawn]
    assert len(boxes) == 5
    assert all(not a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[k + 1:])
    assert all(box.x1 <= figure.bbox.width and box.width > 10 for box in boxes)


def test_draws_over_decades_get_a_logarithmic_axis() -> None:
    """A slip force between 1 and 1000 N is one bar at zero on a linear axis; a signed or a well-known parameter stays linear."""
    from matplotlib.patches import Rectangle

    from bayes_nlsid.study import figures_inference as i

    rng = np.random.default_rng(2)
    draws = np.stack([10 ** rng.uniform(0, 3, 3000), rng.normal(size=3000), rng.normal(80, 0.1, 3000)], axis=1)
    names, units = ["a.f_s", "a.c", "f[1]"], ["N", "", "Hz"]
    alone = i.posterior_marginals(draws, names, units, prior=np.abs(draws) * 2).axes[:3]
    assert [axes.get_xscale() for axes in alone] == ["log", "linear", "linear"]
    bars = np.array([bar.get_height() for bar in alone[0].patches if isinstance(bar, Rectangle)][:44])
    assert bars.max() < 2.5 * np.median(bars[bars > 0]), "uniform in the logarithm looks level"
    assert alone[1].get_xlabel() == "no unit" and alone[2].get_xlabel() == "Hz"
    pairs = i.posterior_pairs(draws, names, units, worst=[0, 1]).axes
    assert [(axes.get_xscale(), axes.get_yscale()) for axes in (pairs[0], pairs[2])] == [("log", "linear"), ("log", "linear")]


def test_bars_of_damping_tell_how_well_it_is_known() -> None:
    from bayes_nlsid.study import figures as f

    measured = {"frequency": np.array([80.0, 298.0]), "zeta": np.array([2e-3, 1e-3]), "frequency_sd": np.array([0.02, 0.1]),
                "number": np.array([1, 2]), "zeta_sd": np.array([1e-4, 9e-4])}
    middle = f.linear_model(measured, {"frequency": np.array([79.0, 300.0])}, np.eye(2)).axes[1]
    ends = [segment[:, 0] for line in middle.collections for segment in line.get_segments()]
    assert ends == [pytest.approx([0.2 - 0.0165, 0.2 + 0.0165]), pytest.approx([0.1 - 0.1485, 0.1 + 0.1485])]


def test_energy_of_a_loop() -> None:
    """A viscous loop c·v over a sine of amplitude X at ω loses π c ω X²; every title has three digits and the same unit."""
    from bayes_nlsid.study import figures_prediction as p

    phase = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    c, omega = 3.0, 500.0
    loops = [{"location": name, "term": "c", "q": size * np.sin(phase), "force": np.tile(c * size * omega * np.cos(phase), (4, 1))}
             for name, size in (("J1", 1.5e-4), ("J2", 1.4047e-5), ("J3", 1e-8))]
    lost = np.pi * c * omega * np.array([1.5e-4, 1.4047e-5, 1e-8]) ** 2
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in p.joint_loops(loops).axes]
    assert f"{1e6 * lost[0]:.0f} µJ" in titles[0]
    assert f"{1e6 * lost[1]:#.3g} µJ" in titles[1] and "e+" not in "".join(titles)
    assert "nJ" in titles[2]


def test_backbone_starts_where_it_can_be_compared() -> None:
    from bayes_nlsid.study.figures_prediction import compared

    a = np.geomspace(1e-7, 1e-4, 20)
    bands = {"amplitude": a, "frequency_q50": np.where(a < 3e-7, np.nan, 80.0), "damping_q50": np.where(a < 3e-7, np.nan, 1e-3)}
    assert compared(bands) == (a[a >= 3e-7][0], a[-1])
    assert compared(bands, {"amplitude": np.array([2e-6, 2e-4])}) == (2e-6, 2e-4)
    assert compared({**bands, "frequency_q50": a * np.nan, "damping_q50": a * np.nan}) == (0.0, 0.0)


def test_digits_show_the_interval() -> None:
    low, high = 20.2984, 20.3011
    digits = digits_for(low, high)
    assert engineering(low, "Hz", digits) != engineering(high, "Hz", digits)
    assert digits_for(1.0, 2.0) == 3 and digits_for(1.0, 1.0) == 4


@pytest.mark.parametrize("n", [100, 3001, 4096, 65_536, 99_999])
def test_envelope_hides_nothing(n: int) -> None:
    from bayes_nlsid.study.figures import envelope

    rng = np.random.default_rng(n)
    time, signal = np.arange(n) / 100.0, rng.standard_normal(n)
    signal[-1] = 50.0
    t, low, high = envelope(time, signal)
    assert high.max() == 50.0 and low.min() == signal.min()
    assert len(t) <= 3000 and t[-1] >= time[-1] - 2 * n / 1500 / 100


def test_spectrum_of_white_noise() -> None:
    """Unit variance at 1000 Hz has a one-sided density of 2/1000, amplitude √0.002; the scatter of ten averages is a few per cent."""
    from bayes_nlsid.study.figures import spectrum

    frequency, amplitude = spectrum(np.random.default_rng(3).standard_normal(2**16), 1e-3)
    assert frequency[-1] == 500.0
    assert np.mean(amplitude[5:-5] ** 2) == pytest.approx(2e-3, rel=0.03)


def pictures() -> dict[str, Any]:
    """Every figure with synthetic numbers, also the awkward ones: nothing tried, one draw, NaN, a single joint."""
    from bayes_nlsid.study import figures as f
    from bayes_nlsid.study import figures_inference as i
    from bayes_nlsid.study import figures_prediction as p

    rng = np.random.default_rng(1)
    n = 3000
    t = np.arange(n) / 1000.0
    signals = np.stack([np.exp(-2 * t) * np.sin(2 * np.pi * 80 * t) * 200, rng.standard_normal(n)], axis=1)
    line = np.linspace(0, 500, 50)
    psd = np.full((50, 2), 1e-4)
    psd[:, 1] = np.nan
    modes = {"frequency": np.array([80.0, 298.0]), "zeta": np.array([2e-3, 1e-3]), "frequency_sd": np.array([0.02, 0.1]),
             "number": np.array([1, 2])}
    draws = np.array([2000.0, 1e8, -0.5, 0.1]) * (1 + 0.05 * rng.standard_normal((500, 4)))
    names = [f"iwan4[J1_slip].{x}" for x in ("f_s", "k_t", "chi", "beta")]
    units = ["N", "N/m", "", ""]
    chains = draws[:480].reshape(2, 30, 8, 4)
    a = np.geomspace(1e-5, 1e-3, 20)
    bands = {"amplitude": a, **{f"frequency_{q}": 80 - 500 * a + d for q, d in (("q05", -0.1), ("q50", 0.0), ("q95", 0.1))},
             **{f"damping_{q}": (1e-3 + a) * d for q, d in (("q05", 0.9), ("q50", 1.0), ("q95", 1.1))}}
    gaps = {k: np.where(a > 5e-4, np.nan, v) if k != "amplitude" else v for k, v in bands.items()}
    single = {k: bands[k.replace("q05", "q50").replace("q95", "q50")] for k in bands}
    loop = {"location": "J1_slip", "term": "iwan4", "q": 1e-6 * np.cos(t[:200] * 31.4), "force": rng.standard_normal((5, 200))}
    tried = [{"step": 0, "name": f"t{k}", "mse": 0.5 / (k + 1)} for k in range(20)]
    steps = [{"phase": "forward", "name": "t19", "mse": 0.025}, {"phase": "backward", "name": "t19", "mse": 0.026}]
    band = (signals[:, 0] - 1, signals[:, 0], signals[:, 0] + 1)
    return {
        "recording": (f.recording_overview, (t, signals, ["a", "force"], ["m/s^2", "N"]),
                      {"windows": [("train", 0.1, 1.0), ("all", 0.0, 3.0)], "noise": (line, psd), "band": (40.0, 160.0), "modes": [80.0]}),
        "linear": (f.linear_model, (modes, {"frequency": np.array([79.0, 300.0])}, np.eye(2)), {"before": np.array([70.0, np.nan])}),
        "selection": (i.selection_path, (steps, tried), {"floor": 1e-3, "linear": 0.6}),
        "no selection": (i.selection_path, ([], []), {"floor": None, "linear": 0.6}),
        "marginals": (i.posterior_marginals, (draws, names, units), {"prior": 2 * draws, "fit": draws[0], "identifiable": [1, 1, 0, 1]}),
        "one marginal": (i.posterior_marginals, (np.ones((50, 1)), names[:1], units[:1]), {}),
        "pairs": (i.posterior_pairs, (draws, names, units), {"worst": [3, 0, 1], "fit": draws[0]}),
        "convergence": (i.convergence, (chains[..., 0], chains, names, units), {"kept_from": 5, "worst": [0]}),
        "loops": (p.joint_loops, ([loop] * 4,), {}), "one loop": (p.joint_loops, ([loop],), {}),
        "backbone": (p.backbone_bands, (bands, {"amplitude": a, "frequency": 80 - 500 * a, "damping": 1e-3 + a}),
                     {"location": "tip", "numerical": np.full(20, 1e-3),
                      "published": [{"label": "paper", "frequency": (79, 81), "damping": None}],
                      "alternatives": [{"name": "static", "amplitude": a, "frequency": 0 * a + 80, "damping": 0 * a + 1e-3}]}),
        "backbone with gaps": (p.backbone_bands, (gaps,), {}), "backbone of one": (p.backbone_bands, (single,), {}),
        "heldout": (p.heldout_overlay, (t, signals[:, 0], *band),
                    {"unit": "m/s^2", "channel": "a", "zoom": 0.05, "noise": 0.1, "facts": "x"}),
    }


PICTURES = pictures()


@pytest.mark.parametrize("name", list(PICTURES))
def test_every_picture_is_drawn(name: str) -> None:
    """Warnings are errors, so a collapsed layout, an empty legend or a missing glyph fails here."""
    from bayes_nlsid.study.figures import DPI, WIDTH, png

    draw, arguments, options = PICTURES[name]
    image = png(draw, *arguments, **options)
    width, height = struct.unpack(">II", image[16:24])
    assert image[:4] == b"\x89PNG" and width == round(WIDTH * DPI) and height > 300
    if name in ("recording", "backbone"):
        assert image == png(draw, *arguments, **options), "the same numbers give the same bytes"
