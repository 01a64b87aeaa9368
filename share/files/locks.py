"""Locks between processes, on a file or on a folder itself. The system releases them when a process ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from share.errors import UsageError
from share.files.writing import writable_dir


def lock_folder(folder: Path) -> int:
    """Create `folder` (as `writable_dir`) and lock it, so that two runs do not write the same files.

    Returns a handle; close it to unlock. Raises UsageError if another run holds it.
    """
    handle = os.open(writable_dir(folder), os.O_RDONLY)
    try:
        lock_handle(handle)
    except BlockingIOError:
        raise UsageError(f"{folder}: another run is writing there; give another --out") from None
    return handle


def lock_handle(handle: int) -> None:
    """Lock an open file or folder. Else close it and raise OSError, BlockingIOError if it is
    locked already."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise


_TRY_S = 0.01  # between two attempts


@contextlib.contextmanager
def folder_locked(folder: Path, wait_s: float | None = None) -> Iterator[None]:
    """Let one process at a time into the block, of all that lock `folder`; the others wait. wait_s: for so
    long, then BlockingIOError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        if wait_s is None:
            fcntl.flock(handle, fcntl.LOCK_EX)
        else:
            _lock_soon(handle, time.monotonic() + wait_s)
        yield
    finally:
        os.close(handle)


def _lock_soon(handle: int, until_s: float) -> None:
    """Lock an open folder until a moment. Raises BlockingIOError."""
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= until_s:
                raise
            time.sleep(_TRY_S)
