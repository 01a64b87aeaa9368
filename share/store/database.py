"""One way to open a map file with SQLite, and one to say what SQLite complains of."""

from __future__ import annotations

import contextlib
import os
import resource
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from share.errors import StoreError, UsageError
from share.files.reading import is_sparse, open_regular, read_bytes
from share.files.sqlite_file import limit_untrusted, read_only_uri, shm_path, wal_path
from share.store.schema import PAGE_BYTES, first_page

BUSY_S = 5.0  # how long a commit waits for a reader of another process
WAL_PAGES = 512  # after as many (4 MiB) the log is moved into the file
MAGIC = b"SQLite format 3\0"
_HEADER_BYTES = 100
_FIXED_HEADER_BYTES = (
    *range(18),
    *range(20, 24),
    *range(44, 48),
    *range(52, 60),
)  # sqlite.org/fileformat.html, 1.3
_MAX_ROW_BYTES = 256 * 1024**2  # of a row: poses of a million keyframes are 128 MB
_MIN_TIME_S, _MIN_BYTES_PER_S = 10.0, 1e6
_STEPS_PER_CHECK = 10_000  # of SQLite's machine between two looks at the clock: some 0.1 ms
_TABLE_MARKERS = b"CREATE TABLE keyframe(", b"CREATE TABLE run_copy("  # one survives a flipped byte

# The world's troubles; whatever else SQLite says of a file, the file is damaged.
_ENVIRONMENT_ERRORS = (
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_PERM,
)

DAMAGE_ERRORS = (
    sqlite3.Error,
    MemoryError,
    OverflowError,
    UnicodeError,
)  # all that reading damaged pages raises


class DamageError(StoreError):
    """The file is a map, and not whole."""


def open_for_writing(path: Path, durable: bool) -> sqlite3.Connection:
    """The one writer. power_cut: a commit waits for the disk, so that not even that costs one."""
    connection = sqlite3.connect(path, BUSY_S, isolation_level=None, check_same_thread=False)
    limit_untrusted(connection, _MAX_ROW_BYTES)
    connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
    connection.execute(f"PRAGMA wal_autocheckpoint = {WAL_PAGES}")
    connection.execute(f"PRAGMA journal_size_limit = {4 * WAL_PAGES * PAGE_BYTES}")
    return connection


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Beside a living writer too."""
    connection = sqlite3.connect(
        read_only_uri(path), BUSY_S, uri=True, isolation_level=None, check_same_thread=False
    )
    return limit_time(connection, path)


def limit_time(connection: sqlite3.Connection, path: Path) -> sqlite3.Connection:
    """`connection` to a file from anywhere: after the time that reading so large a file takes on a slow disk,
    whatever it does ends with an error."""
    limit_untrusted(connection, _MAX_ROW_BYTES)
    deadline_s = time.monotonic() + _MIN_TIME_S + path.stat().st_size / _MIN_BYTES_PER_S
    connection.set_progress_handler(lambda: time.monotonic() > deadline_s, _STEPS_PER_CHECK)
    return connection


@contextlib.contextmanager
def translate_errors(path: Path, action: str) -> Iterator[None]:
    """SQLite's errors inside become a StoreError that names `path`, or DamageError: the file is to blame."""
    try:
        yield
    except DAMAGE_ERRORS as error:
        if is_damage(error):
            raise DamageError(f"{path}: the map is damaged: {error}") from None
        why = size_limit_message(error, path) or error
        raise StoreError(f"{path}: the map cannot be {action}: {why}") from None


def is_damage(error: Exception) -> bool:
    return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF not in _ENVIRONMENT_ERRORS


def check_is_map(path: Path) -> bool:
    """Whether there is something in it. Raises UsageError if that is not a map of ours.

    A writer killed before its first commit leaves nothing or a bare first page; what follows is in the log.
    """
    for side_file in (wal_path(path), shm_path(path)):
        _check_side_file(side_file)
    try:
        with open_regular(path) as file:
            head = file.read(PAGE_BYTES)
        if is_sparse(path):
            raise UsageError(f"{path}: is nearly all holes, which no map is; give another file")
    except FileNotFoundError:
        return False
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    if any(text in head for text in _TABLE_MARKERS):
        return True
    if head and not is_blank(path):
        raise UsageError(f"{path}: is not a map of SHARE, and was left as it is; give another file")
    return wal_path(path).exists() and bool(wal_path(path).stat().st_size)


def _check_side_file(file: Path) -> None:
    """Raises UsageError unless it is a file of SQLite's, or not there."""
    what = "the log of a map" if file.suffix.endswith("-wal") else "the index of a map's log"
    if file.is_symlink():
        raise UsageError(f"{file}: is a link; {what} lies beside it")
    try:
        open_regular(file).close()
    except FileNotFoundError:
        return
    except OSError as error:
        raise UsageError(f"{file}: cannot be {what}: {error.strerror}; remove it") from None


def is_blank(path: Path) -> bool:
    """A first page without tables and nothing else."""
    head = read_bytes(path, PAGE_BYTES) if os.stat(path).st_size <= PAGE_BYTES else b"CREATE "
    return head.startswith(MAGIC) and b"CREATE " not in head


def check_header(path: Path) -> None:
    """Raises DamageError if a byte is wrong by which SQLite would take it for another kind of file."""
    with open_regular(path) as file:
        head, expected = file.read(_HEADER_BYTES), first_page()
    kinds = set(head[18:20])  # of file, for writing and reading: 1 without a log, 2 with one
    if not is_blank(path) and (
        any(head[offset] != expected[offset] for offset in _FIXED_HEADER_BYTES) or kinds - {1, 2}
    ):
        raise DamageError(f"{path}: the map is damaged: its header")


def is_map(path: Path) -> bool:
    """Whether a file looks like a map, whole or damaged."""
    try:
        return path.is_file() and check_is_map(path)
    except UsageError:
        return False


# ---- Why SQLite cannot write a map, as a person knows it: SQLite itself says the same of many troubles.

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
    return size_limit_message(error, path) or str(error)


def size_limit_message(error: Exception, path: Path) -> str | None:
    """What is wrong, where the process may not let its files grow any more and SQLite met with that."""
    max_bytes, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code != sqlite3.SQLITE_IOERR or max_bytes == resource.RLIM_INFINITY:
        return None
    growth_bytes = {path: PAGE_BYTES, wal_path(path): PAGE_BYTES + _FRAME_BYTES, shm_path(path): _INDEX_BYTES}
    for file, more in growth_bytes.items():
        if file.exists() and file.stat().st_size + more > max_bytes:
            return (
                f"{file.name} may not grow beyond the file size "
                f"limit of this process, "
                f"{max_bytes / 1e6:.3g} MB; "
                "raise it (ulimit -f) and start again"
            )
    return None


# ---- One edge a map: a lock beside the file, that ends with its holder however that ends.


def write_obstacle(path: Path) -> str:
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


def lock_map(path: Path) -> int:
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
