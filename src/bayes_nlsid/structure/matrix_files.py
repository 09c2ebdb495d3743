"""Matrices of finite-element programs: MatrixMarket, Harwell–Boeing, Abaqus ``.mtx``, Nastran OUTPUT4 and DMIG, into SI."""

from __future__ import annotations

import io
import re
import tempfile
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.recordings.isolation import Unreadable, parse_apart
from bayes_nlsid.recordings.units import unit_factor
from bayes_nlsid.structure.structure import Matrix

MAX_BYTES = 2**30  # of a file, and of what it unpacks to
MAX_ROWS = 2_000_000
FIXED = 1e36  # what Abaqus writes on the diagonal of stiffness for a degree of freedom that is held
PROGRAM = Path(__file__).with_name("nastran.py")
_LETTERS = {"mass": "M", "stiffness": "K", "damping": "BC"}
_NASTRAN = {".op4": "op4", ".pch": "dmig", ".dmig": "dmig", ".bdf": "dmig", ".dat": "dmig"}
_BOEING = (".hb", ".rb", ".rsa", ".rua", ".psa", ".pua")
SEVERAL = tuple(_NASTRAN)
"""Endings of files that may hold mass and stiffness together."""
FORMATS = (".mtx", *_BOEING, *_NASTRAN)


@final
@dataclass(frozen=True)
class FileMatrix:
    """One matrix as a file holds it.

    Parameters
    ----------
    matrix : ndarray or sparse array (N, N)
        In the units of the file.
    dofs : tuple of str
        ``node.component`` with components 1 to 3 (displacements) and 4 to 6 (rotations) where the format names them, else empty.
    form : str
        The format, for the report.
    """

    matrix: Matrix
    dofs: tuple[str, ...]
    form: str

    @property
    def si_already(self) -> bool:
        """Whether the format is one whose numbers count as SI unless units are given."""
        return self.form == "MatrixMarket"


def read_matrix(path: Path, kind: str, name: str | None = None) -> FileMatrix:
    """The mass, stiffness or damping matrix of a file, in the units of the file.

    Parameters
    ----------
    path : Path
    kind : {"mass", "stiffness", "damping"}
    name : str, optional
        Which matrix of a Nastran file; by default the only one whose name begins with M, K, or B or C.

    Raises
    ------
    InputError
        If the file cannot be read, is of another format, too large, or holds several matrices that could be meant.
    """
    data, suffix = _bytes(path), path.suffix.lower()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if suffix in _NASTRAN:
                return _nastran(path, data, kind, name)
            if suffix in _BOEING:
                return FileMatrix(_boeing(data), (), "Harwell–Boeing")
            if suffix == ".mtx" and data.lstrip()[:14].lower() == b"%%matrixmarket":
                return FileMatrix(_market(data), (), "MatrixMarket")
            if suffix == ".mtx":
                return _abaqus(data)
    except Unreadable as error:
        raise InputError(str(path), error.problem, error.mend) from error
    except InputError:
        raise
    except Exception as error:  # the parsers document no closed set of exceptions for damaged files
        detail = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(str(path), f"cannot be read as {suffix} ({detail})",
                         "check its header line and its entries, or export it again") from error
    raise InputError(str(path), f"files of kind {path.suffix or 'without a suffix'!r} are not read as matrices",
                     f"give .npz or {', '.join(FORMATS)}")


def _bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise Unreadable(f"holds more than the {MAX_BYTES / 2**20:.0f} MiB that are read at once", "reduce the model first")
        return path.read_bytes()
    except Unreadable as error:
        raise InputError(str(path), error.problem, error.mend) from None
    except OSError as error:
        raise InputError(str(path), f"cannot be opened ({error.strerror})", "check the path") from error


