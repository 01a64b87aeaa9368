"""An NTP client: measures the offset of time servers' clocks, with a bound on its error.

RFC 5905, sections 8 and 10, for a client that asks a few times and reports (SNTP, section 14).
"""

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

MAX_DRIFT_PPM = 15  # PHI: largest drift between two clocks during an exchange
QUESTION_PERIOD_S = 0.25  # between two requests to one server
REPLY_TIMEOUT_S = 1.0
MAX_UNANSWERED = 3  # requests without any reply before giving up
_NTP_PORT = 123

_KISS_REASONS = {
    "RATE": "asked too often; wait a minute",
    "DENY": "its configuration denies it",
    "RSTR": "its configuration denies it",
}


class KissError(ValueError):
    """The server refuses (kiss-o'-death, section 7.4): it must not be asked again. code: RATE, DENY, …"""

    def __init__(self, code: str) -> None:
        super().__init__(
            f"the server refuses to answer ({code}): {_KISS_REASONS.get(code, 'no known reason')}"
        )
        self.code = code


@dataclass(frozen=True)
class NtpReply:
    """One exchange, and the server's own accuracy. root_distance_ns: half its root delay plus its root
    dispersion."""

    exchange: Exchange
    stratum: int
    precision_ns: int
    root_distance_ns: int

    def max_error_ns(self, own_precision_ns: int) -> int:
        """Return the largest error of the offset: the root distance (sections 11.2 and A.5.5.2) of one
        sample, without jitter, which is no bound."""
        took_ns = self.exchange.returned_ns - self.exchange.sent_ns
        reading_ns = self.precision_ns + own_precision_ns + -(-MAX_DRIFT_PPM * took_ns // 1_000_000)
        return -(-self.exchange.delay_ns // 2) + reading_ns + self.root_distance_ns


@dataclass(frozen=True)
class NtpEstimate:
    """Estimate from several replies. offset_ns: server minus own clock, with an error of at most
    uncertainty_ns."""

    offset_ns: int
    uncertainty_ns: int
    delay_ns: int
    jitter_ns: int
    stratum: int
    answers: int


def make_request(nonce: int) -> bytes:
    """Return a request. nonce: 64 random bits in place of the transmit time. The reply must repeat them, so
    that only a host that received the request can answer."""
    return NtpPacket(NtpMode.CLIENT, transmit=nonce).encode()


def parse_reply(data: bytes, nonce: int, sent_ns: int, back_ns: int) -> NtpReply:
    """Parse a datagram that came at `back_ns`. Raises KissError, or ValueError if it is no valid reply
    (section 9.2: bogus, unsynchronised, impossible)."""
    packet = NtpPacket.decode(data)
    if packet.mode is not NtpMode.SERVER:
        raise ValueError(f"mode {packet.mode.name}, expected SERVER")
    if packet.origin != nonce:
        raise ValueError("it answers another request")
    if packet.stratum == KISS_STRATUM and (code := packet.refid.rstrip(b"\0 ")).isalnum():
        raise KissError(code.decode("ascii"))
    unsynchronised = (KISS_STRATUM, UNSYNCHRONISED_STRATUM)  # chronyd uses 0
    if packet.leap == LEAP_UNKNOWN or packet.stratum in unsynchronised:
        raise ValueError("the server is not synchronised itself")
    if packet.precision > 0:
        raise ValueError(f"the server's clock has a precision of only 2^{packet.precision} s")
    received_ns, replied_ns = from_stamp(packet.receive, sent_ns), from_stamp(packet.transmit, sent_ns)
    exchange = Exchange(sent_ns, received_ns, replied_ns, back_ns)
    if not exchange.is_valid:
        raise ValueError("its times are impossible; a clock may have been set meanwhile")
    root_ns = -(-short_ns(packet.root_delay) // 2) + short_ns(packet.root_dispersion)
    return NtpReply(exchange, packet.stratum, log2_ns(packet.precision), root_ns)


def estimate_offset(answers: Sequence[NtpReply], own_precision_ns: int) -> NtpEstimate:
    """Return the estimate of the reply with the least delay (section 10), the one with the least queueing.

    Its jitter is the root mean square of the other offsets against that one; with a single reply, the sum of
    the precisions. Raises ValueError without replies.
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


@dataclass(frozen=True)
class TimeServerResult:
    """Result of one server. estimate: None without a reply. trouble: why there was no reply, or no further
    ones, and what to do."""

    host: HostPort
    estimate: NtpEstimate | None
    questions: int
    duration_s: float
    trouble: str | None


@dataclass
class _ServerQuery:
    """State of the requests to one server."""

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
    """Send `count` requests to each server, one at a time so that they do not disturb each other. step:
    called with 1 for each request, also for those not sent to a server that was given up. Raises UsageError
    for an unknown host before sending anything.
    """
    queries: list[_ServerQuery] = []
    try:
        for host in hosts:
            queries.append(_open_query(host))  # one by one: an unknown host closes the earlier sockets
        for round_ in range(count):
            if round_:
                time.sleep(QUESTION_PERIOD_S)
            for query in queries:
                _ask_next(query)
                step(1)
    finally:
        for query in queries:
            if query.socket is not None:
                query.socket.close()
    precision_ns = log2_ns(clock_precision())
    return [_query_result(query, precision_ns) for query in queries]


def _open_query(host: HostPort) -> _ServerQuery:
    query = _ServerQuery(host)
    try:
        query.socket = StampedSocket.connect(host)
    except OSError as error:
        query.stop(f"unreachable: {error.strerror or error}")
    return query


def _ask_next(query: _ServerQuery) -> None:
    if query.is_over or query.socket is None:
        return
    query.questions += 1
    if query.start_s is None:
        query.start_s = time.monotonic()
    try:
        _ask(query, query.socket)
    except KissError as error:
        query.stop(str(error))
    except ConnectionRefusedError:
        query.stop(_no_listener_message(query.host))
    except OSError as error:
        query.stop(f"unreachable: {error.strerror or error}")
    query.duration_s = time.monotonic() - query.start_s
    if not query.answers and query.questions >= MAX_UNANSWERED:
        query.stop(query.trouble or _no_answer_message(query.host))


def _ask(query: _ServerQuery, link: StampedSocket) -> None:
    """Send one request and wait for its reply. Invalid replies are skipped and recorded as trouble."""
    nonce = secrets.randbits(64) or 1
    request = make_request(nonce)
    deadline = time.monotonic() + REPLY_TIMEOUT_S
    sent_ns = time.time_ns()
    link.send(request)
    while (left_s := deadline - time.monotonic()) > 0:
        datagram = link.receive(left_s)
        try:
            if datagram is not None:
                query.answers.append(parse_reply(datagram.data, nonce, sent_ns, datagram.stamp_ns))
                return
        except KissError:
            raise
        except ValueError as error:
            query.trouble = f"invalid reply: {error}"


def _query_result(query: _ServerQuery, precision_ns: int) -> TimeServerResult:
    estimate: NtpEstimate | None = None
    if query.answers:
        estimate = estimate_offset(query.answers, precision_ns)
        trouble = query.trouble if query.is_over else None
    else:
        trouble = query.trouble or _no_answer_message(query.host)
    return TimeServerResult(query.host, estimate, query.questions, query.duration_s, trouble)


def _no_listener_message(host: HostPort) -> str:
    return f"nothing listens at UDP port {host.port}; start `share sync server` there{_other_port_hint(host)}"


def _no_answer_message(host: HostPort) -> str:
    check = f"check that `share sync server` runs there and that UDP port {host.port} is open"
    return f"no answer; {check}{_other_port_hint(host)}"


def _other_port_hint(host: HostPort) -> str:
    return "" if host.port == _NTP_PORT else f" (ntpd and chronyd use port {_NTP_PORT})"
