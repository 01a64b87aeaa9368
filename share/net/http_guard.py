"""Access to HTTP servers of SHARE processes: for this machine's users, or with a token.

Bound to loopback, a server answers requests for the name localhost only; so no web page reaches it under a
name of its own (DNS rebinding). On any other address a token is needed. A page of another origin is refused
everywhere, also a WebSocket, which browsers open across origins. Sources: RFC 6454 (origin), RFC 6750
(bearer token), RFC 7617 (basic authentication), RFC 6265 (cookies).
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import os
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qsl, urlencode

from share.errors import ShareError, UsageError
from share.files.reading import open_regular
from share.files.writing import write_private
from share.net.transport import Address, bind_error, parse_address

_LEAST_TOKEN, _MOST_TOKEN, _MAX_FILE_BYTES = 16, 256, 4096
_BACKLOG = 16


@dataclass(frozen=True)
class HttpRefusal:
    """An answer in place of what was asked for. headers: lines without their end."""

    status: HTTPStatus
    text: str
    headers: tuple[str, ...] = ()


class HttpGuard:
    """Checks requests to one bound address. token: as from `read_token`; None: none is needed."""

    def __init__(self, address: Address, token: str | None = None) -> None:
        self.is_local, self._token = address.local, token
        # Named by the token, not the port: browsers send it to all ports, so one opens all pages of an edge.
        self._cookie_name = f"share_{_digest(f'name {token}')[:8]}"
        self._cookie = "" if token is None else _digest(f"cookie {token}")

    def check(self, target: str, headers: Mapping[str, str]) -> HttpRefusal | None:
        """Return what to answer instead; None if the request is served.

        target: path and query. headers: by name in lower case.
        """
        host = headers.get("host")
        if self.is_local and host is not None and not _is_local_name(host):
            return HttpRefusal(HTTPStatus.FORBIDDEN, "only requests for the host name localhost are served")
        if (origin := headers.get("origin")) is not None and not _is_same_origin(origin, host):
            return HttpRefusal(HTTPStatus.FORBIDDEN, "only pages of this server may read it")
        if self._token is None:
            return None
        path, _, query_text = target.partition("?")
        query = parse_qsl(query_text)
        if any(name == "token" and self._is_token(value) for name, value in query):  # off the address bar
            rest = urlencode([pair for pair in query if pair[0] != "token"], errors="replace")
            where = f"Location: {_own_path(path)}{'?' if rest else ''}{rest}"
            return HttpRefusal(
                HTTPStatus.SEE_OTHER, "go on without the token", (where, *self.cookie_headers())
            )
        if self._has_cookie(headers.get("cookie", "")) or self._is_authorised(
            headers.get("authorization", "")
        ):
            return None
        text = (
            "a token is needed, that in the file of --http-token: open /?token=TOKEN, or give it as password"
        )
        ask = 'WWW-Authenticate: Basic realm="SHARE: any name, the token as password", charset="UTF-8"'
        return HttpRefusal(HTTPStatus.UNAUTHORIZED, text, (ask,))

    def cookie_headers(self) -> tuple[str, ...]:
        """Return the header lines by which a browser, once served, is known; none without a token."""
        if self._token is None:
            return ()
        return (f"Set-Cookie: {self._cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Lax",)

    def _is_token(self, value: str) -> bool:
        assert self._token is not None
        return _are_equal(value, self._token)

    def _has_cookie(self, cookies: str) -> bool:
        pairs = (pair.strip().partition("=") for pair in cookies.split(";"))
        values = [value for name, _, value in pairs if name == self._cookie_name]
        return any(_are_equal(value, self._cookie) for value in values)

    def _is_authorised(self, authorization: str) -> bool:
        scheme, _, value = authorization.partition(" ")
        if scheme.lower() == "bearer":
            return self._is_token(value.strip())
        if scheme.lower() != "basic":
            return False
        try:
            _, _, password = base64.b64decode(value.strip(), validate=True).decode().partition(":")
        except (binascii.Error, UnicodeDecodeError, ValueError):
            return False
        return self._is_token(password)


def _are_equal(given: str, secret: str) -> bool:
    """given: from a request, with whatever bytes it had."""
    return hmac.compare_digest(given.encode(errors="surrogatepass"), secret.encode())


def _own_path(path: str) -> str:
    """Return a path that leads to no other host: one that begins with `//` would."""
    printable = "".join(c for c in path if "!" <= c <= "~")
    return "/" + printable.lstrip("/\\")


def _is_same_origin(origin: str, host: str | None) -> bool:
    """Return whether a page of this origin came from the host that the request names."""
    scheme, _, authority = origin.partition("://")
    return scheme in ("http", "https") and host is not None and authority.lower() == host.lower()


def _is_local_name(host: str) -> bool:
    """host: a name or address, with or without a port. Takes linear time."""
    host_part, colon, port = host.rpartition(":")
    name = (host_part if colon and port.isdecimal() else host).strip("[]").lower()
    return name == "localhost" or Address(name, 0).local


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def served_address(text: str) -> Address:
    """Return the address of HOST:PORT, or of a PORT of this machine alone. Raises UsageError."""
    try:
        return parse_address(f"tcp://127.0.0.1:{text}" if text.isdigit() else f"tcp://{text}", True)
    except UsageError:
        wrong = f"'{text}' is not an address to serve at; expected HOST:PORT, such as 127.0.0.1:8080"
        raise UsageError(wrong) from None


def http_address(option: str, text: str, token: str | None) -> Address:
    """Return the address that an option names, as `served_address`.

    Raises UsageError if it is malformed, or reachable from other machines without a token.
    """
    try:
        address = served_address(text)
    except UsageError as error:
        raise UsageError(f"{option} {error}") from None
    if token is None and not address.local:
        raise UsageError(
            f"{option} {text}: others could read it; add --http-token FILE (made if it is not there), "
            "or use a port of this machine alone"
        )
    return address


def listen(address: Address) -> tuple[socket.socket, Address]:
    """Return a listening socket and its address, with the actual port. Raises TransportError."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        listener = socket.create_server((address.host, address.port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise bind_error(address, error.errno, error.strerror or str(error)) from None
    listener.setblocking(False)
    return listener, Address(address.host, listener.getsockname()[1])


def read_token(path: Path) -> str:
    """Return the token in a file, which is made, readable for its owner alone, if it is not there.

    Raises UsageError.
    """
    try:
        if not os.path.lexists(path):
            token = secrets.token_urlsafe(24)
            write_private(path, f"{token}\n")
            return token
        with open_regular(path, _MAX_FILE_BYTES) as stored:
            is_secret = not os.fstat(stored.fileno()).st_mode & 0o077
            token = stored.read().decode("ascii", "replace").strip()
    except ShareError as error:
        raise UsageError(f"--http-token {error}") from None
    except OSError as error:
        raise UsageError(f"--http-token {path}: {error.strerror or error}") from None
    if not is_secret:
        raise UsageError(f"--http-token {path}: others can read it; `chmod 600 {path}`")
    if not (_LEAST_TOKEN <= len(token) <= _MOST_TOKEN and all("!" <= c <= "~" for c in token)):
        raise UsageError(
            f"--http-token {path}: expected one word of {_LEAST_TOKEN} to {_MOST_TOKEN} ASCII characters; "
            "remove the file, and one is made"
        )
    return token