def _market(data: bytes) -> Matrix:
    """A triangle marked ``symmetric`` is completed, sparse ones stay sparse; the header is checked against the length of the file."""
    from scipy.io import mmread
    from scipy.sparse import csr_array, issparse

    sizes = next((line for line in data.splitlines()[1:] if line.strip() and not line.startswith(b"%")), b"").split()
    if not 2 <= len(sizes) <= 3 or not all(s.isdigit() for s in sizes):
        raise Unreadable("cannot be read as MatrixMarket (no line of sizes)", "check the header line and the number of entries")
    rows, columns = int(sizes[0]), int(sizes[1])
    entries = int(sizes[2]) if len(sizes) == 3 else rows * (columns if b"general" in data[:200].lower() else 1)
    if rows != columns or not 0 < rows <= MAX_ROWS or 2 * entries > len(data):
        raise Unreadable(f"cannot be read as MatrixMarket (sizes {rows} × {columns} with {entries} entries do not fit the file)",
                         "check the header line and the number of entries; a matrix must be square")
    # scipy 1.17 reads past the end of a file that stops within a number, and the program dies of it: a line feed keeps it inside
    matrix = mmread(io.BytesIO(data + b"\n"))
    return csr_array(matrix, dtype=float) if issparse(matrix) else np.asarray(matrix, dtype=float)


def _boeing(data: bytes) -> Matrix:
    """An assembled real matrix; a triangle marked symmetric is completed."""
    from scipy.io import hb_read
    from scipy.sparse import csr_array

    lines = data[:2000].splitlines()
    if len(lines) < 4 or lines[2][:1].lower() != b"r" or lines[2][2:3].lower() != b"a":
        raise Unreadable("is no assembled real Harwell–Boeing matrix", "export it assembled and real (type RSA or RUA)")
    with tempfile.TemporaryDirectory(prefix="nlsid") as folder:
        path = Path(folder) / "matrix.hb"  # scipy reads by name or text stream; a copy keeps line ends uniform
        path.write_bytes(data.replace(b"\r\n", b"\n").replace(b"RSA", b"RUA", 1).replace(b"rsa", b"rua", 1))
        columns = hb_read(path)
    columns.check_format(full_check=True)  # scipy takes indices as they are, and converting wrong ones writes over memory
    if columns.shape[0] != columns.shape[1] or columns.shape[0] > MAX_ROWS:
        raise Unreadable(f"holds a matrix of {columns.shape[0]} × {columns.shape[1]}", "a matrix of mass or stiffness is square")
    matrix = csr_array(columns, dtype=float)
    return _completed(matrix) if lines[2][1:2].lower() == b"s" else matrix


def _completed(matrix: Any) -> Matrix:
    """A matrix of which one triangle was stored, in full; one that has entries on both sides stays."""
    from scipy.sparse import csr_array, tril, triu

    upper, lower = csr_array(triu(matrix, 1)), csr_array(tril(matrix, -1))
    if (upper.nnz == 0) == (lower.nnz == 0):
        return csr_array(matrix)
    return csr_array(matrix + upper.T + lower.T)


def _abaqus(data: bytes) -> FileMatrix:
    """``node, component, node, component, value`` (formats MATRIX INPUT and LABELS) or ``row column value`` (COORDINATE)."""
    from scipy.sparse import coo_array, csr_array

    text = data.replace(b",", b" ").decode("latin-1")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(("*", "%"))]
    if not lines or len(lines[0].split()) not in (3, 5):
        raise Unreadable("is neither MatrixMarket nor an Abaqus matrix", "write lines of node, component, node, component, value")
    table = np.loadtxt(lines, ndmin=2)
    dofs: tuple[str, ...] = ()
    if table.shape[1] == 3:
        index = table[:, :2].astype(int) - 1
        size = int(index.max()) + 1
    else:
        pairs, inverse = np.unique(table[:, :4].reshape(-1, 2).astype(int), axis=0, return_inverse=True)
        index, dofs, size = inverse.reshape(-1, 2), tuple(f"{n}.{c}" for n, c in pairs), len(pairs)
    if size > MAX_ROWS or index.min() < 0:
        raise Unreadable("numbers its rows in a way that cannot be", "number rows from 1")
    matrix = coo_array((table[:, -1], (index[:, 0], index[:, 1])), shape=(size, size))
    return FileMatrix(_completed(csr_array(matrix)), dofs, "Abaqus")


