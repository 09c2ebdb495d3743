"""Work given away: the same answers from any number of workers, nothing lost with a worker that dies, nothing counted twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.executors import Crew, run_tasks

TASKS = [(k, np.arange(k + 1.0)) for k in range(9)]


def weigh(shared: dict[str, Any], task: tuple[int, np.ndarray]) -> float:
    return float(shared["factor"] * np.random.default_rng(task[0]).random() + task[1].sum())


def dies_once(shared: str, task: int) -> int:
    """The worker of task 3 is killed the first time."""
    mark = Path(shared)
    if task == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    return task * task


def threads_of(shared: None, task: int) -> tuple[int, str]:
    return os.getpid(), os.environ["OMP_NUM_THREADS"]


def always_dies(shared: None, task: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    return task


def sleeps(shared: str, task: int) -> int:
    (Path(shared) / str(os.getpid())).touch()
    time.sleep(60.0 if task else 0.0)
    return task


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return not Path(f"/proc/{pid}/stat").exists() or Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def fails(shared: None, task: int) -> int:
    raise ArithmeticError(f"task {task}")


def test_here_in_two_processes_and_in_a_foreign_executor() -> None:
    alone = dict(run_tasks(weigh, {"factor": 2.0}, TASKS))
    assert sorted(alone) == list(range(9))
    assert dict(run_tasks(weigh, {"factor": 2.0}, TASKS, workers=2)) == alone
    with ThreadPoolExecutor(2) as pool:
        assert dict(run_tasks(weigh, {"factor": 2.0}, TASKS, executor=pool)) == alone
        assert pool.submit(int, "7").result() == 7, "an executor that was handed in stays open"


def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    found = list(run_tasks(dies_once, str(tmp_path / "died"), list(range(8)), workers=2))
    assert (tmp_path / "died").exists()
    assert sorted(found) == [(k, k * k) for k in range(8)]


def test_workers_have_one_thread_each_and_the_environment_is_left_as_it_was() -> None:
    before = os.environ.get("OMP_NUM_THREADS")
    found = dict(run_tasks(threads_of, None, [0, 1, 2, 3], workers=2))
    assert {threads for _, threads in found.values()} == {"1"} and os.getpid() not in {pid for pid, _ in found.values()}
    assert os.environ.get("OMP_NUM_THREADS") == before


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_inside_a_task_is_passed_on(workers: int) -> None:
    with pytest.raises(ArithmeticError, match="task"):
        list(run_tasks(fails, None, [1, 2], workers=workers))


def test_work_that_kills_whoever_does_it_is_given_up_with_a_sentence() -> None:
    with pytest.raises(InputError, match="--workers 2: workers died 5 times with 2 of 2 tasks left"):
        list(run_tasks(always_dies, None, [1, 2], workers=2))


def test_whoever_stops_does_not_wait_for_tasks_under_way(tmp_path: Path) -> None:
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), Crew(str(tmp_path), workers=2) as crew:
        for _ in crew.run(sleeps, [0, 1, 1]):
            raise KeyboardInterrupt
    assert time.monotonic() - began < 30


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_workers_die_with_the_process_that_made_them(tmp_path: Path) -> None:
    code = ("from tests.test_executors import *\nif __name__ == '__main__':\n"
            f"    list(run_tasks(sleeps, {str(tmp_path)!r}, [0, 1, 1], workers=2))")
    script = tmp_path / "giver.py"
    script.write_text(code, encoding="utf-8")
    giver = subprocess.Popen([sys.executable, str(script)], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    until = time.monotonic() + 30
    while len(workers := [int(p.name) for p in tmp_path.iterdir() if p.name.isdigit()]) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    giver.kill()
    giver.wait()
    while any(map(alive, workers)) and time.monotonic() < until:
        time.sleep(0.05)
    assert len(workers) == 2 and not any(map(alive, workers))


def test_what_cannot_be_used_is_said() -> None:
    with pytest.raises(InputError, match="neither local nor dask"):
        list(run_tasks(weigh, {}, TASKS, executor="cloud"))
    with pytest.raises(ValueError, match="cannot be sent"):
        list(run_tasks(weigh, {"lock": threading.Lock()}, TASKS, workers=2))
    assert list(run_tasks(weigh, {}, [])) == []
