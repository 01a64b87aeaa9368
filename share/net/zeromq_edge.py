"""The edge's link over ZeroMQ; with keys, the authentication of agents by ZAP (RFC 27)."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from threading import Thread

import zmq
from zmq.utils import z85

from share.net.backlog import CURVE_OVERHEAD_BYTES, BacklogLimits, wire_bytes
from share.net.connection_gate import Blocklist
from share.net.connection_guard import ConnectionGuard
from share.net.keys import EdgeKeys
from share.net.transport import LINGER_MS, Address, IncomingMessage, bind_error, check_keys, parse_address
from share.net.zeromq_socket import MAX_PARTS, WAKE, ZmqSocket, make_curve_server
from share.wire.layouts import MAX_FRAME_BYTES, Bytes
from share.wire.messages import PEER_ID_BYTES
from share.wire.room_messages import Permission

_GUARD_WAKE = b"g"  # wakes the socket for the guard: look for a message, but do not return without one
_MAX_REFUSALS = 128  # lines at a time
_MAX_DISCARDED_PER_CALL = 2000  # messages from unidentified or disconnected peers, in one call
_LIST_REFRESH_S = 0.1  # age of the cached allow list; reading it for each message was a quarter of the work
_ZAP_DOMAIN = b"share"
_OPTIONS: dict[int, int] = {
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
        self._options = _OPTIONS | {
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
        self._expects_growth = False
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
            by_guard = bool(woken) and WAKE not in woken
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
        elif len(parts) > MAX_PARTS:
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

    def permissions(self, key: str) -> frozenset[Permission]:
        return frozenset() if self._keys is None else self._keys.allowed.permissions_of(key)

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

    def expect_growth(self, is_expected: bool) -> None:
        self._expects_growth = self._guard.expects_growth = is_expected

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._close(LINGER_MS)

    def _open(self) -> None:
        self._link = ZmqSocket(zmq.ROUTER, self._options, self._target)
        socket = self._link.socket
        self._guard = ConnectionGuard(
            socket, self._bounds, self._blocklist, partial(self._link.wake, _GUARD_WAKE)
        )
        self._guard.expects_growth = self._expects_growth
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


class ZapAuthenticator:
    """Makes `socket` a CURVE server and decides for each handshake whether its key is admitted.

    It runs a thread, so that agents can connect while the edge is busy. The thread ends when the context is
    terminated; call `join` then. Must be created before the socket is bound.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        socket: zmq.Socket[bytes],
        keys: EdgeKeys,
        guard: ConnectionGuard,
    ) -> None:
        self._guard = guard
        self._refusals: deque[str] = deque(maxlen=128)
        self._allowed = keys.allowed
        self._admitted_keys: set[str] = set()  # so far
        self._requests = make_curve_server(context, socket, keys.own, _ZAP_DOMAIN)
        self._thread = Thread(target=self._serve, name="authenticator", daemon=True)
        self._thread.start()

    def has_revoked(self) -> bool:
        """Return whether an admitted key is no longer authorized."""
        return not all(self._allowed.is_allowed(key) for key in tuple(self._admitted_keys))

    def trouble(self) -> str | None:
        """Return why no key is admitted; None if the allow list is readable."""
        list_trouble = self._allowed.trouble()
        return None if list_trouble is None else f"all agents are refused: {list_trouble}"

    def refusals(self) -> list[str]:
        """Return a line for each refusal since the last call."""
        return [self._refusals.popleft() for _ in range(len(self._refusals))]

    def join(self) -> None:
        self._thread.join()

    def _serve(self) -> None:
        while True:
            try:
                self._requests.send_multipart(self._answer(self._requests.recv_multipart()))
            except zmq.ContextTerminated:
                self._requests.close()
                return

    def _answer(self, request: list[bytes]) -> list[bytes]:
        version, number, _domain, address, _identity, _mechanism, credentials = request
        key = z85.encode(credentials).decode()
        if self._allowed.is_allowed(key):
            if not self._guard.admit(key, address.decode()):  # 300: temporary, so that libzmq retries
                return [version, number, b"300", b"blocked", b"", b""]
            self._admitted_keys.add(key)  # a revocation meanwhile is found by the next `has_revoked`
            return [version, number, b"200", b"", key.encode(), b""]
        self._refusals.append(self.trouble() or self._allowed.refusal(key, address.decode()))
        return [version, number, b"400", b"not authorized", b"", b""]
