"""Rows 1 to 3: time integration against a plain dense Newton loop in numpy, and the exponential step beside HHT."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.model import Model
from bayes_nlsid.prediction.bands import backbone_bands
from bayes_nlsid.simulation.integration import simulate
from benchmarks.case import ALPHA, FS, START, Row, beam, quick, released, scattered, seconds

RECORD = 80.0   # s that the paper simulates
GRID = np.geomspace(4e-4, 3.5e-3, 12)


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


def step(model: Model, samples: int, count: int, scheme: str = "hht", compiled: bool | None = True, rounds: int = 5) -> float:
    """CPU time of one step of one sample, s."""
    theta = scattered(samples)

    def run() -> object:
        return simulate(model, theta, fs=FS, samples=count + 1, u0=released(), keep=("tip",), store=("displacement",), compiled=compiled,
                        scheme=scheme)  # type: ignore[arg-type]

    return seconds(run, rounds) / count / samples


def rows() -> tuple[list[Row], float]:
    """Lines for rows 1 to 3, and the time of a step of the static batch, s."""
    static, memory = beam(LIBRARY["iwan4"]), beam(LIBRARY["iwan4_memory"])
    reference = seconds(lambda: dense(static, scattered(1)[0], released(), 300), 5) / 300
    out = [Row("", "reference: dense Newton loop in numpy", "", f"{quick(reference)} a step, {reference * FS * RECORD:.1f} s for 80 s")]
    batch = step(static, 100, 8000)
    cases = (("1", "HHT, static Iwan joints, batch of 100", batch, 1500),
             ("1", "HHT, Masing memory (exact loops), batch of 100", step(memory, 100, 4000), 500),
             ("", "HHT, static, batch of 100, without compiler", step(static, 100, 200, compiled=False), 0),
             ("2", "HHT, static, one trace", step(static, 1, 40_000), 200),
             ("2", "HHT, Masing memory, one trace", step(memory, 1, 20_000), 0))
    for number, what, each, least in cases:
        out.append(Row(number, what, f"{least}x" if least else "", f"{quick(each)} a step, {quick(each * FS * RECORD)} for 80 s: "
                       f"{reference / each:.0f}x", reference / each >= least if least else None))
    return out + [_schemes(static, batch)], batch


def _schemes(model: Model, batch: float) -> Row:
    """Row 3, errors against the exponential step at sixteen times the rate."""
    def curves(scheme: str, rate: float) -> NDArray[np.float64]:
        return backbone_bands(scattered(4), model, at="tip", start_amplitude=START, amplitudes=GRID, fs=rate,
                              scheme=scheme).samples_frequency  # type: ignore[arg-type]

    fine = curves("exponential", 16 * FS)
    error = {scheme: float(np.median(np.abs(curves(scheme, FS) - fine))) for scheme in ("hht", "exponential")}
    ratio, times = error["hht"] / error["exponential"], step(model, 100, 8000, "exponential") / batch
    return Row("3", "exponential step beside HHT, 8192 Hz, backbone frequency", "50x smaller error, no more time",
               f"{error['hht']:.2g} against {error['exponential']:.2g} Hz: {ratio:.0f}x, in {times:.2f} of the time",
               ratio >= 50 and times <= 1.0)
