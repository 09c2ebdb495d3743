"""A hypothesis settled on the bench: linear parameters and laws moved together, before any record is simulated.

The bench is laid out for the linear model alone, which a strong effect has bent: its stiffness is that of the loud motion. Here the
forces of the laws go to the observer as known forces, and linear parameters, strengths and shapes move together by Gauss–Newton on the
innovations, some times over. Innovations see one step ahead, so there are no far valleys in which a simulation of whole records is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.motion import force_along
from bayes_nlsid.mismatch.calibrated import Drive, Linear
from bayes_nlsid.mismatch.campaign import RIGID, Campaign
from bayes_nlsid.mismatch.forward import Extended
from bayes_nlsid.mismatch.innovations import Bench, lay_out, linear_columns
from bayes_nlsid.mismatch.observer import Modal
from bayes_nlsid.mismatch.suspects import FINER, Place, places_of, response

Array = NDArray[np.float64]
ROUNDS = 4
TRUST = 1.0      # standard deviation of one move of a law's parameters, in logarithms or units
SHIFT = 1e-3


def settled(campaign: Campaign, linear: Linear, drive: Drive, bench: Bench, ext: Extended) -> list[Array]:
    """Parameters (P,) of an extended model after every round in which the innovations became likelier, best settled last.

    Parameters
    ----------
    campaign : Campaign
    linear : Linear
        From which ``ext`` was made.
    drive : Drive
        Of the observer.
    bench : Bench
        Laid out for the linear model alone; gives the first motion.
    ext : Extended
    """
    out: list[Array] = []
    theta, desks, likelihood = ext.theta, bench, -np.inf
    for _ in range(ROUNDS):
        try:
            with np.errstate(all="ignore"):
                base = linear_at(linear, ext, theta)
                known = known_forces(ext, theta, places_for(desks, ext), desks)
                desks = lay_out(campaign, base, known, taps=False, drive=drive)
                reached = float(sum(d.smoothed.likelihood for d in desks.desks))
                if not reached > likelihood:
                    return out[:-1]   # the last move led astray
                likelihood = reached
                theta = _moved(desks, base, replace(ext, theta=theta), places_for(desks, ext))
        except (np.linalg.LinAlgError, ValueError):
            break
        if not np.isfinite(theta).all():
            break
        out.append(theta)
    return out


def linear_at(linear: Linear, ext: Extended, theta: Array) -> Linear:
    """The linear part of an extended model at parameters theta (P,)."""
    omega, zeta = ext.model.linear_values(theta)
    gain = ext.model.gain(theta)
    stiffness = np.where(linear.modal.stiffness > 0, omega ** 2, 0.0)
    offsets = linear.offsets.copy()
    if _forced(ext):
        offsets[0] = -float(theta[_first_law(ext) - 1])
    return replace(linear, modal=Modal(stiffness, 2 * zeta * omega), gain=linear.gain if gain is None else float(gain), offsets=offsets)


def places_for(bench: Bench, ext: Extended) -> dict[str, Place]:
    """Motion at the places of the laws."""
    names = list(dict.fromkeys(s.place for s in ext.suspects))
    return {p.name: p for p in places_of(bench, names)}


def known_forces(ext: Extended, theta: Array, places: dict[str, Place], bench: Bench) -> list[Array]:
    """Modal force (n, m) of all laws along the smoothed motion of every fitted record."""
    out = [np.zeros((d.n, bench.linear.model.modes)) for d in bench.desks]
    for i, suspect in enumerate(ext.suspects):
        law = suspect.law
        assert law is not None
        p = law_values(ext, theta, i)
        place = places[suspect.place]
        for force, motion in zip(out, place.motions, strict=True):
            g = force_along(law.term, motion, p[None], law.excess)[0, ::FINER]
            if not np.isfinite(g).all():
                raise ValueError("the law is not finite along the motion")
            force -= g[:, None] * place.row
    return out


def law_values(ext: Extended, theta: Array, i: int) -> Array:
    """All parameters (..., n_p) of the i-th law."""
    return np.asarray(ext.model.element_values(theta, i + int(_forced(ext)), ext.suspects[i].place))


def _forced(ext: Extended) -> bool:
    return bool(ext.model.linear.inputs)


def _first_law(ext: Extended) -> int:
    """Index in theta of the first parameter of a law."""
    return 2 * ext.model.linear.modes + 2 * int(_forced(ext))


def _moved(bench: Bench, linear: Linear, ext: Extended, places: dict[str, Place]) -> Array:
    """One step of Gauss–Newton from ext.theta."""
    names, parts, prior = linear_columns(bench.linear, bench.desks, False)
    columns = np.concatenate(parts, axis=1)
    first = _first_law(ext)
    which = [j for j in range(first, len(ext.theta)) if ext.kind[j] != "held"]
    slopes = _slopes(bench, ext, places, which)
    matrix = np.concatenate([columns, slopes]).T
    norm = np.linalg.norm(matrix, axis=0)
    keep = norm > 1e-12 * max(float(norm.max()), 1e-300)
    limits = np.concatenate([prior, np.full(len(which), TRUST)])
    # what is known beforehand weighs little against the data: a bench has unit variance in every block
    sd = np.where(np.isfinite(limits), limits, 1e6 / np.maximum(norm, 1e-300))[keep]
    tall = np.concatenate([matrix[:, keep] * sd, np.eye(int(keep.sum()))])
    target = np.concatenate([bench.innovations, np.zeros(int(keep.sum()))])
    found = np.zeros(len(norm))
    found[keep] = sd * np.linalg.lstsq(tall, target, rcond=1e-9)[0]
    return _applied(linear, ext, dict(zip(names, found, strict=False)), which, found[len(names):])


def _slopes(bench: Bench, ext: Extended, places: dict[str, Place], which: Sequence[int]) -> Array:
    """What a small move of each law's parameter does to the innovations, (len(which), N), per unit move."""
    moves = np.zeros((len(which) + 1, len(ext.theta)))
    moves[np.arange(1, len(which) + 1), which] = SHIFT
    thetas = ext.at(moves)
    total = np.zeros((len(which) + 1, len(bench.innovations)))
    for i, suspect in enumerate(ext.suspects):
        assert suspect.law is not None
        values = law_values(ext, thetas, i)
        unlike = np.concatenate([[0], np.flatnonzero((values != values[0]).any(axis=1))])
        x = response(bench, places[suspect.place], suspect.law, values[unlike])
        total += x[0]
        total[unlike[1:]] += x[1:] - x[0]
    return np.asarray((total[1:] - total[0]) / SHIFT)


