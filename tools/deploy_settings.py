"""Settings of a service, /etc/share/SERVICE.env, as systemd reads them (systemd.exec(5))."""

from __future__ import annotations

import re
from collections.abc import Mapping

from share.errors import UsageError

_LINE = re.compile(r"([A-Z_]+)=(.*)")
_PLAIN = re.compile(r"[\w@%+=:,./ -]*", re.ASCII)  # nothing that systemd would quote, continue or expand


def merged(text: str, given: Mapping[str, str | None], defaults: Mapping[str, str]) -> str:
    """Return `text` with all `given` values that are not None, and `defaults` for missing ones.

    Other lines stay as they are. Raises UsageError for a value that is not plain text.
    """
    wanted = {key: value for key, value in given.items() if value is not None}
    for key, value in wanted.items():
        if not _PLAIN.fullmatch(value):
            raise UsageError(
                f"{key.lower()} '{value}': has characters that are not allowed in a settings file"
            )
    lines = [_put(line, wanted) for line in text.splitlines()]
    there = {match[1] for line in lines if (match := _LINE.fullmatch(line))}
    missing = {key: value for key, value in {**defaults, **wanted}.items() if key not in there}
    return "".join(f"{line}\n" for line in [*lines, *(f"{k}={v}" for k, v in missing.items())])


def _put(line: str, wanted: Mapping[str, str]) -> str:
    match = _LINE.fullmatch(line)
    return f"{match[1]}={wanted[match[1]]}" if match and match[1] in wanted else line
