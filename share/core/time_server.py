"""A time server's side: which questions are answered, and with what (RFC 5905, sections 9.2 and 14)."""

from __future__ import annotations

from collections import Counter, OrderedDict

from share.core.rate import TokenBucket
from share.wire.ntp import Mode, Packet, to_stamp

LOCAL = bytes(
    (127, 127, 1, 1)
)  # the reference id of a clock that follows nothing, as ntpd and chrony write it
PER_S = 8.0  # questions that one address may ask, on average,
BURST = 32  # and at once; chronyd's iburst is 4 to 8 in 2 s each
CLIENTS = 1024  # addresses remembered; the one not heard for longest is forgotten


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
        self.newest: str | None = None  # address that was answered last

    @property
    def clients(self) -> int:
        """Addresses that asked, of those remembered."""
        return len(self._clients)

    def answer(self, data: bytes, address: str, received_ns: int, now_ns: int) -> Packet | None:
        """All but its transmit stamp, which is for who sends it; None: nothing is to be sent.

        received_ns: Unix time when `data` came; now_ns: of a clock that is never set.
        """
        try:
            question = Packet.decode(data)
        except ValueError:
            question = None
        if question is None or question.mode is not Mode.CLIENT:
            self.counts["ignored"] += 1
            return None
        if not self._bucket(address, now_ns).take(now_ns):
            self.counts["limited"] += 1
            return None
        self.counts["answered"] += 1
        self.newest = address
        return self._reply(question, to_stamp(received_ns))

    def _reply(self, question: Packet, received: int) -> Packet:
        return Packet(
            Mode.SERVER,
            version=question.version,
            stratum=self.stratum,
            poll=question.poll,
            precision=self._precision,
            refid=LOCAL,
            reference=received,  # a clock that follows nothing but itself was right just now
            origin=question.transmit,
            receive=received,
        )

    def _bucket(self, address: str, now_ns: int) -> TokenBucket:
        bucket = self._clients.get(address)
        if bucket is None:
            bucket = self._clients[address] = TokenBucket(BURST)
            bucket.limit(PER_S, now_ns)
            if len(self._clients) > CLIENTS:
                self._clients.popitem(last=False)
        self._clients.move_to_end(address)
        return bucket
