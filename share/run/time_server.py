"""A time server at its socket. Nothing that comes in ends it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from share.core.rate import Every
from share.core.time_server import TimeServer
from share.io.udp import Datagram, StampedSocket
from share.wire.ntp import sent_at

_TICK_S = 0.2  # how long it may take to end
_REMEMBERED = 16  # complaints


class TimeServerRun:
    """`go` serves until `stop`. show: called a few times a second; say: what is new, a line."""

    def __init__(
        self,
        link: StampedSocket,
        server: TimeServer,
        say: Callable[[str], None],
        show: Callable[[], None] = lambda: None,
    ) -> None:
        self._link, self._server, self._say, self._show = link, server, say, show
        self._stop = threading.Event()
        self._shown = Every(_TICK_S)
        self._troubles: set[str] = set()

    def stop(self) -> None:
        self._stop.set()

    def go(self) -> None:
        while not self._stop.is_set():
            try:
                datagram = self._link.receive(_TICK_S)
            except OSError as error:  # the system is short of something: not to be asked at once again
                self._lament(f"nothing can be received: {error.strerror or error}")
                self._stop.wait(_TICK_S)
                continue
            if datagram is not None:
                self._serve(datagram)
            if self._shown.due(time.monotonic_ns()):
                self._show()

    def _serve(self, datagram: Datagram) -> None:
        known, address = self._server.clients, str(datagram.source[0])
        reply = self._server.answer(datagram.data, address, datagram.stamp_ns, time.monotonic_ns())
        if reply is not None:
            self._send(reply.encode(), datagram.source)
        if self._server.clients > known:
            self._say(f"{address} asks")

    def _send(self, reply: bytes, to: Any) -> None:
        try:
            self._link.send(sent_at(reply, time.time_ns()), to)
        except OSError as error:  # no way there, a firewall, a forged address: the next client is another
            self._lament(f"an answer could not be sent to {to[0]}: {error.strerror or error}")

    def _lament(self, trouble: str) -> None:
        """Once each: `_REMEMBERED` of them, as forged addresses are many."""
        if trouble not in self._troubles and len(self._troubles) < _REMEMBERED:
            self._troubles.add(trouble)
            self._say(trouble)
