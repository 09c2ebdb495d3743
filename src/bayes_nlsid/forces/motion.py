"""A recorded motion at one location, and the force of any term along it.

For a rate-independent force with Masing's rules, *where* a path reverses and which loops it closes does not depend on the
parameters of the force. So the path is worked out once: for every sample the reversal from which its branch starts, for every
reversal the branch on which it was reached. The force is then a sum along a chain of reversals,

    F(t) = F(reversal) + 2 f((q − q_reversal)/2),        F = f(q) on the curve of first loading,

evaluated on whole vectors, for a whole batch of parameters at once. Chains grow by one for each half-cycle of a free decay;
they are summed by doubling (each pass halves the number of links left), so depth costs only its logarithm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayes_nlsid.forces import memory
from bayes_nlsid.forces.term import Term

BLOCK = 1 << 16  # values evaluated at a time: a block and its temporaries stay in the cache


@final
@dataclass(frozen=True)
class Path:
    """The motion as monotone pieces between nodes, with its tree of reversals.

    Parameters
    ----------
    nodes : ndarray (N,)
        Displacement at the samples and at turning points between them, m.
    sample : ndarray (n,) of int
        Node of each sample.
    parent : ndarray (N,) of int
        Node of the reversal from which the branch of each node starts; −1 on the curve of first loading.
    """

    nodes: NDArray[np.float64]
    sample: NDArray[np.intp]
    parent: NDArray[np.intp]

    @cached_property
    def reversals(self) -> NDArray[np.intp]:
        """Nodes (R,) from which some branch starts, ascending."""
        return np.unique(self.parent[self.parent >= 0])

    @cached_property
    def slot(self) -> NDArray[np.intp]:
        """Place (N,) of each node's reversal among ``reversals``; R on the curve of first loading."""
        slot = np.full(len(self.nodes), len(self.reversals), dtype=np.intp)
        bound = self.parent >= 0
        slot[bound] = np.searchsorted(self.reversals, self.parent[bound])
        return slot

    @cached_property
    def passes(self) -> tuple[NDArray[np.intp], ...]:
        """Doubled links, each (R + 1,): from each reversal to the one 1, 2, 4, … before it; R where there is none."""
        count = len(self.reversals)
        link = np.append(self.slot[self.reversals], count)
        out = []
        while (link < count).any():
            out.append(link)
            link = link[link]
        return tuple(out)

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """(N,) 1 on the curve of first loading, 2 on every later branch."""
        return np.where(self.parent < 0, 1.0, 2.0)

    @cached_property
    def reach(self) -> NDArray[np.float64]:
        """(N,) displacement at which the curve of first loading is to be read for each node, m."""
        return (self.nodes - np.where(self.parent < 0, 0.0, self.nodes[self.parent])) / self.scale

    @cached_property
    def sample_slot(self) -> NDArray[np.intp]:
        """``slot`` of each sample, (n,)."""
        return self.slot[self.sample]


