"""Asks time servers how far their clocks are from this one's."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from share.core.time_client import Answer, Estimate, KissError, estimate, read, request
from share.io.udp import Host, StampedSocket, clock_precision
from share.wire.ntp import log2_ns

PAUSE_S = 0.25  # between two questions to one server
PATIENCE_S = 1.0  # for an answer
SILENT = 3  # questions without an answer, before the first one, that are enough
_NTP_PORT = 123


@dataclass(frozen=True)
class Finding:
    """estimate: None where nothing came. trouble: why nothing came, or not more, and what to do."""

    host: Host
    estimate: Estimate | None
    asked: int
    took_s: float
    trouble: str | None


@dataclass
class _Inquiry:
    """What is known of one server so far."""

    host: Host
    link: StampedSocket | None = None
    answers: list[Answer] = field(default_factory=list)
    asked: int = 0
    began: float | None = None
    took_s: float = 0.0
    trouble: str | None = None
    over: bool = False

    def end(self, trouble: str) -> None:
        self.trouble, self.over = trouble, True


def check(
    hosts: Sequence[Host], count: int, step: Callable[[int], None] = lambda done: None
) -> list[Finding]:
    """Each is asked `count` times, one after the other so that none disturbs another. step: told 1 for
    each question, also for those that one who is given up is spared. Raises UsageError for a host that is
    unknown, before any is asked.
    """
    inquiries: list[_Inquiry] = []
    try:
        for host in hosts:
            inquiries.append(_begin(host))  # one by one: what is open is closed if the next is unknown
        for round_ in range(count):
            _pause(round_)
            for inquiry in inquiries:
                _ask_again(inquiry)
                step(1)
    finally:
        for inquiry in inquiries:
            if inquiry.link is not None:
                inquiry.link.close()
    precision_ns = log2_ns(clock_precision())
    return [_finding(inquiry, precision_ns) for inquiry in inquiries]


def _pause(round_: int) -> None:
    if round_:
        time.sleep(PAUSE_S)


def _begin(host: Host) -> _Inquiry:
    inquiry = _Inquiry(host)
    try:
        inquiry.link = StampedSocket.connected(host)
    except OSError as error:
        inquiry.end(f"no way there: {error.strerror or error}")
    return inquiry


def _ask_again(inquiry: _Inquiry) -> None:
    if inquiry.over or inquiry.link is None:
        return
    inquiry.asked += 1
    if inquiry.began is None:
        inquiry.began = time.monotonic()
    try:
        _ask(inquiry, inquiry.link)
    except KissError as error:
        inquiry.end(str(error))
    except ConnectionRefusedError:
        inquiry.end(_nobody(inquiry.host))
    except OSError as error:
        inquiry.end(f"no way there: {error.strerror or error}")
    inquiry.took_s = time.monotonic() - inquiry.began
    if not inquiry.answers and inquiry.asked >= SILENT:
        inquiry.end(inquiry.trouble or _silent(inquiry.host))


def _ask(inquiry: _Inquiry, link: StampedSocket) -> None:
    """One question. What is no answer to it is passed over, and remembered as the trouble."""
    nonce = secrets.randbits(64) or 1
    question = request(nonce)
    deadline = time.monotonic() + PATIENCE_S
    sent_ns = time.time_ns()
    link.send(question)
    while (left_s := deadline - time.monotonic()) > 0:
        datagram = link.receive(left_s)
        try:
            if datagram is not None:
                inquiry.answers.append(read(datagram.data, nonce, sent_ns, datagram.stamp_ns))
                return
        except KissError:
            raise
        except ValueError as error:
            inquiry.trouble = f"an answer that cannot be used: {error}"


def _finding(inquiry: _Inquiry, precision_ns: int) -> Finding:
    if inquiry.answers:
        found, trouble = estimate(inquiry.answers, precision_ns), inquiry.trouble if inquiry.over else None
    else:
        found, trouble = None, inquiry.trouble or _silent(inquiry.host)
    return Finding(inquiry.host, found, inquiry.asked, inquiry.took_s, trouble)


def _nobody(host: Host) -> str:
    return f"nothing listens at UDP port {host.port}; start `share sync server` there{_elsewhere(host)}"


def _silent(host: Host) -> str:
    open_ = f"is UDP port {host.port} open to it?"
    return f"no answer; does `share sync server` run there, and {open_}{_elsewhere(host)}"


def _elsewhere(host: Host) -> str:
    return "" if host.port == _NTP_PORT else f" (ntpd and chronyd have port {_NTP_PORT})"
