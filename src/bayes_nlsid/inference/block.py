"""A stretch of chain and the state it ends in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Walkers:
    """Where an ensemble stands: positions (W, P) in s, log density (W,), and the state of its random generator."""

    s: Array
    log_prob: Array
    random: tuple[Any, ...]


@final
@dataclass(frozen=True, eq=False)
class Block:
    """Some steps of one ensemble.

    ``s`` (n, W, P), ``log_prob`` (n, W), ``accepted`` (W,) proposals, ``end`` state, ``failures`` and where the first happened (F, P).
    """

    s: Array = field(repr=False)
    log_prob: Array = field(repr=False)
    accepted: Array
    end: Walkers = field(repr=False)
    failures: int = 0
    failed_at: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
