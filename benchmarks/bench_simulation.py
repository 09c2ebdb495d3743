"""How fast the time loops are, as ratios to a plain dense Newton loop in numpy run in the same process.

    python benchmarks/bench_simulation.py

Ten modes (Table 2 of the paper), five four-parameter Iwan joints, 8192 Hz, HHT-alpha. Times are CPU time of this
thread, best of some rounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.term import Term
from bayes_nlsid.model import Element, Model
from bayes_nlsid.prediction.fast import fast_bands
from bayes_nlsid.simulation.integration import simulate
from bayes_nlsid.structure.modal import ModalModel

FREQUENCY = np.array([78.56, 288.84, 515.3, 837.91, 1329.66, 1481.95, 1938.58, 2509.94, 2929.71, 4383.22])
JOINT = np.array([2000.0, 1e8, -0.5, 0.1])
FS, ALPHA, TIP = 8192.0, -0.05, 0.86


def beam(term: Term) -> Model:
    """A stand-in for the beam of the paper: joint motion grows with frequency, the outer joints move most in mode 1."""
    rng = np.random.default_rng(1)
    shapes = 1.5e-3 * rng.standard_normal((5, 10)) * np.sqrt(FREQUENCY / FREQUENCY[0])
    shapes[:, 0] = np.array([1.1, 0.75, 0.25, 0.7, 1.05]) * 1e-2
    tip = np.zeros((1, 10))
    tip[0, 0] = TIP
    joints = tuple(f"J{i + 1}" for i in range(5))
    linear = ModalModel(2 * np.pi * FREQUENCY, np.full(10, 1e-3), (*joints, "tip"), np.concatenate([shapes, tip]), ("tip",), (), joints)
    return Model(linear, (Element(term, joints),))


def dense(model: Model, theta: NDArray[np.float64], u: NDArray[np.float64], count: int) -> None:
    """Textbook HHT-alpha: Newton on all modes with a dense Jacobian, one sample, one step at a time."""
    lin, h = model.linear, 1 / FS
    beta, gamma = (1 - ALPHA) ** 2 / 4, 0.5 - ALPHA
    b, term, p = lin.shapes[:5], model.elements[0].term, theta.reshape(5, 4).T
    stiffness, damping, spring = np.diag(lin.omega**2), np.diag(2 * lin.zeta * lin.omega), term.stiffness(*p)  # type: ignore[misc]
    v = np.zeros(10)
    force = b.T @ (term.law(b @ u, b @ v, *p) - spring * (b @ u))
    a = -stiffness @ u - force
    base = np.eye(10) / (beta * h * h) + (1 + ALPHA) * (gamma / (beta * h) * damping + stiffness)
    for _ in range(count):
        u_star, v_star = u + h * v + h * h * (0.5 - beta) * a, v + h * (1 - gamma) * a
        before, u_new = ALPHA * (damping @ v + stiffness @ u + force), u_star.copy()
        for _ in range(20):
            a_new = (u_new - u_star) / (beta * h * h)
            v_new, q = v_star + gamma * h * a_new, b @ u_new
            force_new = b.T @ (term.law(q, b @ v_new, *p) - spring * q)
            residual = a_new + (1 + ALPHA) * (damping @ v_new + stiffness @ u_new + force_new) - before
            slope = term.slope(q, b @ v_new, *p)[0] - spring
            change = np.linalg.solve(base + (1 + ALPHA) * (b.T * slope) @ b, residual)
            u_new = u_new - change
            if np.abs(change).max() < 1e-10 * np.abs(u_new).max():
                break
        a_new = (u_new - u_star) / (beta * h * h)
        u, v, a = u_new, v_star + gamma * h * a_new, a_new
        force = b.T @ (term.law(b @ u, b @ v, *p) - spring * (b @ u))


def best(run: Callable[[], object], rounds: int = 4) -> float:
    """Smallest CPU time of some runs, s, after one to warm up."""
    run()
    times = []
    for _ in range(rounds):
        start = time.thread_time()
        run()
        times.append(time.thread_time() - start)
    return min(times)


def main() -> None:
    static, memory = beam(LIBRARY["iwan4"]), beam(LIBRARY["iwan4_memory"])
    theta = np.tile(JOINT, 5) * (1 + 0.05 * np.random.default_rng(0).standard_normal((100, 20)))
    u0 = np.zeros(10)
    u0[0] = 4e-3 / TIP
    reference = best(lambda: dense(static, theta[0], u0, 200)) / 200
    print(f"{'dense Newton loop':44s} {1e9 * reference:10.0f} ns per step and sample")
    cases = [("numpy, 1 sample", static, 1, 400, False), ("numpy, 100 samples", static, 100, 200, False),
             ("compiled, 1 sample", static, 1, 8000, True), ("compiled, 100 samples", static, 100, 2000, True),
             ("compiled, 100 samples, Masing memory", memory, 100, 2000, True), ("compiled, 1 sample, Masing memory", memory, 1, 4000,
             True)]
    for name, model, samples, count, compiled in cases:
        def run(model: Model = model, samples: int = samples, count: int = count, compiled: bool = compiled) -> object:
            return simulate(model, theta[:samples], fs=FS, samples=count + 1, u0=u0, keep=("tip",), store=("displacement",),
                            compiled=compiled)

        each = best(run) / count / samples
        print(f"{name:44s} {1e9 * each:10.0f} ns per step and sample {reference / each:10.0f}x")
    for name, model in (("static", static), ("Masing memory", memory)):
        seconds = best(lambda model=model: fast_bands(np.tile(theta, (10, 1)), model, at="tip", start_amplitude=3e-3),
             2)  # type: ignore[misc]
        print(f"averaged backbone, 1000 samples, {name:15s} {seconds:10.2f} s")


if __name__ == "__main__":
    main()