def _applied(linear: Linear, ext: Extended, found: dict[str, float], which: Sequence[int], moves: Array) -> Array:
    """Parameters after a step: linear ones within factors that keep the model a model."""
    m = ext.model.linear.modes
    full = np.zeros((1, len(ext.theta)))
    full[0, which] = np.clip(moves, -1.0, 1.0)
    theta = np.array(ext.at(full)[0])
    k, c = linear.modal.stiffness, linear.modal.damping
    dk, dc = (np.array([found.get(f"{what}[{i + 1}]", 0.0) for i in range(m)]) for what in ("stiffness", "damping"))
    omega = np.sqrt(np.clip(k + dk, 0.3 * k, 3 * k))
    omega = np.where(k > 0, np.clip(omega, *(2 * np.pi * np.broadcast_to(x, theta.shape)[:m] for x in (ext.low, ext.high))),
                     ext.model.linear_values(ext.theta)[0])
    damping = np.clip(c + dc, np.maximum(0.1 * c, 1e-9), np.maximum(5 * c, 1e-3))
    rigid = omega < RIGID
    theta[:m] = np.where(rigid, theta[:m], omega / (2 * np.pi))
    theta[m:2 * m] = damping / (2 * omega)
    if _forced(ext):
        name = ext.model.linear.inputs[0]
        theta[2 * m] = np.clip(theta[2 * m] + found.get(f"gain[{name}]", 0.0), 0.3, 3.0)
        shifts = [v for n, v in found.items() if n.startswith("offset[") and n.endswith(",force]")]
        theta[2 * m + 1] -= float(np.mean(shifts)) if shifts else 0.0
    return theta
