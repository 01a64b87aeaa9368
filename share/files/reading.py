"""Open untrusted files for reading: regular files only, of a limited size.

A pipe would block, a device may never end. A link to a regular file is allowed. Every refusal is an OSError,
as if from the operating system.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from share.errors import DataError, ShareError

MB = 10**6
MAX_SETTINGS_BYTES = 2 * MB  # YAML of settings or a calibration; ours with full provenance has 0.1
MAX_TABLE_BYTES = 4000 * MB  # numbers as text: half a day of a 1 kHz IMU
MAX_REPORT_BYTES = 100 * MB  # one JSON object of our own commands; a day of eight agents has 30
MAX_EVENTS_BYTES = 1000 * MB  # one JSON object per line: the events of a day
MAX_KEYS_BYTES = 10 * MB  # public keys, one per line: 100,000 machines
MAX_ARRAYS_BYTES = 2000 * MB  # labels of a run, weights; an hour at 5 keyframes a second has 300
MAX_LOG_BYTES = 100 * MB  # output of a child process
_OPEN_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY
_KIND_TEXTS = {
    stat.S_IFDIR: "it is a folder",
    stat.S_IFIFO: "it is a pipe",
    stat.S_IFSOCK: "it is a socket",
    stat.S_IFCHR: "it is a device",
    stat.S_IFBLK: "it is a device",
}


def open_regular(path: Path, max_bytes: int | None = None) -> BinaryIO:
    """Open a file for reading. Raises OSError, also if it is not a regular file or larger than max_bytes."""
    try:
        handle = os.open(path, _OPEN_FLAGS)
    except OSError as error:
        if error.errno == errno.ENXIO:  # from open(2) of a socket
            raise _not_regular_error(path, stat.S_IFSOCK) from None
        raise
    except ValueError:  # a NUL in its name
        raise OSError(errno.EINVAL, "its name is not a valid file name", repr(str(path))) from None
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise _not_regular_error(path, stat.S_IFMT(status.st_mode))
        if max_bytes is not None and status.st_size > max_bytes:
            raise _too_large_error(path, status.st_size, max_bytes)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


@contextlib.contextmanager
def read_errors(path: Path, kind: type[ShareError] = DataError, missing: str = "") -> Iterator[None]:
    """Within the block, an error of reading `path` becomes a `kind` that names it.

    missing: what to say if there is no such file.
    """
    try:
        yield
    except UnicodeDecodeError:
        raise kind(f"{path}: is not a text file, or damaged") from None
    except OSError as error:
        is_missing = missing and isinstance(error, FileNotFoundError)
        reason = missing if is_missing else f"cannot be read: {error.strerror or error}"
        raise kind(f"{path}: {reason}") from None


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read a whole file of at most max_bytes. Raises OSError."""
    with open_regular(path, max_bytes) as file:
        data = file.read(os.fstat(file.fileno()).st_size + 1)  # Python allocates the size asked for
        while more := file.read(MB):  # it is growing, or in /proc, where sizes are 0
            data += more
            if len(data) > max_bytes:
                raise _too_large_error(path, len(data), max_bytes)
    return data


def read_text(path: Path, max_bytes: int, encoding: str = "utf-8") -> str:
    """Read a whole text file, with \\n line ends. Raises OSError, UnicodeDecodeError."""
    return read_bytes(path, max_bytes).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def is_sparse(path: Path) -> bool:
    """Return whether a file is nearly all holes: its size is far beyond its disk blocks, more than a
    compressing file system reaches. Raises OSError."""
    status = os.stat(path)
    return status.st_size > MB + _MAX_COMPRESSION * _BLOCK_BYTES * status.st_blocks


_BLOCK_BYTES = 512  # unit of st_blocks
_MAX_COMPRESSION = 50  # by a file system


def _not_regular_error(path: Path, kind: int) -> OSError:
    what = _KIND_TEXTS.get(kind, "it is of an unknown kind")
    return OSError(errno.EINVAL, f"{what}, not a regular file", str(path))


def _too_large_error(path: Path, size: int, max_bytes: int) -> OSError:
    size_text, limit_text = (f"{n / MB:,.1f} MB" for n in (size, max_bytes))
    return OSError(errno.EFBIG, f"it has {size_text}; the limit for this kind is {limit_text}", str(path))


_MAX_PATH_BYTES = 1000  # of a path; 255 of a name: limits of file systems


def path_inside(folder: Path, name: str, where: str) -> Path:
    """Return the path of file `name`, which file `where` lists, below `folder`.

    Raises DataError for a name that leads out of the folder. Links in the folder are followed: its owner may
    keep the images on another disk.
    """
    parts = PurePosixPath(name).parts
    leads_out = name.startswith("/") or ".." in parts or "\0" in name or not parts
    if leads_out or len(name.encode()) > _MAX_PATH_BYTES or max(len(part.encode()) for part in parts) > 255:
        raise DataError(f"{where}: '{name:.80}' is not a file name below {folder}")
    return folder / name
