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
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any, final

from bayes_nlsid import __version__
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
    executor, workers
        As for `Crew`; one that is handed in is left open.

    Yields
    ------
    number, answer
        Each task once, in the order in which they are finished.

    Raises
    ------
    InputError, ValueError
        As `Crew`. An exception inside a task is passed on as it is.
    """
    with Crew(shared, executor=executor, workers=min(workers, max(1, len(tasks)))) as crew:
        yield from crew.run(function, tasks)


@final
class Crew:
    """Workers that have been told the same; use it in a ``with`` statement for several rounds of tasks.

    Parameters
    ----------
    shared : object
        What all tasks need; any object that pickle takes.
    executor : str or concurrent.futures.Executor
        ``"local"``, ``"dask://HOST:PORT"``, or an executor.
    workers : int
        Processes for ``"local"``; 1 works in this process.

    Raises
    ------
    InputError
        If the cluster cannot be reached, has no workers or another version of this package, or Dask is not installed here.
    ValueError
        If ``shared`` cannot be sent to another process.
    """

    def __init__(self, shared: Any, *, executor: str | Executor = "local", workers: int = 1) -> None:
        if isinstance(executor, str) and executor != "local" and not executor.startswith("dask://"):
            raise InputError(f"--executor {executor}", "is neither local nor dask://HOST:PORT", "write one of these")
        self._shared, self._name = shared, f"--executor {executor}" if executor != "local" else f"--workers {workers}"
        self._here = executor == "local" and workers == 1
        content = b"" if self._here else packed(shared)
        self._place: _Place = _Nowhere()
        if self._here:
            return
        if isinstance(executor, Executor):
            self._place = _Foreign(executor, content)
        elif executor == "local":
            self._place = _Processes(content, workers)
        else:
            self._place = _Cluster(executor, content)

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *reason: object) -> None:
        self._place.close(hurry=reason[0] is not None)

    def run(self, function: Task, tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """One round; see `run_tasks`.

        Raises
        ------
        InputError
            If workers die again and again, or the scheduler does.
        RuntimeError
            If an executor that was handed in breaks.
        """
        if self._here:
            for number, task in enumerate(tasks):
                yield number, function(self._shared, task)
            return
        left = set(range(len(tasks)))
        for _ in range(MOST_LOSSES):
            if not left:
                return
            for number, answer in self._place.round(function, tasks, sorted(left)):
                if number in left:
                    left.discard(number)
                    yield number, answer
        if left:
            raise InputError(self._name, f"workers died {MOST_LOSSES} times with {len(left)} of {len(tasks)} tasks left",
                             "see that they have memory enough, or take fewer on one machine")


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
    """Once in each local worker: take what all tasks need; leave Ctrl-C to the process that gave the work, and die with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _ARRIVED["local"] = pickle.loads(content)


def _here(function: Task, task: Any) -> Any:
    return function(_ARRIVED["local"], task)


def _with(function: Task, content: bytes, task: Any) -> Any:
    return function(_unpacked(content), task)


