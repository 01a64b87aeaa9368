"""One edge a map: a lock beside the file, that ends with its holder however that ends."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from share.errors import StoreError


def obstacle(path: Path) -> str:
    """Why the map at `path` cannot be written, for a person; "" if it can.

    The file itself is not opened: closing it would end all locks that this process has on it (POSIX, fcntl).
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not os.access(path, os.W_OK):
            return "the file is read-only"
        with tempfile.TemporaryFile(dir=path.parent):  # SQLite puts files beside it
            return ""
    except OSError as error:
        return f"its folder cannot be written: {error.strerror or error}"


def take(path: Path) -> int:
    """A handle; closing it gives the map free. Raises StoreError while another edge has it."""
    import fcntl

    name = path.with_name(path.name + ".lock")
    try:
        handle = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise StoreError(f"{name}: cannot be locked: {error.strerror}; remove it") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise StoreError(f"{path}: another edge uses this map; end it, or give another file") from None
    return handle
