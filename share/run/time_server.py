"""A time server at its socket. Nothing that comes in ends it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from share.core.time_server import TimeServer
from share.io.udp import Datagram, StampedSocket
from share.wire.ntp import sent_at

_TICK_S = 0.2  # how long it may take to end


class TimeServerRun:
    """`go` serves until `stop`. show: called after each datagram and each tick; say: what is new, a line."""

    def __init__(
        self,
        link: StampedSocket,
        server: TimeServer,
        say: Callable[[str], None],
        show: Callable[[], None] = lambda: None,
    ) -> None:
        self._link, self._server, self._say, self._show = link, server, say, show
        self._stop = threading.Event()
        self._trouble = ""

    def stop(self) -> None:
        self._stop.set()

    def go(self) -> None:
        while not self._stop.is_set():
            try:
                datagram = self._link.receive(_TICK_S)
                if datagram is not None:
                    self._serve(datagram)
            except OSError as error:  # no way to that client, a firewall, no memory
                self._lament(error.strerror or str(error))
            self._show()

    def _serve(self, datagram: Datagram) -> None:
        known, address = self._server.clients, str(datagram.source[0])
        reply = self._server.answer(datagram.data, address, datagram.stamp_ns, time.monotonic_ns())
        if reply is not None:
            encoded = reply.encode()
            self._link.send(sent_at(encoded, time.time_ns()), datagram.source)
        if self._server.clients > known:
            self._say(f"{address} asks")

    def _lament(self, trouble: str) -> None:
        """Says what is wrong, once, and does not spin on it."""
        if trouble != self._trouble:
            self._trouble = trouble
            self._say(f"an answer could not be sent: {trouble}")
        self._stop.wait(_TICK_S)
