"""The command ``nlsid diagnose``: run the mismatch engine on a case folder, write its files, figures and page."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.diagnose import diagnose
from bayes_nlsid.mismatch.diagnosis import Diagnosis, write_diagnosis
from bayes_nlsid.study import report_page as html
from bayes_nlsid.study.axes import digits_for, engineering
from bayes_nlsid.study.lock import held
from bayes_nlsid.study.progress import Reporter, duration
from bayes_nlsid.study.store import versions, write_atomic, writing


def run_diagnosis(path: Path | str, out: Path | str, *, seed: int | None = None, reporter: Reporter | None = None) -> Diagnosis:
    """Diagnose a study or a case folder and leave ``diagnosis.json``, ``predictions.npz``, ``report.html`` and ``figures/`` in ``out``.

    Raises
    ------
    InputError
        If the case cannot be used, or ``out`` cannot be written.
    """
    case, folder = Path(path), Path(out)
    if folder.exists() and not folder.is_dir():
        raise InputError(str(folder), "the output folder is a file", "choose another --out")
    try:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(folder), f"cannot be made ({error.strerror})", "choose another --out") from None
    with writing(folder), held(folder / "figures" / "lock"):
        return _carry_out(case, folder, seed, reporter)


def _carry_out(case: Path, folder: Path, seed: int | None, reporter: Reporter | None) -> Diagnosis:
    """Diagnose and write, with the folder held."""
    told = reporter if reporter is not None else Reporter((folder / "run.log",))
    told.begin(1, 2, "diagnose", str(case))
    found = _diagnosed(case, seed, told)
    told.end(found.seconds, reused=False)
    told.begin(2, 2, "report", "always written anew")
    write_diagnosis(found, folder)
    pictures = _pictures(found)
    for name, (image, _) in pictures.items():
        write_atomic(folder / "figures" / f"{name}.png", image)
    write_atomic(folder / "report.html", _page(found, pictures).encode())
    told.end(0.0, reused=False)
    return found


def _diagnosed(path: Path, seed: int | None, told: Reporter) -> Diagnosis:
    """A study goes to the engine for recordings of any kind; so does a case folder whose records are not what its own engine needs."""
    from bayes_nlsid.mismatch.recorded_answer import diagnose_campaign

    if path.is_dir():
        from bayes_nlsid.mismatch.case_campaign import campaign_from_case, needs_general

        if not needs_general(path):
            return diagnose(path, seed or 0, lambda sentence: told.update(0.0, sentence))
        campaign = campaign_from_case(path)
    else:
        from bayes_nlsid.study.campaigns import campaign_of
        from bayes_nlsid.study.reading import read_study

        study = read_study(path)
        seed = study.seed if seed is None else seed
        campaign = campaign_of(study)
    return diagnose_campaign(campaign, seed or 0, told.update)


def _pictures(found: Diagnosis) -> dict[str, tuple[bytes, str]]:
    """Every figure that the numbers of the diagnosis allow, with its caption."""
    from bayes_nlsid.study import figures_diagnosis as draw
    from bayes_nlsid.study.figures import png

    f: Mapping[str, Any] = found.figures
    out: dict[str, tuple[bytes, str]] = {}
    if "hypothesis_names" in f:
        places = np.asarray(f.get("place_names", np.array([], dtype=str)))
        image = png(draw.hypotheses, f["hypothesis_names"].tolist(), f["hypothesis_probability"], places.tolist(),
                    f.get("place_share", np.zeros(0)))
        out["hypotheses"] = (image, "Probability of every explanation that was weighed, and how much of the mismatch a force at each "
                                    "place would explain.")
    latents = [{"place": str(f["place_names"][i]), **{k: f[f"latent_{i}_{k}"] for k in ("force", "displacement", "velocity")}}
               for i in range(3) if f"latent_{i}_force" in f]
    if latents:
        out["latent_force"] = (png(draw.latent_forces, latents), "The force that would explain the mismatch at the likeliest places, "
                               "recovered without assuming its law, against displacement and velocity there.")
    if "frf_measured" in f:
        image = png(draw.transfer_functions, f["frf_frequency"], f["frf_measured"], f["frf_linear"], f["frequency"], f["residual_by_line"],
                    f["noise_by_line"])
        out["transfer_function"] = (image, "Measured transfer function against the re-tuned linear model, and what is left against "
                                           "the noise.")
    waves = {k: np.asarray(f[f"heldout_{k}"], dtype=float) for k in ("measured", "nominal", "updated", "extended") if f"heldout_{k}" in f}
    if "measured" in waves:
        facts = ", ".join(f"{name} {100 * found.heldout[key]:.3g} %" for name, key in (
            ("NRMSE as delivered", "nrmse_nominal"), ("re-tuned", "nrmse_updated_linear"), ("extended", "nrmse_extended"))
            if found.heldout.get(key) is not None)
        channels, units = (np.asarray(f.get(f"heldout_{key}", [])).tolist() for key in ("channels", "units"))
        image = png(draw.before_after, f["heldout_time"], waves, _of_record(f) + facts, channels, units)
        out["before_after"] = (image, "A record that was not used: the error of the model as delivered, and on a finer scale those of the "
                                      "re-tuned and of the extended model.")
    return out


def _of_record(figures: Mapping[str, Any]) -> str:
    """Which record is drawn, if that is stored."""
    return f"in {figures['heldout_name']}; over all records not used: " if "heldout_name" in figures else ""


def _page(found: Diagnosis, pictures: Mapping[str, tuple[bytes, str]]) -> str:
    """The page: the answer in words, the ranking, the proof, the figures."""
    told = [found.sentence, *(h.sentence for h in found.hypotheses[:1] if h.sentence and h.sentence != found.sentence)]
    separating = found.hypotheses[0].separated_by if found.hypotheses else ""
    told += [f"Next: {separating}"] if separating else []
    rows = []
    for h in found.hypotheses[:12]:
        effects = " + ".join(f"{c} at {p}" for c, p in h.effects) or "nothing missing"
        values = "; ".join(_parameter(p) for p in h.parameters)
        rows.append([effects, f"{100 * h.probability:.1f} %", values, h.separated_by])
    held = found.heldout
    proof = [[words, f"{100 * held[key]:.3g} %"] for words, key in (
        ("model as delivered", "nrmse_nominal"), ("best model without new physics", "nrmse_updated_linear"),
        ("with what was found", "nrmse_extended"), ("sensor noise alone", "noise_floor")) if held.get(key) is not None]
    body = [f'<p class="soft">nlsid diagnose, case {escape(found.case)}, seed {found.seed}, {duration(found.seconds)}</p>',
            f"<h1>{escape(found.case)}: {escape(found.verdict.replace('_', ' '))}</h1>",
            '<div class="story">' + "".join(html.paragraph(text) for text in told if text) + "</div>",
            "<h2>What may be missing</h2>",
            html.table(["explanation", "probability", "parameters (5 / 50 / 95 %)", "would be separated by"], rows, "diagnosis.json", (1,)),
            "<h2>On records that were not used</h2>",
            html.table(["model", "NRMSE"], proof, f"diagnosis.json, records {', '.join(held.get('records', []))}", (1,))]
    body += [html.picture(image, caption, f"figures/{name}.png", name) for name, (image, caption) in pictures.items()]
    body += ["<h2>What else to know</h2>", html.listing(list(found.notes)),
             html.table(["package", "version"], [[k, v] for k, v in versions().items()], "this run")]
    return html.page(f"Diagnosis of {found.case}", "\n".join(body))


def _parameter(p: Mapping[str, Any]) -> str:
    low, high = float(p["q05"]), float(p["q95"])
    digits = min(digits_for(low, high), 4)
    quantiles = " / ".join(engineering(float(p[q]), str(p["unit"]), digits) for q in ("q05", "q50", "q95"))
    return f"{p['name']} {quantiles}"


def lines(found: Diagnosis) -> str:
    """The answer on one screen."""
    out = [f"{found.case}: {found.verdict} (probability of a mismatch {100 * found.p_mismatch:.0f} %)", found.sentence, ""]
    out += [f"  {100 * h.probability:5.1f} %  " + (" + ".join(f"{c} at {p}" for c, p in h.effects) or "nothing missing")
            for h in found.hypotheses[:6]]
    held = found.heldout
    if held.get("nrmse_extended") is not None:
        out.append(f"\non {', '.join(held['records'])}: NRMSE {100 * held['nrmse_nominal']:.3g} % as delivered, "
                   f"{100 * held['nrmse_updated_linear']:.3g} % re-tuned, {100 * held['nrmse_extended']:.3g} % extended, "
                   f"noise {100 * held['noise_floor']:.2g} %")
    return "\n".join(out)
