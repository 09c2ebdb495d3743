"""Structures from matrices on disk: .npz archives or files of finite-element programs, with rows of locations from a file of their own."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.structure.matrix_files import MAX_BYTES, SEVERAL, FileMatrix, converted, matched, read_matrix, without_massless
from bayes_nlsid.structure.structure import Matrix, Structure

ROLES = ("sensors", "inputs", "joints", "other")


def read_matrices(mass: str | Path, stiffness: str | Path | None = None, damping: str | Path | None = None, *,
                  locations: str | Path | None = None, joints: Sequence[str] | None = None, sensors: Sequence[str] | None = None,
                  inputs: Sequence[str] | None = None, length_unit: str | None = None, force_unit: str | None = None,
                  rotations: Sequence[str] | None = None, mass_name: str | None = None, stiffness_name: str | None = None,
                  damping_name: str | None = None) -> Structure:
    """A structure from files.

    Parameters
    ----------
    mass : path
        An ``.npz`` archive in SI, or the mass matrix as MatrixMarket or Abaqus ``.mtx``, Harwell–Boeing (``.hb``, ``.rb``, ``.rsa``,
        ``.rua``), Nastran OUTPUT4 (``.op4``) or DMIG (``.pch``, ``.dmig``, ``.bdf``); symmetric ones by one triangle or in full.

        Archive: ``M``, ``K`` (N, N), optional ``C``; ``K_parts`` (P, N, N) with ``K_part_names`` (P,), ``M_parts`` likewise;
        ``dof_names`` (N,); ``location_names`` (L,) with ``location_vectors`` (L, N); ``sensor_select`` (s, N), which become S1..Ss;
        ``shaker_vector`` (N,), which becomes the input SHAKER; ``base_vector`` (N,), rigid motion with the base, whose row BASE is
        M times it: with acceleration of the base it gives minus the force on the structure, kg.
    stiffness, damping : path
        Files that belong to the mass; a Nastran file may hold all of them.
    locations : path, optional
        ``.npz`` with ``location_names`` and ``location_vectors``; ``.csv`` with columns name, dof, coefficient and optionally role
        (repeated names add up; dof is a name or a number from 1); ``.toml`` with tables ``[[location]]`` of name, dofs,
        coefficients, role. Roles are sensors, inputs, joints, other.
    joints, sensors, inputs : sequence of str, optional
        Which locations have these roles; by default those the files say, and for joints every location called ``J<number>...``,
        ``ROOT...`` or ``TIP...`` of an archive.
    length_unit, force_unit : str, optional
        Consistent units of the files with the second, for instance ``"mm"`` and ``"N"`` (masses in t). MatrixMarket counts as SI without
        them; the formats of finite-element programs need them.
    rotations : sequence of str, optional
        Degrees of freedom that are angles, where the format does not say it and the length is not in m.
    mass_name, stiffness_name, damping_name : str, optional
        Which matrix of a Nastran file; by default the only one whose name begins with M, K, B or C.

    Notes
    -----
    Held degrees of freedom of Abaqus (1e36 on the diagonal) are left out; those without any mass are condensed, which is exact.
    Coefficients of locations are SI.

    Raises
    ------
    InputError
        If a file cannot be read, a matrix has the wrong size, is not symmetric, not finite or not positive (semi-)definite, or a name
        is unknown.
    """
    path = Path(mass)
    units = (length_unit, force_unit)
    if path.suffix == ".npz":
        if any(units):
            raise InputError(str(path), "units are given, but an archive is in SI", "convert it, and leave length_unit and force_unit out")
        content = _from_archive(path, read_archive(path))
    else:
        called = {"mass": mass_name, "stiffness": stiffness_name, "damping": damping_name}
        content = _from_files(path, {"stiffness": stiffness, "damping": damping}, called, units, rotations)
    if locations is not None:
        _add_locations(Path(locations), content)
    content.condense()
    for role, names in (("joints", joints), ("sensors", sensors), ("inputs", inputs)):
        if names is not None:
            unknown = [n for n in names if n not in content.rows]
            if unknown:
                raise InputError(f"{path}: {role}", f"unknown locations {unknown}", f"use names among {sorted(content.rows)}")
            content.roles[role] = list(names)
    try:
        return Structure(content.M, content.K, content.dofs, content.rows, sensors=tuple(content.roles["sensors"]),
                         inputs=tuple(content.roles["inputs"]), joints=tuple(content.roles["joints"]), C=content.C,
                         K_parts=content.K_parts, M_parts=content.M_parts, notes=(f"matrices read from {path.name}{content.said}",))
    except ValueError as error:
        raise InputError(str(path), str(error), "export the matrices again, complete and in one set of SI units") from error


@final
class _Content:
    """What has been read so far."""

    def __init__(self, M: Matrix, K: Matrix, C: Matrix | None, dofs: tuple[str, ...]) -> None:
        self.M, self.K, self.C, self.dofs = M, K, C, dofs
        self.rows: dict[str, NDArray[np.float64]] = {}
        self.roles: dict[str, list[str]] = {role: [] for role in ROLES}
        self.K_parts: dict[str, Matrix] = {}
        self.M_parts: dict[str, Matrix] = {}
        self.said = ""
        self.condensable = False

    def condense(self) -> None:
        """Leave out degrees of freedom that have no mass, where the matrices are those of a finite-element program."""
        if not self.condensable:
            return
        given = {"mass": self.M, "stiffness": self.K, **({} if self.C is None else {"damping": self.C})}
        found, self.dofs, self.rows, count = without_massless(given, self.dofs, self.rows)
        self.M, self.K, self.C = found["mass"], found["stiffness"], found.get("damping")
        self.said += f"; {count} degrees of freedom without mass were condensed" if count else ""

    def add(self, where: str, name: str, row: NDArray[np.float64], role: str) -> None:
        """One location; a name may be given again only for another role with the same row.

        Raises
        ------
        InputError
            If the role is unknown, the row (n,) has another length, or the name stands for another row already.
        """
        if role not in ROLES:
            raise InputError(where, f"location {name!r} has unknown role {role!r}", f"use one of {', '.join(ROLES)}")
        if row.shape != (len(self.dofs),):
            raise InputError(where, f"location {name!r} has {row.shape} entries", f"give {len(self.dofs)}, one for each degree of freedom")
        if name in self.rows and not np.array_equal(self.rows[name], row):
            raise InputError(where, f"location {name!r} is given twice with different rows", "rename one of them")
        self.rows[name] = row
        if name not in self.roles[role]:
            self.roles[role].append(name)


def read_archive(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of an ``.npz`` archive, names among them, whose declared sizes are checked before anything is unpacked.

    Raises
    ------
    InputError
        If it is damaged, too large, or holds pickled objects.
    """
    import zipfile

    try:
        with zipfile.ZipFile(path) as members:
            size = sum(m.file_size for m in members.infolist())
        if size > MAX_BYTES:
            raise InputError(str(path), f"unpacks to {size / 2**20:.0f} MiB, more than is read at once ({MAX_BYTES / 2**20:.0f} MiB)",
                             "reduce the model, or cut the recording")
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except InputError:
        raise
    except Exception as error:  # zipfile and numpy document no closed set of exceptions for damaged files
        detail = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(str(path), f"cannot be read as an .npz archive ({detail})", "save plain arrays with numpy.savez") from error


