"""What a decoder writes to stderr: libjpeg fills up a damaged image and says so nowhere else.

A peer could fill the log with such lines; and what was filled up is no image of its camera.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_STDERR = 2
_redirecting = threading.Lock()  # file descriptors belong to the whole process


def with_complaints(decode: Callable[[], T]) -> tuple[T, str]:
    """Return `decode()` and what it wrote to the process's stderr, which nobody else sees.

    Other threads' lines of that moment count as its own: for a process whose other threads write none."""
    with _redirecting:
        try:
            stderr = os.dup(_STDERR)
        except OSError:  # closed, so nothing can be written
            return decode(), ""
        sink = os.memfd_create("complaints")
        try:
            os.dup2(sink, _STDERR)
            try:
                result = decode()
            finally:
                os.dup2(stderr, _STDERR)
            return result, os.pread(sink, 4096, 0).decode(errors="replace")
        finally:
            os.close(stderr)
            os.close(sink)
