"""The time loop in numpy: all samples at once, Newton on the joints only.

With f = p − Bᵀg (g: force at the R locations that carry elements), a step gives q(n+1) = q⁰ − S_q g and v(n+1) = v⁰ − S_v g with constant
S_q = B diag(b_u) Bᵀ and S_v = B diag(b_v) Bᵀ: however many modes there are, only g is unknown. One evaluation at the extrapolated g with
a first-order
correction is accepted where the residual says so; all other samples go through Newton with line search.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.simulation.joints import Joints
from bayes_nlsid.simulation.schemes import Steps

Array = NDArray[np.float64]
ACCEPT = 1e-8
"""Error of q (and v) for which one step is accepted without Newton, relative to the largest motion so far at that location."""
CONVERGED = 1e-10
"""The same for Newton."""
SMALLEST_CONTRACTION = 1e-3
"""Below this the estimate of the contraction is not believed: a kink may lie just ahead."""
MOST_ITERATIONS = 60
FULL_STEPS = 12
"""Iterations in which laws that jump may change sides before the line search sets in."""
Evaluated = tuple[Array, Array, Array | None, Array | None]


@final
class Propagator:
    """The linear part of a step for a batch: dense products where all samples share the modes, element by element where not."""

    def __init__(self, steps: Steps, shapes: Array, samples: int, velocity: bool) -> None:
        self.components, self.modes, self.samples = steps.components, shapes.shape[1], samples
        self.shared = steps.amplification.ndim == 3
        self.velocity = velocity
        self.shapes = shapes
        c, m, r = self.components, self.modes, len(shapes)
        # x (c, m, S): components of every mode; f (m, S): modal force at the same instant; sample axis last throughout
        self.x, self.f = np.zeros((c, m, samples)), np.zeros((m, samples))
        if self.shared:
            blocks = [[np.diag(steps.amplification[:, i, j]) for j in range(c)] + [np.diag(steps.old[:, i])] for i in range(c)]
            top = np.block(blocks)
            push = np.concatenate([np.diag(steps.new[:, i]) for i in range(c)])
            rows = [top, shapes @ top[:m]] + ([shapes @ top[m:2 * m]] if velocity else [])
            self._predict = np.ascontiguousarray(np.concatenate(rows))
            pushes = [push, shapes @ push[:m]] + ([shapes @ push[m:2 * m]] if velocity else [])
            self._push = np.ascontiguousarray(np.concatenate(pushes))
            self._correct = np.ascontiguousarray(np.concatenate([push @ shapes.T, shapes.T]))
            self._state = np.zeros((c * m + m, samples))
            self._buffer = np.empty((self._predict.shape[0], self.samples))
            self._give_q, self._give_v = shapes * steps.new[:, 0] @ shapes.T, shapes * steps.new[:, 1] @ shapes.T
        else:
            self._a = np.ascontiguousarray(np.moveaxis(steps.amplification, 0, -1).transpose(1, 2, 0, 3))
            self._old = np.ascontiguousarray(steps.old.transpose(2, 1, 0))
            self._new = np.ascontiguousarray(steps.new.transpose(2, 1, 0))
        self.count = r

    def restart(self, u: Array, v: Array, a: Array, f: Array) -> None:
        """Put displacement, velocity, acceleration and force (m, S) of every mode into the state."""
        self.x, self.f = np.stack([u, v, a][:self.components]), f.copy()
        if self.shared:
            self._state[:] = np.concatenate([self.x.reshape(-1, self.samples), f])

    def predict(self, p: Array | None) -> tuple[Array, Array | None]:
        """q⁰ and v⁰ (R, S): where the joints would be at the end of the step without any force in them there.

        ``p``: modal force (m,) or (m, S) at the end of the step.
        """
        c, m, r = self.components, self.modes, self.count
        if self.shared:
            y = np.matmul(self._predict, self._state, out=self._buffer)
            if p is not None:
                y += (self._push @ p)[:, None] if p.ndim == 1 else self._push @ p
            return y[c * m:c * m + r], y[c * m + r:] if self.velocity else None
        y = np.einsum("ijms,jms->ims", self._a, self.x)
        y += self._old * self.f
        if p is not None:
            y += self._new * (p[:, None] if p.ndim == 1 else p)
        self._y = y
        return self.shapes @ y[0], self.shapes @ y[1] if self.velocity else None

    def correct(self, g: Array, p: Array | None) -> None:
        """Finish the step with the joint force g (R, S)."""
        c, m = self.components, self.modes
        if self.shared:
            state = np.matmul(self._correct, g, out=self._state)
            np.negative(state, out=state)
            state[:c * m] += self._buffer[:c * m]
            if p is not None:
                state[c * m:] += p[:, None] if p.ndim == 1 else p
            self.x, self.f = state[:c * m].reshape(c, m, -1), state[c * m:]
            return
        back = self.shapes.T @ g
        self.x = self._y - self._new * back
        self.f = -back if p is None else (p[:, None] if p.ndim == 1 else p) - back

    def give_q(self, g: Array) -> Array:
        """S_q g (R, S)."""
        return self._give_q @ g if self.shared else self.shapes @ (self._new[0] * (self.shapes.T @ g))

    def give_v(self, g: Array) -> Array:
        """S_v g (R, S)."""
        return self._give_v @ g if self.shared else self.shapes @ (self._new[1] * (self.shapes.T @ g))

    def flexibility(self, which: NDArray[np.intp] | slice, component: int) -> Array:
        """S_q (component 0) or S_v (1) of some samples, (s, R, R) or (1, R, R) where shared."""
        if self.shared:
            return (self._give_q if component == 0 else self._give_v)[None]
        return np.einsum("rm,ms,tm->srt", self.shapes, self._new[component][:, which], self.shapes)


@final
class NumpyStepper:
    """Advance a batch of samples; the reference that every faster loop must reproduce.

    Parameters
    ----------
    steps : Steps
        Coefficients (m, …) for all samples or (S, m, …) for each.
    joints : Joints
    damping, stiffness : ndarray (m, 1) or (m, S)
        2ζω and ω², for accelerations from the equation of motion.
    u, v : ndarray (m, S)
    p : ndarray (m,) or (m, S) or None
        Modal force at t = 0.
    """

    def __init__(self, steps: Steps, joints: Joints, damping: Array, stiffness: Array, u: Array, v: Array, p: Array | None) -> None:
        self.joints, self.damping, self.stiffness = joints, damping, stiffness
        samples = joints.samples
        b = joints.shapes
        modal = np.zeros_like(u) if p is None else np.broadcast_to(p[:, None] if p.ndim == 1 else p, u.shape)
        self.linear = Propagator(steps, b, samples, joints.velocity)
        self.iterations: NDArray[np.int64] = np.zeros(samples, dtype=np.int64)
        self.failures: NDArray[np.int64] = np.zeros(samples, dtype=np.int64)
        q, w = b @ u, b @ v
        self.g = np.zeros_like(q)
        if joints.count:
            give_q = np.abs(np.diagonal(self.linear.flexibility(slice(None), 0), axis1=1, axis2=2)).T
            give_v = np.abs(np.diagonal(self.linear.flexibility(slice(None), 1), axis1=1, axis2=2)).T
            self.g = joints.begin(q, w, steps.step, give_q, give_v)
            if joints.jumping:
                self.g = self.g + joints.breakaway(q, w, b @ (modal - damping * v - stiffness * u - b.T @ self.g))
            # largest row sums: bounds of what a force changes, (S,) or (1,)
            self._reach_q, self._reach_v = (np.abs(self.linear.flexibility(slice(None), i)).sum(axis=-1).max(axis=-1) for i in (0, 1))
        f = modal - b.T @ self.g
        self.linear.restart(u, v, f - damping * v - stiffness * u, f)
        self._past = [self.g, self.g]
        self._scale_q, self._scale_v = np.abs(q), np.abs(w)
        self._age = 0

    @property
    def displacement(self) -> Array:
        """Modal displacements (m, S)."""
        return self.linear.x[0]

    @property
    def velocity(self) -> Array:
        """Modal velocities (m, S)."""
        return self.linear.x[1]

    @property
    def acceleration(self) -> Array:
        """Modal accelerations (m, S) from the equation of motion at this very instant, not the one HHT-alpha carries along."""
        return self.linear.f - self.damping * self.linear.x[1] - self.stiffness * self.linear.x[0]

    def advance(self, count: int, force: Array | None, rows: Array, every: int, out: tuple[Array | None, ...]) -> None:
        """``count`` steps; after every ``every``-th, write rows @ (u, v, a) into ``out`` (each (count // every, L, S) or None).

        ``force``: modal force (count, m) or (count, m, S) at the ends of the steps.
        """
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for n in range(count):
                self._step(None if force is None else force[n])
                if (n + 1) % every == 0:
                    k = n // every
                    for array, name in zip(out, ("displacement", "velocity", "acceleration"), strict=True):
                        if array is not None:
                            np.matmul(rows, getattr(self, name), out=array[k])

    def _step(self, p: Array | None) -> None:
        lin, joints = self.linear, self.joints
        q0, v0 = lin.predict(p)
        if not joints.count:
            lin.correct(self.g, p)
            return
        before, older = self._past
        g = 3 * (self.g - before) + older if self._age > 2 else self.g
        self._age += 1
        new, at, doubt = self._attempt(q0, v0, g)
        if doubt.any():
            g = np.where(doubt, new, g)
            new, at, doubt = self._attempt(q0, v0, g)
            if doubt.any():
                new = self._newton(q0, v0, g, new, at, doubt)
        if joints.memory or joints.jumping:
            joints.commit(q0 - lin.give_q(new), None if v0 is None else v0 - lin.give_v(new))
        lin.correct(new, p)
        self._past = [self.g, before]
        self.g = new

    def _attempt(self, q0: Array, v0: Array | None, g: Array) -> tuple[Array, Evaluated, NDArray[np.bool_]]:
        """Evaluate at a guess g and correct to first order in the contraction S f'; also which samples are in doubt."""
        lin = self.linear
        q = q0 - lin.give_q(g)
        v = None if v0 is None else v0 - lin.give_v(g)
        f, fq, fv, held = self.joints.evaluate(q, v, g)
        e = f - g
        eq = lin.give_q(e)
        new = f - fq * eq
        contraction = np.abs(fq).max(axis=0) * self._reach_q
        np.maximum(self._scale_q, np.abs(q), out=self._scale_q)
        if v is None or fv is None:
            limit = ACCEPT / np.maximum(contraction, SMALLEST_CONTRACTION)
            return new, (f, fq, fv, held), (np.abs(eq) > limit * self._scale_q).any(axis=0)
        ev = lin.give_v(e)
        new -= fv * ev
        contraction += np.abs(fv).max(axis=0) * self._reach_v
        np.maximum(self._scale_v, np.abs(v), out=self._scale_v)
        limit = ACCEPT / np.maximum(contraction, SMALLEST_CONTRACTION)
        doubt = (np.abs(eq) > limit * self._scale_q) | (np.abs(ev) > limit * self._scale_v)
        if held is not None:
            doubt |= held  # sticking is decided by Newton alone
        return new, (f, fq, fv, held), doubt.any(axis=0)

    def _newton(self, q0: Array, v0: Array | None, g: Array, accepted: Array, at: Evaluated, active: NDArray[np.bool_]) -> Array:
        """Converged Newton with line search on e(g) = f(q⁰ − S_q g, v⁰ − S_v g) − g for the active samples; the others keep
        ``accepted``."""
        lin = self.linear
        f, fq, fv, held = at
        g = np.where(active, g, accepted)
        e = f - g
        running = active.copy()
        for iteration in range(MOST_ITERATIONS):
            where = np.flatnonzero(running)
            self.iterations[where] += 1
            matrix = self._own(held, where) + fq[:, where].T[:, :, None] * lin.flexibility(where, 0)
            if fv is not None:
                matrix = matrix + fv[:, where].T[:, :, None] * lin.flexibility(where, 1)
            change = np.zeros_like(g)
            change[:, where] = _solve(matrix, e[:, where])
            merit = np.where(running, np.square(e).sum(axis=0), 0.0)
            length = np.where(running, 1.0, 0.0)
            for _ in range(12):
                attempt = g + length * change
                q = q0 - lin.give_q(attempt)
                v = None if v0 is None else v0 - lin.give_v(attempt)
                f, fq, fv, held = self.joints.evaluate(q, v, attempt)
                tried = f - attempt
                worse = running & (np.square(tried).sum(axis=0) > merit * (1 - 1e-4 * length))
                small = self._converged(tried, running)
                if not (worse & ~small).any() or (held is not None and iteration < FULL_STEPS):
                    break
                length = np.where(worse & ~small, 0.5 * length, length)
            g, e = attempt, tried
            running &= ~small
            if not running.any():
                break
        # a sample that has left all bounds is "diverged", not "newton"
        self.failures[running & np.isfinite(g).all(axis=0)] += 1
        # the last residual is used up: a Picard step inside the tolerance would only undo a stiff solve, so g stays
        return np.where(active, g, accepted)

    def _own(self, held: Array | None, where: NDArray[np.intp]) -> Array:
        """Identity (1 or s, R, R), with zero rows where friction holds."""
        identity = np.eye(self.joints.count)[None]
        return identity if held is None else identity * ~held[:, where].T[:, :, None].astype(bool)

    def _converged(self, e: Array, running: NDArray[np.bool_]) -> NDArray[np.bool_]:
        small = (np.abs(self.linear.give_q(e)) <= CONVERGED * self._scale_q).all(axis=0)
        if self.joints.velocity:
            small &= (np.abs(self.linear.give_v(e)) <= CONVERGED * self._scale_v).all(axis=0)
        return running & (small | ~np.isfinite(e).all(axis=0))


def _solve(matrix: Array, e: Array) -> Array:
    """Solve (s, R, R) x = e (R, s); a singular matrix gives the plain residual, which the line search then shortens."""
    if matrix.shape[-1] == 1:
        return e / matrix[:, 0, 0]
    try:
        return np.asarray(np.linalg.solve(matrix, e.T[:, :, None])[:, :, 0].T, dtype=float)
    except np.linalg.LinAlgError:
        return e
