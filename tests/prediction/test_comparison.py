"""Alternatives on a common target: sums in closed form, the true law found, an irrelevant one not preferred, bad input."""

from __future__ import annotations

import numpy as np
import pytest

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.model import Element, Model
from bayes_nlsid.prediction.comparison import Alternative, Comparison, compare
from bayes_nlsid.recordings.noise import noise_psd
from bayes_nlsid.recordings.recording import Channel, Recording
from bayes_nlsid.structure.chains import oscillator

FS = 512.0
LINEAR = oscillator(frequency=20.0, zeta=0.02, location="x")
NAMES = ("a", "b", "c")


def made(by_block: np.ndarray) -> Comparison:
    k, b = by_block.shape
    return Comparison(NAMES[:k], tuple(map(str, range(b))), tuple(x[None] for x in by_block), by_block, np.zeros(k), np.zeros(k),
                      (None,) * k)


def test_differences_and_their_errors() -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(size=30)
    found = made(np.stack([base, base - 1 + 0.5 * rng.normal(size=30), base + 0.01 * rng.normal(size=30)]))
    value, error = found.difference(1, 0)
    each = found.by_block[1] - found.by_block[0]
    assert value == pytest.approx(each.sum()) and error == pytest.approx(np.sqrt(30) * each.std(ddof=1))
    assert found.told_apart(1) and not found.told_apart(0) and not found.told_apart(2)
    assert "cannot be told" in found.sentence and "b by" in found.sentence
    assert [r["name"] for r in found.rows()][-1] == "b"


def test_blocks_of_unequal_weight_that_all_agree_are_no_chance() -> None:
    """One alternative loses everywhere, by ten here and thousands there: the standard error is as large as the difference."""
    base = np.zeros(6)
    found = made(np.stack([base, -np.array([12.0, 15.0, 20.0, 80.0, 9000.0, 30.0]), -np.array([12.0, -15.0, 20.0, -80.0, 9000.0, 30.0])]))
    value, error = found.difference(1)
    assert -value < 2 * error and found.chance(1) == pytest.approx(1 / 64) and found.told_apart(1)
    assert not found.told_apart(2) and found.chance(2) > 0.05
    five = made(np.stack([base[:5], -np.array([12.0, 15.0, 20.0, 80.0, 9000.0])]))
    assert not five.told_apart(1)       # five signs agree by chance in one of 32 cases
    rng = np.random.default_rng(1)
    many = made(np.stack([np.zeros(40), rng.normal(size=40)]))
    assert 0.05 < many.chance(1, 0) < 0.95


def test_stacking_is_the_best_mixture() -> None:
    """Two alternatives, each right on half of the blocks: the mixture's log score is largest at the weights returned."""
    log = np.log(np.array([[0.9, 0.8, 0.9, 0.1, 0.2], [0.1, 0.2, 0.3, 0.7, 0.9]]))
    found = made(log).stacking
    grid = np.linspace(0, 1, 2001)
    score = np.log(grid[:, None] * np.exp(log[0]) + (1 - grid[:, None]) * np.exp(log[1])).sum(axis=1)
    assert found.sum() == pytest.approx(1.0) and found[0] == pytest.approx(grid[np.argmax(score)], abs=2e-3)
    lost = made(np.stack([log[0], np.full(5, -np.inf)]))
    assert lost.stacking == pytest.approx([1.0, 0.0]) and "fails" in lost.sentence and lost.told_apart(1)


def test_different_data_cannot_be_compared() -> None:
    with pytest.raises(ValueError, match="different blocks"):
        Comparison(("a", "b"), ("1", "2"), (np.zeros((1, 2)), np.zeros((1, 3))), np.zeros((2, 2)), np.zeros(2), np.zeros(2), (None, None))


def duffing(seed: int, seconds: float = 8.0) -> Recording:
    """Hardening oscillator under random force by Runge–Kutta at four steps per sample, 1 % noise."""
    rng = np.random.default_rng(seed)
    n, inner = round(seconds * FS), 4
    half = np.arange(2 * inner * n + 1) / (2 * inner * FS)
    force = sum(0.1 * np.cos(2 * np.pi * f * half + p) for f, p in zip(np.arange(12, 30, 0.4), rng.uniform(0, 6.28, 45), strict=True))
    force = force * np.minimum(1, half / 0.3)
    w, x, v, out, h = 2 * np.pi * 20.0, 0.0, 0.0, [], 1 / (inner * FS)
    p = force.tolist()

    def rate(x: float, v: float, f: float) -> float:
        return f - 0.04 * w * v - w * w * x - 1e9 * x**3

    for i in range(inner * n):
        a = rate(x, v, p[2 * i])
        if i % inner == 0:
            out.append(a)
        v1 = v + 0.5 * h * a
        b = rate(x + 0.5 * h * v, v1, p[2 * i + 1])
        v2 = v + 0.5 * h * b
        c = rate(x + 0.5 * h * v1, v2, p[2 * i + 1])
        v3 = v + h * c
        d = rate(x + h * v2, v3, p[2 * i + 2])
        x, v = x + h / 6 * (v + 2 * v1 + 2 * v2 + v3), v + h / 6 * (a + 2 * b + 2 * c + d)
    clean = np.array(out)
    noisy = clean + 0.01 * clean.std() * rng.normal(size=n)
    return Recording(f"r{seed}", 1 / FS, noisy[:, None], (Channel("a", "x", "acceleration", "m/s^2"),),
                     force[:2 * inner * n:2 * inner, None],
                     (Channel("f", "x", "force", "N"),))


def test_the_true_law_wins_and_an_irrelevant_one_does_not() -> None:
    train, held = duffing(1), duffing(2)
    rng = np.random.default_rng(3)
    true = 1e9 * (1 + 0.003 * rng.normal(size=(20, 1)))
    both = np.concatenate([true, 20 * rng.normal(size=(20, 1))], axis=1)
    cubic, extra = Element(LIBRARY["cubic"], ("x",)), Element(LIBRARY["q|q|"], ("x",))
    given = [Alternative("cubic", Model(LINEAR, (cubic,)), true), Alternative("linear", Model(LINEAR), np.zeros((1, 0))),
             Alternative("cubic and more", Model(LINEAR, (cubic, extra)), both)]
    found = compare(given, [(train, noise_psd(train))], [(held, noise_psd(held))], band=(8.0, 40.0))
    assert found.told_apart(1) and found.difference(1)[0] < -100
    better, error = found.difference(2, 0)
    assert not (better > 4 and better > 2 * error)
    assert found.discrepancy[0] < 0.02 < found.discrepancy[1] and found.nrmse[0] < 0.03 < found.nrmse[1]
    assert len(found.blocks) >= 3 and found.sentence.startswith(f"Over {len(found.blocks)} blocks")


def test_too_short_a_record_is_one_sentence() -> None:
    short = duffing(4, 1.0)
    with pytest.raises(ValueError, match="too short"):
        compare([Alternative("linear", Model(LINEAR), np.zeros((1, 0)))], [], [(short, noise_psd(short))], band=(8.0, 40.0))
