"""What the edge is doing, over HTTP: health, metrics, the report, and a page for people (docs/status.md)."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from share.runtime import status_metrics
from share.runtime.status_page import PAGE
from share.runtime.web import Answer, WebServer, line

KEPT_S = 0.1  # an answer is given again so long: however many ask, the edge is asked ten times a second


class StatusServer:
    """Serves at `address`, HOST:PORT or a PORT of this machine alone, until closed.

    report: the edge's report as in edge.json, and of now `trouble`, a list of what is wrong, `last_solve_s`
    and `uptime_s`, so far as there are such. It is called from the server's own thread; if it fails, that
    is answered, and told once. Raises UsageError or TransportError as `WebServer`.
    """

    def __init__(
        self,
        address: str,
        report: Callable[[], dict[str, Any]],
        tell: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
    ) -> None:
        self._ask, self._tell = report, tell
        self._began = time.monotonic()
        self._kept: dict[str, tuple[float, Answer]] = {}
        self._failed = False
        self._server = WebServer(address, self._answer)

    @property
    def endpoint(self) -> str:
        """HOST:PORT really bound."""
        return self._server.endpoint

    def close(self) -> None:
        """Frees the address. May be repeated."""
        self._server.close()

    def _answer(self, path: str) -> Answer:
        if path == "/":
            return _PAGE
        if path not in _REPORTS:
            return line(HTTPStatus.NOT_FOUND, f"there are / {' '.join(_REPORTS)}")
        made, answer = self._kept.get(path, (-KEPT_S, None))
        if answer is None or time.monotonic() - made > KEPT_S:
            answer = self._made(path)
            self._kept[path] = time.monotonic(), answer
        return answer

    def _made(self, path: str) -> Answer:
        try:
            return _REPORTS[path]({"uptime_s": round(time.monotonic() - self._began, 3), **self._ask()})
        except Exception as error:  # whatever is wrong with a report, the edge goes on
            text = " ".join(f"no report: {type(error).__name__}: {error}".split())
            if not self._failed:
                self._tell(f"status: {text}")
            self._failed = True
            return line(HTTPStatus.INTERNAL_SERVER_ERROR, text)


def _health(report: dict[str, Any]) -> Answer:
    """503 where something is wrong, for whoever restarts or balances and does not read on."""
    trouble = list(report.get("trouble") or ())
    agents = report.get("agents", {}).items()
    health: dict[str, Any] = {
        "status": "trouble" if trouble else "ok",
        "trouble": trouble,
        "refused": list(report.get("refused") or ()),
        "agents": sorted(name for name, agent in agents if not agent.get("gone")),
        **{key: report[key] for key in ("uptime_s", "waiting", "last_solve_s") if key in report},
    }
    return _json(HTTPStatus.SERVICE_UNAVAILABLE if trouble else HTTPStatus.OK, health)


def _metrics(report: dict[str, Any]) -> Answer:
    body, media_type = status_metrics.text(report)
    return Answer(HTTPStatus.OK, media_type, body)


def _snapshot(report: dict[str, Any]) -> Answer:
    return _json(HTTPStatus.OK, report)


def _json(status: HTTPStatus, value: Any) -> Answer:
    """Raises ValueError where a number is not finite: that is no JSON."""
    return Answer(status, "application/json", json.dumps(value, allow_nan=False).encode() + b"\n")


_PAGE = Answer(HTTPStatus.OK, "text/html; charset=utf-8", PAGE.encode())
_REPORTS = {"/health": _health, "/metrics": _metrics, "/snapshot.json": _snapshot}
