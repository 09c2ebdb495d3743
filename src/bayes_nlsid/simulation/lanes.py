"""What the compiled loop works on: samples side by side in blocks of lanes, and the stepper that drives it."""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.laws import iwan4, iwan5
from bayes_nlsid.forces.memory import iwan_sliders
from bayes_nlsid.forces.term import Term
from bayes_nlsid.simulation.joints import Joints
from bayes_nlsid.simulation.schemes import Steps

Array = NDArray[np.float64]
LANES = 8
"""Samples per block: one vector register, see ``vector.py``; blocks are filled up by repeating the last sample."""
ROOM = 16
"""Open reversals for which there is room at first."""
KINDS = {"none": 0, "masing": 1, "sliders": 2, "bouc_wen": 3}
MOST_PARAMETERS = 6


@final
class At(NamedTuple):
    """Sizes, and the first row of each quantity in the array ``w`` (rows, 8) of a block.

    Only the first ``filled`` lanes hold samples of their own. Coefficients of a step: a (m, c, c), old, new (m, c), sq and sv (R, R), reach
    (2): largest row sums of both, damping, stiffness (m). State: x (c, m), f (m), joint forces g and those of the steps before: last_g,
    before, older (R). Laws: coefficient (E, 5), spring (E). Histories: last (4, E); the branch each Masing entry is on: origin, base, half,
    far (E). The rest is scratch.
    """

    filled: int
    velocity: int
    memory: int
    components: int
    modes: int
    joints: int
    entries: int
    a: int
    old: int
    new: int
    sq: int
    sv: int
    reach: int
    damping: int
    stiffness: int
    x: int
    f: int
    y: int
    g: int
    fresh: int
    last_g: int
    before: int
    older: int
    scale_q: int
    scale_v: int
    doubt: int
    q0: int
    v0: int
    q: int
    v: int
    force: int
    slope_q: int
    slope_v: int
    error: int
    spare: int
    coefficient: int
    spring: int
    last: int
    origin: int
    base: int
    half: int
    far: int


@final
class Walks(NamedTuple):
    """What is followed lane by lane: kind, code, row, quick and slot of every entry (table (E, 5)), power (E,), p (E, 8, 6), depth (E, 8),
    ends and forces (E, 8, room) of open reversals; sliders of the entries with a slot: theta (s, 8), stiffness, slip, stretch, sliding
    (s, sliders, 8); counts (2, 8): iterations and failures; clock (2,): steps done and the deepest stack; work (12 + R, at least R and 4):
    scratch of one lane."""

    dt: float
    table: NDArray[np.int64]
    power: Array
    p: Array
    depth: NDArray[np.int64]
    ends: Array
    forces: Array
    theta: Array
    stiffness: Array
    slip: Array
    stretch: Array
    sliding: Array
    counts: NDArray[np.int64]
    clock: NDArray[np.int64]
    work: Array


def _layout(count: int, joints: Joints, c: int, m: int) -> tuple[At, int]:
    """Rows of a block, and how many there are."""
    r, e = joints.count, len(joints.entries)
    rows = {"a": m * c * c, "old": m * c, "new": m * c, "sq": r * r, "sv": r * r, "reach": 2, "damping": m, "stiffness": m, "x": c * m,
            "f": m, "y": c * m, **dict.fromkeys(("g", "fresh", "last_g", "before", "older", "scale_q", "scale_v"), r), "doubt": 1,
            **dict.fromkeys(("q0", "v0", "q", "v", "force", "slope_q", "slope_v", "error"), r), "spare": 3, "coefficient": 5 * e,
            "spring": e, "last": 4 * e, "origin": e, "base": e, "half": e, "far": e}
    starts = np.concatenate([[0], np.cumsum(list(rows.values()))]).tolist()
    return At(count, int(joints.velocity), int(bool(joints.memory)), c, m, r, e, **dict(zip(rows, starts, strict=False))), starts[-1]


