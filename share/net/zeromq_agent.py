"""The agent's link over ZeroMQ. It reconnects by itself, and leaves an edge that sends what no edge does.

libzmq holds what it has received and not yet delivered; the guard bounds that whenever the agent receives.
`share.net.connection_guard` is the edge's counterpart.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Iterator, Sequence

import zmq
from zmq.utils.monitor import recv_monitor_message

from share.errors import UsageError
from share.net import tcp
from share.net.backlog import CURVE_OVERHEAD_BYTES, Backlog, BacklogLimits, wire_bytes
from share.net.keys import AgentKeys
from share.net.transport import LINGER_MS, check_keys, parse_address
from share.net.zeromq_socket import ZmqSocket
from share.timing import Backoff
from share.wire.layouts import MAX_FRAME_BYTES, Bytes
from share.wire.messages import peer_id

_BACKLOG_CHECK_MS = 20  # how often the data that wait are checked
_FLOOD_TROUBLE_S = 10.0  # connected for so long, the link no longer reports an edge's flood as trouble
_RECONNECT_S = 1.0  # after a failed handshake or connection; libzmq itself gives up after a ZMTP error
_HANDSHAKE_EVENTS = (
    zmq.EVENT_CONNECTED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_OPTIONS: dict[int, int] = {
    zmq.IMMEDIATE: 1,  # nothing queues for an absent edge
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 400,
    zmq.CONNECT_TIMEOUT: 2000,
    zmq.SNDBUF: 256 * 1024,  # on a slow network poses must not age in the kernel
    zmq.RCVBUF: 256 * 1024,  # an edge sends little; the kernel would buffer up to 32 MB
}
# libzmq compares MAXMSGSIZE with the encrypted frame.
_CURVE_OPTIONS: dict[int, int] = {zmq.MAXMSGSIZE: MAX_FRAME_BYTES + CURVE_OVERHEAD_BYTES}


class ZmqAgentLink:
    """`AgentLink` to tcp://HOST:PORT. Raises UsageError if that is not an address, or on another machine and
    there are no keys."""

    def __init__(self, address: str, run_id: int, keys: AgentKeys | None = None) -> None:
        self._target = check_keys(parse_address(address), keys)
        self._keys, self._run_id = keys, run_id
        self._trouble: str | None = None
        self._flood_trouble: str | None = None  # why the agent disconnected from its edge
        self._guard = AgentConnectionGuard(BacklogLimits.for_frame_size(MAX_FRAME_BYTES))
        self._backoff = Backoff(time.monotonic_ns())
        self._reconnect_s: float | None = None  # monotonic time of the next attempt
        self._flood_trouble_until_s = 0.0  # monotonic time at which `_flood_trouble` ends
        self._has_connected = False  # since the last `poll_connected`
        self._early_ends = 0  # of connections by the edge, within their handshakes, one after the other
        self._open()
        try:
            self._link.socket.connect(str(self._target))
        except zmq.ZMQError:
            self.close()
            host = self._target.host
            raise UsageError(f"{self._target}: '{host}' is not a valid host name") from None

    def _open(self) -> None:
        options = _OPTIONS | (_CURVE_OPTIONS if self._keys else {})
        self._link = ZmqSocket(zmq.DEALER, options, self._target)
        zmq_socket = self._link.socket
        self._events: zmq.Socket[bytes] = zmq_socket.get_monitor_socket(_HANDSHAKE_EVENTS)
        zmq_socket.setsockopt(zmq.ROUTING_ID, peer_id(self._run_id))
        if self._keys is not None:
            zmq_socket.setsockopt(zmq.CURVE_PUBLICKEY, self._keys.own.public.encode())
            zmq_socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.own.secret.encode())
            zmq_socket.setsockopt(zmq.CURVE_SERVERKEY, self._keys.edge.encode())

    def send(self, frames: Sequence[Bytes]) -> bool:
        return self._link.send(frames)

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        end_s, is_over = time.monotonic() + timeout_ms * 1e-3, timeout_ms <= 0
        while True:
            self._keep_connected()
            self._handle_excess(self._guard.check())
            parts = self._link.receive_now()
            left_ms = round((end_s - time.monotonic()) * 1e3)
            if parts is not None:
                size = sum(wire_bytes(len(part), self._keys is not None) for part in parts)
                self._guard.deliver(size, len(parts), time.monotonic())
                return [part.bytes for part in parts]
            self._handle_excess(self._guard.check_empty())
            if is_over:
                return None
            is_over = (
                bool(self._link.wait(min(max(0, left_ms), _BACKLOG_CHECK_MS))) or left_ms <= _BACKLOG_CHECK_MS
            )

    def trouble(self) -> str | None:
        return self._trouble or self._flood_trouble

    def poll_connected(self) -> bool:
        has_connected, self._has_connected = self._has_connected, False
        return has_connected

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._close()

    def _close(self, linger_ms: int = LINGER_MS) -> None:
        if not self._link.socket.closed:
            self._link.socket.disable_monitor()
            self._events.close(linger=0)
        self._link.close(linger_ms)

    def _handle_excess(self, excess: str | None) -> None:
        """excess: what the edge sends too much of, if it does. Then disconnect, drop what it sent, and
        reconnect later."""
        now_ns = time.monotonic_ns()
        if excess is not None:
            self._close(linger_ms=0)
            self._open()
            self._reconnect_s = (now_ns * 1e-9) + self._backoff.record_failure(now_ns)
            self._trouble = None
            self._flood_trouble = (
                f"disconnected from the edge, which sends what no edge does ({excess}); this run goes on "
                "without it and reconnects at growing intervals"
            )
        elif (
            self._flood_trouble and self._reconnect_s is None and now_ns * 1e-9 > self._flood_trouble_until_s
        ):
            self._flood_trouble = None

    def _keep_connected(self) -> None:
        """Follow the handshakes (zmq_socket_monitor), and reconnect when due."""
        for event, value in self._new_events():
            if event == zmq.EVENT_CONNECTED:  # the handshake starts
                self._reconnect_s = None
                self._guard.set_connection(value, time.monotonic())
            elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._reconnect_s = self._trouble = None
                self._has_connected, self._early_ends = True, 0
                self._flood_trouble_until_s = time.monotonic() + _FLOOD_TROUBLE_S
            else:
                self._reconnect_s = time.monotonic() + _RECONNECT_S
                if event != zmq.EVENT_DISCONNECTED and self._is_refusal(event, value):
                    self._trouble = f"refused: {self._reason(event)}"
        if self._reconnect_s is not None and time.monotonic() >= self._reconnect_s:
            self._reconnect_s = None
            with contextlib.suppress(zmq.ZMQError):  # libzmq has dropped the endpoint already
                self._link.socket.disconnect(str(self._target))
            self._link.socket.connect(str(self._target))

    def _new_events(self) -> Iterator[tuple[int, int]]:
        with contextlib.suppress(zmq.Again):
            while True:
                message = recv_monitor_message(self._events, zmq.NOBLOCK)
                yield message["event"], message["value"]

    def _is_refusal(self, failure: int, error: int) -> bool:
        """Return whether a handshake failed because the edge does not want it. A paused edge does not answer;
        one that stops ends a connection once."""
        if failure != zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL:
            return True
        self._early_ends = 0 if error == errno.EAGAIN else self._early_ends + 1
        return self._early_ends > 1

    def _reason(self, failure: int) -> str:
        if self._keys is None:
            return "the edge requires keys; give its public key with --server-key"
        if failure == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            own = self._keys.own
            if self._keys.is_lent:
                return f"the edge's list of keys has no agent '{own.name}' any more, or is damaged"
            command = f"share keys authorize {own.name} '{own.public}'"
            return f"the edge does not know this key; on the edge's machine: {command}"
        return "the edge has another key than --server-key, or none"


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
