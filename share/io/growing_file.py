"""A text file that another process is writing, read as it grows."""

from __future__ import annotations

from pathlib import Path

from share.io.regular_file import MB, open_regular

_PIECE = 10 * MB  # the rest the next time


class GrowingFile:
    """Its lines, each once. partial: the name that it has until it is whole; what has the other name before
    that is of earlier."""

    def __init__(self, path: Path, partial: Path | None = None) -> None:
        self._path, self._partial = path, partial
        self._read = 0  # bytes

    def lines(self) -> list[str]:
        """Whole lines that have come since the last time; none while there is no file."""
        new = b"" if self._partial is None else self._beyond(self._partial)
        if not new and (self._partial is None or self._read):
            new = self._beyond(self._path)
        whole = new[: new.rfind(b"\n") + 1]
        self._read += len(whole)
        return whole.decode(errors="replace").splitlines()

    def _beyond(self, path: Path) -> bytes:
        try:
            with open_regular(path) as file:
                file.seek(self._read)
                return file.read(_PIECE)
        except OSError:
            return b""
