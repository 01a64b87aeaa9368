"""A small single-threaded HTTP server for few clients, which cannot hold up the process that it runs in.

A connection carries one GET or HEAD request without a body, or where it is wanted a small POST, and its
response (RFC 9110, 9112). The thread uses at most a fifth of a core whatever clients do: it sleeps four times
as long as it has worked.
"""

from __future__ import annotations

import contextlib
import re
import selectors
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from email.utils import formatdate
from http import HTTPStatus

from share.net.http_guard import HttpGuard, http_address, listen

MAX_CONNECTIONS = 16  # at a time; one more closes the oldest
MAX_REQUEST_BYTES = 8192
CLIENT_TIMEOUT_S = 5.0  # for the request, and again for the response
_LINGER_S = 1.0  # input is read so long after the response; a reset would destroy the response
_MAX_SLEEP_S = 0.1  # after work, and when no socket is left
_SLEEP_RATIO = 4.0  # sleep per CPU time

_READS = ("GET", "HEAD")
_REQUEST = re.compile(r"([A-Z]+) (\S+) HTTP/1\.[01]")
_HEADERS = (
    "Cache-Control: no-store",
    "Connection: close",
    "Content-Security-Policy: default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy: same-origin",
    "X-Content-Type-Options: nosniff",
)


@dataclass(frozen=True)
class Response:
    """An HTTP response."""

    status: HTTPStatus
    media_type: str
    body: bytes
    headers: tuple[str, ...] = ()  # further lines

    def encode(self, with_body: bool) -> bytes:
        """Return the bytes on the wire."""
        allow = [f"Allow: {', '.join(_READS)}"] if self.status is HTTPStatus.METHOD_NOT_ALLOWED else []
        head = [
            f"HTTP/1.1 {self.status.value} {self.status.phrase}",
            f"Date: {formatdate(usegmt=True)}",
            f"Content-Type: {self.media_type}",
            f"Content-Length: {len(self.body)}",
            *_HEADERS,
            *allow,
            *self.headers,
        ]
        return "\r\n".join([*head, "", ""]).encode() + (self.body if with_body else b"")


def text_response(status: HTTPStatus, text: str, headers: tuple[str, ...] = ()) -> Response:
    """Return a response of one line of plain text."""
    return Response(status, "text/plain; charset=utf-8", f"{text}\n".encode(), headers)


