"""Opening and locking a map file with SQLite, and translating SQLite's errors."""

from __future__ import annotations

import contextlib
import os
import resource
import sqlite3
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from share.errors import StoreError, UsageError
from share.files.locks import lock_handle
from share.files.reading import is_sparse, open_regular, read_bytes
from share.files.sqlite_file import STEPS_PER_CHECK, limit_untrusted, read_only_uri, shm_path, wal_path
from share.store.schema import PAGE_BYTES, first_page

BUSY_S = 5.0  # how long a commit waits for a reader of another process
WAL_PAGES = 512  # of the log (4 MiB) before a checkpoint
MAGIC = b"SQLite format 3\0"
_HEADER_BYTES = 100
# Offsets of header bytes that are the same in all maps (sqlite.org/fileformat.html, 1.3).
_FIXED_HEADER_BYTES = (*range(18), *range(20, 24), *range(44, 48), *range(52, 60))
_MAX_ROW_BYTES = 256 * 1024**2  # poses of a million keyframes take 128 MB
_MIN_TIME_S = 10.0  # time limit for reading an empty file
_MIN_BYTES_PER_S = 1e6  # slowest disk: adds to the time limit by file size
_TABLE_MARKERS = b"CREATE TABLE keyframe(", b"CREATE TABLE run_copy("  # two, to survive a flipped byte
_INDEX_BYTES = 32_768  # by which SQLite grows the index of the log
_FRAME_BYTES = 24  # before each page in the log

# Errors that are not the file's fault; any other means that the file is damaged.
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

# What SQLite raises: on damaged pages, or since the machine fails (`is_damage` tells).
DAMAGE_ERRORS = (sqlite3.Error, MemoryError, OverflowError, UnicodeError)


class DamageError(StoreError):
    """The file is a map, but damaged."""


def open_for_writing(path: Path, durable: bool) -> sqlite3.Connection:
    """Open the single writer. durable: commits wait for the disk, so that a power failure loses none."""
    connection = sqlite3.connect(path, BUSY_S, isolation_level=None, check_same_thread=False)
    limit_untrusted(connection, _MAX_ROW_BYTES)
    connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
    connection.execute(f"PRAGMA wal_autocheckpoint = {WAL_PAGES}")
    connection.execute(f"PRAGMA journal_size_limit = {4 * WAL_PAGES * PAGE_BYTES}")
    connection.execute("PRAGMA secure_delete = ON")  # what is removed is overwritten with zeros
    return connection


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Open a reader; a writer may run at the same time."""
    connection = sqlite3.connect(
        read_only_uri(path), BUSY_S, uri=True, isolation_level=None, check_same_thread=False
    )
    return limit_time(connection, path)


def limit_time(connection: sqlite3.Connection, path: Path) -> sqlite3.Connection:
    """Limit the time of all queries on an untrusted file, by the time that a slow disk takes to read it.
    Return `connection`."""
    limit_untrusted(connection, _MAX_ROW_BYTES)
    deadline_s = time.monotonic() + _MIN_TIME_S + path.stat().st_size / _MIN_BYTES_PER_S
    connection.set_progress_handler(lambda: time.monotonic() > deadline_s, STEPS_PER_CHECK)
    return connection


@contextlib.contextmanager
def translate_errors(path: Path, action: str, writes: bool = False) -> Iterator[None]:
    """Turn SQLite's errors in the block into DamageError if the file is damaged, else StoreError. writes: the
    block writes, so that a full disk is told from a broken one."""
    try:
        yield
    except DAMAGE_ERRORS as error:
        if is_damage(error):
            raise DamageError(f"{path}: the map is damaged: {error}") from None
        why = why_not_written(error, path) if writes else size_limit_message(error, path) or _text(error)
        raise StoreError(f"{path}: the map cannot be {action}: {why}") from None


def _text(error: Exception) -> str:
    return str(error) or "out of memory"  # a MemoryError has none


def is_damage(error: Exception) -> bool:
    """Return whether one of DAMAGE_ERRORS is the file's fault."""
    if isinstance(error, MemoryError):  # no size in a file asks for more than the file has
        return False
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT)
    is_cut = code == sqlite3.SQLITE_IOERR_SHORT_READ  # the file, or its log
    return is_cut or code & 0xFF not in _ENVIRONMENT_ERRORS


def check_damage(error: Exception) -> None:
    """Raise the error unless it is the file's fault. One of the machine would pass for a loss, and half of
    the file for all that is left of it."""
    if not is_damage(error):
        raise error


def check_is_map(path: Path) -> bool:
    """Return whether the file holds a map; False if it is missing or empty. Raises UsageError for another
    file.

    A writer killed before its first checkpoint leaves nothing or a bare first page; the rest is in the log.
    """
    for side_file in (wal_path(path), shm_path(path)):
        _check_side_file(side_file)
    try:
        with open_regular(path) as file:
            head = file.read(PAGE_BYTES)
        if is_sparse(path):
            raise UsageError(f"{path}: is a sparse file, not a map; give another file")
    except FileNotFoundError:
        return False
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    if any(text in head for text in _TABLE_MARKERS):
        return True
    if head and not is_blank(path):
        raise UsageError(f"{path}: is not a SHARE map and was left unchanged; give another file")
    return wal_path(path).exists() and bool(wal_path(path).stat().st_size)


