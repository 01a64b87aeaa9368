"""NumPy's files (.npz, .npy) from anywhere: what they unpack to is known before anything is unpacked."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.files.reading import ARRAYS, read_bytes

_MOST_FILES = 2000  # in an archive; the weights of a fit have 100
_PLAIN = "biufU"  # kinds of dtype; objects would be code
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_arrays(path: Path, otherwise: str, most: int = ARRAYS) -> dict[str, NDArray[Any]]:
    """Those of an archive, by name. most: bytes, packed and unpacked. otherwise: what to say of a file that
    is none (`is no file of labels`). Raises DataError that names it."""
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path, most))) as archive:
            told = archive.infolist()
            total = sum(one.file_size for one in told)
            if len(told) > _MOST_FILES or total > most:
                raise ValueError(f"{len(told)} arrays that unpack to {total / 1e6:,.1f} MB are too much")
            return {one.filename.removesuffix(".npy"): _entry(archive, one) for one in told}
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # zip, zlib and numpy each have their own
        raise DataError(f"{path}: {otherwise}, or damaged: {error!r:.200}") from None


def read_array(path: Path, most: int = ARRAYS) -> NDArray[Any]:
    """That of one .npy file. Raises DataError that names it."""
    try:
        data = read_bytes(path, most)
        return _array(io.BytesIO(data), len(data))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:
        raise DataError(f"{path}: is no array, or damaged: {error!r:.200}") from None


def _entry(archive: zipfile.ZipFile, told: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(told) as file:
        return _array(file, told.file_size)


def _array(file: IO[bytes], size: int) -> NDArray[Any]:
    """size: bytes of the file, header and all. Raises what numpy does, ValueError, KeyError."""
    shape, by_column, dtype = _HEADERS[np.lib.format.read_magic(file)](file)
    if dtype.kind not in _PLAIN or dtype.hasobject:
        raise ValueError(f"an array of {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != size - file.tell():
        raise ValueError(f"an array that says that it is {shape} of {dtype} has {size - file.tell()} bytes")
    data = np.frombuffer(file.read(), dtype)
    return data.reshape(shape, order="F" if by_column else "C").copy()  # one that can be written to
