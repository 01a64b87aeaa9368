"""Which replies of a time server are valid, and the estimate from several."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from share.devices.time_client import KissError, NtpReply, estimate_offset, make_request, parse_reply
from share.net.ntp import NtpMode, NtpPacket, to_stamp
from share.protocol.edge_clock import Exchange

MS = 1_000_000
S = 1000 * MS
NOW = 1_795_446_605 * S
NONCE = 0xFEEDFACECAFEBEEF
GOOD = NtpPacket(
    NtpMode.SERVER,
    stratum=3,
    precision=-20,
    root_delay=1 << 6,  # 0.9765625 ms
    root_dispersion=1 << 7,  # 1.953125 ms
    origin=NONCE,
    receive=to_stamp(NOW + 7 * MS),
    transmit=to_stamp(NOW + 8 * MS),
)


def answer(there: int, back: int, offset: int = 0) -> NtpReply:
    arrived = NOW + there
    return NtpReply(Exchange(NOW, arrived + offset, arrived + offset, arrived + back), 10, 0, 0)


def test_request_contains_only_a_nonce() -> None:
    assert make_request(NONCE) == b"\x23" + bytes(39) + NONCE.to_bytes(8, "big")


def test_reply_and_its_error_bound_match_hand_calculation() -> None:
    found = parse_reply(GOOD.encode(), NONCE, NOW, NOW + 5 * MS)
    assert (found.exchange.offset_ns, found.exchange.delay_ns) == (5 * MS, 4 * MS)
    assert (found.stratum, found.precision_ns) == (3, 954)
    root = -(-976_563 // 2) + 1_953_125
    assert found.max_error_ns(46) == 2 * MS + 954 + 46 + 75 + root  # 15 ppm of 5 ms are 75 ns


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"mode": NtpMode.CLIENT}, "mode CLIENT, expected SERVER"),
        ({"mode": NtpMode.BROADCAST}, "mode BROADCAST, expected SERVER"),
        ({"origin": NONCE + 1}, "answers another request"),
        ({"leap": 3}, "is not synchronised itself"),
        ({"stratum": 16}, "is not synchronised itself"),
        ({"precision": 127}, r"has a precision of only 2\^127 s"),
        ({"stratum": 0}, "is not synchronised itself"),  # chronyd's; a kiss has letters
        ({"receive": 0}, "unknown"),
        ({"transmit": 0}, "unknown"),
        ({"transmit": to_stamp(NOW + 6 * MS)}, "impossible"),
        ({"transmit": to_stamp(NOW + 13 * MS)}, "impossible"),
    ],
)
def test_invalid_replies_are_refused(changed: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_reply(replace(GOOD, **changed).encode(), NONCE, NOW, NOW + 5 * MS)  # type: ignore[arg-type]


def test_kiss_of_death_has_its_code() -> None:
    kiss = replace(GOOD, stratum=0, refid=b"RATE")
    with pytest.raises(KissError, match=r"refuses to answer \(RATE\)") as reported:
        parse_reply(kiss.encode(), NONCE, NOW, NOW + MS)
    assert reported.value.code == "RATE"


def test_kiss_of_death_with_a_wrong_nonce_is_invalid() -> None:
    """Otherwise any host could make a client give up its server."""
    kiss = replace(GOOD, stratum=0, refid=b"DENY", origin=1)
    with pytest.raises(ValueError, match="another request") as reported:
        parse_reply(kiss.encode(), NONCE, NOW, NOW + MS)
    assert not isinstance(reported.value, KissError)


@pytest.mark.long
@given(st.binary(max_size=120))
@settings(max_examples=300)
def test_any_bytes_give_a_reply_or_a_value_error(data: bytes) -> None:
    for tried in (data, GOOD.encode()[:24] + NONCE.to_bytes(8, "big") + data[:16].ljust(16, b"\1")):
        with contextlib.suppress(ValueError):
            assert parse_reply(tried, NONCE, NOW, NOW + S).exchange.is_valid


def test_reply_with_the_least_delay_is_used() -> None:
    found = estimate_offset([answer(5 * MS, MS, 10), answer(MS, MS, 20), answer(MS, 9 * MS, 30)], 0)
    assert (found.offset_ns, found.delay_ns, found.uncertainty_ns) == (20, 2 * MS, MS + 30)
    assert found.answers == 3


def test_jitter_is_the_rms_of_the_other_offsets() -> None:
    """Against numpy: three others, off by 2, 0 and -4 ms."""
    answers = [answer(MS, MS), answer(6 * MS, 2 * MS), answer(2 * MS, 2 * MS), answer(2 * MS, 10 * MS)]
    assert estimate_offset(answers, 0).jitter_ns == int(
        np.sqrt(np.mean(np.array([2 * MS, 0, -4 * MS]) ** 2.0))
    )


def test_jitter_is_at_least_the_clock_precision() -> None:
    assert estimate_offset([answer(MS, MS)], 40).jitter_ns == 40


def test_no_replies_give_no_estimate() -> None:
    with pytest.raises(ValueError, match="no answers"):
        estimate_offset([], 1)


@pytest.mark.long
@given(
    st.integers(-(10**12), 10**12),
    st.floats(-15, 15),
    st.lists(
        st.tuples(st.integers(0, 10**9), st.integers(0, 10**6), st.integers(0, 10**9)), min_size=1, max_size=8
    ),
)
@settings(max_examples=200)
def test_true_offset_is_within_the_uncertainty(
    offset: int, drift_ppm: float, ways: list[tuple[int, int, int]]
) -> None:
    """Whatever the ways there and back took, between clocks that part by no more than PHI, at the time
    of the answer that was taken."""

    def theirs(ns: int) -> int:
        return ns + offset + round((ns - NOW) * drift_ppm * 1e-6)

    answers, truths = [], []
    for k, (there, kept, back) in enumerate(ways):
        sent = NOW + k * S // 4
        replied = sent + there + kept
        exchange = Exchange(sent, theirs(sent + there), theirs(replied), replied + back)
        answers.append(NtpReply(exchange, 10, 1, 0))
        truths.append(theirs(replied + back) - (replied + back))
    found = estimate_offset(answers, 1)
    taken = min(range(len(ways)), key=lambda k: answers[k].exchange.delay_ns)
    assert abs(found.offset_ns - truths[taken]) <= found.uncertainty_ns