def _from_archive(path: Path, archive: dict[str, NDArray[Any]]) -> _Content:
    missing = [name for name in ("M", "K") if name not in archive]
    if missing:
        raise InputError(str(path), f"{' and '.join(missing)} missing", "save the mass matrix as M and the stiffness matrix as K")
    M, K = _square(path, "M", archive["M"]), _square(path, "K", archive["K"])
    n = len(M)
    C = _square(path, "C", archive["C"]) if "C" in archive else None
    dofs = tuple(str(d) for d in archive.get("dof_names", [f"q{i + 1}" for i in range(n)]))
    content = _Content(M, K, C, dofs)
    content.K_parts, content.M_parts = _parts(path, archive, "K", n), _parts(path, archive, "M", n)
    names, vectors = archive.get("location_names", np.zeros(0, str)), archive.get("location_vectors", np.zeros((0, n)))
    if len(names) != len(vectors):
        raise InputError(f"{path}: location_vectors", f"{len(vectors)} rows for {len(names)} location_names", "give one row per name")
    for name, row in zip(names, vectors, strict=True):
        joint = str(name).startswith(("ROOT", "TIP")) or (str(name)[:1] == "J" and str(name)[1:2].isdigit())
        content.add(f"{path}: location_vectors", str(name), np.asarray(row, dtype=float), "joints" if joint else "other")
    for i, row in enumerate(np.atleast_2d(archive["sensor_select"]) if "sensor_select" in archive else []):
        content.add(f"{path}: sensor_select", f"S{i + 1}", np.asarray(row, dtype=float), "sensors")
    if "shaker_vector" in archive:
        content.add(f"{path}: shaker_vector", "SHAKER", np.asarray(archive["shaker_vector"], dtype=float), "inputs")
    if "base_vector" in archive:
        base = np.asarray(archive["base_vector"], dtype=float)
        if base.shape != (n,):
            raise InputError(f"{path}: base_vector", f"has shape {base.shape}", f"give {n} entries, one for each degree of freedom")
        content.add(f"{path}: base_vector", "BASE", M @ base, "other")
    return content


