"""A program: MATLAB file on standard input, npz archive of its numeric arrays on standard output.

It is started by `readers`, and imports nothing of this package. Fields of structs get dotted names, elements of cells numbers.
Exit status 0: done; 3: the file cannot be read, and standard output says why.
"""

from __future__ import annotations

import io
import struct
import sys
import warnings
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
COMPRESSED = 15  # miCOMPRESSED


def parse(data: bytes, most: int) -> Arrays:
    """Numeric arrays of a MATLAB file that unpacks to at most ``most`` bytes."""
    if HDF5_SIGNATURE in (data[:8], data[512:520]):
        return _version_7_3(data, most)
    from scipy.io import loadmat

    _limit(_unpacked(data), most)
    arrays: Arrays = {}
    for name, value in loadmat(io.BytesIO(data), simplify_cells=True).items():
        if not name.startswith("__"):
            _flatten(name, value, arrays)
    return arrays


def _limit(size: int, most: int) -> None:
    if size > most:
        raise ValueError(f"it unpacks to {size / 2**20:.0f} MiB, more than the {most / 2**20:.0f} MiB that are read at once")


def _unpacked(data: bytes) -> int:
    """Bytes that the compressed elements of a version 5 file claim to unpack to (0 for older versions)."""
    if not data.startswith(b"MATLAB"):
        return 0
    order = "<" if data[126:128] == b"IM" else ">"
    position, total = 128, 0
    while position + 8 <= len(data):
        kind, size = struct.unpack(order + "II", data[position:position + 8])
        if kind == COMPRESSED:  # the tag of the element inside stands in its first eight bytes
            head = zlib.decompressobj().decompress(data[position + 8:position + 8 + min(size, 4096)], 8)
            total += struct.unpack(order + "II", head)[1] if len(head) == 8 else 0
        position += 8 + size
    return total


def _flatten(name: str, value: Any, arrays: Arrays) -> None:
    """Put numeric arrays of nested structs and cells under dotted names; text and empty values are left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(f"{name}.{key}", inner, arrays)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for i, inner in enumerate(value.ravel() if isinstance(value, np.ndarray) else value):
            _flatten(f"{name}.{i}", inner, arrays)
    else:
        array = np.asarray(value)
        if array.dtype.kind in "fiub" and array.size:
            arrays[name] = array


def _version_7_3(data: bytes, most: int) -> Arrays:
    """Arrays of a version 7.3 file, which is HDF5 with the axes turned round."""
    import h5py

    arrays: Arrays = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and item.dtype.kind in "fiub" and item.size:
            if item.attrs.get("MATLAB_class", b"") not in (b"char", "char") and not item.attrs.get("MATLAB_empty", 0):
                _limit(item.size * item.dtype.itemsize, most)
                arrays[name.replace("/", ".")] = np.squeeze(np.asarray(item[()]).T)

    with h5py.File(io.BytesIO(data), "r") as file:
        file.visititems(visit)
    return arrays


def main() -> int:
    """Run the program."""
    stream = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arrays = parse(sys.stdin.buffer.read(), int(sys.argv[1]))
        with zipfile.ZipFile(stream, "w") as archive:  # numpy.savez cannot hold an array called "file"
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
    except Exception as error:  # the parsers document no closed set of exceptions for damaged files
        sys.stdout.buffer.write((" ".join(str(error).split()) or type(error).__name__).encode(errors="replace"))
        return 3
    sys.stdout.buffer.write(stream.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(main())
