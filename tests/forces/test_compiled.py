"""Compiled and plain code give the same numbers."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from bayes_nlsid.forces import memory
from bayes_nlsid.forces.expression import user_term
from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import force_along, motion
from tests.forces.cases import ordinary, ringing

compiled = pytest.importorskip("bayes_nlsid.forces.compiled")
N, DT = 400, 1 / 2000


@pytest.mark.parametrize("name", ["iwan5_memory", "bouc_wen"])
def test_marching_compiled_equals_plain(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = motion(*ringing(N, DT), DT)
    p = ordinary(LIBRARY[name]) * np.array([[1.0], [1.1], [0.7]])
    fast = force_along(LIBRARY[name], path, p)
    called = []
    monkeypatch.setattr(compiled, "march_sliders", called.append)
    monkeypatch.setattr(compiled, "march_bouc_wen", called.append)
    monkeypatch.setenv("BAYES_NLSID_COMPILED", "0")
    plain = force_along(LIBRARY[name], path, p)
    assert not called
    np.testing.assert_allclose(fast, plain, rtol=0, atol=1e-12 * np.abs(plain).max())


@pytest.mark.parametrize("term", [t for t in LIBRARY.values() if t.memory != "bouc_wen"], ids=lambda t: t.name)
def test_law_value_is_the_law(term) -> None:  # noqa: ANN001
    code = compiled.law_code(term)
    p = ordinary(term)
    size = 5e-5 if len(p) > 1 else 1.0
    for q in size * np.array([-1.3, -0.2, 0.0, 0.4, 1.0]):
        for v in 100 * size * np.array([-0.7, 0.0, 0.9]):
            expected = [float(np.asarray(x)) for x in (term.law(q, v, *p), *term.slope(q, v, *p))]
            np.testing.assert_allclose(compiled.law_value(*code, q, v, p), expected, rtol=1e-13, atol=1e-15)


def test_laws_of_users_have_no_number() -> None:
    assert compiled.law_code(user_term("mine", "c*q**3", {"c": ("N/m^3", "coefficient")})) is None


@pytest.mark.parametrize("name", ["jenkins_memory", "iwan4_memory"])
def test_masing_walk_follows_the_motion(name: str) -> None:
    term, (q, v) = LIBRARY[name], ringing(N, DT)
    p, code = ordinary(term), compiled.law_code(term)
    expected = force_along(term, motion(q, v, DT), p)
    last, depth, ends, forces = np.zeros(4), 0, np.zeros(64), np.zeros(64)
    for i in range(N):
        before = last.copy(), ends.copy(), forces.copy()
        tried = compiled.masing_walk(*code, p, last, depth, ends, forces, q[i], v[i], DT, False)
        for a, b in zip((last, ends, forces), before, strict=True):
            np.testing.assert_array_equal(a, b)
        force, _, depth, overflow = compiled.masing_walk(*code, p, last, depth, ends, forces, q[i], v[i], DT, True)
        assert not overflow and tried[0] == force
        assert force == pytest.approx(expected[i], abs=1e-10 * 2000)


def test_masing_walk_says_when_its_stack_is_full() -> None:
    term = LIBRARY["iwan4_memory"]
    p, code = ordinary(term), compiled.law_code(term)
    last, depth, ends, forces, flags = np.zeros(4), 0, np.zeros(3), np.zeros(3), []
    for peak in 1e-5 * np.array([1.0, -0.9, 0.8, -0.7, 0.6]):
        _, _, depth, overflow = compiled.masing_walk(*code, p, last, depth, ends, forces, peak, 0.0, 1.0, True)
        flags.append(overflow)
    assert flags == [False, False, False, False, True]


def test_slider_and_bouc_wen_walks_follow_the_motion() -> None:
    q, v = ringing(N, DT)
    path = motion(q, v, DT)
    five, wen = LIBRARY["iwan5_memory"], LIBRARY["bouc_wen"]
    p5, pw = ordinary(five), ordinary(wen)
    stiffness, slip, theta = memory.iwan_sliders(p5)
    last5, stretch, sliding, last_wen = np.zeros(2), np.zeros_like(slip), np.zeros_like(slip), np.zeros(3)
    found = np.empty((2, N))
    for i in range(N):
        found[0, i] = compiled.sliders_walk(theta[0], stiffness, slip, last5, stretch, sliding, q[i], v[i], DT, True)[0]
        found[1, i] = compiled.bouc_wen_walk(pw, last_wen, q[i], v[i], DT, True)[0]
    np.testing.assert_allclose(found[0], force_along(five, path, p5), atol=1e-9 * 2000)
    np.testing.assert_allclose(found[1], force_along(wen, path, pw), atol=1e-9 * np.abs(found[1]).max())


def test_compiles_without_a_place_for_its_cache(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN001
    file = tmp_path / "a file, no directory"
    file.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(file))
    assert compiled.cache_directory(memory.__file__) == ""
    assert compiled.compiled(memory.slider_step)(0.5, 0.0, 0.0, 1.0, 1.0) == (0.5, 0.0)


def test_cache_changes_its_name_with_the_sources(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN001
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    source = tmp_path / "law.py"
    names = set()
    for text in ("a = 1", "a = 2", "a = 1"):
        source.write_text(text)
        names.add(compiled.cache_directory(str(source)))
    assert len(names) == 2 and all(name.startswith(str(tmp_path)) for name in names)


def test_forces_import_neither_numba_nor_scipy() -> None:
    code = ("import sys; import bayes_nlsid.forces.library, bayes_nlsid.forces.motion, bayes_nlsid.forces.stepping, "
            "bayes_nlsid.forces.expression; sys.exit(bool({'numba', 'scipy'} & set(sys.modules)))")
    assert subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": ":".join(sys.path)}, check=False).returncode == 0
