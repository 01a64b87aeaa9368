"""Lines that a live run puts down and reads once more at its end, so that they take no memory meanwhile."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from share.errors import ShareError
from share.io.files import fresh
from share.io.line_file import LineFile

_LASTING = Path("/var/tmp")  # /tmp may lie in memory
_AT_ONCE = 1 << 20  # bytes


class Spool:
    """As `LineFile`, made by the first line, and readable while it is open, even if it was removed.

    path None: a file without a name in the system's folder of temporary ones, of which nothing is left
    however the run ends.
    """

    def __init__(self, path: Path | None, say: Callable[[str], None]) -> None:
        self._path, self._say = path, say
        self._file: LineFile | None = None
        self._reading: int | None = None  # a handle of the same file

    def write(self, line: str) -> None:
        """One line, without its end."""
        if self._file is None:
            shown = _lasting() / "share (without a name)" if self._path is None else self._path
            self._file = LineFile(shown, self._say, self._opened)
        self._file.write(line)

    def read(self) -> Iterator[str]:
        """Lines in order, but for those that could not be written. Raises ShareError if the disk fails."""
        if self._file is None or self._reading is None:
            return
        at, cut = 0, b""
        while at < self._file.whole_bytes:
            lines = (cut + self._part(at, min(_AT_ONCE, self._file.whole_bytes - at))).split(b"\n")
            at += sum(map(len, lines)) + len(lines) - 1 - len(cut)
            cut = lines.pop()
            yield from (line.decode() for line in lines)

    def check(self) -> None:
        """Raises ShareError if a line is missing."""
        if self._file is not None:
            self._file.check()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        if self._reading is not None:
            os.close(self._reading)
            self._reading = None

    def _opened(self, path: Path) -> IO[bytes]:
        file = self._nameless() if self._path is None else fresh(path)
        self._reading = os.dup(file.fileno())
        return file

    def _nameless(self) -> IO[bytes]:
        return tempfile.TemporaryFile(dir=_lasting())

    def _part(self, at: int, size: int) -> bytes:
        assert self._file is not None and self._reading is not None
        try:
            part = os.pread(self._reading, size, at)
        except OSError as error:
            raise ShareError(f"{self._file.path}: cannot be read: {error.strerror}") from None
        if not part:
            raise ShareError(f"{self._file.path}: somebody cut it off while it was written")
        return part


def _lasting() -> Path:
    return _LASTING if os.access(_LASTING, os.W_OK) else Path(tempfile.gettempdir())
