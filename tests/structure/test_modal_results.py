"""Modes that another program found: the same from a table and from universal datasets 55."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyuff

from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.modal_model import modal_model
from bayes_nlsid.structure.modal_results import matched_to, read_modal_results
from bayes_nlsid.structure.structure import Structure

M, K = np.diag([1.0, 1.0]), np.array([[2e4, -1e4], [-1e4, 2e4]])  # 15.9 Hz in phase, 27.6 Hz against each other
MODEL = modal_model(Structure(M, K, ("a", "b"), {"A": np.array([1.0, 0.0]), "B": np.array([0.0, 1.0])}, sensors=("A", "B")), 2)
TABLE = "mode; frequency [Hz]; damping [%]; A; B\n1; 27.5; 0.3; 0.5; -0.49\n2; 16,0; 0.2; 2; 2.02\n".replace(",", ".")


def universal(path: Path, complex_modes: bool) -> Path:
    """One dataset 55 for each mode: node 11 along Z is A, node 12 against Z is B."""
    sets = []
    for k, (f, z, a, b) in enumerate([(16.0, 0.002, 2.0, 2.02), (27.5, 0.003, 0.5, -0.49)]):
        turn = np.exp(1j * (0.7 if complex_modes else 0.0))
        pole = 2 * np.pi * f * (-z + 1j * np.sqrt(1 - z**2))
        shape = turn * np.array([a, -b])
        part = shape if complex_modes else shape.real
        sets.append({
            "type": 55, "model_type": 1, **{f"id{i}": "NONE" for i in range(1, 6)},
            "analysis_type": 3 if complex_modes else 2, "data_ch": 2, "spec_data_type": 8, "data_type": 5 if complex_modes else 2,
            "r1": 0 * part, "r2": 0 * part, "r3": part, "n_data_per_node": 3, "node_nums": np.array([11, 12]), "load_case": 1,
            "mode_n": k + 1, "modal_m": 0.0, "freq": f, "modal_damp_vis": z, "modal_damp_his": 0.0, "eig": pole,
            "modal_a": 0j, "modal_b": 0j})
    pyuff.UFF(str(path)).write_sets(sets, mode="add")
    return path


@pytest.mark.parametrize("form", ["csv", "uff normal", "uff complex"])
def test_modes_from_every_form(tmp_path: Path, form: str) -> None:
    if form == "csv":
        (tmp_path / "modes.csv").write_text(TABLE)
        found = read_modal_results(tmp_path / "modes.csv", MODEL.locations)
    else:
        found = read_modal_results(universal(tmp_path / "m.uff", form == "uff complex"), MODEL.locations, {"A": "11Z", "B": "-12Z"})
    np.testing.assert_allclose(found.frequency, [16.0, 27.5], rtol=1e-5)
    np.testing.assert_allclose(found.zeta, [0.002, 0.003], rtol=1e-5)
    np.testing.assert_allclose(np.abs(found.shapes), [[2 / 2.02, 1.0], [1.0, 0.98]], rtol=1e-5)
    assert np.sign(found.shapes[0] * found.shapes[1]).tolist() == [1, -1] and np.all(found.phase_scatter < 1e-5)
    assert "0.1 % of the frequency" in found.notes[0]
    only = matched_to(found, MODEL, [1])
    assert only.nominal == (1,) and only.frequency[0] == pytest.approx(27.5, rel=1e-5) and "16 Hz" in only.notes[-1]


def test_given_standard_deviations_are_taken(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("frequency [kHz],damping [1],frequency_sd [Hz],damping_sd [%],A\n0.016,0.002,0.1,0.01,1\n")
    found = read_modal_results(tmp_path / "m.csv", MODEL.locations)
    assert (found.frequency[0], found.frequency_sd[0], found.zeta_sd[0]) == pytest.approx((16.0, 0.1, 1e-4))


@pytest.mark.parametrize(("text", "words"), [
    ("frequency,damping [%],A\n16,1,1\n", r"'frequency' has no unit; head it frequency \[Hz\]"),
    ("frequency [Hz],damping,A\n16,1,1\n", r"'damping' has no unit; head it damping \[%\]"),
    ("frequency [Hz],damping [dB],A\n16,1,1\n", "unknown unit 'dB'"), ("frequency [Hz],A\n16,1\n", "no column damping"),
    ("frequency [Hz],damping [%],A\n16,1,inf\n", "shape 'A' holds values that are no numbers"),
    ("frequency [Hz],damping [%],C\n16,1,1\n", r"none of its shapes \(C\) is called"),
    ("frequency [Hz],damping [%]\n16,1\n", "there are none"), ("frequency [Hz],damping [%],A\n-16,1,1\n", "mode 1 has frequency -16"),
    ("frequency [Hz],damping [%],A\n16,1,1\n16,100,1\n", "mode 2 .* damping ratio 1"),
    ("frequency [Hz],damping [%],A\n16,1,0\n", "is zero"),
])
def test_tables_are_checked(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_modal_results(tmp_path / "m.csv", MODEL.locations)
    assert "\n" not in str(caught.value)


def test_universal_files_are_checked(tmp_path: Path) -> None:
    file = universal(tmp_path / "m.uff", False)
    with pytest.raises(InputError, match="holds no shape '13Z' .*; it holds 11X"):
        read_modal_results(file, MODEL.locations, {"A": "13Z"})
    (tmp_path / "c.uff").write_bytes(file.read_bytes()[:900])
    with pytest.raises(InputError, match="cut short|broken"):
        read_modal_results(tmp_path / "c.uff", MODEL.locations, {"A": "11Z"})
    with pytest.raises(InputError, match="cannot be opened"):
        read_modal_results(tmp_path / "none.uff", MODEL.locations)
