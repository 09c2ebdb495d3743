"""The study of recordings of any kind: its truth shares nothing with the package and solves its equations."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import numpy as np
import studies.any_recording as study
from studies.any_recording.generate import generate
from studies.any_recording.score import gather, table
from studies.any_recording.truth import draw_chain, laws, march


def test_the_truth_imports_nothing_of_the_package() -> None:
    for name in ("truth.py", "generate.py", "score.py"):
        tree = ast.parse((Path(study.__file__).parent / name).read_text())
        found = [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
        found += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
        assert not any(module.startswith("bayes_nlsid") for module in found)


def test_a_free_decay_is_that_of_its_modes() -> None:
    chain = draw_chain(np.random.default_rng(1), 1)
    w, t = 2 * np.pi * chain.frequencies[0], np.arange(400) / (40 * chain.frequencies[0])
    zeta = chain.C[0, 0] / (2 * w * chain.M[0, 0])
    u, _, a = march(chain, None, 0.0, 0, None, np.ones(1), np.array([1.0, 0.0]), t, 1.0)
    wd = w * np.sqrt(1 - zeta ** 2)
    exact = np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))
    assert np.abs(u[:, 0] - exact).max() < 1e-5
    assert np.abs(a[:, 0] + 2 * zeta * w * np.gradient(exact, t) + w * w * exact)[2:-2].max() < 2e-2 * w * w


def test_hysteresis_dissipates() -> None:
    law = laws(np.random.default_rng(3), "hysteresis", 1.0, 1.0, 2.0, 1.0)
    z, work, dt = np.zeros(law.states), 0.0, 1e-3
    for x in np.arange(0, 20, dt):
        q, v = 2 * np.sin(x), 2 * np.cos(x)
        g, dz = law.rate(q, v, z)
        z, work = z + dt * dz, work + dt * g * v
    assert work > 0


def test_cases_are_written_and_scored(tmp_path: Path) -> None:
    generate(1, 11, tmp_path / "cases", tmp_path / "answers", first=4)
    assert (tmp_path / "cases" / "case_004" / "nominal.npz").is_file()
    said = {"p_mismatch": 0.1, "seconds": 1.0, "heldout": {"nrmse_extended": 0.1, "nrmse_updated_linear": 0.1, "noise_floor": 0.05},
            "hypotheses": [{"effects": [{"class": "none", "location": "-"}], "probability": 0.9},
                           {"effects": [{"class": "coulomb", "location": "J1"}], "probability": 0.1}]}
    (tmp_path / "out" / "case_004").mkdir(parents=True)
    (tmp_path / "out" / "case_004" / "diagnosis.json").write_text(json.dumps(said))
    assert "0 of 1" in table(gather(tmp_path / "out", tmp_path / "answers"))
