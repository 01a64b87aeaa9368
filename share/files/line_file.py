"""Text files that a live run appends to and reads back at its end, so that the lines take no memory."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from share.errors import ShareError
from share.files.reading import MB, open_regular
from share.files.writing import open_new


class LineFile:
    """A text file that a live run appends to. A write error never ends the run.

    Every line is with the operating system when `write` returns, so a crash of the process loses none. After
    the first line that cannot be written (disk full, quota), `notify` is called once and nothing more is
    written; the file keeps its complete lines.
    """

    def __init__(self, path: Path, notify: Callable[[str], None]) -> None:
        self.path, self._notify = path, notify
        self.written_bytes = 0  # in complete lines
        self._file: IO[str] | None = None
        self._failure = ""
        self._open()

    def _open(self) -> None:
        try:
            self._file = io.TextIOWrapper(self._create(), "utf-8", line_buffering=True)
        except OSError as error:
            self._fail(error)

    def _create(self) -> IO[bytes]:
        return open_new(self.path)

    def write(self, line: str) -> None:
        """Append a line, given without its end."""
        if self._file is None:
            return
        try:
            self._file.write(line + "\n")
            self.written_bytes += len(line.encode()) + 1
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def check(self) -> None:
        """Raise ShareError if a line is missing."""
        if self._failure:
            raise ShareError(f"{self.path}: is not complete: {self._failure}")

    def _fail(self, error: OSError) -> None:
        self._failure = error.strerror or str(error)
        if self._file is not None:
            with contextlib.suppress(OSError):  # its buffer cannot be written either
                self._file.close()
            self._file = None
            with contextlib.suppress(OSError):  # a device cannot be truncated
                os.truncate(self.path, self.written_bytes)
        self._notify(f"{self.path}: cannot be written: {self._failure}; the run goes on without it")


_VAR_TMP = Path("/var/tmp")  # /tmp may be in memory
_READ_BYTES = 1 << 20  # per read


class Spool(LineFile):
    """A `LineFile` created with its first line, and readable while it is open, even after its removal.

    path None: an unnamed temporary file, of which nothing is left however the run ends.
    """

    def __init__(self, path: Path | None, notify: Callable[[str], None]) -> None:
        self._is_named, self._has_begun = path is not None, False
        self._read_handle: int | None = None  # a handle of the same file
        super().__init__(path or _temp_folder() / "share (unnamed)", notify)

    def write(self, line: str) -> None:
        if not self._has_begun:
            self._has_begun = True
            super()._open()
        super().write(line)

    def read(self) -> Iterator[str]:
        """Yield all lines that were written, in order. Raises ShareError if the disk fails."""
        offset, partial_line = 0, b""
        while offset < self.written_bytes:
            part = self._read_at(offset, min(_READ_BYTES, self.written_bytes - offset))
            *lines, partial_line = (partial_line + part).split(b"\n")
            offset += len(part)
            yield from (line.decode() for line in lines)

    def close(self) -> None:
        super().close()
        if self._read_handle is not None:
            os.close(self._read_handle)
            self._read_handle = None

    def _open(self) -> None:
        """Wait for the first line."""

    def _create(self) -> IO[bytes]:
        file = super()._create() if self._is_named else _unnamed_file()
        self._read_handle = os.dup(file.fileno())
        return file

    def _read_at(self, offset: int, size: int) -> bytes:
        if self._read_handle is None:
            return b""
        try:
            part = os.pread(self._read_handle, size, offset)
        except OSError as error:
            raise ShareError(f"{self.path}: cannot be read: {error.strerror}") from None
        if not part:
            raise ShareError(f"{self.path}: was truncated by another process while it was written")
        return part


def _unnamed_file() -> IO[bytes]:
    return tempfile.TemporaryFile(dir=_temp_folder())


def _temp_folder() -> Path:
    return _VAR_TMP if os.access(_VAR_TMP, os.W_OK) else Path(tempfile.gettempdir())


_MAX_READ_BYTES = 10 * MB  # per call of GrowingFile.new_lines


class GrowingFile:
    """A text file that another process is writing: yields each line once.

    partial: its name until it is complete; before that, a file of the final name is an older one.
    """

    def __init__(self, path: Path, partial: Path | None = None) -> None:
        self._path, self._partial = path, partial
        self._read_bytes = 0

    def new_lines(self) -> list[str]:
        """Return the complete lines since the last call; none while there is no file."""
        new = b"" if self._partial is None else self._read_new(self._partial)
        if not new and (self._partial is None or self._read_bytes):
            new = self._read_new(self._path)
        complete = new[: new.rfind(b"\n") + 1]
        self._read_bytes += len(complete)
        return complete.decode(errors="replace").splitlines()

    def _read_new(self, path: Path) -> bytes:
        try:
            with open_regular(path) as file:
                file.seek(self._read_bytes)
                return file.read(_MAX_READ_BYTES)
        except OSError:
            return b""
