"""The edge's status over HTTP: health, metrics, report, plan and a status page (docs/lookup/status.md)."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from share.runtime.edge_metrics import render_metrics
from share.runtime.status_page import status_page
from share.runtime.web import Response, WebServer, text_response

CACHE_S = 0.1  # lifetime of a response: any number of clients costs the edge ten reports a second


class StatusServer:
    """Serves at `address`, HOST:PORT or a PORT of this machine alone, until closed.

    report: returns the edge's report as in edge.json, with current problems as `trouble`, `last_solve_s` and
    `uptime_s` where known. Called from the server's thread; if it fails, the response says so, and `notify`
    is called once. token: as in `WebServer`. plan: returns /plan.json, as `RoomPlan.report`. Raises
    UsageError or TransportError like it.
    """

    def __init__(
        self,
        address: str,
        report: Callable[[], dict[str, Any]],
        notify: Callable[[str], None] = lambda text: print(text, file=sys.stderr),
        token: str | None = None,
        plan: Callable[[], dict[str, Any]] = lambda: {"agents": {}},
    ) -> None:
        self._get_report, self._get_plan, self._notify = report, plan, notify
        self._start_s = time.monotonic()
        self._cache: dict[str, tuple[float, Response]] = {}
        self._failed = False
        self._server = WebServer(address, self._respond, token)

    @property
    def endpoint(self) -> str:
        """The bound HOST:PORT."""
        return self._server.endpoint

    def close(self) -> None:
        """Free the address. May be repeated."""
        self._server.close()

    def _respond(self, path: str) -> Response:
        if path == "/":
            return _PAGE
        if path not in (*_REPORTS, _PLAN):
            available = " ".join(("/", *_REPORTS, _PLAN))
            return text_response(HTTPStatus.NOT_FOUND, f"not found; available: {available}")
        cached_s, response = self._cache.get(path, (-CACHE_S, None))
        if response is None or time.monotonic() - cached_s > CACHE_S:
            response = self._render(path)
            self._cache[path] = time.monotonic(), response
        return response

    def _render(self, path: str) -> Response:
        try:
            if path == _PLAN:
                return _json(HTTPStatus.OK, self._get_plan())
            return _REPORTS[path](
                {"uptime_s": round(time.monotonic() - self._start_s, 3), **self._get_report()}
            )
        except Exception as error:  # a faulty report must not end the edge
            text = " ".join(f"no report: {type(error).__name__}: {error}".split())
            if not self._failed:
                self._notify(f"status: {text}")
            self._failed = True
            return text_response(HTTPStatus.INTERNAL_SERVER_ERROR, text)


def _health(report: dict[str, Any]) -> Response:
    """Return health as JSON; with status 503 if the edge is in trouble, for monitors that read only the
    status. An agent's trouble does not count there: else a peer could have the edge restarted. Nor does
    what the map has lost: a restart would not bring it back."""
    return _json(_status_of(report.get("trouble")), _health_report(report))


def _agents_health(report: dict[str, Any]) -> Response:
    """Return the same, with status 503 if the edge or an agent is in trouble."""
    return _json(_status_of(report.get("trouble") or report.get("agent_trouble")), _health_report(report))


def _status_of(trouble: Any) -> HTTPStatus:
    return HTTPStatus.SERVICE_UNAVAILABLE if trouble else HTTPStatus.OK


def _health_report(report: dict[str, Any]) -> dict[str, Any]:
    trouble, agent_trouble = (list(report.get(key) or ()) for key in ("trouble", "agent_trouble"))
    degraded = list(report.get("degraded") or ())
    agents = report.get("agents", {}).items()
    return {
        "status": "trouble" if trouble or agent_trouble else "degraded" if degraded else "ok",
        "trouble": trouble,
        "degraded": degraded,
        "agent_trouble": agent_trouble,
        "refused": list(report.get("refused") or ()),
        "agents": sorted(name for name, agent in agents if not agent.get("gone")),
        **{key: report[key] for key in ("uptime_s", "waiting", "last_solve_s", "loading") if key in report},
    }


def _metrics(report: dict[str, Any]) -> Response:
    body, media_type = render_metrics(report)
    return Response(HTTPStatus.OK, media_type, body)


def _snapshot(report: dict[str, Any]) -> Response:
    return _json(HTTPStatus.OK, report)


def _json(status: HTTPStatus, value: Any) -> Response:
    """Raises ValueError for a number that is not finite, which JSON cannot express."""
    return Response(status, "application/json", json.dumps(value, allow_nan=False).encode() + b"\n")


_PAGE = Response(HTTPStatus.OK, "text/html; charset=utf-8", status_page())
_REPORTS = {
    "/health": _health,
    "/health/agents": _agents_health,
    "/metrics": _metrics,
    "/snapshot.json": _snapshot,
}
_PLAN = "/plan.json"
