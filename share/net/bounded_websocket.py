"""WebSocket connections that cannot cost their server much, for `websockets.asyncio.server.serve`.

A connection counts from its TCP handshake on, not from its first message. What waits too long, or sends more
than it has reason to, is closed before it is parsed.
"""

from __future__ import annotations

import selectors
import time
from dataclasses import dataclass
from typing import Any

from websockets.asyncio.server import ServerConnection

BACKLOG = 16  # that many are accepted at once
HANDSHAKE_S = 5.0  # from the connection to the request's end
_MAX_SLEEP_S = 0.1


@dataclass(frozen=True)
class PeerLimits:
    """max_open: connections served at once. max_waiting: before they are let in, or on their way out; one
    more closes the oldest. A peer may send `burst` frames and `burst_bytes` at once, and more by and by (per
    s)."""

    max_open: int
    max_waiting: int
    burst: float
    frames_per_s: float
    burst_bytes: float
    bytes_per_s: float


class PeerConnections:
    """The connections of one server."""

    def __init__(self, limits: PeerLimits) -> None:
        self.limits = limits
        self._waiting: dict[BoundedConnection, None] = {}  # oldest first
        self._open: set[BoundedConnection] = set()

    @property
    def open_count(self) -> int:
        return len(self._open)

    def arrive(self, connection: BoundedConnection) -> None:
        if len(self._waiting) >= self.limits.max_waiting:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.transport.abort()
        self._waiting[connection] = None

    def admit(self, connection: Any) -> bool:
        """Let a connection in. Return whether there is room."""
        if connection not in self._open:
            if len(self._open) >= self.limits.max_open:
                return False
            self._waiting.pop(connection, None)
            self._open.add(connection)
        return True

    def leave(self, connection: BoundedConnection) -> None:
        self._waiting.pop(connection, None)
        self._open.discard(connection)

    def abort_all(self) -> None:
        """Close every connection at once."""
        for connection in [*self._waiting, *self._open]:
            connection.transport.abort()


class Allowance:
    """What may still come: `burst` at once, and `per_s` more by and by."""

    def __init__(self, burst: float, per_s: float) -> None:
        self._burst, self._per_s = burst, per_s
        self._left, self._at_s = burst, 0.0

    def take(self, amount: float, now_s: float) -> bool:
        """Return whether that is allowed. now_s: never less than before."""
        self._left = min(self._burst, self._left + self._per_s * (now_s - self._at_s)) - amount
        self._at_s = now_s
        return self._left >= 0


class BoundedConnection(ServerConnection):  # type: ignore[misc]
    """A connection through a door. Given as `create_connection=partial(BoundedConnection, door=door)`."""

    def __init__(self, *args: Any, connections: PeerConnections, **options: Any) -> None:
        super().__init__(*args, **options)
        limits = connections.limits
        self._peer_connections = connections
        self._frames = Allowance(limits.burst, limits.frames_per_s)
        self._bytes = Allowance(limits.burst_bytes, limits.bytes_per_s)

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._peer_connections.arrive(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._peer_connections.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._bytes.take(len(data), self.loop.time()):
            super().data_received(data)
        else:
            self.transport.abort()

    def process_event(self, event: Any) -> None:
        if self._frames.take(1, self.loop.time()):
            super().process_event(event)
        else:
            self.transport.abort()


class ModestSelector(selectors.DefaultSelector):
    """Lets an event loop use at most one part in `1 + ratio` of a core, whatever its peers do: it sleeps
    `ratio` times as long as it has worked."""

    def __init__(self, ratio: float) -> None:
        super().__init__()
        self._ratio, self._cpu_s = ratio, time.thread_time()

    def select(self, timeout: float | None = None) -> Any:
        worked_s = time.thread_time() - self._cpu_s
        time.sleep(min(_MAX_SLEEP_S, max(0.0, self._ratio * worked_s)))
        self._cpu_s = time.thread_time()
        return super().select(timeout)