def _nastran(path: Path, data: bytes, kind: str, name: str | None) -> FileMatrix:
    from scipy.sparse import coo_array, csr_array

    form = _NASTRAN[path.suffix.lower()]
    archive = parse_apart(PROGRAM, (form, str(MAX_BYTES)), data, MAX_BYTES)
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        names = sorted({member.rpartition(".")[0].rpartition(".")[0] for member in opened.namelist()})
    if not names:
        raise Unreadable("holds no square matrix", "export mass and stiffness as OUTPUT4 or DMIG")
    meant = [n for n in names if n[:1] in _LETTERS[kind]] if len(names) > 1 else names
    if name is not None:
        meant = [n for n in names if n == name.upper()]
    if len(meant) != 1:
        raise InputError(str(path), f"holds the matrices {', '.join(names)}, and it is not clear which is the {kind}"
                         if name is None else f"holds no matrix {name!r} but {', '.join(names)}", f'write {kind}_name = "..."')
    with np.load(io.BytesIO(archive), allow_pickle=False) as arrays:
        value, shape = arrays[f"{meant[0]}.value"], arrays[f"{meant[0]}.shape"]
        dofs = tuple(map(str, arrays[f"{meant[0]}.dofs"])) if f"{meant[0]}.dofs" in arrays else ()
        place = (arrays[f"{meant[0]}.row"], arrays[f"{meant[0]}.column"])
    if np.iscomplexobj(value) or shape[0] != shape[1] or shape[0] > MAX_ROWS:
        raise Unreadable(f"matrix {meant[0]} is not a square real matrix", "export real mass and stiffness")
    matrix = csr_array(coo_array((np.asarray(value, dtype=float), place), shape=(int(shape[0]), int(shape[1]))))
    return FileMatrix(_completed(matrix), dofs, "Nastran OUTPUT4" if form == "op4" else "Nastran DMIG")


# ------------------------------------------------------------------------------------------------------ one model out of several files

def matched(files: Mapping[str, FileMatrix], where: str) -> tuple[dict[str, Matrix], tuple[str, ...]]:
    """Matrices on the same degrees of freedom, without those that are held.

    Parameters
    ----------
    files : dict of str to FileMatrix
        ``mass``, ``stiffness``, perhaps ``damping``.

    Raises
    ------
    InputError
        If sizes differ and the formats do not name degrees of freedom.
    """
    from scipy.sparse import csr_array

    if any(not f.dofs for f in files.values()):
        sizes = {kind: f.matrix.shape[0] for kind, f in files.items()}
        if len(set(sizes.values())) > 1:
            raise InputError(where, f"sizes differ: {', '.join(f'{k} {n}' for k, n in sizes.items())}", "export all of them from one model")
        dofs = next((f.dofs for f in files.values() if f.dofs), tuple(f"q{i + 1}" for i in range(next(iter(sizes.values())))))
        return {kind: f.matrix for kind, f in files.items()}, dofs
    held = {d for d, k in zip(files["stiffness"].dofs, files["stiffness"].matrix.diagonal(), strict=True) if k >= FIXED}
    dofs = tuple(dict.fromkeys(d for f in files.values() for d in f.dofs if d not in held))
    at = {name: i for i, name in enumerate(dofs)}
    out: dict[str, Matrix] = {}
    for kind, f in files.items():
        kept = [i for i, d in enumerate(f.dofs) if d in at]
        to = np.array([at[f.dofs[i]] for i in kept], dtype=int)
        pick = csr_array((np.ones(len(kept)), (to, np.array(kept, dtype=int))), shape=(len(dofs), len(f.dofs)))
        out[kind] = csr_array(pick @ csr_array(f.matrix) @ pick.T)
    return out, dofs


