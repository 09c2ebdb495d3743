"""A Dask cluster of three local worker processes, one of them killed in mid-run: the same numbers as one process gives."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid import executors
from bayes_nlsid.cli import main
from bayes_nlsid.errors import InputError
from bayes_nlsid.executors import run_tasks
from bayes_nlsid.prediction import montecarlo
from bayes_nlsid.prediction.montecarlo import Decay, backbones
from bayes_nlsid.prediction.response_bands import response_bands
from tests.simulation.problems import IWAN, beam, scattered
from tests.study.conftest import recording, small  # noqa: F401 - fixtures

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None) as found:
        yield found


def address(cluster: Any) -> str:
    return str(cluster.scheduler_address).replace("tcp://", "dask://")


def pids(cluster: Any) -> set[int]:
    with distributed.Client(cluster, set_as_default=False) as client:
        return set(client.run(os.getpid).values())


def ticket(shared: dict[str, str], task: int) -> int:
    """Leaves a mark for each time it is done."""
    (Path(shared["folder"]) / f"{task}.{os.getpid()}").touch()
    return task + 1


def slow_ticket(shared: dict[str, str], task: int) -> int:
    time.sleep(0.2)
    return ticket(shared, task)


def deadly(shared: None, task: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return task


def test_each_task_is_answered_once(cluster: Any, tmp_path: Path) -> None:
    found = list(run_tasks(ticket, {"folder": str(tmp_path)}, list(range(30)), executor=address(cluster)))
    assert sorted(found) == [(k, k + 1) for k in range(30)]
    done_by = {name.name.split(".")[1] for name in tmp_path.iterdir()}
    assert len(list(tmp_path.iterdir())) == 30 and len(done_by) > 1 and str(os.getpid()) not in done_by


def test_a_killed_worker_loses_nothing_and_doubles_nothing(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(montecarlo, "TIME_CHUNK", 2)
    theta, model = scattered(IWAN, 32), beam("iwan4_memory")
    decay = Decay("tip", 2.4e-3, amplitudes=(1.3e-3, 2e-3), fs=600.0, scheme="exponential", duration=1.7)
    alone = backbones(model, theta, decay, path="time")
    two = backbones(model, theta, decay, path="time", workers=2)
    before, killed = pids(cluster), []

    def strike(share: float, sentence: str) -> None:
        if share > 0.2 and not killed:
            killed.append(min(before))
            os.kill(killed[0], signal.SIGKILL)

    third = backbones(model, theta, decay, path="time", executor=address(cluster), folder=tmp_path, progress=strike)
    assert killed and killed[0] not in pids(cluster)
    assert len(list(tmp_path.glob("chunk_*.npz"))) == 16
    for other in (two, third):
        for name in ("frequency", "damping", "status", "path"):
            assert np.array_equal(getattr(alone, name), getattr(other, name), equal_nan=name in ("frequency", "damping")), name
    assert np.isfinite(alone.frequency).all()


def test_response_curves_on_the_cluster(cluster: Any) -> None:
    options: dict[str, Any] = {"drive": "shaker", "at": "tip", "levels": [2.0], "band": (18.0, 22.0), "harmonics": 3}
    theta = scattered(IWAN, 60)
    one = response_bands(theta, beam("iwan4"), **options)
    other = response_bands(theta, beam("iwan4"), **options, executor=address(cluster))
    assert np.array_equal(one.samples_up, other.samples_up, equal_nan=True) and np.array_equal(one.peak_frequency, other.peak_frequency)


def test_from_the_command_line(cluster: Any, small: Path, tmp_path: Path) -> None:  # noqa: F811
    study = small.parent / "dask.toml"
    study.write_text(small.read_text(encoding="utf-8") + '[montecarlo]\nat = "x"\namplitude = "2 mm"\nsource = "fit"\nscatter = "2 %"\n'
                     "samples = 1000\n[posterior]\nsteps = 50\nmost = 400\n", encoding="utf-8")
    outs = []
    for name, extra in (("one", []), ("two", ["--workers", "2"]), ("cluster", ["--executor", address(cluster)])):
        outs.append(tmp_path / name)
        main(["montecarlo", str(study), "--out", str(outs[-1]), "--quiet", *extra])
    for other in outs[1:]:
        with np.load(outs[0] / "montecarlo.npz") as a, np.load(other / "montecarlo.npz") as b:
            assert all(np.array_equal(a[k], b[k], equal_nan=a[k].dtype.kind == "f") for k in a.files)
        with np.load(outs[0] / "stages/posterior/arrays.npz") as a, np.load(other / "stages/posterior/arrays.npz") as b:
            assert np.array_equal(a["theta"], b["theta"])


def test_a_scheduler_that_is_not_there_or_has_no_workers_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scheduler answers"):
        list(run_tasks(ticket, {}, [1], executor="dask://127.0.0.1:9"))
    with distributed.LocalCluster(n_workers=0, dashboard_address=None) as empty, pytest.raises(InputError, match="has no workers"):
        list(run_tasks(ticket, {}, [1], executor=address(empty)))


def test_a_worker_of_another_version_is_refused(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "__version__", "9.9.9")
    with pytest.raises(InputError, match="has version .* install bayes-nlsid==9.9.9"):
        list(run_tasks(ticket, {}, [1], executor=address(cluster)))


def test_a_task_that_kills_every_worker_is_given_up(tmp_path: Path) -> None:
    with (distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as found,
          pytest.raises(InputError, match="workers died 5 times with 1 of 1 tasks left")):
        list(run_tasks(deadly, None, [0], executor=address(found)))


def test_a_scheduler_that_dies_in_mid_run_is_said(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
               "--scheduler-file", str(tmp_path / "where.json")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    helper = subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment)
    try:
        while not (tmp_path / "where.json").exists():
            time.sleep(0.05)
        where = json.loads((tmp_path / "where.json").read_text())["address"]
        worker = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", where, "--no-dashboard", "--death-timeout", "5"],
                                  stderr=subprocess.DEVNULL, env=environment)
        with distributed.Client(where, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)
        with pytest.raises(InputError, match="scheduler is gone"):
            for number, _ in run_tasks(slow_ticket, {"folder": str(tmp_path)}, list(range(40)), executor=where.replace("tcp", "dask")):
                if number == 0:
                    helper.kill()
    finally:
        helper.kill()
        worker.kill()
        helper.wait()
        worker.wait()


def test_without_the_package_it_says_what_to_install() -> None:
    code = ("import sys; sys.modules['distributed'] = None\nfrom bayes_nlsid.executors import Crew\n"
            "from bayes_nlsid.errors import InputError\n"
            "try:\n    Crew({}, executor='dask://a:1')\nexcept InputError as error:\n    print(error)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1] / "src")})
    assert "bayes-nlsid[dask]" in done.stdout