def _check_side_file(file: Path) -> None:
    """Raises UsageError if the file exists and cannot be one of SQLite's, or be read."""
    what = "the log of a map" if file.suffix.endswith("-wal") else "the index of a map's log"
    if file.is_symlink():
        raise UsageError(f"{file}: is a link, but should be {what}; remove it")
    try:
        open_regular(file).close()
    except FileNotFoundError:
        return
    except OSError as error:
        if is_other_kind(file):
            raise UsageError(f"{file}: cannot be {what}: {error.strerror}; remove it") from None
        raise UsageError(f"{file}: {what} cannot be read: {error.strerror}") from None


def is_other_kind(file: Path) -> bool:
    """Return whether there is something else than a regular file, such as a folder. Only that may be removed:
    the log has what the map has not yet."""
    try:
        return not stat.S_ISREG(file.lstat().st_mode)
    except OSError:
        return False


def is_blank(path: Path) -> bool:
    """Return whether the file is only a first page without tables."""
    head = read_bytes(path, PAGE_BYTES) if os.stat(path).st_size <= PAGE_BYTES else b"CREATE "
    return head.startswith(MAGIC) and b"CREATE " not in head


def check_header(path: Path) -> None:
    """Raises DamageError if a fixed header byte is wrong, which could make SQLite misread the file."""
    with open_regular(path) as file:
        head, expected = file.read(_HEADER_BYTES), first_page()
    kinds = set(head[18:20])  # write and read version: 1 without a log, 2 with one
    if not is_blank(path) and (
        any(head[offset] != expected[offset] for offset in _FIXED_HEADER_BYTES) or kinds - {1, 2}
    ):
        raise DamageError(f"{path}: the map is damaged: its header")


def is_map(path: Path) -> bool:
    """Return whether a file looks like a map, intact or damaged."""
    try:
        return path.is_file() and check_is_map(path)
    except UsageError:
        return False


def why_not_written(error: Exception, path: Path) -> str:
    """Return why a write failed. SQLite reports a quota and a broken disk alike, so a test file is
    written."""
    if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
        return "No space left on device"
    if (message := size_limit_message(error, path)) is not None:
        return message
    try:
        with tempfile.TemporaryFile(dir=path.parent) as file:
            file.write(bytes(PAGE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as system:
        return system.strerror or str(system)
    return _text(error)


def size_limit_message(error: Exception, path: Path) -> str | None:
    """Return a message if the process's file size limit caused `error`, else None."""
    max_bytes, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code != sqlite3.SQLITE_IOERR or max_bytes == resource.RLIM_INFINITY:
        return None
    growth_bytes = {path: PAGE_BYTES, wal_path(path): PAGE_BYTES + _FRAME_BYTES, shm_path(path): _INDEX_BYTES}
    for file, more in growth_bytes.items():
        if file.exists() and file.stat().st_size + more > max_bytes:
            return (
                f"{file.name} may not grow beyond the file size limit of this process, "
                f"{max_bytes / 1e6:.3g} MB; raise it (ulimit -f) and start again"
            )
    return None


def write_obstacle(path: Path) -> str:
    """Return why the map at `path` cannot be written, "" if it can.

    The file itself is not opened: closing it would release all locks that this process holds on it (fcntl).
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not os.access(path, os.W_OK):
            return "the file is read-only"
        with tempfile.TemporaryFile(dir=path.parent):  # SQLite makes files beside it
            return ""
    except OSError as error:
        return f"its folder cannot be written: {error.strerror or error}"


def create_private(path: Path) -> None:
    """Create the file of a new map, which only its owner may read; SQLite gives the log the same mode. An
    existing one is not opened: see `write_obstacle`. Raises StoreError."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600))
    except FileExistsError:
        make_private(path)
    except OSError as error:
        raise StoreError(f"{path}: the map cannot be written: {error.strerror}") from None


def make_private(path: Path) -> None:
    """Let only its owner read a map that all users may read, if the file system and its owner allow.

    One that only a group may read besides was made so on purpose, and stays so.
    """
    for file in (path, wal_path(path), shm_path(path)):
        with contextlib.suppress(OSError):
            if is_public(file):
                file.chmod(stat.S_IMODE(file.stat().st_mode) & stat.S_IRWXU)


def is_public(file: Path) -> bool:
    """Return whether all users of this machine may read or write the file."""
    return file.exists() and bool(file.stat().st_mode & (stat.S_IROTH | stat.S_IWOTH))


def refuse_hard_links(path: Path) -> None:
    """Raise StoreError if the file has another name: an edge could use it by that, with a log of its own."""
    with contextlib.suppress(FileNotFoundError):
        if (names := os.stat(path).st_nlink) > 1:
            raise StoreError(
                f"{path}: has {names} names (hard links), and another edge could use it by one; "
                "copy it, and give the copy"
            )


def lock_map(path: Path) -> int:
    """Lock the map by a file beside it, which is released when this process ends. Return a handle; close it
    to unlock. Raises StoreError while another edge has the lock."""
    name = path.with_name(path.name + ".lock")
    try:
        handle = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        remedy = "; remove it" if is_other_kind(name) else ""
        raise StoreError(f"{name}: cannot be locked: {error.strerror}{remedy}") from None
    try:
        lock_handle(handle)
    except OSError:
        raise StoreError(f"{path}: another edge uses this map; stop it, or give another file") from None
    return handle