def converted(matrices: Mapping[str, Matrix], dofs: Sequence[str], length_unit: str, force_unit: str, rotations: Sequence[str] | None,
              where: str) -> dict[str, Matrix]:
    """Matrices in SI from consistent units of length, force and second.

    Displacements count in the length unit, rotations in rad: an entry between degrees of freedom i and j is multiplied by
    force · length / (s_i s_j), s being the length unit in m for a displacement and 1 for a rotation.

    Raises
    ------
    InputError
        If a unit is unknown, or the unit of length is not m and nothing says which degrees of freedom are rotations.
    """
    from scipy.sparse import diags_array

    length, force = unit_factor(length_unit, "displacement"), unit_factor(force_unit, "force")
    if (length, force) == (1.0, 1.0):
        return dict(matrices)
    named = all(re.fullmatch(r"-?\d+\.\d", d) for d in dofs)
    if rotations is None and not named and length != 1.0:
        raise InputError(f"{where}: length_unit", f"is {length_unit!r}, and the format does not say which degrees of freedom are rotations",
                         'write rotations = [] if there are none, or rotations = ["q3", ...]')
    turned = {str(r) for r in rotations or ()}
    unknown = turned - set(dofs) - {str(i + 1) for i in range(len(dofs))}
    if unknown:
        raise InputError(f"{where}: rotations", f"{sorted(unknown)} are no degrees of freedom", "use their names or numbers from 1")
    by_name = named and rotations is None
    turns = [d in turned or str(i + 1) in turned or (by_name and d.rpartition(".")[2] in "456") for i, d in enumerate(dofs)]
    scale = np.where(turns, 1.0, 1.0 / length)
    if any(isinstance(m, np.ndarray) for m in matrices.values()):
        return {kind: np.asarray(force * length * scale[:, None] * (m if isinstance(m, np.ndarray) else m.toarray()) * scale)
                for kind, m in matrices.items()}
    side = diags_array(scale)
    return {kind: (force * length * (side @ m @ side)).tocsr() for kind, m in matrices.items()}


def without_massless(matrices: Mapping[str, Matrix], dofs: tuple[str, ...], rows: Mapping[str, NDArray[np.float64]]) \
        -> tuple[dict[str, Matrix], tuple[str, ...], dict[str, NDArray[np.float64]], int]:
    """Degrees of freedom without any mass condensed statically, which is exact for them: they follow the others.

    Returns
    -------
    matrices, dofs, rows
        On the degrees of freedom that have mass; rows of locations see the others through K.
    count : int
        How many were condensed.
    """
    from scipy.sparse import csc_array, csr_array, issparse
    from scipy.sparse.linalg import splu

    M = matrices["mass"]
    light = np.asarray(abs(M).sum(axis=1)).ravel() == 0
    count = int(light.sum())
    if count == 0 or count == len(dofs):
        return dict(matrices), dofs, dict(rows), 0
    K = csc_array(matrices["stiffness"])
    a, o = np.flatnonzero(~light), np.flatnonzero(light)
    try:
        follow = -splu(csc_array(K[o][:, o])).solve(K[o][:, a].toarray())  # (o, a): u_o = follow u_a
    except RuntimeError:
        return dict(matrices), dofs, dict(rows), 0  # singular: they are attached to nothing, which the structure's own check will say
    dense = not issparse(matrices["stiffness"])

    def condensed(m: Matrix) -> Matrix:
        full = csc_array(m)
        small = full[a][:, a].toarray() + full[a][:, o] @ follow + (full[a][:, o] @ follow).T + follow.T @ (full[o][:, o] @ follow)
        return np.asarray(small) if dense else csr_array(small)

    new_rows = {name: row[a] + row[o] @ follow for name, row in rows.items()}
    return {kind: condensed(m) for kind, m in matrices.items()}, tuple(dofs[i] for i in a), new_rows, count

