"""How every SHARE process is set up, before numpy is imported: the one place for it.

Measured on a 752x480 stereo frame: one thread per library is fastest on a busy small computer, and
keeping big temporaries from going back to the kernel took a frame from 6.5 to 4.5 ms.
"""

from __future__ import annotations

import os
import sys

from share import children

_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # mallopt(3) parameter numbers
_KEEP_BYTES = 512 * 1024 * 1024


def prepare() -> None:
    """Ends with the SHARE process that started it, if one did; thread counts and malloc thresholds. What the
    user set in the environment stays."""
    children.follow_starter()
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    if sys.platform == "linux":
        import ctypes

        try:
            mallopt = ctypes.CDLL(None).mallopt
        except AttributeError:  # a C library other than glibc
            return
        mallopt(_M_MMAP_THRESHOLD, _KEEP_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
