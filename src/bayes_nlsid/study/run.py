"""All stages of a study, each skipped when nothing it depends on has changed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.archive import keep_study, stored_study, study_text
from bayes_nlsid.study.context import Context, Result
from bayes_nlsid.study.progress import Reporter, ending, opening
from bayes_nlsid.study.report import Report, render
from bayes_nlsid.study.report_markdown import markdown
from bayes_nlsid.study.schema import EXTRAS, STAGES, Study
from bayes_nlsid.study.store import Saved, Store, versions, write_atomic, writing
from bayes_nlsid.study.story import story
from bayes_nlsid.study.summary import summarise, to_text

# a stage is a pure function of the context: what it returns is stored, and stored results are all that later stages see
_STAGES = {stage: (f"bayes_nlsid.study.stage_{stage}", stage) for stage in (*STAGES, *EXTRAS) if stage != "report"}
_NEEDED = {"frf": "input, output, levels and band", "montecarlo": 'source = "posterior", or source = "fit" and scatter = "5 %"',
           "compare": "an [identification] to compare"}


def _stage(name: str) -> Callable[[Context], Result]:
    """The function of a stage; imported when it is needed, so that a run that skips the sampler never loads it."""
    module, function = _STAGES[name]
    found: Callable[[Context], Result] = getattr(import_module(module), function)
    return found


def run_study(study: Study, out: Path | str, *, seed: int | None = None, workers: int = 1, executor: str = "local", fresh: bool = False,
              extra: str | None = None, reporter: Reporter | None = None) -> dict[str, Any]:
    """Run every stage the study names and write the files of the results folder.

    Parameters
    ----------
    study : Study
    out : Path or str
        Results folder; what it already holds is reused where its inputs are unchanged.
    seed : int, optional
        In place of the study's own.
    workers : int
        Processes or threads within a stage; the results do not depend on it.
    executor : str
        Where work of many tasks is done: ``local`` or ``dask://HOST:PORT``; the results do not depend on it.
    fresh : bool
        Compute everything again; with ``extra``, that alone.
    extra : str, optional
        A stage beside the run, "frf", "montecarlo" or "compare", computed from the finished run, which is taken from
        disk where it is there.
    reporter : Reporter, optional

    Returns
    -------
    dict
        What ``result.json`` holds.

    Raises
    ------
    InputError
        If the study cannot be carried out as written, another run holds the folder, or the disk is full.
    KeyboardInterrupt
        Passed on; finished stages and sampler checkpoints stay, and the next run goes on from them.
    """
    if extra is not None and getattr(study, extra) is None:
        raise InputError(f"{study.file.name}: [{extra}]", "is missing", f"add [{extra}] with {_NEEDED[extra]}")
    if not study.recordings:
        raise InputError(f"{study.file.name}: [[recordings]]", "there is none, so there is nothing to run", "add one, or use nlsid plan")
    store = Store(out)
    with writing(store.out), store.lock():
        store.sweep()
        keep_study(store.stages, study, study.seed if seed is None else seed)
        told = reporter if reporter is not None else Reporter((store.out / "run.log",))
        opening(told, f"{study.title}: {study.file.name}, seed {study.seed if seed is None else seed}, "
                      f"{workers} worker{'s' if workers > 1 else ''}, {executor}", versions(), study.inputs)
        context = Context(study, study.seed if seed is None else seed, workers, executor, {}, told.update, told.note, store.scratch)
        with ending(told, "goes on from here"):
            stages = [*study.stages[:-1], *([extra] if extra is not None else []), "report"]
            for number, name in enumerate(stages[:-1], start=1):
                context.done[name] = _one(store, context, name, (number, len(stages)), fresh and extra in (None, name), told)
            context.done.update(kept_extras(store, study, context.done))
            told.begin(len(stages), len(stages), "report", "always written anew")
            began = time.monotonic()
            result = finish(store, study, context.done, context.seed, told)
            told.end(time.monotonic() - began, reused=False)
            for sentence in (f"{result['status']}: " + "; ".join(result["reasons"]) if result["reasons"] else result["status"],
                             *story(study, result)):
                told.log(sentence)
    return result


def kept_extras(store: Store, study: Study, done: Mapping[str, Saved]) -> dict[str, Saved]:
    """What commands beside the run have left, as far as it belongs to these very results."""
    out = {}
    for name in EXTRAS:
        saved = done.get(name) or (store.load(name) if getattr(study, name) is not None else None)
        if saved is not None and all(done[stage].key == key for stage, key in saved.data["from"].items() if stage in done):
            out[name] = saved
    return out


def _one(store: Store, context: Context, name: str, place: tuple[int, int], fresh: bool, told: Reporter) -> Saved:
    """One stage: from disk if it is there, else computed and stored."""
    key = context.key(name)
    why = "asked for by --fresh" if fresh else store.why_redo(name, key)
    told.begin(*place, name, why or "unchanged")
    if not why:
        saved = store.load(name)
        if saved is not None:
            told.end(saved.seconds, reused=True)
            return saved
    if fresh:
        store.clear_scratch(name)
    began = time.monotonic()
    arrays, data = _stage(name)(context)
    if name in EXTRAS:
        data["from"] = context.inputs(name)["earlier"]
    saved = store.save(name, key, arrays, data, time.monotonic() - began, context.inputs(name))
    store.clear_scratch(name)
    told.end(saved.seconds, reused=False)
    return saved


def finish(store: Store, study: Study, done: dict[str, Saved], seed: int, told: Reporter | None = None) -> dict[str, Any]:
    """Write ``result.json``, ``posterior.nc``, ``backbone.npz``, the figures and the report from stored stages."""
    from bayes_nlsid.study.pictures import draw_all

    result = summarise(study, done, seed)
    write_atomic(store.out / "result.json", to_text(result).encode())
    if "posterior" in done and "netcdf" in done["posterior"].arrays:
        write_atomic(store.out / "posterior.nc", done["posterior"].arrays["netcdf"].tobytes())
    if "predict" in done and "amplitude" in done["predict"].arrays:
        _write_backbone(done["predict"], store.out / "backbone.npz")
    for name in EXTRAS:
        if name in done:
            arrays = done[name].arrays
            write_atomic(store.out / f"{name}.npz", npz({key: a for key, a in arrays.items() if not key.startswith("netcdf")}))
            for key in (key for key in arrays if key.startswith("netcdf")):
                write_atomic(store.out / f"{name}_{key.removeprefix('netcdf')}.nc", arrays[key].tobytes())
            write_atomic(store.out / f"{name}.json", to_text({key: result[key] for key in ("format", "title", "seed", "versions", "inputs")}
                                                             | result[name]).encode())
    pictures = draw_all(study, done, told.update if told is not None else None)
    folder = store.out / "figures"
    folder.mkdir(exist_ok=True)
    for picture in pictures:
        write_atomic(folder / f"{picture.name}.png", picture.png)
    write_atomic(store.out / "report.html", render(Report(study, dict(done), result, tuple(pictures), study_text(store.out))).encode())
    return result


def _write_backbone(saved: Saved, path: Path) -> None:
    """The arrays of the contract, with the backbone measured directly beside them."""
    wanted = ("amplitude", *(f"{q}_{level}" for q in ("frequency", "damping") for level in ("q05", "q50", "q95")), "samples_frequency",
              "samples_damping", "numerical_error_frequency")
    arrays = {name: saved.arrays[name] for name in wanted}
    arrays |= {name.replace("measured.", "measured_"): a for name, a in saved.arrays.items() if name.startswith("measured.")}
    write_atomic(path, npz(arrays))


def npz(arrays: Mapping[str, Any]) -> bytes:
    """Arrays as the bytes of an npz file."""
    from io import BytesIO

    import numpy as np

    buffer = BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def rebuild_report(out: Path | str) -> dict[str, Any]:
    """Write the report again from stored results; the study file is read from where the last run left a copy.

    Raises
    ------
    InputError
        If the folder holds no results.
    """
    if not Path(out).is_dir():
        raise InputError(str(out), "there is no such folder", "give the --out of an earlier nlsid run")
    study, seed = stored_study(Path(out))
    store = Store(out)
    with writing(store.out), store.lock():
        done = {name: saved for name in study.stages if (saved := store.load(name)) is not None}
        done |= kept_extras(store, study, done)
        return finish(store, study, done, seed)


def write_markdown(out: Path | str) -> Path:
    """Write ``report.md`` beside the page: of a run, whose page is written anew first, of a diagnosis or of a plan.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    InputError
        If the folder holds no results.
    """
    folder = Path(out)
    pages = [p for p in (folder / "report.html", folder / "plan.html") if p.exists()]
    ready = pages and not (folder / "stages").is_dir()
    if not ready:
        rebuild_report(folder)
    page = pages[0] if ready else folder / "report.html"
    target = page.with_suffix(".md")
    with writing(folder):
        write_atomic(target, markdown(page.read_text(encoding="utf-8")).encode())
    return target