def _die_with_parent() -> None:
    """A pool never tells its processes that the one which made them was killed; they would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _ready() -> int:
    return os.getpid()


def _version() -> str:
    return __version__


# --- in the process that gives the work ---------------------------------------------------------------------------------------


class _Place(ABC):
    """Where tasks are done."""

    @abstractmethod
    def round(self, function: Task, tasks: Sequence[Any], left: Sequence[int]) -> Iterator[tuple[int, Any]]:
        """Answers to the tasks whose numbers are given; ends early if workers die, and then is asked again for what is left."""

    @abstractmethod
    def close(self, hurry: bool = False) -> None:
        """End what was begun; in a hurry without waiting for tasks that are being done."""


@final
class _Nowhere(_Place):
    """For work that is done in this process."""

    def round(self, function: Task, tasks: Sequence[Any], left: Sequence[int]) -> Iterator[tuple[int, Any]]:
        yield from ()

    def close(self, hurry: bool = False) -> None:
        """There is nothing to end."""


@final
class _Processes(_Place):
    """Spawned processes with one thread each. A process that dies breaks the pool: what it leaves is for the next one."""

    def __init__(self, content: bytes, workers: int) -> None:
        self._content, self._workers = content, workers
        self._pool: ProcessPoolExecutor | None = None

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self._workers, mp_context=multiprocessing.get_context("spawn"), initializer=_install,
                                             initargs=(self._content,))
            with _environment(SINGLE_THREAD):  # processes start while the environment is set
                for future in [self._pool.submit(_ready) for _ in range(self._workers)]:
                    future.result()
        return self._pool

    def round(self, function: Task, tasks: Sequence[Any], left: Sequence[int]) -> Iterator[tuple[int, Any]]:
        waiting: dict[Future[Any], int] = {}
        try:
            pool = self._started()
            waiting.update((pool.submit(_here, function, tasks[i]), i) for i in left)
            for future in as_completed(list(waiting)):
                yield waiting.pop(future), future.result()  # what has been handed on is not kept here
        except BrokenExecutor:
            self.close()
        finally:
            for future in waiting:
                future.cancel()

    def close(self, hurry: bool = False) -> None:
        if self._pool is not None:
            for process in list((getattr(self._pool, "_processes", None) or {}).values()) if hurry else ():
                process.terminate()
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None


@final
class _Foreign(_Place):
    """Any executor: its interface knows no way to send data ahead, so the bytes go along and are unpacked once in each worker."""

    def __init__(self, pool: Executor, content: bytes) -> None:
        self._pool, self._content = pool, content

    def round(self, function: Task, tasks: Sequence[Any], left: Sequence[int]) -> Iterator[tuple[int, Any]]:
        waiting = {self._pool.submit(_with, function, self._content, tasks[i]): i for i in left}
        try:
            for future in as_completed(list(waiting)):
                yield waiting.pop(future), future.result()
        except BrokenExecutor as error:
            raise RuntimeError(f"the executor broke ({error}); give a fresh one and start again: what was stored is kept") from error
        finally:
            for future in waiting:
                future.cancel()

    def close(self, hurry: bool = False) -> None:
        """It belongs to the caller."""


@final
class _Cluster(_Place):
    """A Dask cluster: the scheduler does again what dies with a worker; what it gives up on comes in another round."""

    def __init__(self, address: str, content: bytes) -> None:
        try:
            import distributed
        except ImportError:
            raise InputError(f"--executor {address}", "needs the package distributed, which is not installed",
                             'install "bayes-nlsid[dask]" here and on the workers') from None
        self._dask, self._content, self._address, self._sent = distributed, content, address, None
        try:
            self._client = distributed.Client("tcp://" + address.removeprefix("dask://"), timeout=10, set_as_default=False)
        except (OSError, TimeoutError, ValueError):
            raise InputError(f"--executor {address}", "no scheduler answers there", "start one with: dask scheduler") from None
        try:
            self._muster()
        except InputError:
            self._client.close()
            raise

    def _muster(self) -> None:
        """See that there are workers, and that they would compute the same; the scheduler, too, reads what is sent."""
        found = self._client.run(_version, on_error="return")
        if not found:
            raise InputError(f"--executor {self._address}", "the scheduler has no workers",
                             f"start some with: dask worker {self._address.removeprefix('dask://')}")
        try:
            found = {"scheduler": self._client.run_on_scheduler(_version), **{f"worker {name}": v for name, v in found.items()}}
        except Exception as error:  # whatever it cannot import
            found = {"scheduler": error}
        for place, version in found.items():
            if version != __version__:
                has = f"version {version}" if isinstance(version, str) else f"no usable bayes_nlsid ({version})"
                raise InputError(f"--executor {self._address}", f"the {place} has {has}",
                                 f"install bayes-nlsid=={__version__} there")

    def round(self, function: Task, tasks: Sequence[Any], left: Sequence[int]) -> Iterator[tuple[int, Any]]:
        client, comm = self._dask.client, self._dask.comm
        lost = (self._dask.scheduler.KilledWorker, client.FutureCancelledError, client.FuturesCancelledError, comm.CommClosedError)
        try:
            if self._sent is None:
                self._sent = self._client.scatter(self._content, broadcast=True, hash=False)
            waiting = {self._client.submit(_with, function, self._sent, tasks[i], pure=False): i for i in left}
        except (OSError, TimeoutError) as error:
            raise InputError(f"--executor {self._address}", f"the scheduler is gone ({error or type(error).__name__})",
                             "start it again; the same command then goes on from what was stored") from None
        try:
            for future in self._dask.as_completed(list(waiting), loop=self._client.loop):
                number = waiting.pop(future)
                try:
                    answer = future.result()
                except lost:
                    self._sent = None  # every worker that held the data may be gone
                    continue
                yield number, answer
        finally:
            if waiting:
                self._client.cancel(list(waiting))

    def close(self, hurry: bool = False) -> None:
        self._client.close()


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
