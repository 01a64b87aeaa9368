"""Where there is a terminal: the room as text, drawn over itself, from an edge's status page."""

from __future__ import annotations

import json
import shutil
import sys
from http.client import HTTPException
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import ProxyHandler, Request, build_opener

from share.cli.terminal import LiveLine
from share.errors import ShareError, printable
from share.view.terminal_picture import MIN_COLUMNS, MIN_ROWS, TerminalPicture

_TIMEOUT_S = 0.4
_MAX_ANSWER = 2**22


class EdgeStatus:
    """Reads the status page at `address`, http://HOST:PORT/. token: as in `share edge --http-token`."""

    def __init__(self, address: str, token: str | None = None, timeout_s: float = _TIMEOUT_S) -> None:
        self._address, self._timeout_s = address, timeout_s
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._opener = build_opener(ProxyHandler({}))

    def report_and_plan(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what the edge reports and its plan of paths. Raises ShareError if it does not answer."""
        try:
            report, plan = self._get("snapshot.json"), self._get("plan.json")
        except HTTPError as error:
            with error:  # closes the connection
                raise ShareError(f"{self._address}: {_refusal(error)}") from None
        except URLError as error:
            raise ShareError(f"{self._address} does not answer: {printable(str(error.reason))}") from None
        except (OSError, HTTPException) as error:
            raise ShareError(f"{self._address} does not answer: {printable(str(error))}") from None
        except ValueError:  # no JSON, or more than is read
            raise ShareError(f"{self._address}: what answers there is no edge's status page") from None
        if not all(
            isinstance(part, dict) and isinstance(part.get("agents", {}), dict) for part in (report, plan)
        ):
            raise ShareError(f"{self._address}: what answers there is no edge's status page")
        return report, plan

    def _get(self, name: str) -> Any:
        request = Request(self._address + name, headers=self._headers)
        with self._opener.open(request, timeout=self._timeout_s) as answer:
            return json.loads(answer.read(_MAX_ANSWER))


def _refusal(error: HTTPError) -> str:
    if error.code == 401:
        return "it asks for a token: give the edge's file with --http-token FILE"
    if error.code == 404:
        return "what answers there is no edge's status page"
    return printable(f"it answers {error.code} {error.reason}")


class TerminalRoom:
    """Draws what the edge at `status` says over `live`. status: http://HOST:PORT/ of its status page."""

    def __init__(self, live: LiveLine, status: str) -> None:
        self._live, self._status = live, EdgeStatus(status)
        self._picture, self._is_drawn = TerminalPicture(), False

    def show(self, below: str) -> bool:
        """Draw the room as it is now, and a line below. Return False if the edge never answered."""
        try:
            report, plan = self._status.report_and_plan()
            draw_room(self._live, self._picture, report, plan, below)
        except ShareError:
            return self._is_drawn
        self._is_drawn = True
        return True


def draw_room(
    live: LiveLine, picture: TerminalPicture, report: dict[str, Any], plan: dict[str, Any], below: str
) -> None:
    """Draw the room and a line below over what was drawn before. Raises ShareError as `room_lines`."""
    lines = room_lines(picture, report, plan)
    live.write_block([*lines, below[: shutil.get_terminal_size().columns - 1]])


def room_lines(picture: TerminalPicture, report: dict[str, Any], plan: dict[str, Any]) -> list[str]:
    """Return the room as lines that fit the terminal. Raises ShareError for a report of another release."""
    size = shutil.get_terminal_size()
    try:
        return picture.lines(report, plan, size.columns - 1, size.lines - 2)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        raise ShareError("the edge's report cannot be drawn: it is of another release of SHARE") from None


def has_room(live: LiveLine) -> bool:
    """Return whether somebody looks at a terminal that is large enough and knows the characters."""
    size = shutil.get_terminal_size(fallback=(0, 0))
    speaks = (getattr(sys.stderr, "encoding", None) or "").lower().replace("-", "") == "utf8"
    is_seen = live.is_terminal and sys.stdout.isatty() and speaks
    return is_seen and size.columns >= MIN_COLUMNS and size.lines >= MIN_ROWS
