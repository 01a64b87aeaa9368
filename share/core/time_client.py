"""What answers of a time server say of the own clock: its offset, and how wrong that can be.

RFC 5905, sections 8 and 10, for one who asks a few times and then says what it found (SNTP, section 14).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt

from share.core.exchange import Exchange
from share.wire.ntp import KISS, LEAP_UNKNOWN, UNSYNCHRONISED, Mode, Packet, from_stamp, log2_ns, short_ns

MAX_DRIFT_PPM = 15  # PHI: how fast two clocks may part during an exchange


_WHY = {"RATE": "asked too often; wait a minute", "DENY": "it is set not to", "RSTR": "it is set not to"}


class KissError(ValueError):
    """The server refuses (section 7.4): it must not be asked again. code: four letters, RATE, DENY, …"""

    def __init__(self, code: str) -> None:
        super().__init__(f"it refuses to answer ({code}): {_WHY.get(code, 'for a reason of its own')}")
        self.code = code


@dataclass(frozen=True)
class Answer:
    """One exchange, and what the server says of itself. root_ns: how far what it has its time from
    can be off by its own account, half its root delay and its root dispersion."""

    exchange: Exchange
    stratum: int
    precision_ns: int
    root_ns: int

    def bound_ns(self, own_precision_ns: int) -> int:
        """Most that the offset can be wrong by: the root distance (section 11.2 and A.5.5.2) of one
        sample, without jitter, which is no bound."""
        took_ns = self.exchange.back_ns - self.exchange.sent_ns
        reading_ns = self.precision_ns + own_precision_ns + -(-MAX_DRIFT_PPM * took_ns // 1_000_000)
        return -(-self.exchange.delay_ns // 2) + reading_ns + self.root_ns


@dataclass(frozen=True)
class Estimate:
    """Of several answers. offset_ns: server minus own clock, wrong by at most uncertainty_ns."""

    offset_ns: int
    uncertainty_ns: int
    delay_ns: int
    jitter_ns: int
    stratum: int
    answers: int

    @property
    def worst_ns(self) -> int:
        """How far apart the clocks can be."""
        return abs(self.offset_ns) + self.uncertainty_ns


def request(nonce: int) -> bytes:
    """A question. nonce: 64 random bits in place of the time, which is nobody's business: the answer has
    to repeat them, so nobody can answer who has not heard the question."""
    return Packet(Mode.CLIENT, transmit=nonce).encode()


def read(data: bytes, nonce: int, sent_ns: int, back_ns: int) -> Answer:
    """What came back at `back_ns`. Raises KissError, and ValueError where it is no answer that can be
    believed (section 9.2: "bogus", unsynchronised, impossible)."""
    packet = Packet.decode(data)
    if packet.mode is not Mode.SERVER:
        raise ValueError(f"mode {packet.mode.name} in place of an answer")
    if packet.origin != nonce:
        raise ValueError("it answers another question")
    if packet.stratum == KISS and (code := packet.refid.rstrip(b"\0 ")).isalnum():
        raise KissError(code.decode("ascii"))
    if packet.leap == LEAP_UNKNOWN or packet.stratum in (KISS, UNSYNCHRONISED):  # 0: chronyd says it so
        raise ValueError("that server does not know the time itself (unsynchronised)")
    if packet.precision > 0:
        raise ValueError(f"that server reads its clock to no better than 2^{packet.precision} s")
    received_ns, replied_ns = from_stamp(packet.receive, sent_ns), from_stamp(packet.transmit, sent_ns)
    exchange = Exchange(sent_ns, received_ns, replied_ns, back_ns)
    if not exchange.is_possible:
        raise ValueError("its times are impossible; was a clock set meanwhile?")
    root_ns = -(-short_ns(packet.root_delay) // 2) + short_ns(packet.root_dispersion)
    return Answer(exchange, packet.stratum, log2_ns(packet.precision), root_ns)


def estimate(answers: Sequence[Answer], own_precision_ns: int) -> Estimate:
    """That of the answer with the least delay (section 10): what waited longest on its way says least.

    Jitter is the root mean square of the other offsets against that one; of a single answer the
    precisions. Raises ValueError without answers.
    """
    if not answers:
        raise ValueError("no answers")
    best = min(answers, key=lambda answer: answer.exchange.delay_ns)
    offset_ns = best.exchange.offset_ns
    squares = sum((answer.exchange.offset_ns - offset_ns) ** 2 for answer in answers)
    spread_ns = isqrt(squares // max(1, len(answers) - 1))
    return Estimate(
        offset_ns,
        best.bound_ns(own_precision_ns),
        best.exchange.delay_ns,
        max(spread_ns, best.precision_ns + own_precision_ns),
        best.stratum,
        len(answers),
    )
