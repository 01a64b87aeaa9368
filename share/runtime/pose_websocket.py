"""Live poses by WebSocket (RFC 6455), for web pages and engines: everyone who connects gets each new pose.

A thread for each reader sends the newest message and leaves out those that it has no time for, so a slow or
silent reader delays neither the agent nor another reader.
"""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import struct
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from share.errors import ShareError, UsageError, install_hint
from share.net.transport import bind_error
from share.net.udp import HostPort, parse_host
from share.runtime.pose import Pose
from share.runtime.pose_feed import DEFAULT_PORT, WEBSOCKET, PoseMessages
from share.types import TrackState

if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

MAX_READERS = 16  # at once; more are refused
_MAX_RECEIVED_BYTES = 1024  # of a message from a reader, which none needs to send
_CLOSE_S = 1.0
_SEND_TIMEOUT = struct.pack("@ll", 5, 0)  # s, us: after that a reader that does not read is disconnected
_TRY_LATER = 1013  # RFC 6455, section 11.7


class PoseWebSocket:
    """Serves poses at ws://HOST:PORT until closed.

    origins: web pages that may read them, such as https://app.example; others are refused, except those of
    this machine (localhost). A program that is no browser sends none and may. Raises UsageError, ShareError
    without the package, TransportError if the port is in use.
    """

    def __init__(self, address: str, agent: str, origins: Sequence[str] = ()) -> None:
        try:
            from websockets.sync.server import serve
        except ImportError:
            raise ShareError(install_hint("websockets", "websocket")) from None
        if bad := [one for one in origins if not re.fullmatch(r"https?://[^/\s]+", one)]:
            raise UsageError(
                f"--poses-origin {bad[0]}: expected a page's origin, such as https://app.example"
            )
        host = parse_host(address.removeprefix(WEBSOCKET), DEFAULT_PORT, bind=True)
        self._messages = PoseMessages(agent)
        self._changed, self._newest, self._number = threading.Condition(), "", 0
        self._is_closed, self._readers = False, set[Any]()
        allowed = [None, re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"), *origins]
        try:
            self._server = serve(
                self._serve_reader,
                host.name,
                host.port,
                origins=allowed,
                compression=None,
                max_size=_MAX_RECEIVED_BYTES,
                logger=_silent_logger(),
            )
        except OSError as error:
            raise bind_error(host, error.errno, error.strerror or str(error), "server") from None
        self.host = HostPort(host.name, int(self._server.socket.getsockname()[1]))
        self._thread = threading.Thread(target=self._server.serve_forever, name="poses", daemon=True)
        self._thread.start()

    def publish(self, pose: Pose) -> None:
        self._show(self._messages.of_pose(pose))

    def publish_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> None:
        self._show(self._messages.of_state(stamp_ns, state, age_ms))

    def close(self) -> None:
        """Disconnect all readers and free the port."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
            readers = list(self._readers)
        self._server.shutdown()
        for reader in readers:  # one that does not read would hold its thread up
            with contextlib.suppress(OSError):
                reader.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(timeout=_CLOSE_S)

    def _show(self, text: str) -> None:
        with self._changed:
            self._newest, self._number = text, self._number + 1
            self._changed.notify_all()

    def _serve_reader(self, connection: ServerConnection) -> None:
        """Send the newest message again and again, in this reader's own thread, until either end closes."""
        from websockets.exceptions import ConnectionClosed

        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)
        with self._changed:
            sent, is_welcome = self._number, len(self._readers) < MAX_READERS
            self._readers.add(connection)
        try:
            if not is_welcome:
                connection.close(_TRY_LATER, f"{MAX_READERS} readers already")
            with contextlib.suppress(ConnectionClosed, OSError):
                while is_welcome and (message := self._next_message(sent)) is not None:
                    text, sent = message
                    connection.send(text)
        finally:
            with self._changed:
                self._readers.discard(connection)

    def _next_message(self, sent: int) -> tuple[str, int] | None:
        """Return the newest message and its number, once it is newer than number `sent`; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > sent or self._is_closed)
            return None if self._is_closed else (self._newest, self._number)


def _silent_logger() -> logging.Logger:
    """Return a logger for failed handshakes that prints nothing: anybody can cause them."""
    logger = logging.Logger("share.poses")
    logger.addHandler(logging.NullHandler())
    return logger
