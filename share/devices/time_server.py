"""An NTP server: which requests are answered, and with what (RFC 5905, sections 9.2 and 14)."""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any

from share.net.ntp import NtpMode, NtpPacket, to_stamp, with_transmit_time
from share.net.udp import Datagram, StampedSocket
from share.timing import PeriodicTimer, TokenBucket

LOCAL_REFERENCE_ID = bytes((127, 127, 1, 1))  # of an undisciplined local clock, as in ntpd and chrony
RATE_PER_S = 8.0  # mean rate of requests per address
BURST = 32  # requests at once per address; chronyd's iburst sends 4 to 8, every 2 s
MAX_CLIENTS = 1024  # addresses remembered; the least recently used is forgotten
_TICK_S = 0.2  # period of `show`; also how long `stop` may take
_MAX_REPORTED_ERRORS = 16  # kinds of errors that are reported


class TimeServer:
    """Answers NTP clients from this machine's clock, which it declares true: stratum `stratum`, no root
    delay, no root dispersion. Times are passed in. precision: log2 of s.

    A reply is never longer than its request, and an address that asks too often gets none, so that requests
    with a forged address amplify nothing.
    """

    def __init__(self, stratum: int = 10, precision: int = -20) -> None:
        self.stratum, self._precision = stratum, precision
        self._clients: OrderedDict[str, TokenBucket] = OrderedDict()
        self.counts: Counter[str] = Counter()  # answered, limited, ignored
        self.last_client: str | None = None  # address answered last

    @property
    def clients(self) -> int:
        """Number of remembered addresses."""
        return len(self._clients)

    def answer(self, data: bytes, address: str, received_ns: int, now_ns: int) -> NtpPacket | None:
        """Return the reply without its transmit stamp, which the sender sets; None to send nothing.

        received_ns: Unix time of arrival of `data`. now_ns: of a monotonic clock.
        """
        try:
            question = NtpPacket.decode(data)
        except ValueError:
            question = None
        if question is None or question.mode is not NtpMode.CLIENT:
            self.counts["ignored"] += 1
            return None
        if not self._bucket(address, now_ns).take(now_ns):
            self.counts["limited"] += 1
            return None
        self.counts["answered"] += 1
        self.last_client = address
        return self._reply(question, to_stamp(received_ns))

    def _reply(self, question: NtpPacket, received: int) -> NtpPacket:
        return NtpPacket(
            NtpMode.SERVER,
            version=question.version,
            stratum=self.stratum,
            poll=question.poll,
            precision=self._precision,
            refid=LOCAL_REFERENCE_ID,
            reference=received,  # the local clock is its own reference
            origin=question.transmit,
            receive=received,
        )

    def _bucket(self, address: str, now_ns: int) -> TokenBucket:
        bucket = self._clients.get(address)
        if bucket is None:
            bucket = self._clients[address] = TokenBucket(BURST)
            bucket.set_rate(RATE_PER_S, now_ns)
            if len(self._clients) > MAX_CLIENTS:
                self._clients.popitem(last=False)
        self._clients.move_to_end(address)
        return bucket


class TimeServerRun:
    """Runs a `TimeServer` at a socket, from `run` until `stop`. No input can end it. show: called several
    times a second. notify: called with a line for each new client and each new error."""

    def __init__(
        self,
        link: StampedSocket,
        server: TimeServer,
        notify: Callable[[str], None],
        show: Callable[[], None] = lambda: None,
    ) -> None:
        self._link, self._server, self._notify, self._show = link, server, notify, show
        self._stop = threading.Event()
        self._show_timer = PeriodicTimer(_TICK_S)
        self._notified: set[str] = set()

    def stop(self) -> None:
        self._stop.set()

    def run(self) -> None:
        while not self._stop.is_set():
            try:
                datagram = self._link.receive(_TICK_S)
            except OSError as error:  # the system lacks a resource: pause before the next attempt
                self._notify_once(f"cannot receive: {error.strerror or error}")
                self._stop.wait(_TICK_S)
                continue
            if datagram is not None:
                self._serve(datagram)
            if self._show_timer.fire_if_due(time.monotonic_ns()):
                self._show()

    def _serve(self, datagram: Datagram) -> None:
        known, address = self._server.clients, str(datagram.source[0])
        reply = self._server.answer(datagram.data, address, datagram.stamp_ns, time.monotonic_ns())
        if reply is not None:
            self._send(reply.encode(), datagram.source)
        if self._server.clients > known:
            self._notify(f"new client: {address}")

    def _send(self, reply: bytes, to: Any) -> None:
        try:
            self._link.send(with_transmit_time(reply, time.time_ns()), to)
        except OSError as error:  # no route, a firewall, a forged address: other clients are not affected
            self._notify_once(f"cannot send a reply to {to[0]}: {error.strerror or error}")

    def _notify_once(self, trouble: str) -> None:
        """Report each error once, at most `_MAX_REPORTED_ERRORS`: forged addresses may be many."""
        if trouble not in self._notified and len(self._notified) < _MAX_REPORTED_ERRORS:
            self._notified.add(trouble)
            self._notify(trouble)
