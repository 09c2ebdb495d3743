"""Matrices from files: the same structure from every format, and each kind of damage refused with file, field and mend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.chains import spring_mass_chain
from bayes_nlsid.structure.matrices import read_matrices
from bayes_nlsid.structure.structure import modes

CHAIN = spring_mass_chain([1.0, 2.0, 3.0], [10.0, 20.0, 30.0])


def archive(path: Path, **changes: object) -> Path:
    content: dict[str, object] = {
        "M": CHAIN.M, "K": CHAIN.K, "K_parts": np.array(list(CHAIN.K_parts.values())), "K_part_names": np.array(list(CHAIN.K_parts)),
        "sensor_select": np.eye(3)[:2], "shaker_vector": np.eye(3)[2], "base_vector": np.ones(3),
        "location_names": np.array(["J2_slip", "P1"]), "location_vectors": np.array([[-1.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), **changes}
    np.savez(path, **{k: v for k, v in content.items() if v is not None})
    return path


def market(path: Path, matrix: np.ndarray, symmetric: bool = True) -> Path:
    lines = [(i + 1, j + 1, v) for (i, j), v in np.ndenumerate(matrix) if v and (j <= i or not symmetric)]
    head = f"%%MatrixMarket matrix coordinate real {'symmetric' if symmetric else 'general'}\n{len(matrix)} {len(matrix)} {len(lines)}\n"
    path.write_text(head + "".join(f"{i} {j} {v:.17g}\n" for i, j, v in lines))
    return path


def test_archive_gives_structure_roles_and_parts(tmp_path: Path) -> None:
    found = read_matrices(archive(tmp_path / "nominal.npz"))
    np.testing.assert_array_equal(found.M, CHAIN.M)
    assert (found.joints, found.sensors, found.inputs) == (("J2_slip",), ("S1", "S2"), ("SHAKER",))
    np.testing.assert_array_equal(found.rows(["J2_slip"])[0], [-1.0, 1.0, 0.0])
    np.testing.assert_array_equal(found.locations["BASE"], [1.0, 2.0, 3.0])
    assert tuple(found.K_parts) == ("J1", "J2", "J3")
    assert read_matrices(tmp_path / "nominal.npz", joints=["P1"]).joints == ("P1",)


@pytest.mark.parametrize("symmetric", [True, False])
def test_market_pair_is_completed_to_the_full_matrix(tmp_path: Path, symmetric: bool) -> None:
    M, K = market(tmp_path / "m.mtx", CHAIN.M, symmetric), market(tmp_path / "k.mtx", CHAIN.K, symmetric)
    found = read_matrices(M, K)
    np.testing.assert_allclose(found.K.toarray(), CHAIN.K)
    np.testing.assert_allclose(modes(found, 3).omega, modes(CHAIN, 3).omega)


def test_locations_from_table_toml_and_archive_agree(tmp_path: Path) -> None:
    M, K = market(tmp_path / "m.mtx", CHAIN.M), market(tmp_path / "k.mtx", CHAIN.K)
    (tmp_path / "l.csv").write_text("name,dof,coefficient,role\nJ1,1,-1,joints\nJ1,2,1,joints\nacc,q3,1.0,sensors\n")
    (tmp_path / "l.toml").write_text('[[location]]\nname = "J1"\ndofs = [1, 2]\ncoefficients = [-1, 1]\nrole = "joints"\n'
                                     '[[location]]\nname = "acc"\ndofs = ["q3"]\ncoefficients = [1]\nrole = "sensors"\n')
    np.savez(tmp_path / "l.npz", location_names=np.array(["J1", "acc"]), location_vectors=np.array([[-1.0, 1, 0], [0, 0, 1]]),
             location_roles=np.array(["joints", "sensors"]))
    for ending in ("csv", "toml", "npz"):
        found = read_matrices(M, K, locations=tmp_path / f"l.{ending}")
        assert (found.joints, found.sensors) == (("J1",), ("acc",))
        np.testing.assert_array_equal(found.rows(["J1", "acc"]), [[-1, 1, 0], [0, 0, 1]])


@pytest.mark.parametrize("changes, word", [
    ({"K": np.eye(2)}, "shape"), ({"K": CHAIN.K + np.triu(np.ones((3, 3)), 1)}, "not symmetric"), ({"M": np.diag([1.0, 0, 1])}, "definite"),
    ({"K": -CHAIN.K}, "negative eigenvalues"), ({"M": np.full((3, 3), np.nan)}, "NaN"), ({"K": None}, "K missing"),
    ({"M": np.ones(3)}, "shape"),
    ({"location_vectors": np.ones((2, 4))}, "entries"), ({"location_vectors": np.ones((1, 3))}, "rows"),
    ({"K_part_names": np.array(["a", "b"])}, "names"), ({"base_vector": np.ones(2)}, "base_vector")])
def test_damaged_archives_are_refused(tmp_path: Path, changes: dict[str, object], word: str) -> None:
    with pytest.raises(InputError, match=word) as caught:
        read_matrices(archive(tmp_path / "nominal.npz", **changes))
    assert "nominal.npz" in caught.value.where and caught.value.mend


@pytest.mark.parametrize("text, word", [
    ("name,dof,coefficient\nA,7,1\n", "does not exist"), ("name,dof,coefficient\nA,1,much\n", "not a number"),
    ("name,dof\nA,1\n", "missing"), ("name,dof,coefficient,role\nA,1,1,boss\n", "unknown role")])
def test_damaged_tables_are_refused_with_their_line(tmp_path: Path, text: str, word: str) -> None:
    M, K = market(tmp_path / "m.mtx", CHAIN.M), market(tmp_path / "k.mtx", CHAIN.K)
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(InputError, match=word):
        read_matrices(M, K, locations=tmp_path / "l.csv")


def test_files_that_are_not_there_or_not_matrices_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_matrices(tmp_path / "none.npz")
    (tmp_path / "bad.mtx").write_text("hello")
    with pytest.raises(InputError, match="MatrixMarket"):
        read_matrices(tmp_path / "bad.mtx", tmp_path / "bad.mtx")
    with pytest.raises(InputError, match="alone"):
        read_matrices(tmp_path / "bad.mtx")
    with pytest.raises(InputError, match="unknown locations"):
        read_matrices(archive(tmp_path / "nominal.npz"), joints=["J9"])
