"""The links over ZeroMQ: DEALER at the agent, ROUTER at the edge (RFC 28/REQREP, ZMTP 3.1)."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence

import zmq

from share.errors import TransportError, UsageError
from share.io.transport import LINGER_MS, QUEUE_MESSAGES, Address, parse_address
from share.wire.codec import MAX_ARRAYS, MAX_FRAME_BYTES, Bytes
from share.wire.messages import PEER_BYTES, peer_id

_MAX_PARTS = 2 + MAX_ARRAYS  # peer, header, arrays; parts beyond are read and thrown away
_COMMON: dict[int, int] = {
    zmq.LINGER: LINGER_MS,
    zmq.SNDHWM: QUEUE_MESSAGES,
    zmq.RCVHWM: QUEUE_MESSAGES,
    zmq.MAXMSGSIZE: MAX_FRAME_BYTES,  # a larger frame closes the connection of its sender
    zmq.HANDSHAKE_IVL: 2000,
    zmq.HEARTBEAT_IVL: 500,  # a peer whose network is gone is noticed, and its queue dropped, in 2 s
    zmq.HEARTBEAT_TIMEOUT: 2000,
    zmq.HEARTBEAT_TTL: 2000,
}
_DEALER: dict[int, int] = {
    zmq.IMMEDIATE: 1,  # nothing queues for an edge that is not there
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 1000,
    zmq.CONNECT_TIMEOUT: 2000,
    zmq.SNDBUF: 256 * 1024,  # on a slow network poses must not grow old in the kernel
}
_ROUTER: dict[int, int] = {
    zmq.ROUTER_MANDATORY: 1,  # sending to a peer that is gone is an error, not silence
    # An agent that comes back over another network takes over from its own half-open connection;
    # without this, libzmq would never route to it again. Ids are 64 random bits.
    zmq.ROUTER_HANDOVER: 1,
}


class _Socket:
    """A socket with its own context, non-blocking, that another thread can wake."""

    def __init__(self, kind: int, options: dict[int, int], target: Address) -> None:
        self._context = zmq.Context()
        self.socket: zmq.Socket[bytes] = self._context.socket(kind)
        for option, value in (_COMMON | options).items():
            self.socket.setsockopt(option, value)
        self.socket.setsockopt(zmq.IPV6, ":" in target.host)
        self._wake_reader, self._wake_writer = socket.socketpair()
        for end in (self._wake_reader, self._wake_writer):
            end.setblocking(False)
        self._poller = zmq.Poller()
        self._poller.register(self.socket, zmq.POLLIN)
        self._poller.register(self._wake_reader, zmq.POLLIN)

    def send(self, frames: Sequence[Bytes]) -> bool:
        try:
            self.socket.send_multipart(frames, zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno in (zmq.EAGAIN, zmq.EHOSTUNREACH):
                return False
            raise TransportError(f"cannot send: {error.strerror}") from None
        return True

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        parts = self._receive_now()
        if parts is not None:
            return parts
        ready = dict(self._poller.poll(timeout_ms))
        if self._wake_reader.fileno() in ready:
            self._wake_reader.recv(4096)
        return self._receive_now()

    def _receive_now(self) -> list[bytes] | None:
        try:
            parts = [self.socket.recv(zmq.NOBLOCK)]
        except zmq.Again:
            return None
        while self.socket.getsockopt(zmq.RCVMORE):
            part = self.socket.recv(zmq.NOBLOCK)
            if len(parts) <= _MAX_PARTS:  # one too many is kept, so that the decoder refuses it
                parts.append(part)
        return parts

    def wake(self) -> None:
        try:
            self._wake_writer.send(b"\0")
        except OSError:  # full: it is awake already; closed: nobody sleeps
            return

    def close(self) -> None:
        self.socket.close()
        self._context.term()
        self._wake_reader.close()
        self._wake_writer.close()


class ZmqAgentLink:
    """`AgentLink` to tcp://HOST:PORT. Raises UsageError if that is not an address."""

    def __init__(self, address: str, run_id: int) -> None:
        target = parse_address(address)
        self._link = _Socket(zmq.DEALER, _DEALER, target)
        self._link.socket.setsockopt(zmq.ROUTING_ID, peer_id(run_id))
        try:
            self._link.socket.connect(str(target))
        except zmq.ZMQError:
            self._link.close()
            raise UsageError(f"{target}: '{target.host}' cannot be the name of a machine") from None

    def send(self, frames: Sequence[Bytes]) -> bool:
        return self._link.send(frames)

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        return self._link.receive(timeout_ms)

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._link.close()


class ZmqEdgeLink:
    """`EdgeLink` on tcp://HOST:PORT. Raises UsageError if that is no address, or one that others can
    reach, and TransportError if it cannot be bound."""

    def __init__(self, address: str) -> None:
        target = parse_address(address, bind=True)
        if not target.local:
            raise UsageError(
                f"{target}: only this machine may be served without keys; bind tcp://127.0.0.1:{target.port}"
            )
        self._link = _Socket(zmq.ROUTER, _ROUTER, target)
        try:
            self._link.socket.bind(str(target))
        except zmq.ZMQError as error:
            self._link.close()
            raise _bind_error(target, error) from None
        bound = self._link.socket.get_string(zmq.LAST_ENDPOINT).rstrip("\0")
        self.strangers = 0  # messages dropped because their sender is no agent
        self.endpoint = str(Address(target.host, parse_address(bound).port))

    def send(self, peer: bytes, frames: Sequence[Bytes]) -> bool:
        return self._link.send([peer, *frames])

    def receive(self, timeout_ms: int) -> tuple[bytes, list[bytes]] | None:
        parts = self._link.receive(timeout_ms)
        if parts and len(parts[0]) != PEER_BYTES:  # libzmq still takes most bytes for ZMTP 1.0
            self.strangers += 1
            return None
        return (parts[0], parts[1:]) if parts else None

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        self._link.close()


def _bind_error(target: Address, error: zmq.ZMQError) -> TransportError:
    mend = {
        errno.EADDRINUSE: "the port is in use; stop the other edge or choose another port",
        errno.EACCES: "this port needs root; choose one above 1023",
        errno.EADDRNOTAVAIL: "this machine has no such address",
        errno.ENODEV: "this machine has no such address",
    }
    return TransportError(f"{target}: {mend.get(error.errno or 0, f'cannot be bound: {error.strerror}')}")
