"""What the compiled loop works on: samples side by side in blocks of lanes, and the stepper that drives it."""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.memory import iwan_sliders
from bayes_nlsid.simulation.joints import PRELOAD_STEPS, Joints
from bayes_nlsid.simulation.schemes import Steps

Array = NDArray[np.float64]
WIDEST = 128
"""Lanes per block at most: fewer pay the fixed cost of every short loop too often, more would not fit the second-level cache."""
VECTOR = 8
ROOM = 16
"""Open reversals for which there is room at first."""
KINDS = {"none": 0, "masing": 1, "sliders": 2, "bouc_wen": 3}
MOST_PARAMETERS = 6


@final
class Linear(NamedTuple):
    """Coefficients of one step (W = lanes or 1): a (m, c, c, W), old, new (m, c, W), sq and sv (R, R, W) with squares (R, R) of the first,
    b (R, m), bt (m, R), reach_q and reach_v (W,): row sums of sq and sv; damping, stiffness (m, W)."""

    shared: bool
    velocity: bool
    a: Array
    old: Array
    new: Array
    sq: Array
    sv: Array
    square_q: Array
    square_v: Array
    b: Array
    bt: Array
    reach_q: Array
    reach_v: Array
    damping: Array
    stiffness: Array


@final
class Elements(NamedTuple):
    """Entries (one law at one location): kind, code, power, row, fast (E,); p (E, lanes, 6); coefficient (E, 5, lanes); spring (E,
    lanes)."""

    kind: NDArray[np.int64]
    code: NDArray[np.int64]
    power: Array
    row: NDArray[np.int64]
    fast: NDArray[np.bool_]
    p: Array
    coefficient: Array
    spring: Array


@final
class Memory(NamedTuple):
    """Histories: last (4, E, lanes), depth (E, lanes), ends and forces (E, lanes, room); the branch each Masing entry is on: origin,
    base, half,
    far (E, lanes); sliders of entry ``slot[e]``: theta (s, lanes), stiffness, slip, stretch, sliding (s, lanes, sliders)."""

    present: bool
    dt: float
    last: Array
    depth: NDArray[np.int64]
    deepest: NDArray[np.int64]
    ends: Array
    forces: Array
    origin: Array
    base: Array
    half: Array
    far: Array
    slot: NDArray[np.int64]
    theta: Array
    stiffness: Array
    slip: Array
    stretch: Array
    sliding: Array


@final
class Motion(NamedTuple):
    """State and buffers: x (c, m, lanes), f (m, lanes); joint forces of this and earlier steps (R, lanes); the rest is scratch."""

    x: Array
    f: Array
    g: Array
    new: Array
    old: Array
    before: Array
    older: Array
    scale_q: Array
    scale_v: Array
    doubt: Array
    steep_q: Array
    steep_v: Array
    iterations: NDArray[np.int64]
    failures: NDArray[np.int64]
    age: NDArray[np.int64]
    y: Array
    back: Array
    acceleration: Array
    scratch: Array


@final
class Block:
    """Some samples in lanes; the last lane is repeated where samples do not fill the vectors."""

    def __init__(self, linear: Linear, elements: Elements, memory: Memory, motion: Motion, which: NDArray[np.intp], count: int) -> None:
        self.linear, self.elements, self.memory, self.motion = linear, elements, memory, motion
        self.which, self.count = which, count
        self.work = np.zeros((10, len(linear.b), len(which)))

    def begin(self, q: Array, v: Array) -> None:
        """Load every history from rest to q along a straight path; ``motion.g`` becomes the force at q, v (R, lanes)."""
        from bayes_nlsid.simulation.compiled import commit, evaluate

        still, mot = np.zeros_like(v), self.motion
        for i in range(1, PRELOAD_STEPS + 1):
            commit(self.elements, self.memory, q * (i / PRELOAD_STEPS), v if i == PRELOAD_STEPS else still, mot.scratch[4])
        evaluate(self.elements, self.memory, q, v, mot.g, self.work[0], self.work[1], mot.scratch)

    def advance(self, count: int, force: Array, rows: Array, every: int, outs: tuple[Array, Array, Array]) -> None:
        """Run ``count`` steps; see ``compiled_loop.advance``."""
        from bayes_nlsid.simulation import compiled_loop as compiled

        done = 0
        while True:
            done = compiled.advance(self.linear, self.elements, self.memory, self.motion, self.work, done, count, force, rows, every, outs)
            if done == count:
                return
            self._more_room()

    def _more_room(self) -> None:
        wider = [np.concatenate([a, np.zeros_like(a)], axis=2) for a in (self.memory.ends, self.memory.forces)]
        self.memory.deepest[0] = self.memory.depth.max()
        self.memory = self.memory._replace(ends=wider[0], forces=wider[1])


