"""The server of the live room: viser behind the house's guard of requests, connections and messages.

It reaches into viser and websockets where they offer no door, so the extra `view` pins viser's version.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from share.errors import ShareError
from share.net.bounded_websocket import (
    BACKLOG,
    HANDSHAKE_S,
    BoundedConnection,
    BoundedListener,
    PeerConnections,
    PeerLimits,
)
from share.net.http_guard import HttpGuard

_MAX_MESSAGE_BYTES = 2**14  # from a browser, which sends its camera and what is chosen
MAX_BROWSERS = 16
# The page asks for one file, then sends its camera 50 times a second at most, 300 bytes each.
_LIMITS = PeerLimits(MAX_BROWSERS, 32, 500, 100.0, 2**18, 2**16)


@contextmanager
def guarded_serving(listener: socket.socket, guard: HttpGuard) -> Iterator[None]:
    """Make viser serve on this socket, only requests that the guard lets through, and only messages that the
    room takes.

    viser offers no such thing itself; it calls `websockets.asyncio.server.serve`, once. Raises ShareError if
    it did not: nothing is served without the guard."""
    from websockets.asyncio import server

    original, connections, is_guarded, is_built = server.serve, PeerConnections(_LIMITS), False, False

    def serve(handler: Any, _host: str, _port: int, **options: Any) -> Any:
        nonlocal is_guarded
        is_guarded = True
        respond = options.pop("process_request")

        async def check(connection: Any, request: Any) -> Any:
            while not is_built:  # viser serves before it is ready
                await asyncio.sleep(0.01)
            return _answer(connection, request, guard, connections, respond)

        ours = {
            "process_request": check,
            "max_size": _MAX_MESSAGE_BYTES,
            "backlog": BACKLOG,
            "open_timeout": HANDSHAKE_S,
            "create_connection": partial(_BrowserConnection, connections=connections),
        }
        return original(handler, sock=BoundedListener(listener, connections), **options | ours)

    server.serve = serve
    try:
        yield
    finally:
        server.serve, is_built = original, True
    if not is_guarded:
        raise ShareError(
            "the live room does not know this version of viser; install the one that setup.cfg names"
        )


def _answer(
    connection: Any,
    request: Any,
    guard: HttpGuard,
    connections: PeerConnections,
    respond: Callable[[Any, Any], Any],
) -> Any:
    """Return the response to a request: a refusal, or what `respond` makes of it; None: it becomes a
    WebSocket."""
    headers: dict[str, str] = {}
    for name, value in request.headers.raw_items():
        headers.setdefault(name.lower(), value)
    refusal = guard.check(request.path, headers)
    lines: Sequence[str]
    if refusal is not None:
        response, lines = connection.respond(refusal.status, f"{refusal.text}\n"), refusal.headers
    elif "upgrade" in headers and not connections.admit(connection):
        response, lines = connection.respond(503, f"{MAX_BROWSERS} browsers connected already\n"), ()
    elif (response := respond(connection, request)) is not None:
        lines = guard.cookie_headers()
    else:
        return None
    for line in lines:
        name, _, value = line.partition(": ")
        response.headers[name] = value
    response.headers["X-Frame-Options"] = "DENY"
    response.headers["Referrer-Policy"] = "no-referrer"
    return response


def remove_tunnel(viser_server: Any) -> None:
    """Refuse browsers' requests for a tunnel to the internet."""
    from viser import _messages

    for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        viser_server._websock_server._incoming_handlers.pop(message, None)


class _BrowserConnection(BoundedConnection):
    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that the room takes; others are ignored."""
        while not is_taken(message := await super().recv(decode)):
            pass
        return message


# ---------------------------------------------------------------- messages of browsers
# viser calls handlers with whatever browsers send, and collects uploads without a limit. What is not one of
# these three messages, well formed, finite and small, never reaches it.

_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]
_Three = tuple[_Number, _Number, _Number]
_Text = Annotated[str, Meta(max_length=200)]


class _CameraMessage(Struct, tag_field="type", tag="ViewerCameraMessage"):
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Three
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Three
    up_direction: _Three


class _NewValue(Struct, forbid_unknown_fields=True):
    value: _Text | bool


class _Choice(Struct, tag_field="type", tag="GuiUpdateMessage"):
    uuid: _Text
    updates: _NewValue


class _SceneClick(Struct, tag_field="type", tag="SceneNodeClickMessage"):
    name: _Text
    ray_origin: _Three
    ray_direction: _Three
    screen_pos: tuple[_Number, _Number]
    instance_index: int | None = None
    modifier: _Text | None = None
    owner: _Text = ""


_decoder = msgspec.msgpack.Decoder(_CameraMessage | _Choice | _SceneClick)


def is_taken(data: Any) -> bool:
    """Return whether a message of a browser is one that the room takes."""
    if not isinstance(data, bytes):
        return False
    try:
        _decoder.decode(data)
    except (msgspec.DecodeError, ValueError, RecursionError):
        return False
    return True
