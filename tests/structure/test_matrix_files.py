"""Files of finite-element programs: the same structure from each, in SI, and one sentence for what cannot be read."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import hb_write
from scipy.sparse import csc_array

from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.chains import spring_mass_chain
from bayes_nlsid.structure.matrices import read_matrices
from bayes_nlsid.structure.structure import Structure, modes

# a chain whose second "node" also turns: dofs 1.1, 2.1, 2.6 (a rotation)
M = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.3], [0.0, 0.3, 0.5]])
K = np.array([[30.0, -10.0, 2.0], [-10.0, 20.0, -1.0], [2.0, -1.0, 5.0]])
DOFS = ("1.1", "2.1", "2.6")
LENGTH = 1e-3
SCALE = np.array([1.0, 1.0, 1 / LENGTH])  # x = SCALE * x_file with lengths in mm: rows of 1/m for displacements, 1 for the angle


def in_mm(matrix: np.ndarray) -> np.ndarray:
    """The matrix in N, mm, s of the model that is ``matrix`` in SI, from energy: u = LENGTH u_file, force work in N mm."""
    to_si = np.array([LENGTH, LENGTH, 1.0])
    return to_si[:, None] * matrix * to_si / LENGTH


def abaqus(path: Path, matrix: np.ndarray) -> Path:
    pairs = [d.split(".") for d in DOFS]
    lines = ["** generated", "*MATRIX, NAME=K"] + [f"{pairs[i][0]},{pairs[i][1]}, {pairs[j][0]},{pairs[j][1]}, {matrix[i, j]:.17e}"
                                                 for i in range(3) for j in range(i + 1) if matrix[i, j]]
    path.write_text("\n".join(lines) + "\n")
    return path


def dmig(path: Path, **matrices: np.ndarray) -> Path:
    lines = []
    for name, matrix in matrices.items():
        lines.append(f"DMIG    {name:<8}       0       6       2       0")
        for j in range(3):
            lines.append(f"DMIG*   {name:<16}{DOFS[j][0]:>16}{DOFS[j][2]:>16}")
            lines += [f"*       {DOFS[i][0]:>16}{DOFS[i][2]:>16}{f'{matrix[i, j]:.9E}'.replace('E', 'D'):>16}" for i in range(j, 3)]
    path.write_text("\n".join(lines) + "\n")
    return path


def output4(path: Path, binary: bool) -> Path:
    op4 = pytest.importorskip("pyyeti.nastran.op4")
    op4.write(str(path), {"MAA": in_mm(M), "KAA": in_mm(K)}, binary=binary)
    return path


def from_abaqus(folder: Path) -> Structure:
    return read_matrices(abaqus(folder / "m.mtx", in_mm(M)), abaqus(folder / "k.mtx", in_mm(K)), length_unit="mm", force_unit="N")


def from_dmig(folder: Path) -> Structure:
    pytest.importorskip("pyyeti")
    return read_matrices(dmig(folder / "model.pch", MAAX=in_mm(M), KAAX=in_mm(K)), length_unit="mm", force_unit="N")


def from_output4(folder: Path) -> Structure:
    return read_matrices(output4(folder / "model.op4", False), length_unit="mm", force_unit="N", rotations=["3"])


def from_binary_output4(folder: Path) -> Structure:
    return read_matrices(output4(folder / "model.op4", True), length_unit="mm", force_unit="N", rotations=["q3"])


def from_boeing(folder: Path) -> Structure:
    for name, matrix in (("m", M), ("k", K)):
        hb_write(folder / f"{name}.rua", csc_array(in_mm(matrix)))
    return read_matrices(folder / "m.rua", folder / "k.rua", length_unit="mm", force_unit="N", rotations=["3"])


def from_market(folder: Path) -> Structure:
    for name, matrix in (("m", in_mm(M)), ("k", in_mm(K))):
        rows = [f"{i + 1} {j + 1} {matrix[i, j]:.17g}" for i in range(3) for j in range(i + 1) if matrix[i, j]]
        head = f"%%MatrixMarket matrix coordinate real symmetric\n% mm\n3 3 {len(rows)}\n"
        (folder / f"{name}.mtx").write_text(head + "\n".join(rows) + "\n")
    return read_matrices(folder / "m.mtx", folder / "k.mtx", length_unit="mm", force_unit="N", rotations=["3"])


@pytest.mark.parametrize("read", [from_abaqus, from_dmig, from_output4, from_binary_output4, from_boeing, from_market])
def test_every_format_gives_the_model_in_si(tmp_path: Path, read: Callable[[Path], Structure]) -> None:
    found = read(tmp_path)
    dense = [m if isinstance(m, np.ndarray) else m.toarray() for m in (found.M, found.K)]
    np.testing.assert_allclose(dense[0], M, rtol=2e-9, atol=1e-9)
    np.testing.assert_allclose(dense[1], K, rtol=2e-9, atol=1e-8)
    assert "mm, N and s, converted to SI" in found.notes[0]
    assert found.dofs == (DOFS if read in (from_abaqus, from_dmig) else ("q1", "q2", "q3"))


def test_units_are_required_where_formats_do_not_fix_them(tmp_path: Path) -> None:
    files = abaqus(tmp_path / "m.mtx", M), abaqus(tmp_path / "k.mtx", K)
    with pytest.raises(InputError, match="length_unit: a file of Abaqus does not say its units"):
        read_matrices(*files)
    with pytest.raises(InputError, match="force_unit: "):
        read_matrices(*files, length_unit="mm")
    with pytest.raises(InputError, match="not a unit that is known"):
        read_matrices(*files, length_unit="cubit", force_unit="N")
    from_market(tmp_path)
    with pytest.raises(InputError, match="does not say which degrees of freedom are rotations"):
        read_matrices(tmp_path / "m.mtx", tmp_path / "k.mtx", length_unit="mm", force_unit="N")


def test_held_degrees_of_freedom_of_abaqus_are_left_out(tmp_path: Path) -> None:
    held = K.copy()
    held[0, 0] = 1e36
    found = read_matrices(abaqus(tmp_path / "m.mtx", M), abaqus(tmp_path / "k.mtx", held), length_unit="m", force_unit="N")
    assert found.dofs == ("2.1", "2.6")
    np.testing.assert_allclose(found.K.toarray(), K[1:, 1:])


def test_massless_degrees_of_freedom_are_condensed_exactly(tmp_path: Path) -> None:
    """A chain with a massless point in the middle of a spring is the chain without it, and the point moves half as far."""
    chain = spring_mass_chain([1.0, 2.0], [10.0, 20.0])
    k = np.array([[30.0, 0.0, -20.0 * 2], [0.0, 20.0 * 2, -20.0 * 2], [-20.0 * 2, -20.0 * 2, 80.0]]) + np.diag([20.0, 0.0, 0.0])
    m = np.diag([1.0, 2.0, 0.0])
    for name, matrix in (("m", m), ("k", k)):
        rows = [f"{i + 1} {j + 1} {v:.17g}" for (i, j), v in np.ndenumerate(matrix) if v]
        (tmp_path / f"{name}.mtx").write_text(f"%%MatrixMarket matrix coordinate real general\n3 3 {len(rows)}\n" + "\n".join(rows) + "\n")
    (tmp_path / "l.csv").write_text("name,dof,coefficient,role\nmiddle,3,1,sensors\n")
    found = read_matrices(tmp_path / "m.mtx", tmp_path / "k.mtx", locations=tmp_path / "l.csv")
    np.testing.assert_allclose(modes(found, 2).omega, modes(chain, 2).omega)
    np.testing.assert_allclose(found.rows(["middle"])[0], [0.5, 0.5])
    assert "1 degrees of freedom without mass were condensed" in found.notes[0]


def test_which_matrix_of_a_nastran_file_is_meant(tmp_path: Path) -> None:
    pytest.importorskip("pyyeti")
    file = dmig(tmp_path / "a.pch", MAA=M, KAA=K, KXX=2 * K)
    with pytest.raises(InputError, match="KAA, KXX, MAA, and it is not clear which is the stiffness; write stiffness_name"):
        read_matrices(file, length_unit="m", force_unit="N")
    found = read_matrices(file, length_unit="m", force_unit="N", stiffness_name="kxx")
    np.testing.assert_allclose(found.K.toarray(), 2 * K)
    with pytest.raises(InputError, match="holds no matrix 'KYY'"):
        read_matrices(file, length_unit="m", force_unit="N", stiffness_name="KYY")


@pytest.mark.parametrize(("name", "text", "words"), [
    ("m.mtx", "%%MatrixMarket matrix coordinate real general\n3 3 999999999\n1 1 1\n", "do not fit the file"),
    ("m.mtx", "%%MatrixMarket matrix coordinate real general\n999999999 999999999 1\n1 1 1\n", "do not fit the file"),
    ("m.mtx", "%%MatrixMarket matrix coordinate real general\n2 3 1\n1 1 1\n", "must be square"),
    ("m.mtx", "1 2 3 4\n", "neither MatrixMarket nor an Abaqus"), ("m.mtx", "1 1 1\n1 x 2\n", "cannot be read as .mtx"),
    ("m.mtx", "99999999 1 1\n", "cannot be"), ("m.mtx", "0 1 1\n", "from 1"),
    ("m.rua", "title\n1 1 1 1\nCUA 3 3 7 0\n(40I2) (40I2) (3E25.16)\n", "assembled real"), ("m.rua", "x", "assembled real"),
    ("m.rua", "title\n1 1 1 1\nRUA 3 3 7 0\n(40I2) (40I2) (3E25.16)\n1 2\n", "cannot be read as .rua"),
    ("m.op4", "nonsense", "cannot be read as .op4|holds no square"), ("m.pch", "GRID,1\n", "as .dmig|holds no square matrix"),
    ("m.inp", "x", "are not read as matrices"), ("m.mtx", "", "neither"),
])
def test_foreign_matrices_are_refused_in_one_sentence(tmp_path: Path, name: str, text: str, words: str) -> None:
    if name.endswith(("op4", "pch")):
        pytest.importorskip("pyyeti")
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_matrices(tmp_path / name, tmp_path / name, length_unit="m", force_unit="N")
    assert "\n" not in str(caught.value) and "Traceback" not in str(caught.value)


@pytest.mark.parametrize("text", ["matrix coordinate real symmetric\n% a comment\n3 3 5\n1 1 2.",
                                  "matrix array real general\n2 2\n2.0\n9999999999999999999D\xb6?r9"])
def test_a_file_cut_within_a_number_does_not_end_the_program(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.mtx").write_bytes(b"%%MatrixMarket " + text.encode("latin-1"))
    program = ("import sys; from pathlib import Path; from bayes_nlsid.structure.matrix_files import read_matrix; "
               "read_matrix(Path(sys.argv[1]), 'mass')")
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "m.mtx")], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "InputError" in done.stderr.splitlines()[-1], (done.returncode, done.stderr[-300:])
