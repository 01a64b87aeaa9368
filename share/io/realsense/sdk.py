"""The SDK, imported when a camera is asked for: it is an extra of SHARE."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from share.errors import ShareError, UsageError, not_installed


def load_sdk() -> Any:
    """The module pyrealsense2. Raises UsageError that says how to get it."""
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise UsageError(f"a RealSense camera: {not_installed('pyrealsense2', 'realsense')}") from None
    except ImportError as error:
        hint = " (apt install libusb-1.0-0)" if "libusb" in str(error) else ""
        raise UsageError(f"a RealSense camera: pyrealsense2 cannot be loaded: {error}{hint}") from None
    return pyrealsense2


@contextlib.contextmanager
def opening(who: str) -> Iterator[None]:
    """The SDK raises RuntimeError, at any question to a camera that comes or goes: here it becomes a
    ShareError that names `who`, in one line."""
    try:
        yield
    except RuntimeError as error:
        reason, mend = str(error).partition("\n")[0], "plug it in anew, or ask `share doctor`"
        raise ShareError(f"{who}: cannot be opened: {reason}; {mend}") from None