def _square(path: Path, name: str, values: NDArray[Any]) -> NDArray[np.float64]:
    if values.ndim != 2 or values.shape[0] != values.shape[1] or values.dtype.kind not in "fiu":
        raise InputError(f"{path}: {name}", f"has shape {values.shape} and type {values.dtype}", "save a square matrix of real numbers")
    return np.asarray(values, dtype=float)


def _parts(path: Path, archive: dict[str, NDArray[Any]], letter: str, n: int) -> dict[str, Matrix]:
    """Named parts, each checked against the whole: what they leave must not be negative in mass or stiffness of any direction."""
    stack = archive.get(f"{letter}_parts", np.zeros((0, n, n)))
    names = [str(name) for name in archive.get(f"{letter}_part_names", [])]
    if stack.shape != (len(names), n, n):
        raise InputError(f"{path}: {letter}_parts", f"has shape {stack.shape} for {len(names)} names", f"give (P, {n}, {n}) and P names")
    if len(set(names)) != len(names):
        raise InputError(f"{path}: {letter}_part_names", f"repeat: {names}", "name every part differently")
    return {name: np.asarray(part, dtype=float) for name, part in zip(names, stack, strict=True)}


def _from_files(mass: Path, others: dict[str, str | Path | None], names: dict[str, str | None], units: tuple[str | None, str | None],
                rotations: Sequence[str] | None) -> _Content:
    """Matrices of one model from the files of a finite-element program, in SI."""
    if others["stiffness"] is None and mass.suffix.lower() not in SEVERAL:
        raise InputError(str(mass), "a mass matrix alone is no structure", "name the stiffness matrix too, or an .npz archive with M and K")
    first = read_matrix(mass, "mass", names["mass"])
    found: dict[str, FileMatrix] = {
        "mass": first, "stiffness": read_matrix(Path(others["stiffness"] or mass), "stiffness", names["stiffness"])}
    if others["damping"] is not None or names["damping"] is not None:
        found["damping"] = read_matrix(Path(others["damping"] or mass), "damping", names["damping"])
    length, force = units
    if (length is None or force is None) and not (length is force is None and all(f.si_already for f in found.values())):
        raise InputError(f"{mass}: {'length_unit' if length is None else 'force_unit'}", f"a file of {first.form} does not say its units",
                         'write length_unit = "mm" and force_unit = "N" for a model in mm, N, t and s, or "m" and "N" for SI')
    where = f"{mass}, {others['stiffness'] or mass.name}"
    matrices, dofs = matched(found, where)
    matrices = converted(matrices, dofs, length or "m", force or "N", rotations, str(mass))
    content = _Content(matrices["mass"], matrices["stiffness"], matrices.get("damping"), dofs)
    content.said, content.condensable = f" ({first.form}; in {length or 'm'}, {force or 'N'} and s, converted to SI)", True
    return content