class WebServer:
    """Listens on HOST:PORT, or on PORT of this machine alone; port 0 takes a free one. `handler` is called
    with a path, from the server's thread, and must not raise. token: see `HttpGuard`. on_post: the same with
    the body of a POST from a page of this server; None: there are none. option: that gives the address.

    Raises UsageError for a malformed address, or one that others reach without a token; TransportError if it
    cannot be bound.
    """

    def __init__(
        self,
        address: str,
        handler: Callable[[str], Response],
        token: str | None = None,
        on_post: Callable[[str, bytes], Response] | None = None,
        option: str = "--http",
    ) -> None:
        self._handler, self._on_post = handler, on_post
        self._listener, bound = listen(http_address(option, address, token))
        self._guard = HttpGuard(bound, token)
        self._wake_sender, self._wake_receiver = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._wake_receiver, selectors.EVENT_READ)
        self._clients: list[_HttpConnection] = []  # oldest first
        self._cpu_s = 0.0  # CPU time of the thread so far
        self._thread = threading.Thread(target=self._serve, name="web", daemon=True)
        self.endpoint = str(bound).removeprefix("tcp://")
        self._thread.start()

    def close(self) -> None:
        """Free the address. May be repeated."""
        with contextlib.suppress(OSError):
            self._wake_sender.send(b"!")
        self._thread.join(timeout=CLIENT_TIMEOUT_S)
        self._wake_sender.close()

    def _serve(self) -> None:
        try:
            while self._step():
                self._throttle()
        finally:
            for client in list(self._clients):
                self._drop(client)
            self._selector.close()
            self._listener.close()
            self._wake_receiver.close()

    def _throttle(self) -> None:
        cpu_s, self._cpu_s = time.thread_time() - self._cpu_s, time.thread_time()
        time.sleep(min(_SLEEP_RATIO * cpu_s, _MAX_SLEEP_S))

    def _step(self) -> bool:
        """Wait for clients and serve those that are ready. Return False once closed."""
        next_deadline = min((client.deadline for client in self._clients), default=None)
        wait_s = None if next_deadline is None else max(next_deadline - time.monotonic(), 0.0)
        for key, _ in self._selector.select(wait_s):
            if key.fileobj is self._wake_receiver:
                return False
            if key.fileobj is self._listener:
                self._accept()
            elif key.data in self._clients:
                self._advance(key.data)
        for client in [c for c in self._clients if c.deadline <= time.monotonic()]:
            self._drop(client)
        return True

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError:
            time.sleep(_MAX_SLEEP_S)
            return
        connection.setblocking(False)
        if len(self._clients) == MAX_CONNECTIONS:
            self._drop(self._clients[0])
        client = _HttpConnection(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _advance(self, client: _HttpConnection) -> None:
        try:
            events = client.advance(self._respond)
        except Exception:  # the client has gone, or its request is malformed: only its connection ends
            events = 0
        if events:
            self._selector.modify(client.socket, events, client)
        else:
            self._drop(client)

    def _drop(self, client: _HttpConnection) -> None:
        self._clients.remove(client)
        self._selector.unregister(client.socket)
        client.socket.close()

    def _respond(self, request: bytes) -> bytes:
        if len(request) > MAX_REQUEST_BYTES:
            text = f"the request is larger than {MAX_REQUEST_BYTES} bytes"
            return text_response(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, text).encode(True)
        head, body = _parts(request)
        first, _, rest = head.partition("\n")
        match = _REQUEST.fullmatch(first)
        if match is None:
            return text_response(HTTPStatus.BAD_REQUEST, "not an HTTP/1.1 request").encode(True)
        method, path = match[1], match[2].partition("?")[0]
        fields = _header_fields(rest)
        refusal = self._guard.check(match[2], fields)
        on_post = self._on_post if method == "POST" else None
        if method not in _READS and on_post is None:
            response = text_response(HTTPStatus.METHOD_NOT_ALLOWED, "only GET and HEAD are allowed")
        elif refusal is not None:
            response = text_response(refusal.status, refusal.text, refusal.headers)
        elif (
            on_post is not None and "origin" not in fields
        ):  # browsers send it; by it other pages are refused
            response = text_response(HTTPStatus.FORBIDDEN, "only the page of this server may send")
        elif on_post is not None:
            response = on_post(path, body)
        else:
            response = self._handler(path)
        return response.encode(method != "HEAD")


@dataclass(eq=False)
class _HttpConnection:
    """One connection: reads a request, sends the response, closes."""

    socket: socket.socket
    deadline: float = field(default_factory=lambda: time.monotonic() + CLIENT_TIMEOUT_S)
    _request: bytearray = field(default_factory=bytearray)
    _response: memoryview | None = None

    def advance(self, respond: Callable[[bytes], bytes]) -> int:
        """Return the selector events to wait for next, 0 at the end. Raises OSError if the client has
        gone."""
        if self._response is None:
            return self._read_request(respond)
        if not self._response:
            return selectors.EVENT_READ if self.socket.recv(MAX_REQUEST_BYTES) else 0
        self._response = self._response[self.socket.send(self._response) :]
        if self._response:
            return selectors.EVENT_WRITE
        self.socket.shutdown(socket.SHUT_WR)
        self.deadline = time.monotonic() + _LINGER_S
        return selectors.EVENT_READ

    def _read_request(self, respond: Callable[[bytes], bytes]) -> int:
        received = self.socket.recv(MAX_REQUEST_BYTES)
        self._request += received
        if not received:
            return 0
        if not _is_whole(bytes(self._request)) and len(self._request) <= MAX_REQUEST_BYTES:
            return selectors.EVENT_READ
        self._response = memoryview(respond(bytes(self._request)))
        self.deadline = time.monotonic() + CLIENT_TIMEOUT_S
        return selectors.EVENT_WRITE


def _parts(request: bytes) -> tuple[str, bytes]:
    """Return the head of a request, with lines that end by newlines, and its body."""
    end = re.search(rb"\n\r?\n", request)
    head, body = (request, b"") if end is None else (request[: end.start() + 1], request[end.end() :])
    return head.decode("latin-1").replace("\r\n", "\n"), body


def _is_whole(request: bytes) -> bool:
    """Return whether all of a request has come: its head, and as much of a body as that says."""
    if re.search(rb"\n\r?\n", request) is None:
        return False
    head, body = _parts(request)
    length = _header_fields(head.partition("\n")[2]).get("content-length", "")
    return not head.startswith("POST ") or not length.isdecimal() or len(body) >= int(length[:9])


def _header_fields(text: str) -> dict[str, str]:
    """Return header fields by name in lower case; of several of one name the first."""
    fields: dict[str, str] = {}
    for line in text.split("\n"):
        name, colon, value = line.partition(":")
        if colon:
            fields.setdefault(name.lower(), value.strip(" \t"))
    return fields
