"""Handshakes of encrypted links: their outcomes, and the edge's authentication of keys by ZAP (RFC 27)."""

from __future__ import annotations

from collections import deque
from enum import Enum
from threading import Thread

import zmq
from zmq.utils import z85
from zmq.utils.monitor import recv_monitor_message

from share.net.connection_guard import ConnectionGuard
from share.net.keys import EdgeKeys

_MECHANISM_MISMATCH = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_ENDPOINT = "inproc://zeromq.zap.01"
_DOMAIN = b"share"


class HandshakeOutcome(Enum):
    CONNECTED = "connected"  # the handshake starts
    DISCONNECTED = "disconnected"
    SUCCEEDED = "joined"
    UNKNOWN_KEY = "unknown key"  # the edge refuses this key
    NO_KEYS = "no keys"  # one side uses keys and the other none, as far as libzmq can tell
    BROKEN_OFF = "broken off"  # by the other side, without a reason


class HandshakeMonitor:
    """Outcomes of a socket's handshakes (zmq_socket_monitor). descriptor: of its newest connection."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket
        self.descriptor: int | None = None
        self.events: zmq.Socket[bytes] = socket.get_monitor_socket(
            zmq.EVENT_CONNECTED
            | zmq.EVENT_DISCONNECTED
            | zmq.EVENT_HANDSHAKE_SUCCEEDED
            | zmq.EVENT_HANDSHAKE_FAILED_AUTH
            | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
            | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
        )

    def next_outcome(self) -> HandshakeOutcome | None:
        """Return the next outcome, None if there is no new one."""
        try:
            event = recv_monitor_message(self.events, zmq.NOBLOCK)
        except zmq.Again:
            return None
        if event["event"] == zmq.EVENT_CONNECTED:
            self.descriptor = int(event["value"])
            return HandshakeOutcome.CONNECTED
        if event["event"] == zmq.EVENT_DISCONNECTED:
            return HandshakeOutcome.DISCONNECTED
        if event["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            return HandshakeOutcome.SUCCEEDED
        if event["event"] == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            return HandshakeOutcome.UNKNOWN_KEY
        return (
            HandshakeOutcome.NO_KEYS if event["value"] == _MECHANISM_MISMATCH else HandshakeOutcome.BROKEN_OFF
        )

    def close(self) -> None:
        """End the monitor; call before the socket is closed."""
        self._socket.disable_monitor()
        self.events.close(linger=0)


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
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret.encode())
        socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN)
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without it, a missing ZAP handler admits everyone
        self._requests = context.socket(zmq.REP)
        self._requests.bind(_ENDPOINT)
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
        self._refusals.append(
            self.trouble()
            or f"the key '{key}' ({address.decode()}) is not authorized; "
            f"to authorize it: share keys authorize NAME '{key}'"
        )
        return [version, number, b"400", b"not authorized", b"", b""]
