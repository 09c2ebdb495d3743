"""Damaged files of every kind: a result or one sentence; never a traceback, a hang, much memory, or a touched file."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import resource
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch.case import read_case
from bayes_nlsid.mismatch.case_campaign import campaign_from_case, needs_general
from bayes_nlsid.recordings import readers
from bayes_nlsid.recordings.readers import read_file
from bayes_nlsid.structure import matrix_files
from bayes_nlsid.structure.matrices import read_matrices
from bayes_nlsid.structure.modal_results import read_modal_results
from bayes_nlsid.study.checking import examine
from bayes_nlsid.study.hypotheses import read_hypotheses
from bayes_nlsid.study.reading import read_study
from bayes_nlsid.study.screen import plan
from bayes_nlsid.study.survey import kind_of
from tests.robustness.corpus import CASE_FILES, READ_APART, READ_HERE, RECORDING, STUDIES, K, damaged, damaged_study, good, npz

PATIENCE = 20  # s for one small file: only a hang takes so long, also on a busy machine
SPARE = 3 * 2**30  # bytes of address space on top of what the test process has


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Time and memory of the block are limited; a hang becomes an error of its own."""
    def late(number: int, frame: FrameType | None) -> None:
        raise TimeoutError("hangs")

    with open("/proc/self/statm", encoding="ascii") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    before, limits = signal.signal(signal.SIGALRM, late), resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + SPARE, limits[1]))
    signal.alarm(PATIENCE)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, limits)


def one_sentence(act: Callable[[], Any]) -> Any:
    """What an action gives, or None if it refused in one sentence; anything else is a failure of the test."""
    with bounded():
        try:
            return act()
        except InputError as error:
            assert "\n" not in str(error) and str(error).endswith(".") and "Traceback" not in str(error), str(error)
            assert len(str(error)) < 1500, len(str(error))
            return None


def read(path: Path) -> Any:
    """Read a file as what its name says."""
    if path.name.startswith("m."):
        return read_modal_results(path, ("acc", "J1"), {"acc": "1Z"} if path.suffix == ".uff" else None)
    if path.name in CASE_FILES:
        for name in CASE_FILES:
            if name != path.name:
                path.with_name(name).write_bytes(good(name))
        if path.name == "nominal.npz":
            one_sentence(lambda: read_matrices(path))
        one_sentence(lambda: needs_general(path.parent) and campaign_from_case(path.parent))   # the other reader of `nlsid diagnose`
        return read_case(path.parent)
    if path.name == "mine.toml":
        return read_hypotheses(path)
    if path.suffix in (".mtx", ".rua"):
        return read_matrices(path, path, length_unit="m", force_unit="N")
    if path.name.startswith("l."):
        np.savez(path.with_name("pair.npz"), M=np.eye(3), K=K)
        return read_matrices(path.with_name("pair.npz"), locations=path)
    return read_file(path)


def attack(folder: Path, name: str, data: bytes) -> None:
    path = folder / name
    path.write_bytes(data)
    one_sentence(lambda: read(path))
    assert path.read_bytes() == data
    if not name.startswith("l."):
        one_sentence(lambda: kind_of(path))


def checked(path: Path) -> str:
    """What ``nlsid check`` says."""
    study = read_study(path)
    return plan(study, examine(study))


def attack_study(folder: Path, data: bytes) -> None:
    """Reading and planning touch nothing but memory."""
    study = folder / "study.toml"
    study.write_bytes(data)
    (folder / "recording.npz").write_bytes(RECORDING)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    one_sentence(lambda: checked(study))
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def program(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"fuzzed_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def attack_apart(module: ModuleType, kind: str, data: bytes, folder: Path) -> None:
    """The parser program in a forked process, as it runs in one of its own: it may refuse or crash, but must end, within its memory."""
    out = folder / "stdout"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
        child = os.fork()
    if child == 0:
        status = 99
        try:
            resource.setrlimit(resource.RLIMIT_AS, (SPARE + 2**30, SPARE + 2**30))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(PATIENCE)
            sys.argv = ["program", kind, str(2**24)]
            sys.stdin = io.TextIOWrapper(io.BytesIO(data))
            with out.open("wb") as file:
                sys.stdout = io.TextIOWrapper(file)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                status = module.main()
                sys.stdout.flush()
        finally:
            os._exit(status)
    _, ended = os.waitpid(child, 0)
    assert not (os.WIFSIGNALED(ended) and os.WTERMSIG(ended) == signal.SIGALRM), "hangs"
    if os.WIFEXITED(ended):
        assert os.WEXITSTATUS(ended) in (0, 3), os.WEXITSTATUS(ended)
        if os.WEXITSTATUS(ended) == 0 and kind in ("mat", "hdf5", "tdms"):
            readers._read_npz(out.read_bytes())


def kind_and_program(name: str) -> tuple[str, Path]:
    suffix = Path(name).suffix
    foreign = {".mat": "mat", ".h5": "hdf5", ".tdms": "tdms"}
    return (foreign[suffix], readers.PARSER) if suffix in foreign else ({".op4": "op4", ".pch": "dmig"}[suffix], matrix_files.PROGRAM)


def needs(name: str) -> None:
    if name.endswith(".tdms"):
        pytest.importorskip("nptdms")
    if name.endswith((".op4", ".pch")):
        pytest.importorskip("pyyeti")


TABLES = ("structure", "recordings", "identification", "posterior", "prediction", "linear", "terms", "reduction", "report", "title", "seed")
KEYS = st.sampled_from(["kind", "mass", "file", "name", "channels", "term", "formula"])
VALUES = st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
                      lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner), max_leaves=12)


