"""Errors that reach a person. `share.cli.main` turns them into one line and an exit code."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path


class ShareError(Exception):
    """A failure that one line describes: what is wrong and how to repair it. Exit code 1."""

    exit_code = 1


class UsageError(ShareError):
    """Wrong use: an argument or path that cannot be used (no such folder, bad address). Exit code 2."""

    exit_code = 2


class NotAttachedError(UsageError):
    """A device is not attached at the moment."""


class ConfigError(UsageError):
    """A configuration or calibration file has invalid content."""


class DataError(ShareError):
    """A recording is damaged or does not fit its calibration."""


class CalibrationMismatchError(DataError):
    """The whole recording does not fit its calibration, not just one image: do not read on."""


class WireError(ShareError):
    """Bytes of a peer that are no valid message. The receiver counts them; never fatal."""


class VersionError(WireError):
    """A message of another wire version. code: its message code; None if unreadable."""

    def __init__(self, version: int, code: int | None, own_version: int) -> None:
        super().__init__(
            f"header: peer speaks wire {version}, this SHARE wire {own_version}: upgrade the older one"
        )
        self.version, self.code = version, code


class TransportError(ShareError):
    """A socket cannot be opened or used (port in use, address not local)."""


class StoreError(ShareError):
    """A map file cannot be opened, read or written."""


def printable(text: str) -> str:
    """Return `text` with "?" for each character that is not printable."""
    return "".join(c if c.isprintable() else "?" for c in text)


def describe_exception(error: BaseException) -> str:
    """Return one line on an unexpected exception: its type, its text, and where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = printable(str(error))[:200]
    return f"{type(error).__name__}: {text}{where}"


def brief_reason(error: Exception) -> str:
    """Return the line of a ShareError, of any other exception `describe_exception`."""
    return str(error) if isinstance(error, ShareError) else describe_exception(error)


def install_hint(packages: str, extra: str) -> str:
    """Return a line on how to install missing `packages` by an extra of SHARE; not possible in a frozen
    program."""
    how = f"pip install 'share-slam[{extra}]', in a checkout .venv/bin/pip install -e '.[{extra}]'"
    if getattr(sys, "frozen", False):
        return f"this frozen program has no {packages}; use a computer with Python: {how}"
    return f"{packages} {'are' if ',' in packages else 'is'} not installed: {how}"


_MAX_LINE_LENGTH = 1500  # characters


def one_line(text: str) -> str:
    """Return `text`, which quotes a foreign file, without control characters and of limited length."""
    clean = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    if len(clean) <= _MAX_LINE_LENGTH:
        return clean
    return f"{clean[: _MAX_LINE_LENGTH // 2]} … {clean[-_MAX_LINE_LENGTH // 2 :]}"
