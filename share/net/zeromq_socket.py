"""A ZeroMQ socket that never blocks and that other threads can wake: of the agent's and of the edge's link.

DEALER at the agent, ROUTER at the edge (RFC 28/REQREP, ZMTP 3.1); with keys, CURVE (RFC 26) encrypts and
authenticates.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence

import zmq

from share.errors import TransportError
from share.net.keys import KeyPair
from share.net.transport import LINGER_MS, QUEUE_MESSAGES, Address
from share.wire.layouts import MAX_ARRAYS, MAX_FRAME_BYTES, Bytes

MAX_PARTS = 2 + MAX_ARRAYS  # peer, header, arrays; further parts are read and discarded
_ZAP_ENDPOINT = "inproc://zeromq.zap.01"
WAKE = b"w"  # written to the wake socket by `wake`
_SKIPPED_PARTS_PER_CALL = 2000  # of a message with too many parts, in one call: 3 ms
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


class ZmqSocket:
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
        MAX_PARTS + 1, so that the caller refuses it."""
        asked_s = time.monotonic()
        if self._is_skipping and not self._skip_parts():
            return None
        parts: list[zmq.Frame] = []
        try:
            while not parts or (parts[-1].more and len(parts) <= MAX_PARTS):
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

    def wake(self, reason: bytes = WAKE) -> None:
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


def make_curve_server(
    context: zmq.Context[zmq.Socket[bytes]], socket: zmq.Socket[bytes], own: KeyPair, domain: bytes
) -> zmq.Socket[bytes]:
    """Make `socket` a CURVE server, before it is bound. Return the socket on which libzmq asks, for each
    handshake, whether its key is admitted (ZAP, RFC 27)."""
    socket.setsockopt(zmq.CURVE_SERVER, 1)
    socket.setsockopt(zmq.CURVE_SECRETKEY, own.secret.encode())
    socket.setsockopt(zmq.ZAP_DOMAIN, domain)
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without it, a missing ZAP handler admits everyone
    requests = context.socket(zmq.REP)
    requests.bind(_ZAP_ENDPOINT)
    return requests
