"""The command ``nlsid diagnose``: run the mismatch engine on a case folder, write its files, figures and page."""

from __future__ import annotations

from pathlib import Path

from bayes_nlsid.mismatch.diagnose import diagnose
from bayes_nlsid.mismatch.diagnosis import Diagnosis, write_diagnosis
from bayes_nlsid.study.diagnosis_page import effects_of, page
from bayes_nlsid.study.diagnosis_pictures import pictures
from bayes_nlsid.study.lock import held
from bayes_nlsid.study.progress import Reporter
from bayes_nlsid.study.sketch import sketch_of
from bayes_nlsid.study.store import make_folder, write_atomic, writing


def run_diagnosis(path: Path | str, out: Path | str, *, seed: int | None = None, reporter: Reporter | None = None) -> Diagnosis:
    """Diagnose a study or a case folder and leave ``diagnosis.json``, ``predictions.npz``, ``report.html`` and ``figures/`` in ``out``.

    Raises
    ------
    InputError
        If the case cannot be used, or ``out`` cannot be written.
    """
    case, folder = Path(path), Path(out)
    figures = make_folder(folder, "figures")
    with writing(folder), held(figures / "lock"):
        return _carry_out(case, folder, seed, reporter)


def _carry_out(case: Path, folder: Path, seed: int | None, reporter: Reporter | None) -> Diagnosis:
    """Diagnose and write, with the folder held."""
    told = reporter if reporter is not None else Reporter((folder / "run.log",))
    told.begin(1, 2, "diagnose", str(case))
    found = _diagnosed(case, seed, told)
    told.end(found.seconds, reused=False)
    told.begin(2, 2, "report", "always written anew")
    write_diagnosis(found, folder)
    drawn = pictures(found, sketch_of(case))
    for name, (image, _) in drawn.items():
        write_atomic(folder / "figures" / f"{name}.png", image)
    for stale in (folder / "figures").glob("*.png"):
        if stale.stem not in drawn:
            stale.unlink()   # of an earlier answer
    write_atomic(folder / "report.html", page(found, drawn).encode())
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


def lines(found: Diagnosis) -> str:
    """The answer on one screen."""
    out = [f"{found.case}: {found.verdict} (probability of a mismatch {100 * found.p_mismatch:.0f} %)", found.sentence, ""]
    out += [f"  {100 * h.probability:5.1f} %  " + effects_of(h)
            for i, h in enumerate(found.hypotheses[:6]) if i < 2 or h.probability > 0.005]
    held = found.heldout
    if held.get("nrmse_extended") is not None:
        out.append(f"\non {', '.join(held['records'])}: NRMSE {100 * held['nrmse_nominal']:.3g} % as delivered, "
                   f"{100 * held['nrmse_updated_linear']:.3g} % re-tuned, {100 * held['nrmse_extended']:.3g} % extended, "
                   f"noise {100 * held['noise_floor']:.2g} %")
    return "\n".join(out)
