"""A text file that a live run appends to, and that never ends the run: a full disk is said once."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO

from share.errors import ShareError
from share.io.files import fresh


class LineFile:
    """Every line is in the system's hands when `write` returns, so a crash loses none.

    After the first line that cannot be written (disk full, quota), `say` is told once and nothing
    more is tried: what is there stays, in whole lines.
    """

    def __init__(
        self, path: Path, say: Callable[[str], None], opened: Callable[[Path], IO[bytes]] = fresh
    ) -> None:
        """opened: makes the file; may raise OSError."""
        self.path, self._say = path, say
        self.whole_bytes = 0  # of whole lines
        self._file: IO[str] | None = None
        self._failure = ""
        try:
            self._file = io.TextIOWrapper(opened(path), "utf-8", line_buffering=True)
        except OSError as error:
            self._fail(error)

    def write(self, line: str) -> None:
        """One line, without its end."""
        if self._file is None:
            return
        try:
            self._file.write(line + "\n")
            self.whole_bytes += len(line.encode()) + 1
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def check(self) -> None:
        """Raises ShareError if a line is missing."""
        if self._failure:
            raise ShareError(f"{self.path}: is not complete: {self._failure}")

    def _fail(self, error: OSError) -> None:
        self._failure = error.strerror or str(error)
        if self._file is not None:
            with contextlib.suppress(OSError):  # what it still holds cannot be written either
                self._file.close()
            self._file = None
            with contextlib.suppress(OSError):  # a device has no end to cut off
                os.truncate(self.path, self.whole_bytes)
        self._say(f"{self.path}: cannot be written: {self._failure}; the run goes on without it")
