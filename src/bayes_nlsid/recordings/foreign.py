"""A program: a MATLAB, HDF5 or TDMS file on standard input, npz archive of its numeric arrays on standard output.

It is started by `readers`, and imports nothing of this package. Fields of structs and groups get dotted names, elements of cells
numbers; units that stand beside an array go into the member ``labels.json``.
Exit status 0: done; 3: the file cannot be read, and standard output says why; 4: a package is missing.
"""

from __future__ import annotations

import io
import json
import struct
import sys
import warnings
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]
Parsed = tuple[Arrays, dict[str, str]]
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
COMPRESSED = 15  # miCOMPRESSED
UNIT_KEYS = ("unit", "units", "unit_string", "ni_unitdescription", "unitsymbol")


def parse(kind: str, data: bytes, most: int) -> Parsed:
    """Numeric arrays of a file that unpacks to at most ``most`` bytes, and the units written beside them."""
    if kind == "hdf5":
        return _hdf5(data, most)
    return _tdms(data, most) if kind == "tdms" else (_matlab(data, most), {})


def _matlab(data: bytes, most: int) -> Arrays:
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
                _limit(item.size * item.dtype.itemsize + sum(a.nbytes for a in arrays.values()), most)
                arrays[name.replace("/", ".")] = np.squeeze(np.asarray(item[()]).T)

    with h5py.File(io.BytesIO(data), "r") as file:
        file.visititems(visit)
    return arrays


def _hdf5(data: bytes, most: int) -> Parsed:
    """Datasets (columns of tables apart), numeric attributes as arrays of their own, and attributes that name a unit.

    Data that lie in other files (external storage, virtual datasets, external links) are not followed.
    """
    import h5py

    arrays: Arrays = {}
    units: dict[str, str] = {}

    def attributes(name: str, item: Any) -> None:
        for key, value in item.attrs.items():
            text = value.decode(errors="replace") if isinstance(value, bytes) else value
            if key.lower() in UNIT_KEYS and isinstance(text, str):
                units[name] = text
            elif np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiu":
                arrays[f"{name}.{key}" if name else key] = np.asarray(value)

    def visit(path: str, item: Any) -> None:
        name = path.replace("/", ".")
        attributes(name, item)
        if not isinstance(item, h5py.Dataset) or not item.size or item.external or item.is_virtual:
            return
        fields = [f for f in item.dtype.names or () if item.dtype[f].kind in "fiub"]
        if item.dtype.kind in "fiub" or fields:
            _limit(item.size * item.dtype.itemsize + sum(a.nbytes for a in arrays.values()), most)
            values = np.asarray(item[()])
            if fields:
                arrays.update({f"{name}.{field}": values[field] for field in fields})
            else:
                arrays[name] = values

    with h5py.File(io.BytesIO(data), "r") as file:
        attributes("", file)
        file.visititems(visit)
    return arrays, units


def _tdms(data: bytes, most: int) -> Parsed:
    """Channels as ``group.channel``; ``group.channel.rate`` (Hz) from the increment of a waveform, ``rate`` if it is the same for all."""
    from nptdms import TdmsFile

    arrays: Arrays = {}
    units: dict[str, str] = {}
    rates: dict[str, float] = {}
    with TdmsFile.open(io.BytesIO(data)) as file:
        for group in file.groups():
            for channel in group.channels():
                if channel.dtype is None or np.dtype(channel.dtype).kind not in "fiub" or not len(channel):
                    continue
                _limit(8 * len(channel) + sum(a.nbytes for a in arrays.values()), most)
                name = f"{group.name}.{channel.name}"
                arrays[name] = np.asarray(channel[:])
                labels = [v for k, v in channel.properties.items() if k.lower() in UNIT_KEYS and isinstance(v, str)]
                units[name] = labels[-1] if labels else ""
                step = channel.properties.get("wf_increment")
                if isinstance(step, int | float) and 0 < step < float("inf"):
                    rates[name] = 1.0 / step
    arrays.update({f"{name}.rate": np.asarray(rate) for name, rate in rates.items()})
    if rates and len(set(rates.values())) == 1:
        arrays.setdefault("rate", np.asarray(next(iter(rates.values()))))
    return arrays, units


def main() -> int:
    """Run the program: ``foreign.py KIND MOST_BYTES``."""
    stream = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arrays, units = parse(sys.argv[1], sys.stdin.buffer.read(), int(sys.argv[2]))
        with zipfile.ZipFile(stream, "w") as archive:  # numpy.savez cannot hold an array called "file"
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
            archive.writestr("labels.json", json.dumps(units))
    except ModuleNotFoundError as error:
        sys.stdout.buffer.write(json.dumps([error.name, sys.argv[1]]).encode())
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
