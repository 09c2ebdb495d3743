"""The command ``nlsid diagnose``: run the mismatch engine on a case folder, write its files, figures and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bayes_nlsid.mismatch.case import Case, read_case
from bayes_nlsid.mismatch.catalogue import Row, with_rows
from bayes_nlsid.mismatch.diagnose import diagnose
from bayes_nlsid.mismatch.diagnosis import Diagnosis, write_diagnosis
from bayes_nlsid.study.diagnosis_page import effects_of, page
from bayes_nlsid.study.diagnosis_pictures import pictures
from bayes_nlsid.study.hypotheses import read_hypotheses
from bayes_nlsid.study.lock import held
from bayes_nlsid.study.progress import Reporter, ending, opening
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.sketch import sketch_of
from bayes_nlsid.study.store import file_digest, make_folder, versions, write_atomic, writing


def run_diagnosis(path: Path | str, out: Path | str, *, seed: int | None = None, hypotheses: Path | str | None = None,
                  reporter: Reporter | None = None) -> Diagnosis:
    """Diagnose a study or a case folder and leave ``diagnosis.json``, ``predictions.npz``, ``report.html`` and ``figures/`` in ``out``.

    ``hypotheses`` names a file of the user's own, see `study.hypotheses`; they are weighed beside those of the catalogue.

    Raises
    ------
    InputError
        If the case or the hypotheses cannot be used, or ``out`` cannot be written.
    """
    case, folder = Path(path), Path(out)
    own = () if hypotheses is None else read_hypotheses(hypotheses)
    inputs = _inputs(case, hypotheses)
    figures = make_folder(folder, "figures")
    told = reporter if reporter is not None else Reporter((folder / "run.log",))
    with writing(folder), held(figures / "lock"), with_rows(own):
        opening(told, f"nlsid diagnose {case}, seed {'of the study, else 0' if seed is None else seed}", versions(), inputs)
        with ending(told, "begins anew"):
            return _carry_out(case, folder, seed, own, inputs, told)


def _inputs(case: Path, hypotheses: Path | str | None) -> tuple[tuple[str, str], ...]:
    """Every file that the answer rests on, with its SHA-256."""
    files = sorted(p for p in case.iterdir() if p.suffix in (".json", ".npz") and p.is_file()) if case.is_dir() else []
    own = [] if hypotheses is None else [Path(hypotheses)]
    study = () if case.is_dir() else read_study(case).inputs
    return (*study, *((p.name, file_digest(p)) for p in (*files, *own)))


def _carry_out(case: Path, folder: Path, seed: int | None, own: Sequence[Row], inputs: Sequence[tuple[str, str]], told: Reporter
               ) -> Diagnosis:
    """Diagnose and write, with the folder held."""
    told.begin(1, 2, "diagnose", str(case))
    found = _diagnosed(case, seed, own, told)
    if own:
        said = (f"Beside the catalogue, {', '.join(row.name for row in own)} of {inputs[-1][0]} (SHA-256 {inputs[-1][1][:12]}) "
                f"{'was' if len(own) == 1 else 'were'} weighed; the probabilities were fitted without.")
        found = replace(found, notes=(said, *found.notes))
    told.end(found.seconds, reused=False)
    told.begin(2, 2, "report", "always written anew")
    write_diagnosis(found, folder)
    drawn = pictures(found, sketch_of(case))
    for name, (image, _) in drawn.items():
        write_atomic(folder / "figures" / f"{name}.png", image)
    for stale in (folder / "figures").glob("*.png"):
        if stale.stem not in drawn:
            stale.unlink()   # of an earlier answer
    write_atomic(folder / "report.html", page(found, drawn, inputs).encode())
    told.end(0.0, reused=False)
    for sentence in (f"seed {found.seed}", *(f"note: {note}" for note in found.notes), *lines(found).splitlines()):
        if sentence:
            told.log(sentence)
    return found


def _diagnosed(path: Path, seed: int | None, own: Sequence[Row], told: Reporter) -> Diagnosis:
    """A study goes to the engine for recordings of any kind; so does a case folder whose records are not what its own engine needs."""
    from bayes_nlsid.mismatch.recorded_answer import diagnose_campaign

    said = [""]

    def say(share: float, sentence: str) -> None:
        told.update(share, sentence)
        if sentence != said[0]:
            said[0] = sentence
            told.log(f"  {sentence}")

    names = tuple(row.name for row in own)
    if path.is_dir():
        from bayes_nlsid.mismatch.case_campaign import campaign_from_case, needs_general

        if not needs_general(path):
            case = _with_classes(read_case(path), names) if names else path
            return diagnose(case, seed or 0, lambda sentence: say(0.0, sentence))
        campaign = campaign_from_case(path)
    else:
        from bayes_nlsid.study.campaigns import campaign_of

        study = read_study(path)
        seed = study.seed if seed is None else seed
        campaign = campaign_of(study)
    return diagnose_campaign(replace(campaign, classes=campaign.classes + names), seed or 0, say)


def _with_classes(case: Case, names: tuple[str, ...]) -> Case:
    """The case, whose vocabulary knows the user's own classes too."""
    return replace(case, classes=case.classes + names)


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
