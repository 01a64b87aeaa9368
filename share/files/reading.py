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
SETTINGS = 2 * MB  # YAML that a person or a calibration wrote; ours with all provenance has 0.1
TABLE = 4000 * MB  # of numbers as text: half a day of a 1 kHz IMU
REPORT = 100 * MB  # one JSON object that our own commands wrote; of a day of eight agents 30
EVENTS = 1000 * MB  # a JSON object a line; the events of a day
KEYS = 10 * MB  # public keys, a line each: 100,000 machines
ARRAYS = 2000 * MB  # labels of a run, weights; a run of an hour at 5 keyframes a second has 300
LOG = 100 * MB  # what a child process said
_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY
_KINDS = {
    stat.S_IFDIR: "it is a folder",
    stat.S_IFIFO: "it is a pipe",
    stat.S_IFSOCK: "it is a socket",
    stat.S_IFCHR: "it is a device",
    stat.S_IFBLK: "it is a device",
}


def open_regular(path: Path, most: int | None = None) -> BinaryIO:
    """The file, for reading. most: bytes that it may have. Raises OSError, also where it is no regular file
    or is larger."""
    try:
        handle = os.open(path, _FLAGS)
    except OSError as error:
        if error.errno == errno.ENXIO:  # what open(2) says of a socket
            raise _refused(path, stat.S_IFSOCK) from None
        raise
    except ValueError:  # a NUL in its name
        raise OSError(errno.EINVAL, "its name is none that a file can have", repr(str(path))) from None
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise _refused(path, stat.S_IFMT(found.st_mode))
        if most is not None and found.st_size > most:
            raise _too_large(path, found.st_size, most)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, most: int) -> bytes:
    """All of a file of at most so many bytes. Raises OSError."""
    with open_regular(path, most) as file:
        data = file.read(os.fstat(file.fileno()).st_size + 1)  # Python reserves what is asked for
        while more := file.read(MB):  # it grows, or is one of /proc, which have no size
            data += more
            if len(data) > most:
                raise _too_large(path, len(data), most)
    return data


def read_text(path: Path, most: int, encoding: str = "utf-8") -> str:
    """Likewise, with \\n at the end of every line. Raises OSError, UnicodeDecodeError."""
    return read_bytes(path, most).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def is_hollow(path: Path) -> bool:
    """Whether a file is nearly all holes: it says a size that takes no disk. File systems that pack what is
    in a file do not get as far. Raises OSError."""
    found = os.stat(path)
    return found.st_size > MB + _PACKED * _BLOCK * found.st_blocks


_BLOCK, _PACKED = 512, 50


def _refused(path: Path, kind: int) -> OSError:
    what = _KINDS.get(kind, "it is of a kind of its own")
    return OSError(errno.EINVAL, f"{what}, not a regular file", str(path))


def _too_large(path: Path, size: int, most: int) -> OSError:
    has, may = (f"{n / MB:,.1f} MB" for n in (size, most))
    return OSError(errno.EFBIG, f"it has {has}, a file of this kind may have {may}", str(path))


# ---- Paths that a file tells of: they stay in that file's folder.

_LONGEST = 1000  # bytes of a path, 255 of a name: what file systems take


def inside(folder: Path, name: str, where: str) -> Path:
    """The file that `where` calls `name`, below `folder`. Raises DataError for a name that leads out of it.

    Links in the folder are followed: who made the folder may keep the images on another disk.
    """
    parts = PurePosixPath(name).parts
    leads_out = name.startswith("/") or ".." in parts or "\0" in name or not parts
    if leads_out or len(name.encode()) > _LONGEST or max(len(part.encode()) for part in parts) > 255:
        raise DataError(f"{where}: '{name:.80}' is no name of a file below {folder}")
    return folder / name
