"""A program: a Nastran OUTPUT4 or DMIG file on standard input, npz archive of its matrices on standard output.

It is started by `matrix_files`, and imports nothing of this package; the parsing is pyyeti's. Every matrix leaves as ``NAME.row``,
``NAME.column``, ``NAME.value``, ``NAME.shape`` and, for DMIG, ``NAME.dofs`` (``grid.component``).
Exit status 0: done; 3: the file cannot be read, and standard output says why; 4: a package is missing.
"""

from __future__ import annotations

import io
import json
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


def parse(kind: str, data: bytes, most: int) -> Arrays:
    """Matrices of a file; together at most ``most`` bytes."""
    arrays: Arrays = {}
    for name, (matrix, dofs) in (_output4(data) if kind == "op4" else _dmig(data)).items():
        from scipy.sparse import coo_array

        sparse = coo_array(matrix)
        arrays |= {f"{name}.row": sparse.row, f"{name}.column": sparse.col, f"{name}.value": sparse.data,
                   f"{name}.shape": np.array(sparse.shape)}
        if dofs:
            arrays[f"{name}.dofs"] = np.array(dofs)
        if sum(a.nbytes for a in arrays.values()) > most:
            raise ValueError(f"it unpacks to more than the {most / 2**20:.0f} MiB that are read at once")
    return arrays


def _output4(data: bytes) -> dict[str, tuple[Any, list[str]]]:
    from pyyeti.nastran import op4

    with tempfile.TemporaryDirectory(prefix="nlsid") as folder:
        path = Path(folder) / "matrices.op4"  # pyyeti reads files only
        path.write_bytes(data)
        found = op4.read(str(path), into="dct", justmatrix=True, sparse=True)
    return {str(name).upper(): (matrix, []) for name, matrix in found.items()}


def _dmig(data: bytes) -> dict[str, tuple[Any, list[str]]]:
    """Square DMIG matrices; INCLUDE is not followed, because the file is handed over as text."""
    from pyyeti.nastran import bulk

    found = bulk.rddmig(io.StringIO(data.decode("latin-1")), square=True)
    out = {}
    for name, frame in found.items():
        values = np.asarray(frame.to_numpy())
        dofs = [f"{grid}.{component}" if component else str(grid) for grid, component in frame.index]
        if values.shape == (len(dofs), len(dofs)) and [tuple(i) for i in frame.index] == [tuple(i) for i in frame.columns]:
            out[str(name).upper()] = (values, dofs)
    return out


def main() -> int:
    """Run the program: ``nastran.py KIND MOST_BYTES``."""
    stream = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arrays = parse(sys.argv[1], sys.stdin.buffer.read(), int(sys.argv[2]))
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    except ModuleNotFoundError as error:
        sys.stdout.buffer.write(json.dumps([error.name, "nastran"]).encode())
        return 4
    except MemoryError:
        sys.stdout.buffer.write(b"it asks for more memory than such a file can need")
        return 3
    except Exception as error:  # the parsers document no closed set of exceptions for damaged files
        sys.stdout.buffer.write((" ".join(str(error).split()) or type(error).__name__).encode(errors="replace"))
        return 3
    sys.stdout.buffer.write(stream.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(main())
