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
from share.net.account import Bounds, wire_bytes
from share.net.edge_watch import EdgeWatch
from share.net.gate import KeepOut
from share.net.guard import Guard
from share.net.handshake import Doorkeeper, Handshakes, Outcome
from share.net.keys import AgentKeys, EdgeKeys
from share.net.transport import (
    LINGER_MS,
    QUEUE_MESSAGES,
    Address,
    Arrival,
    bind_error,
    check_keys,
    parse_address,
)
from share.rates import Backoff
from share.wire.codec import MAX_ARRAYS, MAX_FRAME_BYTES, Bytes
from share.wire.messages import PEER_BYTES, peer_id

_MAX_PARTS = 2 + MAX_ARRAYS  # peer, header, arrays; parts beyond are read and thrown away
_SLICE = 2000  # of these, in one call: 3 ms
_WAKE, _POKE = b"w", b"p"
_REFUSALS = 128  # lines at a time
_IN_VAIN = 2000  # messages of strangers, or of who was cut off, in one call
_LIST_S = 0.1  # so old is what the edge knows of its list; a look at each message was a quarter of its work
_LOOK_MS = 20  # how often an agent looks how much of its edge waits
_WELL_S = 10.0  # an edge that has been connected so long does not send too much
_REDIAL_S = 1.0  # after a handshake that failed, or a connection; libzmq gives up where it was wrong ZMTP
_COMMON: dict[int, int] = {
    zmq.LINGER: LINGER_MS,
    zmq.SNDHWM: QUEUE_MESSAGES,
    zmq.RCVHWM: 0,  # see ZmqEdgeLink: an edge that resets while a full queue stops the input ends an agent
    zmq.MAXMSGSIZE: MAX_FRAME_BYTES,  # a larger frame closes the connection of its sender
    zmq.HANDSHAKE_IVL: 4000,  # an edge under attack holds newcomers meanwhile
    zmq.HEARTBEAT_IVL: 500,  # a peer whose network is gone is noticed, and its queue dropped, in 2 s
    zmq.HEARTBEAT_TIMEOUT: 2000,
    zmq.HEARTBEAT_TTL: 2000,
}
_SEAL_BYTES = 33  # libzmq measures the sealed frame: name and nonce 16, authenticator 16, flags 1 byte
_SEALED: dict[int, int] = {zmq.MAXMSGSIZE: MAX_FRAME_BYTES + _SEAL_BYTES}
_DEALER: dict[int, int] = {
    zmq.IMMEDIATE: 1,  # nothing queues for an edge that is not there
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 400,
    zmq.CONNECT_TIMEOUT: 2000,
    zmq.SNDBUF: 256 * 1024,  # on a slow network poses must not grow old in the kernel
    zmq.RCVBUF: 256 * 1024,  # an edge sends little; the kernel would take up to 32 MB of it
}
_ROUTER: dict[int, int] = {
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
_RECEIVED_BYTES = 256 * 1024  # in the kernel, of a connection: else up to 32 MB; images need more than that


class _Socket:
    """A socket with its own context, non-blocking, that another thread can wake."""

    def __init__(self, kind: int, options: dict[int, int], target: Address) -> None:
        self.context = zmq.Context()
        self.socket: zmq.Socket[bytes] = self.context.socket(kind)
        for option, value in (_COMMON | options).items():
            self.socket.setsockopt(option, value)
        self.socket.setsockopt(zmq.IPV6, ":" in target.host)
        self._wake_reader, self._wake_writer = socket.socketpair()
        for end in (self._wake_reader, self._wake_writer):
            end.setblocking(False)
        self._poller = zmq.Poller()
        self._poller.register(self.socket, zmq.POLLIN)
        self._poller.register(self._wake_reader, zmq.POLLIN)
        self._too_long = False  # what comes next are parts of a message that has too many
        self.empty_s = 0.0  # when it was last asked for a message and there was none

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
        ready = dict(self._poller.poll(0 if self._too_long else timeout_ms))
        return self._wake_reader.recv(4096) if self._wake_reader.fileno() in ready else b""

    def receive_now(self) -> list[zmq.Frame] | None:
        """The next message. Of one with too many parts one too many stays, so that it is refused."""
        asked_s = time.monotonic()
        if self._too_long and not self._skip():
            return None
        parts: list[zmq.Frame] = []
        try:
            while not parts or (parts[-1].more and len(parts) <= _MAX_PARTS):
                parts.append(self.socket.recv(zmq.NOBLOCK, copy=False))
        except zmq.Again:
            self.empty_s = asked_s
            return None
        self._too_long = parts[-1].more
        return parts

    def _skip(self) -> bool:
        """Throws away what is left of a message that is too long, or some of it. Whether that was all."""
        for _ in range(_SLICE):
            if not self.socket.recv(zmq.NOBLOCK, copy=False).more:
                self._too_long = False
                break
        return not self._too_long

    def wake(self, how: bytes = _WAKE) -> None:
        try:
            self._wake_writer.send(how)
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
        self._excess: str | None = None  # what the edge there sent too much of, of late
        self._watch = EdgeWatch(Bounds.of(MAX_FRAME_BYTES))
        self._backoff = Backoff(time.monotonic_ns())
        self._redial_s: float | None = None  # when
        self._well_s = 0.0  # when what the edge sent too much of is forgiven
        self._joined = False  # since last asked
        self._open()
        try:
            self._link.socket.connect(str(self._target))
        except zmq.ZMQError:
            self.close()
            host = self._target.host
            raise UsageError(f"{self._target}: '{host}' cannot be the name of a machine") from None

    def _open(self) -> None:
        self._link = _Socket(zmq.DEALER, _DEALER | (_SEALED if self._keys else {}), self._target)
        self._handshakes = Handshakes(self._link.socket)
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
            self._look(self._watch.look())
            parts = self._link.receive_now()
            left_ms = round((end_s - time.monotonic()) * 1e3)
            if parts is not None:
                size = sum(wire_bytes(len(part), self._keys is not None) for part in parts)
                self._watch.took(size, len(parts), time.monotonic())
                return [part.bytes for part in parts]
            self._look(self._watch.empty())
            if is_over:
                return None
            is_over = bool(self._link.wait(min(max(0, left_ms), _LOOK_MS))) or left_ms <= _LOOK_MS

    def trouble(self) -> str | None:
        return self._trouble or self._excess

    def connected(self) -> bool:
        joined, self._joined = self._joined, False
        return joined

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        if not self._link.socket.closed:
            self._handshakes.close()
        self._link.close()

    def _look(self, excess: str | None) -> None:
        """excess: what the edge sends too much of. What it sent is dropped; it is tried again later."""
        now_ns = time.monotonic_ns()
        if excess is not None:
            self._handshakes.close()
            self._link.close(linger_ms=0)
            self._open()
            self._redial_s = (now_ns * 1e-9) + self._backoff.died(now_ns)
            self._trouble = None
            self._excess = (
                f"the edge there sends what no edge does ({excess}): cut off; this run goes on without it, "
                "and tries again, ever more rarely"
            )
        elif self._excess and self._redial_s is None and now_ns * 1e-9 > self._well_s:
            self._excess = None

    def _keep_connected(self) -> None:
        while (outcome := self._handshakes.next()) is not None:
            if outcome is Outcome.CONNECTED:
                self._redial_s = None
                if self._handshakes.descriptor is not None:
                    self._watch.connected(self._handshakes.descriptor, time.monotonic())
                continue
            joined = outcome is Outcome.JOINED
            self._redial_s = None if joined else time.monotonic() + _REDIAL_S
            if joined:
                self._joined, self._trouble, self._well_s = True, None, time.monotonic() + _WELL_S
            elif outcome is not Outcome.DISCONNECTED:
                self._trouble = f"not let in: {self._reason(outcome)}"
        if self._redial_s is not None and time.monotonic() >= self._redial_s:
            self._redial_s = None
            with contextlib.suppress(zmq.ZMQError):  # libzmq has forgotten it already
                self._link.socket.disconnect(str(self._target))
            self._link.socket.connect(str(self._target))

    def _reason(self, outcome: Outcome) -> str:
        if self._keys is None:
            return "the edge there wants keys; give --server-key, its public key"
        if outcome is Outcome.UNKNOWN_KEY:
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
        self._bounds = Bounds.of(max_frame_bytes)
        self._options = _ROUTER | {
            zmq.MAXMSGSIZE: max_frame_bytes + (_SEAL_BYTES if keys else 0),
            # libzmq 4.3.5 aborts where a peer resets its connection while a full queue has stopped its input
            # (stream_engine_base.cpp: !_io_error), so it never is full: the guard bounds what waits.
            zmq.RCVHWM: 0,
            **({} if max_frame_bytes > MAX_FRAME_BYTES else {zmq.RCVBUF: _RECEIVED_BYTES}),
        }
        self._kept_out = KeepOut()
        self._names: dict[str, frozenset[str]] = {}  # by key, since the last look at the list
        self._list_due_s = 0.0
        self._list_trouble: str | None = None
        self.strangers = 0  # messages dropped: their sender is no agent, or was cut off
        self._open()

    @property
    def endpoint(self) -> str:
        return str(self._target)

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        return self._link.send([peer, *frames])

    def receive(self, timeout_ms: int) -> Arrival | None:
        self._keep_to_list()
        end_s = time.monotonic() + timeout_ms * 1e-3
        arrival, poked = self._receive_now(), True
        while arrival is None and poked:
            woken = self._link.wait(max(0, round((end_s - time.monotonic()) * 1e3)))
            poked = bool(woken) and _WAKE not in woken  # only to look again
            arrival = self._receive_now()
        return arrival

    def _receive_now(self) -> Arrival | None:
        for _ in range(_IN_VAIN):
            self._guard.look()
            parts = self._link.receive_now()
            if parts is None:
                self._guard.empty(self._link.empty_s)
                return None
            key = self._account_for(parts)
            if key is not None and len(parts[0]) == PEER_BYTES:
                return Arrival(parts[0].bytes, [part.bytes for part in parts[1:]], key)
            self.strangers += 1
        return None

    def _account_for(self, parts: list[zmq.Frame]) -> str | None:
        """Tells the guard of a message; its sender's key, None where it is to be thrown away."""
        sealed = self._keys is not None
        try:
            descriptor, key = int(parts[0].get(zmq.SRCFD)), self._key(parts[0])
        except zmq.ZMQError:  # ZMTP 1.0 has no such thing
            return ""
        if self._guard.discards(descriptor):
            return None
        size = sum(wire_bytes(len(part), sealed) for part in parts[1:])
        self._guard.took(descriptor, size, len(parts) - 1, key)
        if len(parts[0]) != PEER_BYTES:  # libzmq still takes most bytes for ZMTP 1.0
            self._guard.charge(descriptor, "its id is not 8 bytes: no agent")
        elif len(parts) > _MAX_PARTS:
            self._guard.charge(descriptor, "a message of too many parts")
        return key

    def _key(self, part: zmq.Frame) -> str:
        """The sender's, that the doorkeeper gave as its ZAP user id."""
        return "" if self._keys is None else str(part.get("User-Id"))

    def names(self, key: str) -> frozenset[str] | None:
        if self._keys is None:
            return None
        if key not in self._names:
            self._names[key] = self._keys.allowed.agents(key)
        return self._names[key]

    def trouble(self) -> str | None:
        return self._list_trouble

    def _keep_to_list(self) -> None:
        """Of who is authorized, as the file says now and then."""
        if self._door is not None and (now_s := time.monotonic()) >= self._list_due_s:
            self._list_due_s = now_s + _LIST_S
            self._names.clear()
            self._list_trouble = self._door.trouble()
            if self._door.revoked():
                self._reopen()

    def refusals(self) -> list[str]:
        cut_off, failed = self._guard.lines(), min(self._guard.failed(), _REFUSALS)
        if self._door is None:
            return cut_off + ["an agent with keys; this edge uses none: start it with --keys"] * failed
        lines = ["one without keys, or with the key of another edge: see its --server-key"] * failed
        return cut_off + lines + self._door.refusals()

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._close(LINGER_MS)

    def _open(self) -> None:
        self._link = _Socket(zmq.ROUTER, self._options, self._target)
        socket = self._link.socket
        self._guard = Guard(socket, self._bounds, self._kept_out, partial(self._link.wake, _POKE))
        self._door = None
        if self._keys is not None:
            self._door = Doorkeeper(self._link.context, socket, self._keys, self._guard)
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
        if self._door is not None:
            self._door.join()
