"""How handshakes end: what libzmq's monitor tells of a socket (zmq_socket_monitor)."""

from __future__ import annotations

from enum import Enum

import zmq
from zmq.utils.monitor import recv_monitor_message

_MECHANISM_MISMATCH = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH


class Outcome(Enum):
    CONNECTED = "connected"  # the handshake begins
    DISCONNECTED = "disconnected"
    JOINED = "joined"
    UNKNOWN_KEY = "unknown key"  # the edge does not let this key in
    NO_KEYS = "no keys"  # one side uses keys, the other none, and libzmq could tell
    BROKEN_OFF = "broken off"  # by the other side, which says no more


class Handshakes:
    """The outcomes of one socket's handshakes, as they happen. descriptor: of its newest connection."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._monitored = socket
        self.descriptor: int | None = None
        self.events: zmq.Socket[bytes] = socket.get_monitor_socket(
            zmq.EVENT_CONNECTED
            | zmq.EVENT_DISCONNECTED
            | zmq.EVENT_HANDSHAKE_SUCCEEDED
            | zmq.EVENT_HANDSHAKE_FAILED_AUTH
            | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
            | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
        )

    def next(self) -> Outcome | None:
        """None: nothing has happened since."""
        try:
            event = recv_monitor_message(self.events, zmq.NOBLOCK)
        except zmq.Again:
            return None
        if event["event"] == zmq.EVENT_CONNECTED:
            self.descriptor = int(event["value"])
            return Outcome.CONNECTED
        if event["event"] == zmq.EVENT_DISCONNECTED:
            return Outcome.DISCONNECTED
        if event["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            return Outcome.JOINED
        if event["event"] == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            return Outcome.UNKNOWN_KEY
        return Outcome.NO_KEYS if event["value"] == _MECHANISM_MISMATCH else Outcome.BROKEN_OFF

    def close(self) -> None:
        """Before the socket itself is closed."""
        self._monitored.disable_monitor()
        self.events.close(linger=0)
