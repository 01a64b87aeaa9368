"""The links over ZeroMQ: DEALER at the agent, ROUTER at the edge (RFC 28/REQREP, ZMTP 3.1).

With keys, CURVE (RFC 26) encrypts and proves who is who; the edge's doorkeeper has the last word.
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
from share.net.backlog import BacklogLimits, wire_bytes
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

_MAX_PARTS = 2 + MAX_ARRAYS  # peer, header, arrays; parts beyond are read and thrown away
_SKIPPED_PARTS_PER_CALL = 2000  # of these, in one call: 3 ms
_WAKE, _POKE = b"w", b"p"
_MAX_REFUSALS = 128  # lines at a time
_MAX_DISCARDED_PER_CALL = 2000  # messages of strangers, or of who was cut off, in one call
_LIST_REFRESH_S = (
    0.1  # so old is what the edge knows of its list; a look at each message was a quarter of its work
)
_BACKLOG_CHECK_MS = 20  # how often an agent looks how much of its edge waits
_FORGIVE_S = 10.0  # an edge that has been connected so long does not send too much
_RECONNECT_S = 1.0  # after a handshake that failed, or a connection; libzmq gives up where it was wrong ZMTP
_COMMON_OPTIONS: dict[int, int] = {
    zmq.LINGER: LINGER_MS,
    zmq.SNDHWM: QUEUE_MESSAGES,
    zmq.RCVHWM: 0,  # see ZmqEdgeLink: an edge that resets while a full queue stops the input ends an agent
    zmq.MAXMSGSIZE: MAX_FRAME_BYTES,  # a larger frame closes the connection of its sender
    zmq.HANDSHAKE_IVL: 4000,  # an edge under attack holds newcomers meanwhile
    zmq.HEARTBEAT_IVL: 500,  # a peer whose network is gone is noticed, and its queue dropped, in 2 s
    zmq.HEARTBEAT_TIMEOUT: 2000,
    zmq.HEARTBEAT_TTL: 2000,
}
_CURVE_OVERHEAD_BYTES = (
    33  # libzmq measures the sealed frame: name and nonce 16, authenticator 16, flags 1 byte
)
_CURVE_OPTIONS: dict[int, int] = {zmq.MAXMSGSIZE: MAX_FRAME_BYTES + _CURVE_OVERHEAD_BYTES}
_DEALER_OPTIONS: dict[int, int] = {
    zmq.IMMEDIATE: 1,  # nothing queues for an edge that is not there
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 400,
    zmq.CONNECT_TIMEOUT: 2000,
    zmq.SNDBUF: 256 * 1024,  # on a slow network poses must not grow old in the kernel
    zmq.RCVBUF: 256 * 1024,  # an edge sends little; the kernel would take up to 32 MB of it
}
_ROUTER_OPTIONS: dict[int, int] = {
    zmq.ROUTER_MANDATORY: 1,  # sending to a peer that is gone is an error, not silence
    # An agent that comes back over another network takes over from its own half-open connection;
    # without this, libzmq would never route to it again. Ids are 64 random bits.
    zmq.ROUTER_HANDOVER: 1,
    # The heartbeat's timer of a connection that another took over ends the process where its peer then resets
    # it (libzmq 4.3.5, as with RCVHWM below). The kernel notices in 2 to 3 s that a network is gone: by what
    # is not acknowledged, or where nothing is under way, by its own probes.
    zmq.HEARTBEAT_IVL: 0,
    zmq.TCP_MAXRT: 2000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 1,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 2,
    zmq.SNDBUF: 256 * 1024,  # of a peer that reads nothing
}
_RECEIVE_BUFFER_BYTES = (
    256 * 1024
)  # in the kernel, of a connection: else up to 32 MB; images need more than that


class _Socket:
    """A socket with its own context, non-blocking, that another thread can wake."""

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
        self._is_skipping = False  # what comes next are parts of a message that has too many
        self.last_empty_s = 0.0  # when it was last asked for a message and there was none

    def send(self, frames: Sequence[Bytes]) -> bool:
        try:
            self.socket.send_multipart(frames, zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
                return False
            raise TransportError(f"cannot send: {error.strerror}") from None
        return True

    def wait(self, timeout_ms: int) -> bytes:
        """Until there is something to receive, or it is woken; by what it was."""
        ready = dict(self._poller.poll(0 if self._is_skipping else timeout_ms))
        return self._wake_reader.recv(4096) if self._wake_reader.fileno() in ready else b""

    def receive_now(self) -> list[zmq.Frame] | None:
        """The next message. Of one with too many parts one too many stays, so that it is refused."""
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
        """Throws away what is left of a message that is too long, or some of it. Whether that was all."""
        for _ in range(_SKIPPED_PARTS_PER_CALL):
            if not self.socket.recv(zmq.NOBLOCK, copy=False).more:
                self._is_skipping = False
                break
        return not self._is_skipping

    def wake(self, reason: bytes = _WAKE) -> None:
        try:
            self._wake_writer.send(reason)
        except OSError:  # full: it is awake already; closed: nobody sleeps
            return

    def close(self, linger_ms: int = LINGER_MS) -> None:
        if self.socket.closed:
            return
        self.socket.close(linger_ms)
        self.context.term()
        self._wake_reader.close()
        self._wake_writer.close()


class ZmqAgentLink:
    """`AgentLink` to tcp://HOST:PORT. Raises UsageError if that is not an address, or one of another
    machine and there are no keys."""

    def __init__(self, address: str, run_id: int, keys: AgentKeys | None = None) -> None:
        self._target = check_keys(parse_address(address), keys)
        self._keys, self._run_id = keys, run_id
        self._trouble: str | None = None
        self._flood_trouble: str | None = None  # what the edge there sent too much of, of late
        self._guard = AgentConnectionGuard(BacklogLimits.for_frame_size(MAX_FRAME_BYTES))
        self._backoff = Backoff(time.monotonic_ns())
        self._reconnect_s: float | None = None  # when
        self._forgive_s = 0.0  # when what the edge sent too much of is forgiven
        self._has_connected = False  # since last asked
        self._open()
        try:
            self._link.socket.connect(str(self._target))
        except zmq.ZMQError:
            self.close()
            host = self._target.host
            raise UsageError(f"{self._target}: '{host}' cannot be the name of a machine") from None

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
        """excess: what the edge sends too much of. What it sent is dropped; it is tried again later."""
        now_ns = time.monotonic_ns()
        if excess is not None:
            self._handshakes.close()
            self._link.close(linger_ms=0)
            self._open()
            self._reconnect_s = (now_ns * 1e-9) + self._backoff.record_failure(now_ns)
            self._trouble = None
            self._flood_trouble = (
                f"the edge there sends what no edge does ({excess}): cut off; this run goes on without it, "
                "and tries again, ever more rarely"
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
                self._has_connected, self._trouble, self._forgive_s = (
                    True,
                    None,
                    time.monotonic() + _FORGIVE_S,
                )
            elif outcome is not HandshakeOutcome.DISCONNECTED:
                self._trouble = f"not let in: {self._reason(outcome)}"
        if self._reconnect_s is not None and time.monotonic() >= self._reconnect_s:
            self._reconnect_s = None
            with contextlib.suppress(zmq.ZMQError):  # libzmq has forgotten it already
                self._link.socket.disconnect(str(self._target))
            self._link.socket.connect(str(self._target))

    def _reason(self, outcome: HandshakeOutcome) -> str:
        if self._keys is None:
            return "the edge there wants keys; give --server-key, its public key"
        if outcome is HandshakeOutcome.UNKNOWN_KEY:
            own = self._keys.own
            return f"the edge does not know this key; there: share keys authorize {own.name} '{own.public}'"
        return "whatever answers there has another key than --server-key says, or none"


class ZmqEdgeLink:
    """`EdgeLink` on tcp://HOST:PORT. Raises UsageError if that is no address, or one that others can
    reach and there are no keys, and TransportError if it cannot be bound.

    When someone who was let in is authorized no longer, all connections are closed: the others are
    back within about a second, as after a break of the network.
    """

    def __init__(
        self, address: str, keys: EdgeKeys | None = None, max_frame_bytes: int = MAX_FRAME_BYTES
    ) -> None:
        self._target = check_keys(parse_address(address, bind=True), keys)
        self._keys = keys
        self._bounds = BacklogLimits.for_frame_size(max_frame_bytes)
        self._options = _ROUTER_OPTIONS | {
            zmq.MAXMSGSIZE: max_frame_bytes + (_CURVE_OVERHEAD_BYTES if keys else 0),
            # libzmq 4.3.5 aborts where a peer resets its connection while a full queue has stopped its input
            # (stream_engine_base.cpp: !_io_error), so it never is full: the guard bounds what waits.
            zmq.RCVHWM: 0,
            **({} if max_frame_bytes > MAX_FRAME_BYTES else {zmq.RCVBUF: _RECEIVE_BUFFER_BYTES}),
        }
        self._blocklist = Blocklist()
        self._agent_names: dict[str, frozenset[str]] = {}  # by key, since the last look at the list
        self._list_due_s = 0.0
        self._list_trouble: str | None = None
        self.discarded_messages = 0  # messages dropped: their sender is no agent, or was cut off
        self._open()

    @property
    def endpoint(self) -> str:
        return str(self._target)

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        return self._link.send([peer, *frames])

    def receive(self, timeout_ms: int) -> IncomingMessage | None:
        self._refresh_allow_list()
        end_s = time.monotonic() + timeout_ms * 1e-3
        arrival, poked = self._receive_now(), True
        while arrival is None and poked:
            woken = self._link.wait(max(0, round((end_s - time.monotonic()) * 1e3)))
            poked = bool(woken) and _WAKE not in woken  # only to look again
            arrival = self._receive_now()
        return arrival

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
        """Tells the guard of a message; its sender's key, None where it is to be thrown away."""
        is_encrypted = self._keys is not None
        try:
            descriptor, key = int(parts[0].get(zmq.SRCFD)), self._sender_key(parts[0])
        except zmq.ZMQError:  # ZMTP 1.0 has no such thing
            return ""
        if self._guard.is_discarding(descriptor):
            return None
        size = sum(wire_bytes(len(part), is_encrypted) for part in parts[1:])
        self._guard.deliver(descriptor, size, len(parts) - 1, key)
        if len(parts[0]) != PEER_ID_BYTES:  # libzmq still takes most bytes for ZMTP 1.0
            self._guard.report_offence(descriptor, "its id is not 8 bytes: no agent")
        elif len(parts) > _MAX_PARTS:
            self._guard.report_offence(descriptor, "a message of too many parts")
        return key

    def _sender_key(self, part: zmq.Frame) -> str:
        """The sender's, that the doorkeeper gave as its ZAP user id."""
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
        """Of who is authorized, as the file says now and then."""
        if self._authenticator is not None and (now_s := time.monotonic()) >= self._list_due_s:
            self._list_due_s = now_s + _LIST_REFRESH_S
            self._agent_names.clear()
            self._list_trouble = self._authenticator.trouble()
            if self._authenticator.has_revoked():
                self._reopen()

    def refusals(self) -> list[str]:
        cut_off, failed = self._guard.take_reports(), min(self._guard.take_failed_handshakes(), _MAX_REFUSALS)
        if self._authenticator is None:
            return cut_off + ["an agent with keys; this edge uses none: start it with --keys"] * failed
        lines = ["one without keys, or with the key of another edge: see its --server-key"] * failed
        return cut_off + lines + self._authenticator.refusals()

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._close(LINGER_MS)

    def _open(self) -> None:
        self._link = _Socket(zmq.ROUTER, self._options, self._target)
        socket = self._link.socket
        self._guard = ConnectionGuard(socket, self._bounds, self._blocklist, partial(self._link.wake, _POKE))
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
        self.wake()  # in case someone has just woken the old socket

    def _close(self, linger_ms: int) -> None:
        self._guard.close()
        self._link.close(linger_ms)
        if self._authenticator is not None:
            self._authenticator.join()
