"""Writing files so that nobody ever finds half of one, and finding out first whether we may."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from share.errors import ShareError, UsageError


def atomic_write(path: Path, data: bytes | str) -> None:
    """Write beside `path`, make it durable, then take its name: `path` is old or new, never between.

    A link of that name is replaced, not followed: who can put one into our folder has no say over what else
    we write. A device, and a pipe that `check_writable` has opened, are simply written to. Raises UsageError
    for another pipe and if the folder cannot be written to, ShareError if the disk is full or fails.
    """
    content = data.encode() if isinstance(data, str) else data
    if is_special(path):
        _write_special(path, content)
        return
    path = path.resolve() if _is_system_path(path) else path
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        with write_errors(path):
            _write_durably(handle, name, content)
            os.replace(name, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
    sync_folder(path.parent)


def _write_durably(handle: int, name: str, content: bytes) -> None:
    with os.fdopen(handle, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.chmod(name, 0o666 & ~_umask())  # mkstemp makes it private


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Says a full disk and its like in one line: OSError inside becomes a ShareError that names `path`."""
    try:
        yield
    except OSError as error:
        raise ShareError(f"{path}: cannot be written: {error.strerror or error}") from None


def sync_folder(folder: Path) -> None:
    """Make a rename in `folder` durable, where the system can."""
    with contextlib.suppress(OSError):  # not every file system opens folders
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_writable(path: Path) -> Path:
    """`path`, which a person named, if a file of that name can be made (its folder may have to be made).

    It may be a device, or a pipe that somebody reads. Else UsageError.
    """
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; give the name of a file")
    if not is_special(path):
        writable_dir(path.parent)
    elif not path.is_char_device():
        _open_pipe(path)
    return path


def check_replaceable(path: Path) -> Path:
    """`path`, if it is a file or nothing, and so can be replaced by one. Else UsageError."""
    if is_special(path):
        raise _blocked_path_error(path)
    return check_writable(path)


_pipes: dict[tuple[int, int], int] = {}  # open for writing, by device and inode


def _open_pipe(path: Path) -> None:
    """It stays open from here on: a reader takes the close of its last writer for the end. Raises UsageError
    where nobody reads it, for which open(2) would wait."""
    if not path.is_fifo():
        raise UsageError(f"{path}: is {_kind_text(path)}; give the name of a file")
    if (file_id := _file_id(path)) in _pipes:
        return
    try:
        handle = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        problem = (
            "that nobody reads" if error.errno == errno.ENXIO else f"and cannot be opened: {error.strerror}"
        )
        raise UsageError(f"{path}: is a pipe {problem}; give the name of a file") from None
    os.set_blocking(handle, True)  # its reader may be slow
    _pipes[file_id] = handle


def _write_special(path: Path, content: bytes) -> None:
    with write_errors(path):
        if path.is_char_device():
            handle = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_NOCTTY)
        elif (pipe := _pipes.get(_file_id(path))) is not None:
            handle = os.dup(pipe)
        else:
            raise _blocked_path_error(path)
        with os.fdopen(handle, "wb") as file:
            file.write(content)


def _file_id(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


def _blocked_path_error(path: Path) -> UsageError:
    return UsageError(
        f"{path}: is {_kind_text(path)}, where a file is to be written; remove it, or give another --out"
    )


def _kind_text(path: Path) -> str:
    """A name for what is no file."""
    return "a pipe" if path.is_fifo() else "a socket" if path.is_socket() else "a device"


def is_special(path: Path) -> bool:
    """Whether it is a device or a pipe (/dev/null, /dev/stdout), which must not be replaced by a file. A link
    to one is not, but for those of the system."""
    if path.is_symlink() and not _is_system_path(path):
        return False
    return path.exists() and not path.is_file() and not path.is_dir()


def _is_system_path(path: Path) -> bool:
    """Whether the system made it, as /dev/stdout, which is a link."""
    return path.absolute().parts[1:2] in (("dev",), ("proc",))


def open_new(path: Path) -> IO[bytes]:
    """A new, empty file in the place of what had that name: neither a link there nor another name of the same
    file is written through. A device is opened as it is. Raises OSError, also for a pipe."""
    if path.is_char_device() and is_special(path):
        return path.open("wb")
    if is_special(path):
        raise OSError(errno.EINVAL, f"it is {_kind_text(path)}, not a file; remove it", str(path))
    with contextlib.suppress(FileNotFoundError):
        path.unlink()
    return os.fdopen(os.open(path, _NEW_FILE_FLAGS, 0o666), "wb")


_NEW_FILE_FLAGS = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def lock_folder(folder: Path) -> int:
    """Make `folder` (as `writable_dir`) and lock it for one run: two must not write the same files.

    Returns a handle; closing it, or the end of the process, gives the folder free. Raises UsageError
    while another run has it.
    """
    import fcntl

    handle = os.open(writable_dir(folder), os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise UsageError(f"{folder}: another run is writing there; give another --out") from None
    return handle


def writable_dir(path: Path, *names: str) -> Path:
    """`path`, made if need be and tried with a file of its own. Else UsageError.

    names: of what will be written there, and so is a file or nothing.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{path}: is not a folder, or lies below a file; give another --out") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be written to: {error.strerror}; give another --out") from None
    for name in names:
        if is_special(path / name):
            raise _blocked_path_error(path / name)
    return path


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextlib.contextmanager
def new_file(out: Path) -> Iterator[IO[bytes]]:
    """A file beside `out` to write into; it is made durable and becomes `out` when the block is done. On
    error: nothing.

    Raises UsageError if `out` is there or cannot be made; ShareError if the disk is full or fails.
    """
    if check_replaceable(out).exists():
        raise UsageError(f"{out}: exists and is not overwritten; give a new name")
    handle, name = tempfile.mkstemp(prefix=f".{out.name}.", dir=out.parent)
    try:
        with write_errors(out), os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.chmod(name, 0o666 & ~_umask())  # mkstemp makes it private
            os.replace(name, out)
    finally:
        Path(name).unlink(missing_ok=True)
    sync_folder(out.parent)


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder beside `out` to write into; it becomes `out` when the block is done. On error: nothing.

    Raises UsageError if there is something in `out`; ShareError if the disk is full or fails.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; give a new name")
    writable_dir(out.parent)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        with write_errors(out):
            yield work
            work.chmod(0o755)
            work.replace(out)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def xdg_folder(variable: str, default: str) -> Path:
    """What the environment's `variable` says, or that folder of the user's home (XDG Base Directory
    Specification). Raises RuntimeError where nobody has a home."""
    folder = os.environ.get(variable, "")
    return Path(folder) if os.path.isabs(folder) else Path.home() / default
