"""A log of JSON lines that a power cut costs at most its last line: each is appended, then synced to disk.

A line that was cut short (killed, power cut, full disk) is taken away before the next one is appended, so
that it never becomes one with it.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from share.files.writing import sync_folder, write_errors


class StudyLog:
    """Appends to `path`, which is made with its folder by the first line. was_torn: an incomplete last line
    was taken away."""

    def __init__(self, path: Path) -> None:
        self.path, self.was_torn = path, False
        self._handle: int | None = None
        self._size = 0  # of what is complete, bytes

    def append(self, line: Mapping[str, Any]) -> None:
        """Append one line; once this returns, it is on the disk. Raises ShareError; then nothing is left of
        it."""
        data = json.dumps(line, allow_nan=False).encode() + b"\n"
        with write_errors(self.path):
            handle = self._opened()
            try:
                written = os.write(handle, data)
                while written < len(data):
                    written += os.write(handle, data[written:])
                os.fsync(handle)
            except OSError:
                with contextlib.suppress(OSError):
                    os.ftruncate(handle, self._size)
                raise
        self._size += len(data)

    def close(self) -> None:
        """May be repeated."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def _opened(self) -> int:
        if self._handle is None:
            is_new = not self.path.exists()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
            handle = os.open(self.path, flags, 0o666)
            try:
                self._size = _complete_bytes(handle)
                if os.fstat(handle).st_size > self._size:
                    self.was_torn = True
                    os.ftruncate(handle, self._size)
                if is_new:
                    sync_folder(self.path.parent)
                    sync_folder(self.path.parent.parent)
            except OSError:
                os.close(handle)
                raise
            self._handle = handle
        return self._handle


def _complete_bytes(handle: int) -> int:
    """Return the size of a file up to its last line's end."""
    at = os.fstat(handle).st_size
    while at > 0:
        begin = max(0, at - 65536)
        end = os.pread(handle, at - begin, begin).rfind(b"\n")
        if end >= 0:
            return begin + end + 1
        at = begin
    return 0
