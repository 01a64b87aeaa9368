"""WebSocket connections that cannot cost their server much, for `websockets.asyncio.server.serve`.

A connection counts from its TCP handshake on, not from its first message. What waits too long, or sends more
than it has reason to, is closed before it is parsed. Where all places are taken, a newcomer gets that of one
that has long had it: who reads for ever cannot be told apart from who only holds a place. Some places may
be kept for programs of the server's own machine.
"""

from __future__ import annotations

import logging
import selectors
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
HANDSHAKE_S = 5.0  # from the connection to the request's end
SURE_S = 60.0  # that a place is its holder's, except that an address with more gives it to one with fewer
PING_S = 10.0  # between PINGs, and until their answer: who gives none is disconnected
_MAX_SLEEP_S = 0.1


@dataclass(frozen=True)
class PeerLimits:
    """max_open: connections served at once (`place_to_free`). max_waiting: before they are let in, or on
    their way out; one more closes the oldest. A peer may send `burst` frames and `burst_bytes` at once, and
    more by and by (per s). kept_open: of max_open, for peers of the server's own machine."""

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
        self._waiting: dict[BoundedConnection, None] = {}  # oldest first
        self._open: dict[BoundedConnection, float] = {}  # since when, monotonic s

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
        """Let a connection in, at the cost of another if need be. Return whether there is room."""
        if connection not in self._open:
            if not self._has_room(connection) and not self._free_place(connection):
                return False
            self._waiting.pop(connection, None)
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
        self._waiting.pop(connection, None)
        self._open.pop(connection, None)

    def abort_all(self) -> None:
        """Close every connection at once."""
        for connection in [*self._waiting, *self._open]:
            connection.transport.abort()


class BoundedConnection(ServerConnection):  # type: ignore[misc]
    """A connection counted by `PeerConnections`.

    Given as `create_connection=partial(BoundedConnection, connections=connections)`.
    """

    def __init__(self, *args: Any, connections: PeerConnections, **options: Any) -> None:
        super().__init__(*args, **options)
        limits, self.address, self.is_local = connections.limits, "", False
        self._peer_connections = connections
        self._frames = TokenBucket(limits.burst, limits.frames_per_s)
        self._bytes = TokenBucket(limits.burst_bytes, limits.bytes_per_s)

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        peer, own = transport.get_extra_info("peername"), transport.get_extra_info("sockname")
        self.address, self.is_local = _holder_of(peer), _is_own_machine(peer, own)
        self._peer_connections.arrive(self)

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


def _holder_of(peer: Any) -> str:
    """Return whose address it is: of IPv6 the first 64 bits, of which one peer has all the others."""
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


def serve_bounded(handler: Any, connections: PeerConnections, **options: Any) -> serve:
    """Return a server whose connections are bounded by `connections`, not compressed, and pinged.

    options: the others of `websockets.asyncio.server.serve`.
    """
    logger = logging.Logger("share.websocket")
    logger.addHandler(logging.NullHandler())  # anybody can cause failed handshakes
    return serve(
        handler,
        backlog=BACKLOG,
        compression=None,
        open_timeout=HANDSHAKE_S,
        ping_interval=PING_S,
        ping_timeout=PING_S,
        create_connection=partial(BoundedConnection, connections=connections),
        logger=logger,
        **options,
    )