def _aligned(rows: int) -> Array:
    """Zeros (rows, 8), each row within one line of the cache."""
    raw = np.zeros((rows + 1) * LANES)
    shift = (-raw.ctypes.data // raw.itemsize) % LANES
    return raw[shift:shift + rows * LANES].reshape(rows, LANES)


@final
class Block:
    """Eight samples; the last of them is repeated where there are fewer.

    ``which`` (8,): index of the sample in each lane; ``count``: lanes that do not only fill the vector; ``codes`` as in
    ``CompiledStepper``; ``damping``, ``stiffness`` (m, 1 or S).
    """

    def __init__(self, steps: Steps, joints: Joints, codes: list[tuple[int, float]], damping: Array, stiffness: Array,
                 which: NDArray[np.intp], count: int) -> None:
        self.which, self.count = which, count
        self.at, rows = _layout(count, joints, steps.components, joints.shapes.shape[1])
        self.w, self.b = _aligned(rows), np.ascontiguousarray(joints.shapes)
        self._linear(steps, damping, stiffness)
        self.walks = self._elements(joints, codes, steps.step)

    def rows(self, name: str, count: int) -> Array:
        """View (count, 8) of a quantity."""
        first = getattr(self.at, name)
        return self.w[first:first + count]

    def _linear(self, steps: Steps, damping: Array, stiffness: Array) -> None:
        def lanes(values: Array) -> Array:
            """Sample axis first (if there is one) to eight lanes last."""
            own = np.moveaxis(values[self.which], 0, -1) if steps.amplification.ndim == 4 else np.repeat(values[..., None], LANES, axis=-1)
            return np.asarray(own)

        new = lanes(steps.new)
        given = [np.einsum("rm,mw,tm->rtw", self.b, new[:, i], self.b) for i in (0, 1)]
        reach = np.stack([np.abs(s).sum(axis=1).max(axis=0, initial=0.0) for s in given])
        modal = [x[:, self.which] if x.shape[1] > 1 else np.repeat(x, LANES, axis=1) for x in (damping, stiffness)]
        parts = {"a": lanes(steps.amplification), "old": lanes(steps.old), "new": new, "sq": given[0], "sv": given[1], "reach": reach,
                 "damping": modal[0], "stiffness": modal[1]}
        for name, values in parts.items():
            flat = values.reshape(-1, LANES)
            self.rows(name, len(flat))[:] = flat

    def _elements(self, joints: Joints, codes: list[tuple[int, float]], dt: float) -> Walks:
        entries = joints.entries
        p, count = np.zeros((len(entries), LANES, MOST_PARAMETERS)), len(entries)
        table = np.zeros((count, 5), dtype=np.int64)
        sliders = [e for e, x in enumerate(entries) if x.term.memory == "sliders"]
        for e, (entry, (code, _)) in enumerate(zip(entries, codes, strict=True)):
            values = entry.p[self.which]
            p[e, :, :values.shape[1]] = values
            if entry.excess and entry.term.stiffness is not None:
                self.w[self.at.spring + e] = entry.term.stiffness(*values.T)
            found = _iwan_coefficients(entry.term, values)
            if found is not None:
                self.rows("coefficient", 5 * count)[5 * e:5 * e + 5] = found
            table[e] = KINDS[entry.term.memory], code, entry.row, found is not None, sliders.index(e) if e in sliders else -1
        self.rows("half", count)[:] = 1.0
        made = [iwan_sliders(entries[e].p[self.which]) for e in sliders]
        stiffness, slip = (np.ascontiguousarray(np.stack([x[i].T for x in made])) if made else np.zeros((0, 0, LANES)) for i in (0, 1))
        theta = np.stack([np.broadcast_to(x[2][:, 0], (LANES,)) for x in made]) if made else np.zeros((0, LANES))
        stacks = np.zeros((2, count, LANES, ROOM))
        return Walks(dt, table, np.array([c[1] for c in codes], dtype=float), p, np.zeros((count, LANES), dtype=np.int64), stacks[0],
                     stacks[1], theta, stiffness, slip, np.zeros_like(slip), np.zeros_like(slip), np.zeros((2, LANES), dtype=np.int64),
                     np.zeros(2, dtype=np.int64), np.zeros((12 + len(self.b), max(4, len(self.b)))))

    def begin(self, u: Array, v: Array, modal: Array) -> None:
        """Start from modal displacement and velocity u, v (m, 8) under the modal force ``modal`` (m, 8), every history loaded from rest."""
        at, m, r = self.at, len(u), len(self.b)
        q, w = self.b @ u, self.b @ v
        self.rows("q0", r)[:], self.rows("v0", r)[:] = q, w
        nothing = np.zeros((0, 0, LANES))
        self._loop(-1, 0, np.zeros((0, 0, 1)), np.zeros((0, m)), 1, (nothing, nothing, nothing))
        for name in ("last_g", "before"):
            self.rows(name, r)[:] = self.rows("g", r)
        self.rows("scale_q", r)[:], self.rows("scale_v", r)[:] = np.abs(q), np.abs(w)
        f = modal - self.b.T @ self.rows("g", r)
        self.rows("f", m)[:] = f
        start = np.concatenate([u, v, f - self.rows("damping", m) * v - self.rows("stiffness", m) * u])[:at.components * m]
        self.rows("x", at.components * m)[:] = start

    def advance(self, count: int, force: Array, rows: Array, every: int, outs: tuple[Array, Array, Array]) -> None:
        """Run ``count`` steps; see ``compiled_loop.advance``."""
        done = 0
        while (done := self._loop(done, count, force, rows, every, outs)) < count:
            self._more_room()

    def _loop(self, first: int, last: int, force: Array, rows: Array, every: int, outs: tuple[Array, Array, Array]) -> int:
        from bayes_nlsid.simulation.compiled_loop import advance

        return int(advance(self.at, self.w, self.walks, self.b, first, last, force, rows, every, *outs))

    def _more_room(self) -> None:
        ends, forces = (np.concatenate([a, np.zeros_like(a)], axis=2) for a in (self.walks.ends, self.walks.forces))
        self.walks.clock[1] = self.walks.depth.max()
        self.walks = self.walks._replace(ends=ends, forces=forces)


def _iwan_coefficients(term: Term, p: Array) -> Array | None:
    """k_t, share, exponent, 1/phi_max and sliding force (5, 8) of the laws that run eight samples at a time; None for all others."""
    if term.law not in (iwan4, iwan5) or term.memory not in ("none", "masing"):
        return None
    f_s, k_t, m, b = p[:, 0], p[:, 1], np.maximum(p[:, 2] + 1, 0), np.maximum(p[:, 3], 0)
    theta = p[:, 4] if p.shape[1] == 5 else np.ones(len(p))
    with np.errstate(divide="ignore", over="ignore"):
        inverse = np.minimum(k_t * (b + m / (m + 1)) / np.maximum(f_s * (1 + b), 1e-300), 1e290)
    return np.stack([k_t, (1 - theta * m / (m + 1)) / (1 + b), m, inverse, theta * f_s])


def _blocks(samples: int) -> list[tuple[NDArray[np.intp], int]]:
    """Indices of the samples in each block, and how many of them do not only fill it."""
    return [(np.minimum(np.arange(i, i + LANES), samples - 1), min(LANES, samples - i)) for i in range(0, samples, LANES)]


@final
class CompiledStepper:
    """The compiled counterpart of ``stepping.NumpyStepper``, with the same arguments.

    ``codes``: number and exponent of every entry's law, from ``forces.compiled.law_code``.
    """

    def __init__(self, steps: Steps, joints: Joints, codes: list[tuple[int, float]], damping: Array, stiffness: Array, u: Array, v: Array,
                 p: Array | None) -> None:
        self.samples, self._modes = joints.samples, len(u)
        self._blocks: list[Block] = []
        modal = np.zeros_like(u) if p is None else np.broadcast_to(p[:, None] if p.ndim == 1 else p, u.shape)
        for which, count in _blocks(joints.samples):
            block = Block(steps, joints, codes, damping, stiffness, which, count)
            block.begin(np.ascontiguousarray(u[:, which]), np.ascontiguousarray(v[:, which]), modal[:, which])
            self._blocks.append(block)

    def _gathered(self, get: Any) -> Array:
        return np.concatenate([get(block)[..., :block.count] for block in self._blocks], axis=-1)

    @property
    def iterations(self) -> NDArray[np.int64]:
        """(S,)."""
        return self._gathered(lambda block: block.walks.counts[0]).astype(np.int64)

    @property
    def failures(self) -> NDArray[np.int64]:
        """(S,)."""
        return self._gathered(lambda block: block.walks.counts[1]).astype(np.int64)

    @property
    def displacement(self) -> Array:
        """Modal displacements (m, S)."""
        return self._gathered(lambda block: block.rows("x", self._modes))

    @property
    def velocity(self) -> Array:
        """Modal velocities (m, S)."""
        return self._gathered(lambda block: block.rows("x", 2 * self._modes)[self._modes:])

    @property
    def acceleration(self) -> Array:
        """Modal accelerations (m, S) from the equation of motion."""
        m = self._modes
        return self._gathered(lambda block: (block.rows("f", m) - block.rows("damping", m) * block.rows("x", 2 * m)[m:]
                                             - block.rows("stiffness", m) * block.rows("x", m)))

    def advance(self, count: int, force: Array | None, rows: Array, every: int, out: tuple[Array | None, ...]) -> None:
        """As ``NumpyStepper.advance``."""
        rows = np.ascontiguousarray(rows)
        at = 0
        for block in self._blocks:
            outs = tuple(np.empty((0 if a is None else count // every, len(rows), LANES)) for a in out)
            if force is None:
                applied = np.zeros((0, 0, 1))
            else:
                applied = np.ascontiguousarray(force[..., None] if force.ndim == 2 else force[..., block.which])
            block.advance(count, applied, rows, every, outs)  # type: ignore[arg-type]
            for target, values in zip(out, outs, strict=True):
                if target is not None:
                    target[..., at:at + block.count] = values[..., :block.count]
            at += block.count
