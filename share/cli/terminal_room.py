"""Where there is a terminal: the room as text, drawn over itself twice a second (`TerminalPicture`)."""

from __future__ import annotations

import json
import shutil
import sys
from http.client import HTTPException
from typing import Any
from urllib.request import ProxyHandler, build_opener

from share.cli.terminal import LiveLine
from share.view.terminal_picture import MIN_COLUMNS, MIN_ROWS, TerminalPicture

_TIMEOUT_S = 0.4
_MAX_ANSWER = 2**22


class TerminalRoom:
    """Draws what the edge at `status` says over `live`. status: http://HOST:PORT/ of its status page."""

    def __init__(self, live: LiveLine, status: str) -> None:
        self._live, self._status = live, status
        self._picture, self._is_drawn = TerminalPicture(), False
        self._opener = build_opener(ProxyHandler({}))

    def show(self, below: str) -> bool:
        """Draw the room as it is now, and a line below. Return False if the edge does not answer."""
        size = shutil.get_terminal_size()
        try:
            report, plan = self._get("snapshot.json"), self._get("plan.json")
            lines = self._picture.lines(report, plan, size.columns - 1, size.lines - 2)
        except (OSError, HTTPException, ValueError):
            return self._is_drawn
        self._is_drawn = True
        self._live.write_block([*lines, below[: size.columns - 1]])
        return True

    def _get(self, name: str) -> Any:
        with self._opener.open(self._status + name, timeout=_TIMEOUT_S) as answer:
            return json.loads(answer.read(_MAX_ANSWER))


def has_room(live: LiveLine) -> bool:
    """Return whether somebody looks at a terminal that is large enough and knows the characters."""
    size = shutil.get_terminal_size(fallback=(0, 0))
    speaks = (getattr(sys.stderr, "encoding", None) or "").lower().replace("-", "") == "utf8"
    is_seen = live.is_terminal and sys.stdout.isatty() and speaks
    return is_seen and size.columns >= MIN_COLUMNS and size.lines >= MIN_ROWS
