"""Why SQLite cannot write a map, as a person knows it: SQLite itself says the same of many troubles."""

from __future__ import annotations

import os
import resource
import sqlite3
import tempfile
from pathlib import Path

from share.io.map_store.schema import PAGE_BYTES
from share.io.sqlite_file import index_of, log_of

_INDEX_BYTES = 32_768  # by which SQLite lets the index of the log grow
_FRAME_BYTES = 24  # before each page in the log


def why_not_written(error: sqlite3.Error, path: Path) -> str:
    """SQLite says the same of a quota and of a broken disk: the system is asked."""
    if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
        return "No space left on device"
    try:
        with tempfile.TemporaryFile(dir=path.parent) as file:
            file.write(bytes(PAGE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as system:
        return system.strerror or str(system)
    return size_limit(error, path) or str(error)


def size_limit(error: Exception, path: Path) -> str | None:
    """What is wrong, where the process may not let its files grow any more and SQLite met with that."""
    most, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code != sqlite3.SQLITE_IOERR or most == resource.RLIM_INFINITY:
        return None
    grow = {path: PAGE_BYTES, log_of(path): PAGE_BYTES + _FRAME_BYTES, index_of(path): _INDEX_BYTES}
    for file, more in grow.items():
        if file.exists() and file.stat().st_size + more > most:
            return (
                f"{file.name} may not grow beyond the file size limit of this process, {most / 1e6:.3g} MB; "
                "raise it (ulimit -f) and start again"
            )
    return None
