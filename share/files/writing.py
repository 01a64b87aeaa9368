"""Write files atomically, and check beforehand that they can be written."""

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
    """Write a temporary file beside `path`, sync it to disk, then rename it: `path` is always old or new.

    A link of that name is replaced, not followed, so that a link planted in the folder cannot redirect the
    write. A device, and a pipe that `check_writable` has opened, are written to directly. Raises UsageError
    for another pipe or if the folder is not writable, ShareError if the disk is full or fails.
    """
    content = data.encode() if isinstance(data, str) else data
    if is_special(path):
        _write_special(path, content)
        return
    with _replacing(path.resolve() if _is_system_path(path) else path) as file:
        file.write(content)


@contextlib.contextmanager
def new_file(out: Path) -> Iterator[IO[bytes]]:
    """Yield a temporary file that becomes `out`, synced to disk, at the end of the block. On error, no file.

    Raises UsageError if `out` exists or cannot be created, ShareError if the disk is full or fails.
    """
    if check_replaceable(out).exists():
        raise UsageError(f"{out}: exists and is not overwritten; give a new name")
    with _replacing(out) as file:
        yield file


def write_private(path: Path, data: bytes | str, replaces: bool = False) -> None:
    """Write a file that no other user can read at any moment, synced to disk.

    replaces: put it in the place of an old one, in one step; else the name must be new. Raises ShareError.
    """
    content = data.encode() if isinstance(data, str) else data
    with write_errors(path):
        new = path.with_name(f".{path.name}.new") if replaces else path
        if replaces:
            new.unlink(missing_ok=True)
        handle = os.open(new, _NEW_FILE_FLAGS, 0o600)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            if replaces:
                new.replace(path)
        except OSError:
            new.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[IO[bytes]]:
    """Yield a temporary file beside `path` that replaces it at the end of the block, synced to disk."""
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        with write_errors(path), os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.chmod(name, 0o666 & ~_umask())  # mkstemp makes it private
            os.replace(name, path)
    finally:
        Path(name).unlink(missing_ok=True)
    sync_folder(path.parent)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Within the block, an OSError (disk full) becomes a ShareError that names `path`."""
    try:
        yield
    except OSError as error:
        raise ShareError(f"{path}: cannot be written: {error.strerror or error}") from None


def sync_folder(folder: Path) -> None:
    """Make a rename in `folder` durable, if the file system can."""
    with contextlib.suppress(OSError):  # some file systems cannot open folders
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_writable(path: Path) -> Path:
    """Return `path` if it can be written; create its folder if needed. Else raise UsageError.

    It may also be a device, or a pipe with a reader.
    """
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; give the name of a file")
    if not is_special(path):
        writable_dir(path.parent)
    elif not path.is_char_device():
        _open_pipe(path)
    return path


def check_replaceable(path: Path) -> Path:
    """Return `path` if a file can replace it: it is a file or does not exist. Else raise UsageError."""
    if is_special(path):
        raise _blocked_path_error(path)
    return check_writable(path)


_pipes: dict[tuple[int, int], int] = {}  # open for writing, by device and inode


def _open_pipe(path: Path) -> None:
    """Open a pipe for writing and keep it open: its reader takes the close of the last writer for the end.

    Raises UsageError if it has no reader, for which open(2) would wait.
    """
    if not path.is_fifo():
        raise UsageError(f"{path}: is {_kind_text(path)}; give the name of a file")
    if (file_id := _file_id(path)) in _pipes:
        return
    try:
        handle = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        problem = (
            "without a reader" if error.errno == errno.ENXIO else f"and cannot be opened: {error.strerror}"
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
    """Return the kind of a special file."""
    return "a pipe" if path.is_fifo() else "a socket" if path.is_socket() else "a device"


def is_special(path: Path) -> bool:
    """Return whether `path` is a device or a pipe (/dev/null, /dev/stdout), which a file must not replace.

    False for a link to one, unless the system made it (/dev/stdout).
    """
    if path.is_symlink() and not _is_system_path(path):
        return False
    return path.exists() and not path.is_file() and not path.is_dir()


def _is_system_path(path: Path) -> bool:
    """Return whether `path` is in /dev or /proc, where the system makes the links."""
    return path.absolute().parts[1:2] in (("dev",), ("proc",))


def open_new(path: Path) -> IO[bytes]:
    """Create an empty file at `path`, replacing what is there; never write through a link or hard link.

    A device is opened as it is. Raises OSError, also for a pipe.
    """
    if path.is_char_device() and is_special(path):
        return path.open("wb")
    if is_special(path):
        raise OSError(errno.EINVAL, f"it is {_kind_text(path)}, not a file; remove it", str(path))
    with contextlib.suppress(FileNotFoundError):
        path.unlink()
    return os.fdopen(os.open(path, _NEW_FILE_FLAGS, 0o666), "wb")


_NEW_FILE_FLAGS = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def writable_dir(path: Path, *names: str) -> Path:
    """Create the folder `path` if needed, check that it is writable, and return it. Else raise UsageError.

    names: files that will be written there; each must be a file or not exist.
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


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `out` at the end of the block. On error, no folder.

    Raises UsageError if `out` is not empty, ShareError if the disk is full or fails.
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
    """Return the folder in environment `variable`, else `default` in the user's home (XDG Base Directory
    Specification). Raises RuntimeError without a home."""
    folder = os.environ.get(variable, "")
    return Path(folder) if os.path.isabs(folder) else Path.home() / default