def _add_locations(path: Path, content: _Content) -> None:
    if path.suffix == ".npz":
        archive = read_archive(path)
        if "location_names" not in archive or "location_vectors" not in archive:
            raise InputError(str(path), "location_names or location_vectors missing", "save both")
        names, vectors = archive["location_names"], archive["location_vectors"]
        if len(names) != len(vectors):
            raise InputError(f"{path}: location_vectors", f"{len(vectors)} rows for {len(names)} location_names", "give one row per name")
        roles = archive.get("location_roles", np.array(["other"] * len(names)))
        for name, row, role in zip(names, vectors, roles, strict=True):
            content.add(str(path), str(name), np.asarray(row, dtype=float), str(role))
        return
    entries = _from_csv(path) if path.suffix == ".csv" else _from_toml(path)
    summed: dict[tuple[str, str], NDArray[np.float64]] = {}
    for where, name, role, dof, coefficient in entries:
        row = summed.setdefault((name, role), np.zeros(len(content.dofs)))
        row[_dof(where, dof, content.dofs)] += coefficient
    for (name, role), row in summed.items():
        content.add(str(path), name, row, role)


def _from_csv(path: Path) -> list[tuple[str, str, str, str, float]]:
    """(where, name, role, dof, coefficient) of each line."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(path), f"cannot be read ({error})", "save the table as plain text") from error
    out = []
    for number, row in enumerate(rows, start=2):
        where = f"{path}: line {number}"
        if not row.get("name") or not row.get("dof") or not row.get("coefficient"):
            raise InputError(where, "name, dof or coefficient missing", "head the columns name, dof, coefficient, role")
        role = (row.get("role") or "other").strip()
        out.append((where, row["name"].strip(), role, row["dof"].strip(), _number(where, row["coefficient"])))
    return out


def _from_toml(path: Path) -> list[tuple[str, str, str, str, float]]:
    try:
        with open(path, "rb") as file:
            tables = tomllib.load(file).get("location", [])
        if not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
            raise ValueError("location is no list of tables")
    except (OSError, ValueError, RecursionError) as error:
        mend = "write [[location]] tables with name, dofs, coefficients"
        raise InputError(str(path), f"cannot be read as TOML ({error})", mend) from error
    out = []
    for number, table in enumerate(tables, start=1):
        where = f"{path}: location {number}"
        dofs, coefficients = table.get("dofs"), table.get("coefficients")
        if not isinstance(table.get("name"), str) or not isinstance(dofs, list) or not isinstance(coefficients, list):
            raise InputError(where, "name, dofs or coefficients missing", "give a name and two lists of the same length")
        if len(dofs) != len(coefficients) or not dofs:
            raise InputError(where, f"{len(dofs)} dofs but {len(coefficients)} coefficients", "give one coefficient for each dof")
        out += [(where, table["name"], str(table.get("role", "other")), str(d), _number(where, c))
                for d, c in zip(dofs, coefficients, strict=True)]
    return out


def _number(where: str, value: object) -> float:
    try:
        number = float(str(value))
    except ValueError:
        raise InputError(where, f"coefficient {value!r} is not a number", "write it like 1.0 or -0.5") from None
    if not np.isfinite(number):
        raise InputError(where, f"coefficient {value!r} is not finite", "write it like 1.0 or -0.5")
    return number


def _dof(where: str, name: str, dofs: tuple[str, ...]) -> int:
    if name in dofs:
        return dofs.index(name)
    if name.isdigit() and 1 <= int(name) <= len(dofs):
        return int(name) - 1
    raise InputError(where, f"degree of freedom {name!r} does not exist", f"use a name of the archive or a number from 1 to {len(dofs)}")
