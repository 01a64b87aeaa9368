"""Asks time servers how far their clocks are from this one's."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import isqrt

from share.net.ntp import (
    KISS_STRATUM,
    LEAP_UNKNOWN,
    UNSYNCHRONISED_STRATUM,
    NtpMode,
    NtpPacket,
    from_stamp,
    log2_ns,
    short_ns,
)
from share.net.udp import HostPort, StampedSocket, clock_precision
from share.protocol.edge_clock import Exchange

# ---- What answers of a time server say of the own clock: its offset, and how wrong that can be.
#
# RFC 5905, sections 8 and 10, for one who asks a few times and then says what it found (SNTP, section 14).

MAX_DRIFT_PPM = 15  # PHI: how fast two clocks may part during an exchange


_KISS_REASONS = {
    "RATE": "asked too often; wait a minute",
    "DENY": "it is set not to",
    "RSTR": "it is set not to",
}


class KissError(ValueError):
    """The server refuses (section 7.4): it must not be asked again. code: four letters, RATE, DENY, …"""

    def __init__(self, code: str) -> None:
        super().__init__(
            f"it refuses to answer ({code}): {_KISS_REASONS.get(code, 'for a reason of its own')}"
        )
        self.code = code


@dataclass(frozen=True)
class NtpReply:
    """One exchange, and what the server says of itself. root_ns: how far what it has its time from
    can be off by its own account, half its root delay and its root dispersion."""

    exchange: Exchange
    stratum: int
    precision_ns: int
    root_distance_ns: int

    def max_error_ns(self, own_precision_ns: int) -> int:
        """Most that the offset can be wrong by: the root distance (section 11.2 and A.5.5.2) of one
        sample, without jitter, which is no bound."""
        took_ns = self.exchange.returned_ns - self.exchange.sent_ns
        reading_ns = self.precision_ns + own_precision_ns + -(-MAX_DRIFT_PPM * took_ns // 1_000_000)
        return -(-self.exchange.delay_ns // 2) + reading_ns + self.root_distance_ns


@dataclass(frozen=True)
class NtpEstimate:
    """Of several answers. offset_ns: server minus own clock, wrong by at most uncertainty_ns."""

    offset_ns: int
    uncertainty_ns: int
    delay_ns: int
    jitter_ns: int
    stratum: int
    answers: int

    @property
    def max_difference_ns(self) -> int:
        """How far apart the clocks can be."""
        return abs(self.offset_ns) + self.uncertainty_ns


def make_request(nonce: int) -> bytes:
    """A question. nonce: 64 random bits in place of the time, which is nobody's business: the answer has
    to repeat them, so nobody can answer who has not heard the question."""
    return NtpPacket(NtpMode.CLIENT, transmit=nonce).encode()


def parse_reply(data: bytes, nonce: int, sent_ns: int, back_ns: int) -> NtpReply:
    """What came back at `returned_ns`. Raises KissError, and ValueError where it is no answer that can be
    believed (section 9.2: "bogus", unsynchronised, impossible)."""
    packet = NtpPacket.decode(data)
    if packet.mode is not NtpMode.SERVER:
        raise ValueError(f"mode {packet.mode.name} in place of an answer")
    if packet.origin != nonce:
        raise ValueError("it answers another question")
    if packet.stratum == KISS_STRATUM and (code := packet.refid.rstrip(b"\0 ")).isalnum():
        raise KissError(code.decode("ascii"))
    if packet.leap == LEAP_UNKNOWN or packet.stratum in (
        KISS_STRATUM,
        UNSYNCHRONISED_STRATUM,
    ):  # 0: chronyd says it so
        raise ValueError("that server does not know the time itself (unsynchronised)")
    if packet.precision > 0:
        raise ValueError(f"that server reads its clock to no better than 2^{packet.precision} s")
    received_ns, replied_ns = from_stamp(packet.receive, sent_ns), from_stamp(packet.transmit, sent_ns)
    exchange = Exchange(sent_ns, received_ns, replied_ns, back_ns)
    if not exchange.is_valid:
        raise ValueError("its times are impossible; was a clock set meanwhile?")
    root_ns = -(-short_ns(packet.root_delay) // 2) + short_ns(packet.root_dispersion)
    return NtpReply(exchange, packet.stratum, log2_ns(packet.precision), root_ns)


def estimate_offset(answers: Sequence[NtpReply], own_precision_ns: int) -> NtpEstimate:
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
    return NtpEstimate(
        offset_ns,
        best.max_error_ns(own_precision_ns),
        best.exchange.delay_ns,
        max(spread_ns, best.precision_ns + own_precision_ns),
        best.stratum,
        len(answers),
    )


QUESTION_PERIOD_S = 0.25  # between two questions to one server
REPLY_TIMEOUT_S = 1.0  # for an answer
MAX_UNANSWERED = 3  # questions without an answer, before the first one, that are enough
_NTP_PORT = 123


@dataclass(frozen=True)
class TimeServerResult:
    """estimate: None where nothing came. trouble: why nothing came, or not more, and what to do."""

    host: HostPort
    estimate: NtpEstimate | None
    questions: int
    duration_s: float
    trouble: str | None


@dataclass
class _ServerQuery:
    """What is known of one server so far."""

    host: HostPort
    socket: StampedSocket | None = None
    answers: list[NtpReply] = field(default_factory=list)
    questions: int = 0
    start_s: float | None = None
    duration_s: float = 0.0
    trouble: str | None = None
    is_over: bool = False

    def stop(self, trouble: str) -> None:
        self.trouble, self.is_over = trouble, True


def query_servers(
    hosts: Sequence[HostPort], count: int, step: Callable[[int], None] = lambda done: None
) -> list[TimeServerResult]:
    """Each is asked `count` times, one after the other so that none disturbs another. step: told 1 for
    each question, also for those that one who is given up is spared. Raises UsageError for a host that is
    unknown, before any is asked.
    """
    inquiries: list[_ServerQuery] = []
    try:
        for host in hosts:
            inquiries.append(_open_query(host))  # one by one: what is open is closed if the next is unknown
        for round_ in range(count):
            _pause(round_)
            for inquiry in inquiries:
                _ask_next(inquiry)
                step(1)
    finally:
        for inquiry in inquiries:
            if inquiry.socket is not None:
                inquiry.socket.close()
    precision_ns = log2_ns(clock_precision())
    return [_query_result(inquiry, precision_ns) for inquiry in inquiries]


def _pause(round_: int) -> None:
    if round_:
        time.sleep(QUESTION_PERIOD_S)


def _open_query(host: HostPort) -> _ServerQuery:
    inquiry = _ServerQuery(host)
    try:
        inquiry.socket = StampedSocket.connect(host)
    except OSError as error:
        inquiry.stop(f"no way there: {error.strerror or error}")
    return inquiry


def _ask_next(inquiry: _ServerQuery) -> None:
    if inquiry.is_over or inquiry.socket is None:
        return
    inquiry.questions += 1
    if inquiry.start_s is None:
        inquiry.start_s = time.monotonic()
    try:
        _ask(inquiry, inquiry.socket)
    except KissError as error:
        inquiry.stop(str(error))
    except ConnectionRefusedError:
        inquiry.stop(_no_listener_message(inquiry.host))
    except OSError as error:
        inquiry.stop(f"no way there: {error.strerror or error}")
    inquiry.duration_s = time.monotonic() - inquiry.start_s
    if not inquiry.answers and inquiry.questions >= MAX_UNANSWERED:
        inquiry.stop(inquiry.trouble or _no_answer_message(inquiry.host))


def _ask(inquiry: _ServerQuery, link: StampedSocket) -> None:
    """One question. What is no answer to it is passed over, and remembered as the trouble."""
    nonce = secrets.randbits(64) or 1
    question = make_request(nonce)
    deadline = time.monotonic() + REPLY_TIMEOUT_S
    sent_ns = time.time_ns()
    link.send(question)
    while (left_s := deadline - time.monotonic()) > 0:
        datagram = link.receive(left_s)
        try:
            if datagram is not None:
                inquiry.answers.append(parse_reply(datagram.data, nonce, sent_ns, datagram.stamp_ns))
                return
        except KissError:
            raise
        except ValueError as error:
            inquiry.trouble = f"an answer that cannot be used: {error}"


def _query_result(inquiry: _ServerQuery, precision_ns: int) -> TimeServerResult:
    if inquiry.answers:
        ntp_estimate, trouble = (
            estimate_offset(inquiry.answers, precision_ns),
            inquiry.trouble if inquiry.is_over else None,
        )
    else:
        ntp_estimate, trouble = None, inquiry.trouble or _no_answer_message(inquiry.host)
    return TimeServerResult(inquiry.host, ntp_estimate, inquiry.questions, inquiry.duration_s, trouble)


def _no_listener_message(host: HostPort) -> str:
    return f"nothing listens at UDP port {host.port}; start `share sync server` there{_other_port_hint(host)}"


def _no_answer_message(host: HostPort) -> str:
    open_ = f"is UDP port {host.port} open to it?"
    return f"no answer; does `share sync server` run there, and {open_}{_other_port_hint(host)}"


def _other_port_hint(host: HostPort) -> str:
    return "" if host.port == _NTP_PORT else f" (ntpd and chronyd have port {_NTP_PORT})"
