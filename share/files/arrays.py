"""Read untrusted NumPy files (.npz, .npy): sizes and types are checked before anything is unpacked."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.files.reading import MAX_ARRAYS_BYTES, read_bytes, read_errors

_MAX_ARRAYS = 2000  # per archive; the weights of a fit have 100
_PLAIN_KINDS = "biufU"  # kinds of dtype; objects are excluded: unpickling them runs code
_HEADER_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_arrays(path: Path, objection: str, max_bytes: int = MAX_ARRAYS_BYTES) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive, by name.

    objection: what the error says of any other file (`is not a file of labels`). max_bytes: limit of the
    packed and of the unpacked size. Raises DataError that names the file.
    """
    with read_errors(path):
        data = read_bytes(path, max_bytes)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            total = sum(one.file_size for one in entries)
            if len(entries) > _MAX_ARRAYS or total > max_bytes:
                raise ValueError(f"too large: {len(entries)} arrays that unpack to {total / 1e6:,.1f} MB")
            return {one.filename.removesuffix(".npy"): _read_entry(archive, one) for one in entries}
    except Exception as error:  # zip, zlib and numpy raise different kinds
        raise DataError(f"{path}: {objection}, or damaged: {error!r:.200}") from None


def read_array(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file. Raises DataError that names the file."""
    with read_errors(path):
        data = read_bytes(path, MAX_ARRAYS_BYTES)
    try:
        return _read_checked(io.BytesIO(data), len(data))
    except Exception as error:
        raise DataError(f"{path}: is not an array file, or damaged: {error!r:.200}") from None


def _read_entry(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(info) as file:
        return _read_checked(file, info.file_size)


def _read_checked(file: IO[bytes], size: int) -> NDArray[Any]:
    """Read one array. size: bytes, header included. Raises ValueError, KeyError, numpy's errors."""
    shape, by_column, dtype = _HEADER_READERS[np.lib.format.read_magic(file)](file)
    if dtype.kind not in _PLAIN_KINDS or dtype.hasobject:
        raise ValueError(f"unsupported array type {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != size - file.tell():
        raise ValueError(f"header says {shape} of {dtype}, but the array has {size - file.tell()} bytes")
    data = np.frombuffer(file.read(), dtype)
    return data.reshape(shape, order="F" if by_column else "C").copy()  # writable