def _blocks(samples: int) -> list[tuple[NDArray[np.intp], int]]:
    """Indices of the samples in each block, and how many of them are not padding."""
    if samples == 1:
        return [(np.zeros(1, dtype=np.intp), 1)]
    vectors = -(-samples // VECTOR)
    blocks = -(-vectors * VECTOR // WIDEST)
    width = -(-vectors // blocks) * VECTOR
    return [(np.minimum(np.arange(i, i + width), samples - 1), min(width, samples - i)) for i in range(0, samples, width)]


def _linear(steps: Steps, joints: Joints, damping: Array, stiffness: Array, which: NDArray[np.intp]) -> Linear:
    shared = steps.amplification.ndim == 3
    if shared:
        a, old, new = steps.amplification[..., None], steps.old[..., None], steps.new[..., None]
    else:
        a, old, new = (np.moveaxis(x[which], 0, -1) for x in (steps.amplification, steps.old, steps.new))
        damping, stiffness = damping[:, which], stiffness[:, which]
    b = np.ascontiguousarray(joints.shapes)
    sq, sv = (np.ascontiguousarray(np.einsum("rm,mw,tm->rtw", b, new[:, i], b)) for i in (0, 1))
    reach = [np.abs(s).sum(axis=1).max(axis=0, initial=0.0) for s in (sq, sv)]
    copies = [np.ascontiguousarray(x) for x in (a, old, new, sq, sv, sq[..., 0], sv[..., 0], b, b.T, *reach, damping, stiffness)]
    return Linear(shared, joints.velocity, *copies)


def _elements(joints: Joints, codes: list[tuple[int, float]], which: NDArray[np.intp]) -> Elements:
    from bayes_nlsid.forces.laws import iwan4, iwan5

    entries = joints.entries
    count, lanes = len(entries), len(which)
    p, coefficient, spring = np.zeros((count, lanes, MOST_PARAMETERS)), np.zeros((count, 5, lanes)), np.zeros((count, lanes))
    fast = np.zeros(count, dtype=bool)
    for e, entry in enumerate(entries):
        values = entry.p[which]
        p[e, :, :values.shape[1]] = values
        if entry.excess and entry.term.stiffness is not None:
            spring[e] = entry.term.stiffness(*values.T)
        if entry.term.law in (iwan4, iwan5) and entry.term.memory in ("none", "masing"):
            fast[e] = True
            f_s, k_t, m, b = values[:, 0], values[:, 1], np.maximum(values[:, 2] + 1, 0), np.maximum(values[:, 3], 0)
            theta = values[:, 4] if values.shape[1] == 5 else np.ones(lanes)
            with np.errstate(divide="ignore", over="ignore"):
                inverse = np.minimum(k_t * (b + m / (m + 1)) / np.maximum(f_s * (1 + b), 1e-300), 1e290)
            coefficient[e] = k_t, (1 - theta * m / (m + 1)) / (1 + b), m, inverse, theta * f_s
    return Elements(np.array([KINDS[x.term.memory] for x in entries], dtype=np.int64), np.array([c[0] for c in codes], dtype=np.int64),
                    np.array([c[1] for c in codes], dtype=float), np.array([x.row for x in entries], dtype=np.int64), fast, p,
                    coefficient, spring)


def _memory(joints: Joints, dt: float, which: NDArray[np.intp]) -> Memory:
    entries, lanes = joints.entries, len(which)
    shape = (len(entries), lanes)
    sliders = [e for e, x in enumerate(entries) if x.term.memory == "sliders"]
    slot = np.full(len(entries), -1, dtype=np.int64)
    slot[sliders] = np.arange(len(sliders))
    made = [iwan_sliders(entries[e].p[which]) for e in sliders]
    stiffness = np.stack([x[0] for x in made]) if made else np.zeros((0, lanes, 0))
    slip = np.stack([x[1] for x in made]) if made else np.zeros((0, lanes, 0))
    theta = np.stack([np.broadcast_to(x[2][:, 0], (lanes,)) for x in made]) if made else np.zeros((0, lanes))
    return Memory(bool(joints.memory), dt, np.zeros((4, *shape)), np.zeros(shape, dtype=np.int64), np.zeros(1, dtype=np.int64),
                  np.zeros((*shape, ROOM)), np.zeros((*shape, ROOM)), np.zeros(shape), np.zeros(shape), np.ones(shape), np.zeros(shape),
                  slot,
                  theta, stiffness, slip, np.zeros_like(slip), np.zeros_like(slip))


def _motion(c: int, m: int, r: int, lanes: int) -> Motion:
    def joint() -> Array:
        return np.zeros((r, lanes))

    def whole() -> NDArray[np.int64]:
        return np.zeros(lanes, dtype=np.int64)

    return Motion(np.zeros((c, m, lanes)), np.zeros((m, lanes)), joint(), joint(), joint(), joint(), joint(), joint(), joint(),
                  np.zeros(lanes),
                  np.zeros(lanes), np.zeros(lanes), whole(), whole(), np.zeros(1, dtype=np.int64), np.zeros((c, m, lanes)), np.zeros((m,
                                                                                                                                      lanes)),
                  np.zeros((m, lanes)), np.zeros((5, lanes)))


@final
class CompiledStepper:
    """The compiled counterpart of ``stepping.NumpyStepper``, with the same arguments.

    ``codes``: number and exponent of every entry's law, from ``forces.compiled.law_code``.
    """

    def __init__(self, steps: Steps, joints: Joints, codes: list[tuple[int, float]], damping: Array, stiffness: Array, u: Array, v: Array,
                 p: Array | None) -> None:
        self.samples = joints.samples
        self._blocks: list[Block] = []
        m, b = len(u), joints.shapes
        modal = np.zeros_like(u) if p is None else np.broadcast_to(p[:, None] if p.ndim == 1 else p, u.shape)
        for which, count in _blocks(joints.samples):
            block = Block(_linear(steps, joints, damping, stiffness, which), _elements(joints, codes, which),
                          _memory(joints, steps.step, which), _motion(steps.components, m, len(b), len(which)), which, count)
            mot, uw, vw = block.motion, np.ascontiguousarray(u[:, which]), np.ascontiguousarray(v[:, which])
            q, w = b @ uw, b @ vw
            block.begin(q, w)
            mot.old[:], mot.before[:] = mot.g, mot.g
            mot.f[:] = modal[:, which] - b.T @ mot.g
            mot.x[:] = np.stack([uw, vw, mot.f - block.linear.damping * vw - block.linear.stiffness * uw])[:steps.components]
            mot.scale_q[:], mot.scale_v[:] = np.abs(q), np.abs(w)
            self._blocks.append(block)

    def _gathered(self, get: Any) -> Array:
        return np.concatenate([get(block)[..., :block.count] for block in self._blocks], axis=-1)

    @property
    def iterations(self) -> NDArray[np.int64]:
        """(S,)."""
        return self._gathered(lambda block: block.motion.iterations).astype(np.int64)

    @property
    def failures(self) -> NDArray[np.int64]:
        """(S,)."""
        return self._gathered(lambda block: block.motion.failures).astype(np.int64)

    @property
    def displacement(self) -> Array:
        """Modal displacements (m, S)."""
        return self._gathered(lambda block: block.motion.x[0])

    @property
    def velocity(self) -> Array:
        """Modal velocities (m, S)."""
        return self._gathered(lambda block: block.motion.x[1])

    @property
    def acceleration(self) -> Array:
        """Modal accelerations (m, S) from the equation of motion."""
        return self._gathered(lambda block: (block.motion.f - block.linear.damping * block.motion.x[1]
                                             - block.linear.stiffness * block.motion.x[0]))

    def advance(self, count: int, force: Array | None, rows: Array, every: int, out: tuple[Array | None, ...]) -> None:
        """As ``NumpyStepper.advance``."""
        rows = np.ascontiguousarray(rows)
        at = 0
        for block in self._blocks:
            lanes = len(block.which)
            outs = tuple(np.empty((0 if a is None else count // every, len(rows), lanes)) for a in out)
            if force is None:
                applied = np.zeros((0, 0, 1))
            else:
                applied = np.ascontiguousarray(force[..., None] if force.ndim == 2 else force[..., block.which])
            block.advance(count, applied, rows, every, outs)  # type: ignore[arg-type]
            for target, values in zip(out, outs, strict=True):
                if target is not None:
                    target[..., at:at + block.count] = values[..., :block.count]
            at += block.count
