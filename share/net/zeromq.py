"""Links over ZeroMQ: DEALER at the agent, ROUTER at the edge (RFC 28/REQREP, ZMTP 3.1).

With keys, CURVE (RFC 26) encrypts and authenticates; the edge's `ZapAuthenticator` decides on admission.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Sequence
from functools import partial

import zmq

from share.errors import TransportError, UsageError
from share.net.agent_guard import AgentConnectionGuard
from share.net.backlog import CURVE_OVERHEAD_BYTES, BacklogLimits, wire_bytes
from share.net.connection_gate import Blocklist
from share.net.connection_guard import ConnectionGuard
from share.net.handshake import HandshakeMonitor, HandshakeOutcome, ZapAuthenticator
from share.net.keys import AgentKeys, EdgeKeys
from share.net.transport import (
    LINGER_MS,
    QUEUE_MESSAGES,
    Address,
    IncomingMessage,
    bind_error,
    check_keys,
    parse_address,
)
from share.timing import Backoff
from share.wire.codec import MAX_ARRAYS, MAX_FRAME_BYTES, Bytes
from share.wire.messages import PEER_ID_BYTES, peer_id

_MAX_PARTS = 2 + MAX_ARRAYS  # peer, header, arrays; further parts are read and discarded
_SKIPPED_PARTS_PER_CALL = 2000  # of these, in one call: 3 ms
_WAKE = b"w"  # written to the wake socket by `wake`
_GUARD_WAKE = b"g"  # the same by the guard: look for a message, but do not return without one
_MAX_REFUSALS = 128  # lines at a time
_MAX_DISCARDED_PER_CALL = 2000  # messages from unidentified or disconnected peers, in one call
_LIST_REFRESH_S = 0.1  # age of the cached allow list; reading it for each message was a quarter of the work
_BACKLOG_CHECK_MS = 20  # how often an agent checks the data that wait from its edge
_FORGIVE_S = 10.0  # after so long a connection, an edge's flood is forgiven
_RECONNECT_S = 1.0  # after a failed handshake or connection; libzmq itself gives up after a ZMTP error
_COMMON_OPTIONS: dict[int, int] = {
    zmq.LINGER: LINGER_MS,
    zmq.SNDHWM: QUEUE_MESSAGES,
    zmq.RCVHWM: 0,  # see ZmqEdgeLink: a peer's reset while a full queue stops input aborts the process
    zmq.MAXMSGSIZE: MAX_FRAME_BYTES,  # a larger frame closes its sender's connection
    zmq.HANDSHAKE_IVL: 4000,  # an edge under attack holds new connections meanwhile
    zmq.HEARTBEAT_IVL: 500,  # a lost network is noticed, and the peer's queue dropped, in 2 s
    zmq.HEARTBEAT_TIMEOUT: 2000,
    zmq.HEARTBEAT_TTL: 2000,
}
# libzmq compares MAXMSGSIZE with the encrypted frame.
_CURVE_OPTIONS: dict[int, int] = {zmq.MAXMSGSIZE: MAX_FRAME_BYTES + CURVE_OVERHEAD_BYTES}
_DEALER_OPTIONS: dict[int, int] = {
    zmq.IMMEDIATE: 1,  # nothing queues for an absent edge
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 400,
    zmq.CONNECT_TIMEOUT: 2000,
    zmq.SNDBUF: 256 * 1024,  # on a slow network poses must not age in the kernel
    zmq.RCVBUF: 256 * 1024,  # an edge sends little; the kernel would buffer up to 32 MB
}
_ROUTER_OPTIONS: dict[int, int] = {
    zmq.ROUTER_MANDATORY: 1,  # sending to an absent peer is an error, not silent
    # An agent that returns over another network takes over from its half-open connection; without this,
    # libzmq would never route to it again. Ids are 64 random bits.
    zmq.ROUTER_HANDOVER: 1,
    # The heartbeat timer of a taken-over connection aborts the process if its peer then resets it (libzmq
    # 4.3.5, as with RCVHWM below). So the kernel detects a lost network, in 2 to 3 s: by missing
    # acknowledgements, or on an idle connection by keepalive probes.
    zmq.HEARTBEAT_IVL: 0,
    zmq.TCP_MAXRT: 2000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 1,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 2,
    zmq.SNDBUF: 256 * 1024,  # bound for a peer that reads nothing
}
_RECEIVE_BUFFER_BYTES = 256 * 1024  # of a connection in the kernel, else up to 32 MB; too little for images


class _Socket:
    """A non-blocking socket with its own context, which another thread can wake."""

    def __init__(self, kind: int, options: dict[int, int], target: Address) -> None:
        self.context = zmq.Context()
        self.socket: zmq.Socket[bytes] = self.context.socket(kind)
        for option, value in (_COMMON_OPTIONS | options).items():
            self.socket.setsockopt(option, value)
        self.socket.setsockopt(zmq.IPV6, ":" in target.host)
        self._wake_reader, self._wake_writer = socket.socketpair()
        for end in (self._wake_reader, self._wake_writer):
            end.setblocking(False)
        self._poller = zmq.Poller()
        self._poller.register(self.socket, zmq.POLLIN)
        self._poller.register(self._wake_reader, zmq.POLLIN)
        self._is_skipping = False  # the next parts belong to a message that has too many
        self.last_empty_s = 0.0  # when `receive_now` last found no message

    def send(self, frames: Sequence[Bytes]) -> bool:
        try:
            self.socket.send_multipart(frames, zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
                return False
            raise TransportError(f"cannot send: {error.strerror}") from None
        return True

    def wait(self, timeout_ms: int) -> bytes:
        """Wait for a message or a wake-up. Return the bytes of the wake-ups."""
        ready = dict(self._poller.poll(0 if self._is_skipping else timeout_ms))
        return self._wake_reader.recv(4096) if self._wake_reader.fileno() in ready else b""

    def receive_now(self) -> list[zmq.Frame] | None:
        """Return the next message, None if there is none. Of a message with too many parts, return
        _MAX_PARTS + 1, so that the caller refuses it."""
        asked_s = time.monotonic()
        if self._is_skipping and not self._skip_parts():
            return None
        parts: list[zmq.Frame] = []
        try:
            while not parts or (parts[-1].more and len(parts) <= _MAX_PARTS):
                parts.append(self.socket.recv(zmq.NOBLOCK, copy=False))
        except zmq.Again:
            self.last_empty_s = asked_s
            return None
        self._is_skipping = parts[-1].more
        return parts

    def _skip_parts(self) -> bool:
        """Discard parts of a message that has too many. Return whether it is finished."""
        for _ in range(_SKIPPED_PARTS_PER_CALL):
            if not self.socket.recv(zmq.NOBLOCK, copy=False).more:
                self._is_skipping = False
                break
        return not self._is_skipping

    def wake(self, reason: bytes = _WAKE) -> None:
        try:
            self._wake_writer.send(reason)
        except OSError:  # full: the reader is woken already; closed: there is no reader
            return

    def close(self, linger_ms: int = LINGER_MS) -> None:
        if self.socket.closed:
            return
        self.socket.close(linger_ms)
        self.context.term()
        self._wake_reader.close()
        self._wake_writer.close()


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
        self._forgive_s = 0.0  # monotonic time at which `_flood_trouble` ends
        self._has_connected = False  # since the last `poll_connected`
        self._open()
        try:
            self._link.socket.connect(str(self._target))
        except zmq.ZMQError:
            self.close()
            host = self._target.host
            raise UsageError(f"{self._target}: '{host}' is not a valid host name") from None

    def _open(self) -> None:
        self._link = _Socket(
            zmq.DEALER, _DEALER_OPTIONS | (_CURVE_OPTIONS if self._keys else {}), self._target
        )
        self._handshakes = HandshakeMonitor(self._link.socket)
        self._link.socket.setsockopt(zmq.ROUTING_ID, peer_id(self._run_id))
        if self._keys is not None:
            self._link.socket.setsockopt(zmq.CURVE_PUBLICKEY, self._keys.own.public.encode())
            self._link.socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.own.secret.encode())
            self._link.socket.setsockopt(zmq.CURVE_SERVERKEY, self._keys.edge.encode())

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
        if not self._link.socket.closed:
            self._handshakes.close()
        self._link.close()

    def _handle_excess(self, excess: str | None) -> None:
        """excess: what the edge sends too much of, if it does. Then disconnect, drop what it sent, and
        reconnect later."""
        now_ns = time.monotonic_ns()
        if excess is not None:
            self._handshakes.close()
            self._link.close(linger_ms=0)
            self._open()
            self._reconnect_s = (now_ns * 1e-9) + self._backoff.record_failure(now_ns)
            self._trouble = None
            self._flood_trouble = (
                f"disconnected from the edge, which sends what no edge does ({excess}); this run goes on "
                "without it and reconnects at growing intervals"
            )
        elif self._flood_trouble and self._reconnect_s is None and now_ns * 1e-9 > self._forgive_s:
            self._flood_trouble = None

    def _keep_connected(self) -> None:
        while (outcome := self._handshakes.next_outcome()) is not None:
            if outcome is HandshakeOutcome.CONNECTED:
                self._reconnect_s = None
                if self._handshakes.descriptor is not None:
                    self._guard.set_connection(self._handshakes.descriptor, time.monotonic())
                continue
            is_connected = outcome is HandshakeOutcome.SUCCEEDED
            self._reconnect_s = None if is_connected else time.monotonic() + _RECONNECT_S
            if is_connected:
                self._has_connected, self._trouble = True, None
                self._forgive_s = time.monotonic() + _FORGIVE_S
            elif outcome is not HandshakeOutcome.DISCONNECTED:
                self._trouble = f"refused: {self._reason(outcome)}"
        if self._reconnect_s is not None and time.monotonic() >= self._reconnect_s:
            self._reconnect_s = None
            with contextlib.suppress(zmq.ZMQError):  # libzmq has dropped the endpoint already
                self._link.socket.disconnect(str(self._target))
            self._link.socket.connect(str(self._target))

    def _reason(self, outcome: HandshakeOutcome) -> str:
        if self._keys is None:
            return "the edge requires keys; give its public key with --server-key"
        if outcome is HandshakeOutcome.UNKNOWN_KEY:
            own = self._keys.own
            command = f"share keys authorize {own.name} '{own.public}'"
            return f"the edge does not know this key; on the edge's machine: {command}"
        return "the edge has another key than --server-key, or none"


class ZmqEdgeLink:
    """`EdgeLink` at tcp://HOST:PORT. Raises UsageError if that is not an address, or other machines can reach
    it and there are no keys; TransportError if it cannot be bound.

    When an admitted key is revoked, all connections are closed; the other agents reconnect within about a
    second, as after a network failure.
    """

    def __init__(
        self, address: str, keys: EdgeKeys | None = None, max_frame_bytes: int = MAX_FRAME_BYTES
    ) -> None:
        self._target = check_keys(parse_address(address, bind=True), keys)
        self._keys = keys
        self._bounds = BacklogLimits.for_frame_size(max_frame_bytes)
        self._options = _ROUTER_OPTIONS | {
            zmq.MAXMSGSIZE: max_frame_bytes + (CURVE_OVERHEAD_BYTES if keys else 0),
            # libzmq 4.3.5 aborts the process if a peer resets its connection while a full queue has stopped
            # its input (stream_engine_base.cpp: !_io_error). So queues are unbounded, and the guard bounds
            # the data that wait.
            zmq.RCVHWM: 0,
            **({} if max_frame_bytes > MAX_FRAME_BYTES else {zmq.RCVBUF: _RECEIVE_BUFFER_BYTES}),
        }
        self._blocklist = Blocklist()
        self._agent_names: dict[str, frozenset[str]] = {}  # by key, since the last refresh of the list
        self._list_due_s = 0.0
        self._list_trouble: str | None = None
        self.discarded_messages = 0  # from peers that are no agents or were disconnected
        self._open()

    @property
    def endpoint(self) -> str:
        return str(self._target)

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        return self._link.send([peer, *frames])

    def receive(self, timeout_ms: int) -> IncomingMessage | None:
        self._refresh_allow_list()
        end_s = time.monotonic() + timeout_ms * 1e-3
        message, by_guard = self._receive_now(), True
        while message is None and by_guard:
            woken = self._link.wait(max(0, round((end_s - time.monotonic()) * 1e3)))
            by_guard = bool(woken) and _WAKE not in woken
            message = self._receive_now()
        return message

    def _receive_now(self) -> IncomingMessage | None:
        for _ in range(_MAX_DISCARDED_PER_CALL):
            self._guard.check()
            parts = self._link.receive_now()
            if parts is None:
                self._guard.record_empty(self._link.last_empty_s)
                return None
            key = self._record_message(parts)
            if key is not None and len(parts[0]) == PEER_ID_BYTES:
                return IncomingMessage(parts[0].bytes, [part.bytes for part in parts[1:]], key)
            self.discarded_messages += 1
        return None

    def _record_message(self, parts: list[zmq.Frame]) -> str | None:
        """Report a message to the guard. Return its sender's key ("" without), None if it is to be
        discarded."""
        is_encrypted = self._keys is not None
        try:
            descriptor, key = int(parts[0].get(zmq.SRCFD)), self._sender_key(parts[0])
        except zmq.ZMQError:  # a ZMTP 1.0 peer has neither
            return ""
        if self._guard.is_discarding(descriptor):
            return None
        size = sum(wire_bytes(len(part), is_encrypted) for part in parts[1:])
        self._guard.deliver(descriptor, size, len(parts) - 1, key)
        if len(parts[0]) != PEER_ID_BYTES:  # libzmq accepts most input as ZMTP 1.0
            self._guard.report_offence(descriptor, "not an agent: its id does not have 8 bytes")
        elif len(parts) > _MAX_PARTS:
            self._guard.report_offence(descriptor, "a message of too many parts")
        return key

    def _sender_key(self, part: zmq.Frame) -> str:
        """Return the sender's key, which `ZapAuthenticator` set as ZAP user id; "" without keys."""
        return "" if self._keys is None else str(part.get("User-Id"))

    def agent_names(self, key: str) -> frozenset[str] | None:
        if self._keys is None:
            return None
        if key not in self._agent_names:
            self._agent_names[key] = self._keys.allowed.agents_for(key)
        return self._agent_names[key]

    def trouble(self) -> str | None:
        return self._list_trouble

    def _refresh_allow_list(self) -> None:
        """Reread the allow list if due; close all connections if an admitted key was revoked."""
        if self._authenticator is not None and (now_s := time.monotonic()) >= self._list_due_s:
            self._list_due_s = now_s + _LIST_REFRESH_S
            self._agent_names.clear()
            self._list_trouble = self._authenticator.trouble()
            if self._authenticator.has_revoked():
                self._reopen()

    def refusals(self) -> list[str]:
        reports = self._guard.take_reports()
        failed = min(self._guard.take_failed_handshakes(), _MAX_REFUSALS)
        if self._authenticator is None:
            return reports + ["an agent uses keys and this edge does not: start it with --keys"] * failed
        lines = ["an agent without keys, or with another edge's key: check its --server-key"] * failed
        return reports + lines + self._authenticator.refusals()

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._close(LINGER_MS)

    def _open(self) -> None:
        self._link = _Socket(zmq.ROUTER, self._options, self._target)
        socket = self._link.socket
        self._guard = ConnectionGuard(
            socket, self._bounds, self._blocklist, partial(self._link.wake, _GUARD_WAKE)
        )
        self._authenticator = None
        if self._keys is not None:
            self._authenticator = ZapAuthenticator(self._link.context, socket, self._keys, self._guard)
        try:
            socket.bind(str(self._target))
        except zmq.ZMQError as error:
            self.close()
            raise bind_error(self._target, error.errno, error.strerror) from None
        bound = parse_address(socket.get_string(zmq.LAST_ENDPOINT).rstrip("\0"))
        self._target = Address(self._target.host, bound.port)

    def _reopen(self) -> None:
        self._close(linger_ms=0)
        self._open()
        self.wake()  # a wake-up of the old socket may be lost

    def _close(self, linger_ms: int) -> None:
        self._guard.close()
        self._link.close(linger_ms)
        if self._authenticator is not None:
            self._authenticator.join()