@final
@dataclass(frozen=True)
class Motion:
    """Relative displacement and velocity at one location.

    Parameters
    ----------
    q : ndarray (n,)
        m. Before the first sample the element is taken to have been loaded from rest at q = 0.
    v : ndarray (n,)
        m/s.
    dt : float
        Time step, s.

    Raises
    ------
    ValueError
        If shapes disagree, dt is not positive, or anything is not finite.
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
    dt: float

    def __post_init__(self) -> None:
        if self.q.ndim != 1 or self.q.shape != self.v.shape or self.q.size == 0:
            raise ValueError(f"motion: q {self.q.shape} and v {self.v.shape} must both be (n,) with n > 0; pass one location at a time")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"motion: dt must be positive, got {self.dt}")
        if not (np.isfinite(self.q).all() and np.isfinite(self.v).all()):
            raise ValueError("motion: q or v holds NaN or infinite samples; repair the recording first")

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.q)

    @cached_property
    def path(self) -> Path:
        """Nodes and reversals, worked out when a term with memory first asks for them, once."""
        turned, extremum = memory.turning_point(self.q[:-1], self.v[:-1], self.q[1:], self.v[1:], self.dt)
        before = np.flatnonzero(turned)
        nodes = np.insert(self.q, before + 1, extremum[before])
        sample = np.arange(self.n) + np.concatenate([[0], np.cumsum(turned)])
        return Path(nodes, sample.astype(np.intp), reversal_parents(nodes))


def motion(q: ArrayLike, v: ArrayLike, dt: float) -> Motion:
    """A motion from anything that numpy can read; see ``Motion``."""
    return Motion(np.ascontiguousarray(q, dtype=float), np.ascontiguousarray(v, dtype=float), float(dt))


def reversal_parents(nodes: ArrayLike) -> NDArray[np.intp]:
    """For every node of a path, the reversal from which its branch starts (Masing's rules with closed loops wiped out).

    Parameters
    ----------
    nodes : array_like (N,)
        Displacement, m; loaded from q = 0 to the first node.

    Returns
    -------
    ndarray (N,) of int
        Index of a node, −1 on the curve of first loading.

    Notes
    -----
    Open loops lie on a stack, each inside the one below. Passing the far end of the loop one is in closes it: that end and the
    reversal go. The outermost branch closes at the mirror image of its reversal, where it meets the curve of first loading.
    Each reversal is pushed and popped at most once, so the cost is linear.
    """
    values = np.asarray(nodes, dtype=float).tolist()
    parent = [-1] * len(values)
    stack: list[int] = []
    previous, heading = 0.0, 0.0
    for i, value in enumerate(values):
        move = value - previous
        if move * heading < 0.0 or (move != 0.0 and heading != 0.0 and (move > 0.0) != (heading > 0.0)):
            stack.append(i - 1)
        if move != 0.0:
            heading = 1.0 if move > 0.0 else -1.0
            while stack:
                if len(stack) > 1:
                    if heading * (value - values[stack[-2]]) < 0.0:
                        break
                    del stack[-2:]
                else:
                    if heading * (value + values[stack[0]]) < 0.0:
                        break
                    del stack[-1:]
        if stack:
            parent[i] = stack[-1]
        previous = value
    return np.asarray(parent, dtype=np.intp)


def force_along(term: Term, motion: Motion, p: ArrayLike, excess: bool = False) -> NDArray[np.float64]:
    """Force of a term along a recorded motion, its memory honoured.

    Parameters
    ----------
    term : Term
    motion : Motion
        n samples.
    p : array_like (..., n_p)
        Parameters, SI.
    excess : bool
        Subtract the spring at rest, f − f'(0) q, because the linear model already contains it.

    Returns
    -------
    ndarray (..., n)
        N. Parameters or motions so extreme that the force leaves the range of double precision give infinities, not warnings.

    Raises
    ------
    ValueError
        If the last axis of ``p`` is not the number of parameters.
    """
    values = np.asarray(p, dtype=float)
    if values.shape[-1:] != (len(term.params),):
        raise ValueError(f"term {term.name!r}: p has shape {values.shape}, its last axis must be {len(term.params)}")
    batch = np.ascontiguousarray(values.reshape(-1, len(term.params)))
    force = np.empty((len(batch), motion.n))
    along = {"none": _static, "masing": _masing, "sliders": _marched, "bouc_wen": _marched}[term.memory]
    # Marching goes sample by sample with the whole batch side by side.
    rows = max(1, BLOCK // motion.n) if along is not _marched else max(1, len(batch))
    with np.errstate(over="ignore", invalid="ignore"):
        for first in range(0, len(batch), rows):
            part = batch[first:first + rows]
            force[first:first + rows] = along(term, motion, part)
            if excess and term.stiffness is not None:
                force[first:first + rows] -= np.asarray(term.stiffness(*part.T))[:, None] * motion.q
    return force.reshape(*values.shape[:-1], motion.n)


def _static(term: Term, motion: Motion, p: NDArray[np.float64]) -> NDArray[np.float64]:
    return term.static_force(motion.q, motion.v, p)


def _masing(term: Term, motion: Motion, p: NDArray[np.float64]) -> NDArray[np.float64]:
    path = motion.path
    rise = path.scale * term.static_force(path.reach, np.zeros(1), p)
    # Force at every reversal: its own rise plus the force at the reversal before, and so on down the chain.
    at_reversal = np.concatenate([rise[:, path.reversals], np.zeros((len(p), 1))], axis=1)
    for link in path.passes:
        at_reversal = at_reversal + at_reversal[:, link]
    return rise[:, path.sample] + at_reversal[:, path.sample_slot]


def _marched(term: Term, motion: Motion, p: NDArray[np.float64]) -> NDArray[np.float64]:
    from bayes_nlsid.forces.march import march
    return march(term.memory, motion.path.nodes, p)[:, motion.path.sample]
