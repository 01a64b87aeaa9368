"""Opening files that others wrote: regular ones only, and no larger than their kind ever is.

A pipe would wait for ever, a device may never end, and a size is known before a byte is read. A link to a
regular file is one. Everything that is refused here is an OSError, as if the system had refused it.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from share.errors import DataError

MB = 10**6
MAX_SETTINGS_BYTES = 2 * MB  # YAML that a person or a calibration wrote; ours with all provenance has 0.1
MAX_TABLE_BYTES = 4000 * MB  # of numbers as text: half a day of a 1 kHz IMU
MAX_REPORT_BYTES = 100 * MB  # one JSON object that our own commands wrote; of a day of eight agents 30
MAX_EVENTS_BYTES = 1000 * MB  # a JSON object a line; the events of a day
MAX_KEYS_BYTES = 10 * MB  # public keys, a line each: 100,000 machines
MAX_ARRAYS_BYTES = 2000 * MB  # labels of a run, weights; a run of an hour at 5 keyframes a second has 300
MAX_LOG_BYTES = 100 * MB  # what a child process said
_OPEN_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY
_KIND_TEXTS = {
    stat.S_IFDIR: "it is a folder",
    stat.S_IFIFO: "it is a pipe",
    stat.S_IFSOCK: "it is a socket",
    stat.S_IFCHR: "it is a device",
    stat.S_IFBLK: "it is a device",
}


def open_regular(path: Path, max_bytes: int | None = None) -> BinaryIO:
    """The file, for reading. most: bytes that it may have. Raises OSError, also where it is no regular file
    or is larger."""
    try:
        handle = os.open(path, _OPEN_FLAGS)
    except OSError as error:
        if error.errno == errno.ENXIO:  # what open(2) says of a socket
            raise _not_regular_error(path, stat.S_IFSOCK) from None
        raise
    except ValueError:  # a NUL in its name
        raise OSError(errno.EINVAL, "its name is none that a file can have", repr(str(path))) from None
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


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """All of a file of at most so many bytes. Raises OSError."""
    with open_regular(path, max_bytes) as file:
        data = file.read(os.fstat(file.fileno()).st_size + 1)  # Python reserves what is asked for
        while more := file.read(MB):  # it grows, or is one of /proc, which have no size
            data += more
            if len(data) > max_bytes:
                raise _too_large_error(path, len(data), max_bytes)
    return data


def read_text(path: Path, max_bytes: int, encoding: str = "utf-8") -> str:
    """Likewise, with \\n at the end of every line. Raises OSError, UnicodeDecodeError."""
    return read_bytes(path, max_bytes).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def is_sparse(path: Path) -> bool:
    """Whether a file is nearly all holes: it says a size that takes no disk. File systems that pack what is
    in a file do not get as far. Raises OSError."""
    status = os.stat(path)
    return status.st_size > MB + _MAX_COMPRESSION * _BLOCK_BYTES * status.st_blocks


_BLOCK_BYTES, _MAX_COMPRESSION = 512, 50


def _not_regular_error(path: Path, kind: int) -> OSError:
    what = _KIND_TEXTS.get(kind, "it is of a kind of its own")
    return OSError(errno.EINVAL, f"{what}, not a regular file", str(path))


def _too_large_error(path: Path, size: int, max_bytes: int) -> OSError:
    size_text, limit_text = (f"{n / MB:,.1f} MB" for n in (size, max_bytes))
    return OSError(errno.EFBIG, f"it has {size_text}, a file of this kind may have {limit_text}", str(path))


# ---- Paths that a file tells of: they stay in that file's folder.

_MAX_PATH_BYTES = 1000  # bytes of a path, 255 of a name: what file systems take


def path_inside(folder: Path, name: str, where: str) -> Path:
    """The file that `where` calls `name`, below `folder`. Raises DataError for a name that leads out of it.

    Links in the folder are followed: who made the folder may keep the images on another disk.
    """
    parts = PurePosixPath(name).parts
    leads_out = name.startswith("/") or ".." in parts or "\0" in name or not parts
    if leads_out or len(name.encode()) > _MAX_PATH_BYTES or max(len(part.encode()) for part in parts) > 255:
        raise DataError(f"{where}: '{name:.80}' is no name of a file below {folder}")
    return folder / name
