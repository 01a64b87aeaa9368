"""What pages measure, as a table (docs/lookup/files.md#headsetcsv) and for the edge's report."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from typing import Any

import msgspec

from share.errors import UsageError
from share.files.writing import open_new
from share.headset.page_messages import PageMeasured
from share.timing import TokenBuckets

HEADSET_TABLE = "headset.csv"
FIELDS = PageMeasured.__struct_fields__
COLUMNS = ("t_s", "wearer", "agent", *FIELDS)
_LIMIT = (4.0, 1.0)  # rows at once, and a second, of a wearer: pages send one each two seconds
_MAX_ROWS = 10**6  # 100 MB: days of two wearers


def begin_table(path: Path) -> Path:
    """Make a table without rows, in the place of an old one. Raises UsageError."""
    try:
        with open_new(path) as file:
            file.write((",".join(COLUMNS) + "\r\n").encode())
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    return path


class MeasureTable:
    """Adds rows as they come to a table that has been begun. path: None: there is none. After the first
    failure of the disk it writes no more. Raises OSError."""

    def __init__(self, path: Path | None) -> None:
        self._file: io.TextIOWrapper | None = None
        if path is not None:
            handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC)
            self._file = io.TextIOWrapper(os.fdopen(handle, "wb"), "utf-8", newline="")
        self._rows, self._limits = 0, TokenBuckets(*_LIMIT)

    def add(self, t_s: float, wearer: str, agent: str | None, measured: PageMeasured, now_ns: int) -> str:
        """Write a row. t_s: since the start. Return why no more can be written, else ""."""
        if self._file is None or not self._limits.bucket(wearer, now_ns).take(now_ns):
            return ""
        values = (getattr(measured, name) for name in FIELDS)
        try:
            row = (round(t_s, 3), wearer, agent or "", *("" if v is None else v for v in values))
            csv.writer(self._file).writerow(row)
            self._file.flush()
        except OSError as error:
            self._file = None
            return f"{HEADSET_TABLE}: cannot be written: {error.strerror}; what pages measure is not kept"
        self._rows += 1
        if self._rows >= _MAX_ROWS:
            self._file.close()
            self._file = None
            return f"{HEADSET_TABLE}: has {_MAX_ROWS} rows, its limit"
        return ""


class ServerReport(msgspec.Struct, omit_defaults=True):
    """What the server tells its edge: a line for a person, or how it stands."""

    line: str = ""
    code: str = ""
    wrong_codes: int = 0
    pages: int = 0
    wearers: dict[str, dict[str, Any]] = {}


def encode_report(report: ServerReport) -> bytes:
    return msgspec.json.encode(report)


def measured_fields(measured: PageMeasured | None) -> dict[str, Any]:
    """Return what a page measured last, for the report; null before."""
    return {name: None if measured is None else getattr(measured, name) for name in FIELDS}
