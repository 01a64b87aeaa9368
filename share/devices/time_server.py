"""A time server's side: which questions are answered, and with what (RFC 5905, sections 9.2 and 14)."""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any

from share.net.ntp import NtpMode, NtpPacket, to_stamp, with_transmit_time
from share.net.udp import Datagram, StampedSocket
from share.timing import PeriodicTimer, TokenBucket

LOCAL_REFERENCE_ID = bytes(
    (127, 127, 1, 1)
)  # the reference id of a clock that follows nothing, as ntpd and chrony write it
RATE_PER_S = 8.0  # questions that one address may ask, on average,
BURST = 32  # and at once; chronyd's iburst is 4 to 8 in 2 s each
MAX_CLIENTS = 1024  # addresses remembered; the one not heard for longest is forgotten


class TimeServer:
    """Answers clients, by address, out of the clock of this machine, which it calls true: stratum
    `stratum`, no root delay, no root dispersion. Times are passed in. precision: log2 of s.

    An answer is never longer than its question, and whoever asks too often is not answered at all, so that
    questions with a forged address bring nobody more than was sent.
    """

    def __init__(self, stratum: int = 10, precision: int = -20) -> None:
        self.stratum, self._precision = stratum, precision
        self._clients: OrderedDict[str, TokenBucket] = OrderedDict()
        self.counts: Counter[str] = Counter()  # answered, limited, ignored
        self.last_client: str | None = None  # address that was answered last

    @property
    def clients(self) -> int:
        """Addresses that asked, of those remembered."""
        return len(self._clients)

    def answer(self, data: bytes, address: str, received_ns: int, now_ns: int) -> NtpPacket | None:
        """All but its transmit stamp, which is for who sends it; None: nothing is to be sent.

        received_ns: Unix time when `data` came; now_ns: of a clock that is never set.
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
            reference=received,  # a clock that follows nothing but itself was right just now
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


# ---- A time server at its socket. Nothing that comes in ends it.

_TICK_S = 0.2  # how long it may take to end
_MAX_COMPLAINTS = 16  # complaints


class TimeServerRun:
    """`run` serves until `stop`. show: called a few times a second; say: what is new, a line."""

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
            except OSError as error:  # the system is short of something: not to be asked at once again
                self._notify_once(f"nothing can be received: {error.strerror or error}")
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
            self._notify(f"{address} asks")

    def _send(self, reply: bytes, to: Any) -> None:
        try:
            self._link.send(with_transmit_time(reply, time.time_ns()), to)
        except OSError as error:  # no way there, a firewall, a forged address: the next client is another
            self._notify_once(f"an answer could not be sent to {to[0]}: {error.strerror or error}")

    def _notify_once(self, trouble: str) -> None:
        """Once each: `_MAX_COMPLAINTS` of them, as forged addresses are many."""
        if trouble not in self._notified and len(self._notified) < _MAX_COMPLAINTS:
            self._notified.add(trouble)
            self._notify(trouble)
