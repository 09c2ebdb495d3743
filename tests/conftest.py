"""CPU time of every test, children included: wall clock tells little on a busy machine. The dearest are listed after each run."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from typing import Any

import pytest

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy: matrices of tests are small, and threads that wait for each other cost CPU time

SHOWN = 15
LEAST = 0.5  # s
SPENT = pytest.StashKey[dict[str, float]]()
OTHERS = pytest.StashKey[float]()  # s of the processes that ran tests side by side


def _cpu() -> float:
    return float(sum(os.times()[:4]))


def pytest_collection_finish() -> None:
    """What importing and collecting has left stays to the end: the garbage collector need not walk through it again and again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    begun = _cpu()
    try:
        return (yield)
    finally:
        item.config.stash.setdefault(SPENT, {})[item.nodeid] = _cpu() - begun


def pytest_sessionfinish(session: pytest.Session) -> None:
    """One of several processes hands its times on to the one that started it."""
    told = getattr(session.config, "workeroutput", None)
    if told is not None:
        told["spent"], told["cpu"] = session.config.stash.get(SPENT, {}), _cpu()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """A process that ran tests has ended (it leaves nothing if it crashed)."""
    told, stash = getattr(node, "workeroutput", None) or {}, node.config.stash
    stash.setdefault(SPENT, {}).update(told.get("spent", {}))
    stash[OTHERS] = stash.get(OTHERS, 0.0) + told.get("cpu", 0.0)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    spent = config.stash.get(SPENT, {})
    others = config.stash.get(OTHERS, None)
    whole = _cpu() if others is None else others + sum(os.times()[:2])
    dear = sorted(((s, name) for name, s in spent.items() if s >= LEAST), reverse=True)[:SHOWN]
    terminalreporter.write_line(f"CPU time: {whole:.0f} s in all, {sum(spent.values()):.0f} s of it in {len(spent)} tests")
    for seconds, name in dear:
        terminalreporter.write_line(f"{seconds:6.1f} s  {name}")
