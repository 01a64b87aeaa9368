"""WebSocket connections of bounded cost to their server, for `websockets.asyncio.server.serve`.

A connection counts from its `accept()` on, before TLS, not from its first message. One that waits too long or
sends too much is closed before its data are parsed. When all places are taken, a newcomer replaces a
connection that has long had its place: a reader cannot be told from a peer that only holds a place. Some
places may be kept for programs of the server's own machine.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import selectors
import socket
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from ipaddress import ip_address
from typing import Any

from websockets.asyncio.server import ServerConnection, serve

from share.timing import TokenBucket

BACKLOG = 16  # that many are accepted at once
HANDSHAKE_S = 5.0  # from the connection, or the end of TLS's handshake, to the request's end
TLS_S = 5.0  # for TLS's handshake, and for its end
_COLLECTED = 64  # connections: asyncio leaves the 256 kB of each unfinished TLS to the garbage collector
SURE_S = 60.0  # that a place is its holder's, except that an address with more gives it to one with fewer
PING_S = 10.0  # between PINGs, and until their answer: who gives none is disconnected
_MAX_SLEEP_S = 0.1


@dataclass(frozen=True)
class PeerLimits:
    """max_open: connections served at once (`place_to_free`). max_waiting: before they are let in, or on
    their way out; one more closes the oldest of the address with the most. A peer may send `burst` frames and
    `burst_bytes` at once, and more by and by (per s). kept_open: of max_open, for peers of the server's own
    machine."""

    max_open: int
    max_waiting: int
    burst: float
    frames_per_s: float
    burst_bytes: float
    bytes_per_s: float
    kept_open: int = 0


def place_to_free(places: Sequence[tuple[str, float]], address: str, now_s: float) -> int | None:
    """Return which place a newcomer from `address` takes where all are taken, None: it is not let in.

    places: the address of each connection and since when it is there, s. It is the oldest of the address with
    the most, if that then still has as many as the newcomer's, or after SURE_S.
    """
    counts = Counter(holder for holder, _ in places)
    most = max(counts.values(), default=0)
    oldest = min((i for i, (holder, _) in enumerate(places) if counts[holder] == most), default=None,
                 key=lambda i: places[i][1])  # fmt: skip
    if oldest is None:
        return None
    is_unfair = most >= counts[address] + 2
    return oldest if is_unfair or now_s - places[oldest][1] >= SURE_S else None


class PeerConnections:
    """The connections of one server."""

    def __init__(self, limits: PeerLimits) -> None:
        self.limits = limits
        self._waiting: dict[AcceptedSocket, None] = {}  # oldest first
        self._open: dict[BoundedConnection, float] = {}  # since when, monotonic s

    @property
    def open_count(self) -> int:
        return len(self._open)

    def arrive(self, accepted: AcceptedSocket) -> None:
        """Count a socket that was just accepted, at the cost of another if need be."""
        if len(self._waiting) >= self.limits.max_waiting:
            counts = Counter(one.address for one in self._waiting)
            most = max(counts.values())
            oldest = next(one for one in self._waiting if counts[one.address] == most)
            del self._waiting[oldest]
            oldest.end()
        self._waiting[accepted] = None

    def take_up(self, connection: BoundedConnection) -> None:
        """Assign a connection to its socket, once its TLS handshake is done."""
        number = connection.transport.get_extra_info("socket").fileno()
        connection.accepted = next((one for one in self._waiting if one.fileno() == number), None)
        if connection.accepted is None:  # its place went to another meanwhile
            connection.transport.abort()
        else:
            connection.accepted.connection = connection

    def admit(self, connection: Any) -> bool:
        """Let a connection in, at the cost of another if need be. Return whether there is room."""
        if connection not in self._open:
            if not self._has_room(connection) and not self._free_place(connection):
                return False
            self.forget(connection.accepted)
            self._open[connection] = time.monotonic()
        return True

    def _has_room(self, newcomer: BoundedConnection) -> bool:
        """Return whether a place is free that the newcomer may take."""
        kept = 0 if newcomer.is_local else max(0, self.limits.kept_open - self._local_count)
        return len(self._open) + kept < self.limits.max_open

    @property
    def _local_count(self) -> int:
        return sum(holder.is_local for holder in self._open)

    def _free_place(self, newcomer: BoundedConnection) -> bool:
        are_kept = not newcomer.is_local and self._local_count <= self.limits.kept_open
        holders = [(one, since_s) for one, since_s in self._open.items() if not (are_kept and one.is_local)]
        places = [(holder.address, since_s) for holder, since_s in holders]
        chosen = place_to_free(places, newcomer.address, time.monotonic())
        if chosen is None:
            return False
        holder = holders[chosen][0]
        del self._open[holder]
        holder.transport.abort()
        return True

    def leave(self, connection: BoundedConnection) -> None:
        self.forget(connection.accepted)
        self._open.pop(connection, None)

    def forget(self, accepted: AcceptedSocket | None) -> None:
        """Count a socket no longer as one that waits."""
        if accepted is not None:
            self._waiting.pop(accepted, None)

    def abort_all(self) -> None:
        """Close every connection at once."""
        for accepted in list(self._waiting):
            accepted.end()
        for connection in list(self._open):
            connection.transport.abort()


class AcceptedSocket(socket.socket):
    """A socket that counts as waiting until its connection is let in, or it is closed."""

    def __init__(self, plain: socket.socket, connections: PeerConnections) -> None:
        peer, own = _names(plain)
        self.address, self.is_local = _holder_of(peer), _is_own_machine(peer, own)
        self.connection: BoundedConnection | None = None  # once TLS is there
        self._peer_connections = connections
        super().__init__(plain.family, plain.type, plain.proto, fileno=plain.detach())

    def end(self) -> None:
        """Close it at once, or let its owner do so, who finds it at its end."""
        if self.connection is not None:
            self.connection.transport.abort()
        else:
            with contextlib.suppress(OSError):  # its peer was faster
                self.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._peer_connections.forget(self)
        super().close()


class BoundedListener(socket.socket):
    """A listener that replaces another, and has `PeerConnections` count each accepted socket."""

    def __init__(self, listener: socket.socket, connections: PeerConnections) -> None:
        self.connections, self.is_collected, self._count = connections, False, 0
        super().__init__(listener.family, listener.type, listener.proto, fileno=listener.detach())

    def accept(self) -> tuple[socket.socket, Any]:
        plain, address = super().accept()
        accepted = AcceptedSocket(plain, self.connections)
        self.connections.arrive(accepted)
        self._count += 1
        if self.is_collected and self._count % _COLLECTED == 0:
            gc.collect()
        return accepted, address


class BoundedConnection(ServerConnection):  # type: ignore[misc]
    """A connection counted by `PeerConnections`.

    Pass `create_connection=partial(BoundedConnection, connections=connections)` to a server on a
    `BoundedListener`.
    """

    def __init__(self, *args: Any, connections: PeerConnections, **options: Any) -> None:
        super().__init__(*args, **options)
        limits, self.address, self.is_local = connections.limits, "", False
        self.accepted: AcceptedSocket | None = None
        self._peer_connections = connections
        self._frames = TokenBucket(limits.burst, limits.frames_per_s)
        self._bytes = TokenBucket(limits.burst_bytes, limits.bytes_per_s)

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._peer_connections.take_up(self)
        if self.accepted is not None:
            self.address, self.is_local = self.accepted.address, self.accepted.is_local

    def connection_lost(self, exc: Exception | None) -> None:
        self._peer_connections.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._bytes.take(time.monotonic_ns(), cost=len(data)):
            super().data_received(data)
        else:
            self.transport.abort()

    def process_event(self, event: Any) -> None:
        if self._frames.take(time.monotonic_ns()):
            super().process_event(event)
        else:
            self.transport.abort()


def _names(plain: socket.socket) -> tuple[Any, Any]:
    """Return the addresses of a socket's peer and its own; None of one that has gone."""
    with contextlib.suppress(OSError):
        return plain.getpeername(), plain.getsockname()
    return None, None


