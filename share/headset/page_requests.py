"""Who is served what over HTTP: the page's files, by name, to a browser that came by a name of this machine.

A page of another origin opens no WebSocket here, nor does a page that reaches this machine under a name of
its own (DNS rebinding): that cannot be an address in digits. Sources: RFC 6454 (origin), RFC 9110 (host),
Content Security Policy Level 3.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path

from share.files.reading import MB, read_bytes
from share.headset.page_joining import inline_sources, joined_html, joined_module

FOLDER = Path(__file__).with_name("page")
MODULE = "main.js"
ROOM_PATH = "/room"
_MAX_FILE_BYTES = 2 * MB
_HOST = re.compile(r"[\w.:%-]+|\[[\w.:%-]+\]", re.ASCII)
_NAME = re.compile(r"[a-z\d][a-z\d_-]{0,60}\.[a-z\d]{2,6}")
_TYPES = {
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
    "png": "image/png",
    "json": "application/json",
}


@dataclass(frozen=True)
class PageAnswer:
    """An answer to a request."""

    status: HTTPStatus
    media_type: str
    body: bytes


def _line(status: HTTPStatus, text: str) -> PageAnswer:
    return PageAnswer(status, "text/plain; charset=utf-8", f"{text}\n".encode())


def read_page(folder: Path = FOLDER) -> dict[str, PageAnswer]:
    """Return the files of the page, by path; its HTML and its module joined (`page_joining`). Raises OSError,
    ValueError."""
    files = {
        one.name: read_bytes(one, _MAX_FILE_BYTES)
        for one in sorted(folder.iterdir() if folder.is_dir() else ())
        if _NAME.fullmatch(one.name) and one.suffix[1:] in _TYPES and one.is_file() and not one.is_symlink()
    }
    texts = {name: data.decode() for name, data in files.items() if name.endswith((".html", ".css", ".js"))}
    if MODULE in files:
        files[MODULE] = joined_module(MODULE, texts).encode()
    if "index.html" in files:
        files[""] = files["index.html"] = joined_html(texts["index.html"], texts).encode()
    kind_of = {name: _TYPES[name.rpartition(".")[2] or "html"] for name in files}
    return {f"/{name}": PageAnswer(HTTPStatus.OK, kind_of[name], data) for name, data in files.items()}


def own_names(host: str, further: Collection[str] = ()) -> frozenset[str]:
    """Return the names under which this machine may be asked for. host: that is listened on. further: of a
    certificate."""
    name = socket.gethostname().lower()
    return frozenset({"localhost", name, f"{name}.local", host.lower(), *(one.lower() for one in further)})


class PageGuard:
    """Answers requests. scheme: of the page's own address. names: as from `own_names`."""

    def __init__(self, scheme: str, names: Collection[str], files: Mapping[str, PageAnswer]) -> None:
        self._scheme, self._names, self._files = scheme, frozenset(names), files
        html = files["/"].body if "/" in files else b""
        self._scripts, self._styles = (
            " ".join(["'self'", *inline_sources(html, kind)]) for kind in ("script", "style")
        )

    def answer(self, target: str, headers: Mapping[str, str], is_upgrade: bool) -> PageAnswer | None:
        """Return the answer to a request; None: it may become a WebSocket. headers: by name in lower case."""
        host, origin = headers.get("host"), headers.get("origin")
        if host is None or not self._is_own(host):
            text = "only requests for a name or address of this machine are served"
            return _line(HTTPStatus.FORBIDDEN, text)
        is_same = origin is not None and origin.lower() == f"{self._scheme}://{host.lower()}"
        if (origin is not None or is_upgrade) and not is_same:
            return _line(HTTPStatus.FORBIDDEN, "only the page of this server may connect")
        path = target.partition("?")[0]
        if is_upgrade:
            return None if path == ROOM_PATH else _line(HTTPStatus.NOT_FOUND, "there is no such room")
        return self._files.get(path) or _line(HTTPStatus.NOT_FOUND, "there is no such page")

    def _is_own(self, host: str) -> bool:
        """host: a name or address, with or without a port."""
        name, colon, port = host.rpartition(":")
        name = (name if colon and port.isdecimal() else host).lower()
        if name in self._names:
            return True
        if not _HOST.fullmatch(name):  # an address may have any text after a "%"
            return False
        try:
            ip_address(name[1:-1] if name.startswith("[") and name.endswith("]") else name)
        except ValueError:
            return False
        return True

    def headers(self, host: str) -> dict[str, str]:
        """Return the headers of every answer. host: as the request names it."""
        socket_origin = f"{'wss' if self._scheme == 'https' else 'ws'}://{host}" if self._is_own(host) else ""
        policy = [
            "default-src 'none'",
            f"script-src {self._scripts}",
            f"style-src {self._styles}",
            "img-src 'self' data:",
            f"connect-src 'self' {socket_origin}".rstrip(),
            *("base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"),
        ]
        return {
            "Cache-Control": "no-store",
            "Content-Security-Policy": "; ".join(policy),
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Permissions-Policy": "xr-spatial-tracking=(self), camera=(), microphone=(), geolocation=()",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
        }
