"""Truth for these tests, written without the package's forces and integrators.

Two kinds: systems integrated by scipy's DOP853, and prescribed motions for which the force that drives them follows from the equation
of motion by algebra, with hysteresis followed by sliders that stick and slip sample by sample.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from bayes_nlsid.structure.modal import ModalData, ModalModel


def beam(modes: int = 3, joints: int = 2) -> ModalModel:
    """Three modes, two joints that see all of them differently."""
    omega = 2 * np.pi * np.array([20.0, 55.0, 110.0, 190.0])[:modes]
    shapes = np.array([[0.9, 0.5, -0.7, 0.2], [0.4, -0.8, 0.6, 0.5], [1.0, 1.0, 1.0, 1.0]])[:, :modes]
    names = ("J1", "J2", "TIP")
    return ModalModel(omega, np.full(modes, 0.01), names, shapes, sensors=("TIP",), inputs=("TIP",), joints=names[:joints])


def pack(model: ModalModel, dt: float, u: np.ndarray, v: np.ndarray, a: np.ndarray, force: np.ndarray, *, name: str = "run",
         band: tuple[float, float] = (5.0, 200.0), noise: float = 0.0, valid: slice = slice(None), periodic: bool = False) -> ModalData:
    """Modal data of all modes of a model."""
    rows = model.rows(model.joints)
    return ModalData(name, dt, tuple(range(model.modes)), u, v, a, force, model.joints, u @ rows.T, v @ rows.T, valid, band,
                     np.full(model.modes, noise), periodic=periodic)


def integrated(model: ModalModel, joint_force: Callable[[np.ndarray, np.ndarray], np.ndarray], *, seconds: float = 3.0,
               rate: float = 1024.0,
               drive: Callable[[float], float] | None = None, u0: np.ndarray | None = None, **options: object) -> ModalData:
    """Solve the modal equations with forces at the joints by DOP853 and recompute the acceleration from the equation."""
    rows, tip = model.rows(model.joints), model.rows(("TIP",))[0]
    damping, stiffness = 2 * model.zeta * model.omega, model.omega**2
    push = drive or (lambda t: 0.0)

    def rate_of(t: float, y: np.ndarray) -> np.ndarray:
        u, v = y[:model.modes], y[model.modes:]
        return np.concatenate([v, tip * push(t) - damping * v - stiffness * u - rows.T @ joint_force(rows @ u, rows @ v)])

    time = np.arange(int(seconds * rate)) / rate
    start = np.concatenate([np.zeros(model.modes) if u0 is None else u0, np.zeros(model.modes)])
    solution = solve_ivp(rate_of, (0.0, time[-1]), start, method="DOP853", t_eval=time, rtol=1e-8, atol=1e-11).y.T
    u, v = solution[:, :model.modes], solution[:, model.modes:]
    force = np.array([tip * push(t) for t in time])
    a = np.array([rate_of(t, y)[model.modes:] for t, y in zip(time, solution, strict=True)])
    return pack(model, 1 / rate, u, v, a, force, **options)  # type: ignore[arg-type]


def prescribed(model: ModalModel, joint_force: Callable[[np.ndarray, np.ndarray], np.ndarray], *, seconds: float = 4.0,
               rate: float = 1024.0,
               size: float = 1e-3, seed: int = 0, **options: object) -> ModalData:
    """A smooth modal motion of several tones, exact in all derivatives, and the force that makes it a solution.

    ``joint_force(q, v)`` takes whole histories (n, joints) and gives (n, joints).
    """
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate
    u, v, a = (np.zeros((len(time), model.modes)) for _ in range(3))
    for k, frequency in enumerate(model.frequency):
        for factor, share in ((0.83, 0.5), (1.0, 1.0), (1.13, 0.6)):
            w, phase = 2 * np.pi * frequency * factor, rng.uniform(0, 2 * np.pi)
            amplitude = size * share / (k + 1) ** 2
            u[:, k] += amplitude * np.sin(w * time + phase)
            v[:, k] += amplitude * w * np.cos(w * time + phase)
            a[:, k] -= amplitude * w**2 * np.sin(w * time + phase)
    rows = model.rows(model.joints)
    force = a + 2 * model.zeta * model.omega * v + model.omega**2 * u + joint_force(u @ rows.T, v @ rows.T) @ rows
    return pack(model, 1 / rate, u, v, a, force, **options)  # type: ignore[arg-type]


def slider(q: np.ndarray, stiffness: float, slip: float) -> np.ndarray:
    """Force (n,) of one spring in series with a friction slider, sample by sample, from rest at q = 0."""
    out, force, last = np.empty_like(q), 0.0, 0.0
    for i, here in enumerate(q):
        force = min(max(force + stiffness * (here - last), -slip), slip)
        out[i], last = force, here
    return out


def turning(q: np.ndarray, v: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement with the extremum of each cubic piece inserted where the velocity changes sign, and the places of the samples in it."""
    path, place = [q[0]], [0]
    for i in range(len(q) - 1):
        if v[i] * v[i + 1] < 0:
            c = 3 * (q[i + 1] - q[i]) - dt * (2 * v[i] + v[i + 1])
            d = 2 * (q[i] - q[i + 1]) + dt * (v[i] + v[i + 1])
            roots = np.roots([3 * d, 2 * c, dt * v[i]])
            inside = [x.real for x in roots if abs(x.imag) < 1e-12 and 0 < x.real < 1]
            if inside:
                x = inside[0]
                path.append(q[i] + dt * v[i] * x + c * x**2 + d * x**3)
        path.append(q[i + 1])
        place.append(len(path) - 1)
    return np.array(path), np.array(place)
