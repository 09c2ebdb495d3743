"""Work given away in tasks: done here, by local processes, by a Dask cluster, or by anything with the interface of ``concurrent.futures``.

A task is ``function(shared, task)`` with ``function`` at module level. What it returns may depend on nothing but these two, so that neither
the number of workers nor their fate can change a result: a task that is lost with its worker is done again, and answers count by the
number of their task, so that none counts twice. What all tasks need (``shared``) travels once to each worker.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any

from bayes_nlsid.errors import InputError

Task = Callable[[Any, Any], Any]
SINGLE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
                                        "VECLIB_MAXIMUM_THREADS")}
MOST_LOSSES = 5
"""Workers that may die in one piece of work before the work itself is suspected."""


def run_tasks(function: Task, shared: Any, tasks: Sequence[Any], *, executor: str | Executor = "local",
              workers: int = 1) -> Iterator[tuple[int, Any]]:
    """Do tasks wherever the executor says, and hand back each answer as soon as it is there.

    Parameters
    ----------
    function : callable
        ``function(shared, task)``, at module level, depending on nothing else.
    shared : object
        What all tasks need; any object that pickle takes.
    tasks : sequence
        Small objects, one for each task.
    executor : str or concurrent.futures.Executor
        ``"local"``, ``"dask://HOST:PORT"``, or an executor; one that is handed in is left open.
    workers : int
        Processes for ``"local"``; 1 works in this process.

    Yields
    ------
    number, answer
        Each task once, in the order in which they are finished.

    Raises
    ------
    InputError
        If the cluster cannot be reached, or its package is not installed.
    RuntimeError
        If workers die again and again. An exception inside a task is passed on as it is.
    """
    if isinstance(executor, str) and executor not in ("local",) and not executor.startswith("dask://"):
        raise InputError(f"--executor {executor}", "is neither local nor dask://HOST:PORT", "write one of these")
    if not tasks:
        return
    if executor == "local" and (workers == 1 or len(tasks) == 1):
        for number, task in enumerate(tasks):
            yield number, function(shared, task)
        return
    content = packed(shared)
    open_ = set(range(len(tasks)))
    for _ in range(MOST_LOSSES):
        if isinstance(executor, Executor):
            answers = _through(executor, function, content, tasks, sorted(open_))
        elif executor == "local":
            answers = _local(function, content, tasks, sorted(open_), workers)
        else:
            answers = _dask(executor, function, content, tasks, sorted(open_))
        for number, answer in answers:
            if number in open_:
                open_.discard(number)
                yield number, answer
        if not open_:
            return
    raise RuntimeError(f"workers died {MOST_LOSSES} times with {len(open_)} of {len(tasks)} tasks left; do they run out of memory?")


def packed(shared: Any) -> bytes:
    """The bytes in which ``shared`` travels.

    Raises
    ------
    ValueError
        If something in it cannot be sent to another process.
    """
    try:
        return pickle.dumps(shared, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(f"the work cannot be sent to another process ({error}); use one local worker, or functions that stand at "
                         "module level") from error


# --- in the worker ------------------------------------------------------------------------------------------------------------

_ARRIVED: dict[str, Any] = {}  # what has been unpacked in this worker, by the hash of its bytes; the latest only


def _unpacked(content: bytes) -> Any:
    name = hashlib.sha256(content).hexdigest()
    if name not in _ARRIVED:
        _ARRIVED.clear()
        _ARRIVED[name] = pickle.loads(content)
    return _ARRIVED[name]


def _install(content: bytes) -> None:
    """Once in each local worker: take what all tasks need; leave Ctrl-C to the process that gave the work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _ARRIVED["local"] = pickle.loads(content)


def _here(function: Task, task: Any) -> Any:
    return function(_ARRIVED["local"], task)


def _with(function: Task, content: bytes, task: Any) -> Any:
    return function(_unpacked(content), task)


def _ready() -> int:
    return os.getpid()


# --- in the process that gives the work ---------------------------------------------------------------------------------------


def _local(function: Task, content: bytes, tasks: Sequence[Any], open_: Sequence[int], workers: int) -> Iterator[tuple[int, Any]]:
    """Spawned processes with one thread each. A process that dies breaks the pool: what it leaves is for the next one."""
    count = min(workers, len(open_))
    pool = ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"), initializer=_install, initargs=(content,))
    try:
        with _environment(SINGLE_THREAD):
            for future in [pool.submit(_ready) for _ in range(count)]:  # processes start while the environment is set
                future.result()
        waiting = {pool.submit(_here, function, tasks[i]): i for i in open_}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except BrokenExecutor:
        return
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _through(pool: Executor, function: Task, content: bytes, tasks: Sequence[Any], open_: Sequence[int]) -> Iterator[tuple[int, Any]]:
    """Any executor: its interface knows no way to send data ahead, so the bytes go along and are unpacked once in each worker."""
    waiting = {pool.submit(_with, function, content, tasks[i]): i for i in open_}
    try:
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except BrokenExecutor as error:
        raise RuntimeError(f"the executor broke ({error}); give a fresh one and start again: what was stored is kept") from error
    finally:
        for future in waiting:
            future.cancel()


def _dask(address: str, function: Task, content: bytes, tasks: Sequence[Any], open_: Sequence[int]) -> Iterator[tuple[int, Any]]:
    """A Dask cluster: the scheduler does again what dies with a worker; what it gives up on is left to the caller."""
    try:
        import distributed
    except ImportError:
        raise InputError(f"--executor {address}", "needs the package distributed, which is not installed",
                         "install bayes-nlsid[dask] here and on the workers") from None
    try:
        client = distributed.Client("tcp://" + address.removeprefix("dask://"), timeout=10, set_as_default=False)
    except (OSError, TimeoutError, ValueError):
        raise InputError(f"--executor {address}", "no scheduler answers there", "start one with: dask scheduler") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise InputError(f"--executor {address}", "the scheduler has no workers", f"start some with: dask worker {address[7:]}")
        sent = client.scatter(content, broadcast=True, hash=False)
        waiting = {client.submit(_with, function, sent, tasks[i], pure=False, retries=0): i for i in open_}
        lost = (distributed.scheduler.KilledWorker, distributed.client.FutureCancelledError, distributed.client.FuturesCancelledError)
        for future in distributed.as_completed(waiting):
            try:
                answer = future.result()
            except lost:
                continue
            yield waiting[future], answer
            future.release()


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
