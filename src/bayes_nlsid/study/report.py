"""The report: one page that tells what was found, how sure it is and what to do next, then shows the evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, final

from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.axes import brief, brief_names, digits_for, engineering, floor_text, percent, places, unit_sign, with_sd
from bayes_nlsid.study.pictures import Picture, idle
from bayes_nlsid.study.progress import duration
from bayes_nlsid.study.report_extras import comparison_section, response_section, scatter_section, stages_section
from bayes_nlsid.study.schema import Study
from bayes_nlsid.study.store import Saved
from bayes_nlsid.study.story import sound, status_words, story


@final
@dataclass(frozen=True)
class Report:
    """All that a report is made of.

    Parameters
    ----------
    study : Study
    done : dict of str to Saved
    result : dict
        What ``result.json`` holds.
    pictures : tuple of Picture
    text : str
        The study file as it was run.
    """

    study: Study
    done: Mapping[str, Saved]
    result: Mapping[str, Any]
    pictures: tuple[Picture, ...]
    text: str = ""


def render(report: Report) -> str:
    """The page as HTML, without any outside resource."""
    badge = f'<span class="badge {"ok" if sound(report.result) else "warn"}">{escape(status_words(report.result))}</span>'
    sections: list[tuple[str, str, Callable[[Report], str]]] = [
        ("recordings", "Recordings", _recordings), ("linear", "Linear model", _linear), ("selection", "Which force laws", _selection),
        ("posterior", "Parameters and their uncertainty", _posterior), ("prediction", "What the model predicts", _prediction),
        ("compare", "Alternatives compared", lambda r: comparison_section(r.done)),
        ("frf", "Response to stepped sines", lambda r: response_section(r.done)),
        ("montecarlo", "Scatter and what it comes from", lambda r: scatter_section(r.done)),
        ("provenance", "Where every number comes from", _provenance)]
    parts = [(name, title, make(report) + _figures(report, name)) for name, title, make in sections]
    parts = [part for part in parts if part[2]]
    links = "".join(f'<a href="#{name}">{escape(title)}</a>' for name, title, _ in parts)
    told = "".join(html.paragraph(sentence) for sentence in story(report.study, report.result))
    body = [f'<p class="soft">bayes_nlsid {escape(str(report.result["versions"].get("bayes_nlsid", "")))}, seed '
            f'{report.result["seed"]}</p>',
            f"<h1>{escape(report.study.title)}</h1>", f"<p>{badge}</p>", f'<div class="story">{told}</div>',
            '<p class="soft">Every number above stands in result.json; tables and figures below name the stage they come from.</p>',
            f"<nav>{links}</nav>"]
    body += [f'<section id="{name}"><h2>{escape(title)}</h2>{content}</section>' for name, title, content in parts]
    return html.page(report.study.title, "\n".join(body))


def _figures(report: Report, section: str) -> str:
    return "".join(html.picture(p.png, p.caption, f"{p.source}; figures/{p.name}.png", p.caption.split(":")[0].split(" (")[0])
                   for p in report.pictures if p.section == section)


def _recordings(report: Report) -> str:
    saved = report.done.get("read")
    if saved is None:
        return ""
    rows, findings = [], []
    for record in saved.data["recordings"]:
        for channel in record["channels"]:
            rows.append([record["name"], record["role"], channel["name"], channel["location"], _units(channel),
                         f"{record['seconds']:.3g} s", f"{record['rate']:.6g} Hz",
                         f"{channel['peak']:.3g} {unit_sign(channel['unit'])}", f"{channel['noise_rms']:.2g} {unit_sign(channel['unit'])}"])
        for channel in record["inputs"]:
            rows.append([record["name"], record["role"], channel["name"], channel["location"], _units(channel),
                         f"{record['seconds']:.3g} s", f"{record['rate']:.6g} Hz",
                         f"{channel['peak']:.3g} N", "–"])
        findings += [f"{record['name']}, {f['channel']}: {f['sentence']}" if f["channel"] else f"{record['name']}: {f['sentence']}"
                     for f in record["findings"]]
    head = ["recording", "role", "channel", "location", "unit in the file → here", "length", "rate", "peak", "noise (rms)"]
    how = list(dict.fromkeys(f"Noise floor: {r['noise']}" for r in saved.data["recordings"]))
    said = "".join(html.paragraph(sentence, "soft") for sentence in how[:3])
    return html.table(head, rows, "stages/read", numeric=(5, 6, 7, 8)) + html.listing(findings) + said


def _units(channel: Mapping[str, Any]) -> str:
    """``g → m/s²``: what the file holds and what it was converted to, once."""
    return f"{unit_sign(channel.get('file_unit') or '?')} → {unit_sign(channel['unit'])}"


def _linear(report: Report) -> str:
    saved = report.done.get("linear")
    if saved is None:
        return ""
    rows = [[str(m["number"]), with_sd(m["measured_hz"], m["measured_sd"]), "–" if m["stated_hz"] is None else f"{m['stated_hz']:.5g}",
             f"{m['model_hz']:.5g}", f"{100 * (m['model_hz'] / m['measured_hz'] - 1):+.2f} %",
             with_sd(m["zeta"], m["zeta_sd"], 100, "%"),
             f"{m['mac']:.3f}", m["status"]] for m in saved.data["modes"]]
    head = ["mode", "measured (Hz)", "as stated (Hz)", "updated (Hz)", "error left", "damping", "MAC", "remark"]
    out = html.table(head, rows, "stages/linear; ± one standard deviation", numeric=(1, 2, 3, 4, 5, 6))
    scaled = [[u["part"], f"× {u['factor']:.4g}", f"{100 * u['log_sd']:.2g} %"] for u in saved.data["updated"]]
    out += html.table(["part of the structure", "scaled by", "standard deviation"], scaled, "stages/linear", numeric=(1, 2))
    out += html.listing([f"Polarity: {p['sentence']}" for p in saved.data["polarity"]])
    return out + html.listing(saved.data["notes"])


def _selection(report: Report) -> str:
    saved = report.done.get("identify")
    if saved is None:
        return ""
    rows = []
    for record in saved.data["variants"]:
        terms = "; ".join(f"{e['term']} at {places(e['locations'])}" for e in record["elements"]) or "none (linear)"
        share = 1 - record["mse"] / record["mse_linear"] if record["mse_linear"] > 0 else 0.0
        rows.append([record["name"], terms, f"{record['mse_linear']:.3g}", f"{record['mse']:.3g}", f"{record['floor']:.2g}",
                     f"{100 * share:.1f} %",
                     record["status"]])
    head = ["form", "force laws", "mean square, linear", "with them", "noise floor", "explained", "fit"]
    how = "mean squares in N²/kg, weighted by the noise of the sensors where it is known"
    out = html.table(head, rows, f"stages/identify, scenario {saved.data['scenario']}; {how}", numeric=(2, 3, 4, 5))
    steps = [[record["name"], s["action"], brief(s["element"]), f"{s['mse']:.4g}", "yes" if s["accepted"] else "no", brief(s["reason"])]
             for record in saved.data["variants"] for s in record.get("path", [])]
    if steps:
        steps_table = html.table(["form", "round", "candidate", "mean square", "accepted", "why"], steps, "stages/identify", numeric=(3,))
        out += f"<details open><summary>Every round of the selection</summary>{steps_table}</details>"
    out += _motion(saved.data.get("motion", ()))
    return out + "".join(_alike(record["name"], record["aliases"]) for record in saved.data["variants"] if record.get("aliases"))


def _motion(rows: Sequence[Mapping[str, Any]]) -> str:
    """How far displacement and velocity, integrated from what was measured, are to be trusted."""
    if not rows:
        return ""
    cells = [[row["record"], f"{row['band_hz'][0]:.4g}–{row['band_hz'][1]:.4g} Hz", f"{row['span_s'][0]:.3g}–{row['span_s'][1]:.3g} s",
              ", ".join(f"{name} {percent(error)}" for name, error in zip(row["channels"], row["error"], strict=True))] for row in rows]
    head = ["record", "motion seen in", "without edge effects", "estimated error of the motion of each channel"]
    return html.details("From recordings to motion: band and error of the integration", html.table(head, cells, "stages/identify"))


def _alike(form: str, aliases: Sequence[str], most: int = 6) -> str:
    """What the recordings cannot tell from the choice: how many at once, the first of them on demand."""
    count = f"{len(aliases)} other force law{'s' if len(aliases) > 1 else ''}"
    more = f" and {len(aliases) - most} more (all of them: result.json, aliases)" if len(aliases) > most else ""
    return html.details(f"{form}: the recordings do not tell {count} from what was chosen",
                        html.paragraph(", ".join(brief_names(aliases)[:most]) + more))


def _posterior(report: Report) -> str:
    rows = []
    parameters = report.result.get("parameters", [])
    for p, name in zip(parameters, brief_names([p["name"] for p in parameters]), strict=True):
        u = p["unit"]
        digits = digits_for(p["q05"], p["q95"]) if p.get("q05") is not None else 4
        quantiles = [engineering(p[q], u, digits) if p.get(q) is not None else "–" for q in ("q05", "q50", "q95")]
        known = "–" if "identifiable" not in p else "yes" if p["identifiable"] else "no: " + _why_not(p)
        rows.append([name, engineering(p["fit"], u, digits) if p["fit"] is not None else "–", *quantiles, known,
                     "–" if p.get("ess") is None else f"{p['ess']:.0f}"])
    head = ["parameter", "least squares", "5 %", "50 %", "95 %", "identifiable", "effective draws"]
    out = html.table(head, rows, "stages/identify, stages/posterior (posterior.nc)", numeric=(1, 2, 3, 4, 6))
    saved = report.done.get("posterior")
    if saved is None:
        return out
    c = saved.data["convergence"]
    facts = [["ensembles × steps", f"{c['ensembles']} × {c['steps']}"], ["converged", "yes" if c["converged"] else "no"],
             ["largest R-hat over ensembles", f"{c['rhat_max']:.4f}" if c["rhat_max"] is not None else "–"],
             ["smallest effective sample size", f"{c['ess_min']:.0f}" if c["ess_min"] is not None else "–"],
             ["walkers re-drawn in burn-in, or stuck after it", str(c["stuck_walkers"])]]
    out += html.table(["sampler", ""], facts, "stages/posterior")
    out += stages_section(saved.data, parameters)
    out += _common_values(saved.data.get("groups", []))
    priors = [[brief(p["parameter"]), brief(p["text"])] for p in saved.data.get("priors", [])]
    table = html.table(["parameter", "prior"], priors, "stages/posterior")
    return out + html.details("What was assumed beforehand (priors)", table)


def _common_values(groups: Sequence[Mapping[str, Any]]) -> str:
    """Nominally equal joints: their common value and how much they scatter around it."""
    rows = []
    for g in groups:
        absolute = g["scatter_of"] == "parameter"
        shown = [engineering(g["common"][q], g["unit"], 4) for q in ("q05", "q50", "q95")]
        rows.append([brief(g["group"]), *shown, *(engineering(g["scatter"][q], g["unit"], 3) if absolute else f"{g['scatter'][q]:.2g}"
                                                 for q in ("q05", "q50", "q95")), "the value" if absolute else f"its {g['scatter_of']}"])
    head = ["nominally equal", "common, 5 %", "50 %", "95 %", "scatter, 5 %", "50 %", "95 %", "scatter of"]
    return html.table(head, rows, "stages/posterior", numeric=(1, 2, 3, 4, 5, 6)) if rows else ""


def _why_not(parameter: Mapping[str, Any]) -> str:
    """Why a parameter is not determined."""
    low, high = parameter["q05"], parameter["q95"]
    if parameter.get("narrowing", 0.0) > 0.8:
        return "as wide as assumed"
    return "spread over a decade or more" if low > 0 and high > 10 * low else "piled up at a bound"


def _prediction(report: Report) -> str:
    saved = report.done.get("predict")
    if saved is None:
        return ""
    rows = [[e["record"], percent(e["nrmse"]), percent(e.get("nrmse_linear")), floor_text(e),
             "–" if e.get("coverage90") is None else f"{100 * e['coverage90']:.0f} %", engineering(e["rmse"], e["unit"])
             if e.get("rmse") is not None else "–"]
            for e in saved.data.get("heldout", [])]
    out = html.table(["record not fitted", "NRMSE", "linear model", "noise floor", "inside 90 % band", "RMSE"], rows, "stages/predict",
                     numeric=(1, 2, 3, 4, 5))
    published = [[p.label, "–" if p.frequency is None else f"{p.frequency[0]:g}–{p.frequency[1]:g} Hz",
                  "–" if p.damping is None else f"{100 * p.damping[0]:.3g}–{100 * p.damping[1]:.3g} %", p.text]
                 for p in report.study.report.published]
    out += html.table(["published by others", "frequency", "damping", ""], published, "the study file")
    silent = [f"No force over the whole recorded motion: {text}" for text in idle(saved)]
    return out + html.listing([*map(brief, saved.data.get("notes", [])), *silent])


def _provenance(report: Report) -> str:
    stages = [[name, duration(s.seconds), s.key[:16], f"stages/{name}/", s.versions.get("numpy", "–"), s.versions.get("python", "–")]
              for name, s in report.done.items()]
    out = html.table(["stage", "took", "hash of inputs", "files", "numpy", "python"], stages, "stages/*/stage.json", hashes=(2,))
    out += html.table(["input file", "SHA-256"], [[n, h] for n, h in report.study.inputs], "the study file", hashes=(1,))
    versions = [[name, str(value)] for name, value in report.result["versions"].items()]
    out += html.table(["package", "version"], versions, "the run that wrote this report")
    if report.text:
        out += f"<details><summary>The study file</summary><pre>{escape(report.text)}</pre></details>"
    return out