def _holder_of(peer: Any) -> str:
    """Return the holder of an address: of IPv6 the first 64 bits, as a peer has all addresses below them."""
    text = str(peer[0]).partition("%")[0] if peer else ""
    return ":".join(ip_address(text).exploded.split(":")[:4]) if ":" in text else text


def _is_own_machine(peer: Any, own: Any) -> bool:
    """Return whether a connection is of the machine that it goes to, by loopback or by an address of its
    own."""
    return bool(peer and own) and (peer[0] == own[0] or ip_address(peer[0].partition("%")[0]).is_loopback)


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


def serve_bounded(handler: Any, listener: BoundedListener, ssl: Any = None, **options: Any) -> serve:
    """Return a server whose connections are bounded, not compressed, and pinged.

    ssl: a TLS context, or None. options: the others of `websockets.asyncio.server.serve`.
    """
    listener.is_collected = ssl is not None
    tls_times = {} if ssl is None else {"ssl_handshake_timeout": TLS_S, "ssl_shutdown_timeout": TLS_S}
    logger = logging.Logger("share.websocket")
    logger.addHandler(logging.NullHandler())  # anybody can cause failed handshakes
    return serve(
        handler,
        sock=listener,
        ssl=ssl,
        backlog=BACKLOG,
        compression=None,
        open_timeout=HANDSHAKE_S,
        ping_interval=PING_S,
        ping_timeout=PING_S,
        create_connection=partial(BoundedConnection, connections=listener.connections),
        logger=logger,
        **tls_times,
        **options,
    )