# ------------------------------------------------------------------------------------------------------------------------ quick

@pytest.mark.parametrize("name", [*READ_HERE, *READ_APART])
def test_the_good_ones_are_read(tmp_path: Path, name: str) -> None:
    needs(name)
    path = tmp_path / name
    path.write_bytes(good(name))
    if Path(name).suffix in (".op4", ".pch"):
        assert matrix_files.read_matrix(path, "stiffness").matrix.shape == (3, 3)
    elif path.suffix in (".mtx", ".rua"):
        assert matrix_files.read_matrix(path, "mass").matrix.shape[0] in (2, 3)
    else:
        assert read(path) is not None


@pytest.mark.parametrize("name", READ_HERE)
def test_damaged_files(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(1)
    for _ in range(15):
        attack(tmp_path, name, damaged(good(name), rng))


@pytest.mark.parametrize(("name", "count"), [("study.toml", 60), ("beam.toml", 6)])
def test_damaged_studies(tmp_path: Path, name: str, count: int) -> None:
    rng = np.random.default_rng(2)
    for _ in range(count):
        attack_study(tmp_path, damaged_study(good(name), rng))


@pytest.mark.parametrize("name", READ_APART)
def test_damaged_files_of_compiled_parsers(tmp_path: Path, name: str) -> None:
    needs(name)
    kind, path = kind_and_program(name)
    module, rng = program(path), np.random.default_rng(3)
    module.parse(kind, good(name), 2**24)  # what is imported now need not be imported in every child
    for _ in range(15):
        attack_apart(module, kind, damaged(good(name), rng), tmp_path)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=200), name=st.sampled_from(["x.npz", "x.csv", "x.uff", "m.uff", "m.csv", "x.mtx", "x.rua", "l.csv",
                                                           "l.toml"]))
def test_arbitrary_bytes(tmp_path: Path, data: bytes, name: str) -> None:
    attack(tmp_path, name, data)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=VALUES, key=st.sampled_from(TABLES))
def test_any_value_for_any_table(tmp_path: Path, data: Any, key: str) -> None:
    import tomllib

    from bayes_nlsid.study import reading

    content = {**tomllib.loads(good("study.toml").decode()), key: data}
    (tmp_path / "study.toml").write_text("")
    (tmp_path / "recording.npz").write_bytes(RECORDING)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading, "parse_toml", lambda file, mend: content)
        one_sentence(lambda: read_study(tmp_path / "study.toml"))


def test_an_archive_that_lies_about_its_size_asks_for_no_memory(tmp_path: Path) -> None:
    data = bytearray(npz(a=np.zeros(8)))
    at = bytes(data).find(b"'shape': (8,), ")
    data[at:at + 15] = b"'shape': (10**9"[:15]
    attack(tmp_path, "a.npz", bytes(data))


# ------------------------------------------------------------------------------------------------------------------------- slow

@pytest.mark.slow
def test_ten_thousand_damaged_inputs(tmp_path: Path) -> None:
    """The same at length: 10 000 inputs over all kinds of files; prints nothing, must simply hold."""
    rng, count = np.random.default_rng(20), 0
    modules = {name: (kind_and_program(name)[0], program(kind_and_program(name)[1])) for name in READ_APART}
    for name, (kind, module) in modules.items():
        module.parse(kind, good(name), 2**24)
    folders = {part: tmp_path / part for part in ("study", "files", "apart")}
    for folder in folders.values():
        folder.mkdir()
    while count < 10_000:
        for name in (*READ_HERE, *STUDIES, *STUDIES, *READ_APART):
            if name in STUDIES:
                attack_study(folders["study"], damaged_study(good(name), rng))
            elif name in modules:
                attack_apart(modules[name][1], modules[name][0], damaged(good(name), rng), folders["apart"])
            else:
                attack(folders["files"], name, damaged(good(name), rng))
            count += 1
