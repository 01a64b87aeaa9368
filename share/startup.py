"""Setup of every SHARE process, before numpy is imported.

Measured on a 752x480 stereo frame: one thread per library is fastest on a busy small computer, and keeping
large temporaries in the heap instead of returning them to the kernel took a frame from 6.5 to 4.5 ms.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

from share import child_processes

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # mallopt(3) parameter numbers
_MALLOC_THRESHOLD_BYTES = 512 * 1024 * 1024
_TRIM_S = 60.0


def prepare_process() -> None:
    """Make the process end with the SHARE process that started it, open the standard streams that are closed,
    and set thread counts and malloc thresholds. Variables that the user has set stay."""
    child_processes.exit_with_starter()
    open_standard_streams()
    for name in _THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    if (mallopt := _glibc_function("mallopt")) is not None:
        mallopt(_M_MMAP_THRESHOLD, _MALLOC_THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _MALLOC_THRESHOLD_BYTES)


def open_standard_streams() -> None:
    """Open the null device in place of the standard streams that are closed. Else their numbers go to the
    next files or sockets, and what a library prints goes there too."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
    sys.stdin = sys.stdin or os.fdopen(0, closefd=False)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)


class HeapTrimmer:
    """Returns free heap memory to the kernel once a minute, for processes that run for hours.

    With the thresholds of `prepare_process` free memory fragments and the process would grow without a leak.
    A trim takes 1 ms and makes the next frame slower."""

    def __init__(self) -> None:
        self._trim = _glibc_function("malloc_trim")
        self._due_s: float | None = None

    def trim_if_due(self, now_s: float) -> None:
        """Trim once a minute. Call often; now_s: monotonic."""
        if self._due_s is not None and now_s < self._due_s:
            return
        if self._due_s is not None and self._trim is not None:
            self._trim(0)
        self._due_s = now_s + _TRIM_S


def _glibc_function(name: str) -> Callable[..., Any] | None:
    """Return the function, or None with another C library."""
    if sys.platform != "linux":
        return None
    import ctypes

    function: Callable[..., Any] | None = getattr(ctypes.CDLL(None), name, None)
    return function
