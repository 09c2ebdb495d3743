"""Work given away: the same answers from any number of workers, nothing lost with a worker that dies, nothing counted twice."""

from __future__ import annotations

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.executors import run_tasks

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


def test_what_cannot_be_used_is_said() -> None:
    with pytest.raises(InputError, match="neither local nor dask"):
        list(run_tasks(weigh, {}, TASKS, executor="cloud"))
    with pytest.raises(ValueError, match="cannot be sent"):
        list(run_tasks(weigh, {"lock": threading.Lock()}, TASKS, workers=2))
    assert list(run_tasks(weigh, {}, [])) == []
