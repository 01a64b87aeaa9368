"""Errors that reach a person. One place (`share.cli.main`) turns them into a line and an exit code."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path


class ShareError(Exception):
    """A failure that can be said in one line: what is wrong and how to mend it. Exit code 1."""

    exit_code = 1


class UsageError(ShareError):
    """What the user typed or pointed at cannot be used (no such folder, bad address). Exit code 2."""

    exit_code = 2


class NotAttachedError(UsageError):
    """A device that is not plugged in, or not at the moment."""


class ConfigError(UsageError):
    """A configuration or calibration file says something that SHARE does not understand."""


class DataError(ShareError):
    """A recording is damaged or does not fit its calibration."""


class CalibrationMismatchError(DataError):
    """Not one image but the recording as a whole does not fit its calibration: reading on is no use."""


class WireError(ShareError):
    """Bytes from a peer that are not a valid message. Counted by the receiver, never fatal."""


class VersionError(WireError):
    """A message of another version of the wire. code: of its kind, None where that cannot be read."""

    def __init__(self, version: int, code: int | None, own_version: int) -> None:
        super().__init__(
            f"header: peer speaks wire {version}, this SHARE wire {own_version}: upgrade the older one"
        )
        self.version, self.code = version, code


class TransportError(ShareError):
    """A socket cannot be opened or used (port in use, address not local)."""


class StoreError(ShareError):
    """The file of a map cannot be opened, read or written."""


def describe_exception(error: BaseException) -> str:
    """One line on an exception that nobody expected: its kind, its text, and where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = "".join(c if c.isprintable() else "?" for c in str(error))[:200]
    return f"{type(error).__name__}: {text}{where}"


def install_hint(packages: str, extra: str) -> str:
    """Who wants `packages` is told how to get them: with an extra of SHARE, and not in a frozen program."""
    how = f"pip install 'share-slam[{extra}]', in a checkout .venv/bin/pip install -e '.[{extra}]'"
    if getattr(sys, "frozen", False):
        return f"this frozen program has no {packages}; use a computer with Python: {how}"
    return f"{packages} is not installed: {how}"


def one_line(text: str) -> str:
    """A message that quotes somebody's file: without control characters, of a bearable length."""
    clean = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return (
        clean
        if len(clean) <= _MAX_LINE_LENGTH
        else f"{clean[: _MAX_LINE_LENGTH // 2]} … {clean[-_MAX_LINE_LENGTH // 2 :]}"
    )


_MAX_LINE_LENGTH = 1500  # characters
