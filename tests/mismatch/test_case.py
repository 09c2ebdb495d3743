"""Reading a case folder: what is fatal gets one sentence, what can be lived without becomes a note."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.mismatch import Diagnosis, read_case, write_diagnosis
from bayes_nlsid.mismatch.case_campaign import needs_general
from bayes_nlsid.mismatch.diagnosis import Named
from bayes_nlsid.mismatch.disturb import _hum

RATE, PERIOD = 256.0, 1.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    n = 4
    K = 1e4 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    vectors = np.array([[0, -1.0, 1.0, 0]])
    np.savez(tmp_path / "nominal.npz", M=np.eye(n), K=K, sensor_select=np.eye(n)[:3], shaker_vector=np.eye(n)[1], base_vector=np.ones(n),
             location_names=np.array(["J1_slip"]), location_vectors=vectors)
    time = np.arange(512) / RATE
    records = []
    for i, (name, level) in enumerate((("low", 0.1), ("high", 1.0), ("low_again", 0.1), ("noise", 0.0))):
        force = level * np.tile(rng.normal(size=256), 2) if name != "low_again" else records[0]["f"]
        np.savez(tmp_path / f"{name}.npz", time=time, force=force, accel=rng.normal(size=(512, 3)))
        records.append({"name": name, "level": level, "kind": "steady multisine" if level else "shaker off", "start_s": 10.0 * i,
                        "sealed": False, "f": force})
    for r in records:
        r.pop("f")
    (tmp_path / "case.json").write_text(json.dumps(
        {"case": "x", "fs_hz": RATE, "period_s": PERIOD, "band_hz": [5, 100], "records": records}))
    return tmp_path


def change(folder: Path, **keys: object) -> None:
    meta = json.loads((folder / "case.json").read_text())
    meta.update(keys)
    (folder / "case.json").write_text(json.dumps(meta))


def nominal(folder: Path, **arrays: np.ndarray) -> None:
    with np.load(folder / "nominal.npz") as store:
        content = {k: store[k] for k in store.files}
    np.savez(folder / "nominal.npz", **(content | arrays))


def test_a_sound_case_is_read(folder: Path) -> None:
    case = read_case(folder)
    assert [r.kind for r in case.records] == ["steady", "steady", "steady", "off"]
    assert case.records[0].periods == 2 and case.usable.all()
    assert "K_parts" in " ".join(case.notes) and "M_parts" in " ".join(case.notes)
    assert not any("repeated" in n for n in case.notes)


@pytest.mark.parametrize(("arrays", "words"), [
    ({"K": -np.eye(4)}, "positive definite"), ({"M": np.eye(3)}, "shape"), ({"shaker_vector": np.ones(5)}, "last axis"),
    ({"location_vectors": np.zeros((2, 4))}, "location_vectors"), ({"K": np.full((4, 4), np.nan)}, "symmetric")])
def test_matrices_that_cannot_be_used(folder: Path, arrays: dict, words: str) -> None:
    nominal(folder, **arrays)
    with pytest.raises(InputError, match=words):
        read_case(folder)


def test_missing_things_say_what_to_do(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="case.json"):
        read_case(tmp_path / "nowhere")
    change(folder, band_hz=[100, 5])
    with pytest.raises(InputError, match="band_hz"):
        read_case(folder)
    change(folder, band_hz=[5, 100], fs_hz="fast")
    with pytest.raises(InputError, match="fs_hz"):
        read_case(folder)
    (folder / "case.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        read_case(folder)


def test_degraded_data_become_notes(folder: Path) -> None:
    with np.load(folder / "high.npz") as store:
        accel = store["accel"].copy()
        time, force = store["time"], store["force"]
    accel[5, 1] = np.nan
    np.savez(folder / "high.npz", time=time, force=force, accel=accel)
    np.savez(folder / "low.npz", time=time * 2, force=force, accel=np.zeros((512, 3)))
    (folder / "noise.npz").unlink()
    case = read_case(folder)
    text = " ".join(case.notes)
    assert not case.usable[1] and case.usable[0]
    for word in ("S2", "128", "noise.npz", "shaker-off", "repeated"):
        assert word in text


def test_the_answer_is_written_as_agreed(tmp_path: Path) -> None:
    hypotheses = (Named((("none", "-"),), 0.9), Named((("other", "-"),), 0.1))
    diagnosis = Diagnosis("x", 1, 2.0, "none", 0.1, {"locations": [], "phase": "-"}, hypotheses, {"nrmse_nominal": float("nan")}, "words",
                          {},
                          (), {"s_accel_q50": np.zeros((4, 2))}, {"frequency": np.arange(3.0)})
    write_diagnosis(diagnosis, tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert stored["format"] == 1 and stored["hypotheses"][0]["effects"] == [{"class": "none", "location": "-"}]
    assert stored["heldout"]["nrmse_nominal"] is None
    with np.load(tmp_path / "out" / "predictions.npz") as store:
        assert store["s_accel_q50"].shape == (4, 2)
    with pytest.raises(ValueError, match="sum"):
        Diagnosis("x", 1, 2.0, "none", 0.1, {}, hypotheses[:1], {}, "", {})


def test_a_periodic_campaign_with_a_burst_that_does_not_end_stays_where_it_belongs(folder: Path) -> None:
    rng = np.random.default_rng(0)
    meta = json.loads((folder / "case.json").read_text())
    period = round(meta["period_s"] * meta["fs_hz"])
    wave = rng.normal(size=period)
    rest = {"time": np.arange(2 * period) / meta["fs_hz"], "accel": rng.normal(size=(2 * period, 2))}
    np.savez(folder / "burst.npz", force=rng.normal(size=2 * period), **rest)
    burst = {"name": "burst", "kind": "burst random", "level": 1.0, "start_s": 0.0, "sealed": False}
    change(folder, records=[burst])
    assert needs_general(folder)
    np.savez(folder / "steady.npz", force=np.tile(wave, 2), **rest)
    change(folder, records=[burst, {"name": "steady", "kind": "steady multisine", "level": 1.0, "start_s": 0.0, "sealed": False}])
    assert not needs_general(folder)


@pytest.mark.parametrize("sort", ["noise", "tone", "ringing"])
def test_mains_hum_is_heard_where_bursts_have_died_away(folder: Path, sort: str) -> None:
    """A tone that is there in the quiet end of every burst; a mode that rings down there is none."""
    rng = np.random.default_rng(1)
    n = 2048
    time = np.arange(n) / RATE
    records = []
    for i in range(4):
        force = np.where(time < 1.0, rng.normal(size=n), 0.0)
        accel = rng.normal(size=(n, 3)) * (1.0 + 20 * (time < 2.0)[:, None])
        if sort != "noise":
            accel[:, 1] += np.cos(2 * np.pi * 50.0 * time + i) * (1.0 if sort == "tone" else 300 * np.exp(-0.9 * time))
        np.savez(folder / f"burst_{i}.npz", time=time, force=force, accel=accel)
        records.append({"name": f"burst_{i}", "kind": "burst", "level": 1.0, "start_s": 10.0 * i, "sealed": False})
    change(folder, records=records, mains_hz=50.0)
    found = _hum(read_case(folder), None)
    if sort == "tone":
        assert found[0].place == "S2" and found[0].gain > 100
    else:
        assert not found or found[0].gain < 12


@pytest.mark.parametrize(("keys", "words"), [
    ({"excited_lines": [1, None]}, "excited_lines: is not a list of whole numbers"),
    ({"excited_lines": [1e400]}, "excited_lines: is not a list of whole numbers"),
    ({"tolerances": {"E_rel_sd": "x"}}, "tolerances.E_rel_sd: is not a number above zero"),
    ({"tolerances": [1]}, "tolerances: is not a table"), ({"period_s": [1]}, "period_s: is not a number"),
    ({"band_hz": ["a", "b"]}, "band_hz: is not a pair"), ({"classes": "hardening"}, "classes: is not a list of names"),
    ({"locations": {"sensors": "S1"}}, "locations.sensors: is not a list of names"), ({"mains_hz": "fifty"}, "mains_hz: is not a number"),
    ({"records": [{"name": "../low"}]}, "is not the name of a file in the folder"),
    ({"records": [{"name": "low", "level": "loud"}]}, "records, level of 'low': is not a number"),
    ({"records": [{"name": "low", "sealed": "no"}]}, "records, sealed of 'low': is not true or false")])
def test_fields_of_another_kind_are_refused_by_both_readers(folder: Path, keys: dict[str, object], words: str) -> None:
    change(folder, **keys)
    for read in (read_case, needs_general):
        with pytest.raises(InputError) as error:
            read(folder)
        assert words in str(error.value) and "case.json" in str(error.value)


def test_null_is_as_good_as_left_out(folder: Path) -> None:
    meta = json.loads((folder / "case.json").read_text())
    meta["records"][-1]["start_s"] = None
    change(folder, mains_hz=None, tolerances={"E_rel_sd": None}, records=meta["records"])
    case = read_case(folder)
    assert case.mains == 50.0 and case.tolerances["E_rel_sd"] == 0.03


def test_torn_archives_are_refused_in_one_sentence(folder: Path) -> None:
    for name in ("low.npz", "nominal.npz"):
        data = (folder / name).read_bytes()
        for torn in (b"", b"text", data[:len(data) // 2], data[:100] + b"x" + data[101:]):
            (folder / name).write_bytes(torn)
            for read in (read_case, needs_general):
                with pytest.raises(InputError, match=name):
                    read(folder)
        (folder / name).write_bytes(data)
