"""Where there is a terminal: the room as text, drawn over itself, from an edge's status page."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from socket import SHUT_RDWR, socket
from threading import Timer
from typing import Any
from urllib.parse import urlsplit

from share.cli.terminal import LiveLine
from share.errors import ShareError, printable
from share.files.json_file import parse_json
from share.view.terminal_picture import MIN_COLUMNS, MIN_ROWS, TerminalPicture

_TIMEOUT_S = 0.4
_MAX_ANSWER = 2**22


class EdgeStatus:
    """Reads the status page at `address`, http://HOST:PORT/.

    token: as in `share edge --http-token`; it goes to that address alone, so no redirection is followed, and
    no proxy asked. timeout_s: of a whole answer.
    """

    def __init__(self, address: str, token: str | None = None, timeout_s: float = _TIMEOUT_S) -> None:
        self._address, self._timeout_s = address, timeout_s
        self._headers = {} if token is None else {"Authorization": f"Bearer {token}"}

    def report_and_plan(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what the edge reports and its plan of paths. Raises ShareError if it does not answer."""
        try:
            return self._get("snapshot.json"), self._get("plan.json")
        except (OSError, HTTPException) as error:
            said = getattr(error, "strerror", None) or str(error) or type(error).__name__
            reason = printable(said[:1].lower() + said[1:])
            raise ShareError(f"{self._address} does not answer: {reason}") from None
        except ValueError:  # no JSON, or more than is read
            raise ShareError(f"{self._address}: what answers there is no edge's status page") from None

    def _get(self, name: str) -> dict[str, Any]:
        where = urlsplit(self._address)
        with closing(HTTPConnection(where.hostname or "", where.port, timeout=self._timeout_s)) as connection:
            connection.connect()
            with _deadline(connection.sock, self._timeout_s):
                connection.request("GET", f"/{name}", headers=self._headers)
                with connection.getresponse() as answer:
                    if answer.status != HTTPStatus.OK:
                        raise ShareError(f"{self._address}: {_refusal(answer.status)}")
                    content = answer.read(_MAX_ANSWER)
        fields = parse_json(content)
        if not isinstance(fields, dict) or not isinstance(fields.get("agents", {}), dict):
            raise ValueError(name)
        return fields


@contextmanager
def _deadline(connection: socket, seconds: float) -> Iterator[None]:
    """End a connection if its other side takes longer, even if it keeps sending."""
    timer = Timer(seconds, partial(_shut_down, connection))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _shut_down(connection: socket) -> None:
    with suppress(OSError):  # it has ended
        connection.shutdown(SHUT_RDWR)


def _refusal(status: int) -> str:
    if status == HTTPStatus.UNAUTHORIZED:
        return "it asks for a token: give the edge's file with --http-token FILE"
    if status in (HTTPStatus.FORBIDDEN, HTTPStatus.INTERNAL_SERVER_ERROR):
        return f"it answers {status}"
    return "what answers there is no edge's status page"


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
    live.write_block([*lines, printable(below[: shutil.get_terminal_size().columns - 1])])


def room_lines(
    picture: TerminalPicture, report: dict[str, Any], plan: dict[str, Any], rows: int | None = None
) -> list[str]:
    """Return the room as lines as wide as the terminal, and no more than `rows` (default: that fit it).

    Raises ShareError for a report of another release."""
    size = shutil.get_terminal_size()
    with reading_report():
        return picture.lines(report, plan, size.columns - 1, rows or size.lines - 2)


@contextmanager
def reading_report() -> Iterator[None]:
    """Turn what goes wrong with fields of a report into a ShareError."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        raise ShareError("the edge's report cannot be drawn: it is of another release of SHARE") from None


def has_room(live: LiveLine) -> bool:
    """Return whether somebody looks at a terminal that is large enough and knows the characters."""
    size = shutil.get_terminal_size(fallback=(0, 0))
    speaks = (getattr(sys.stderr, "encoding", None) or "").lower().replace("-", "") == "utf8"
    is_seen = live.is_terminal and sys.stdout.isatty() and speaks
    return is_seen and size.columns >= MIN_COLUMNS and size.lines >= MIN_ROWS
