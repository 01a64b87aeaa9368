"""An agent's guard against its edge: bounds the data that libzmq has received and not yet delivered.

The agent checks whenever it receives. `share.net.connection_guard` is the edge's counterpart.
"""

from __future__ import annotations

from share.net import tcp
from share.net.backlog import Backlog, BacklogLimits


class AgentConnectionGuard:
    """Guards one connection at a time."""

    def __init__(self, limits: BacklogLimits) -> None:
        self._limits = limits
        self._connection: tuple[int, int] | None = None  # descriptor and cookie
        self._backlog = Backlog(0.0)

    def set_connection(self, descriptor: int, now_s: float) -> None:
        """Guard the new connection with this file descriptor."""
        cookie = tcp.socket_cookie(descriptor)
        self._connection = None if cookie is None else (descriptor, cookie)
        self._backlog = Backlog(now_s)

    def deliver(self, size: int, parts: int, now_s: float) -> None:
        """Record a received message of `size` bytes on the wire in `parts` frames."""
        self._backlog.deliver(size, parts, 1, now_s)

    def check(self) -> str | None:
        """Abort the connection if too much waits. Return the reason, None if all is well."""
        if self._connection is None:
            return None
        read = tcp.bytes_read(self._connection[0]) if self._is_open() else None
        if read is None:
            self._connection = None
            return None
        self._backlog.update_read(*read)
        if self._backlog.exceeds(self._limits):
            return self._abort(
                "many small messages" if self._backlog.has_small_parts else "too much data waits"
            )
        return None

    def check_empty(self) -> str | None:
        """Check a connection that has no complete message: what was read before the previous call is at most
        part of one message. Returns as `check`."""
        backlog = self._backlog
        if self._connection is not None and backlog.marked_bytes > self._limits.message_bytes:
            return self._abort("an endless message")
        backlog.classify_commands()
        backlog.mark()
        return None

    def _is_open(self) -> bool:
        return self._connection is not None and tcp.socket_cookie(self._connection[0]) == self._connection[1]

    def _abort(self, reason: str) -> str:
        if self._connection is not None:
            tcp.abort(*self._connection)
        self._connection = None
        return reason
