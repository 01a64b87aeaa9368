"""Which requests a time server answers, and with what."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.devices.time_server import BURST, MAX_CLIENTS, RATE_PER_S, TimeServer
from share.net.ntp import NtpMode, NtpPacket, to_stamp

S = 1_000_000_000
NOW = 1_795_446_605 * S
QUESTION = NtpPacket(NtpMode.CLIENT, version=3, poll=6, transmit=0xFEEDFACECAFEBEEF).encode()


def ask(
    server: TimeServer, data: bytes = QUESTION, address: str = "192.0.2.7", at_s: float = 0.0
) -> NtpPacket | None:
    return server.answer(data, address, NOW, round(at_s * S))


def test_reply_repeats_the_request_and_its_arrival() -> None:
    answer = ask(TimeServer(stratum=9, precision=-23))
    assert answer == NtpPacket(
        NtpMode.SERVER,
        version=3,  # the client's
        stratum=9,
        poll=6,  # the client's
        precision=-23,
        refid=bytes((127, 127, 1, 1)),
        reference=to_stamp(NOW),
        origin=0xFEEDFACECAFEBEEF,
        receive=to_stamp(NOW),
    )


@pytest.mark.parametrize("mode", [mode for mode in NtpMode if mode is not NtpMode.CLIENT])
def test_only_client_requests_are_answered(mode: NtpMode) -> None:
    """Replies are ignored: two servers would answer each other forever."""
    server = TimeServer()
    assert ask(server, NtpPacket(mode).encode()) is None
    assert server.counts == {"ignored": 1}
    assert server.clients == 0


@given(st.binary(max_size=600))
def test_reply_is_never_longer_than_the_request(data: bytes) -> None:
    server = TimeServer()
    for tried in (data, QUESTION + data):
        answer = ask(server, tried)
        assert answer is None or len(answer.encode()) <= len(tried)
    assert ask(server) is not None


def test_rate_limit_applies_to_each_address() -> None:
    server = TimeServer()
    answered = [ask(server, at_s=k / 1000) is not None for k in range(1000)]
    assert sum(answered) == BURST + int(RATE_PER_S * 0.999)
    assert server.counts["limited"] == 1000 - sum(answered)
    assert ask(server, address="192.0.2.8", at_s=1.0) is not None
    assert ask(server, at_s=2.0) is not None  # and again after a while


def test_fastest_chronyd_stays_below_the_rate_limit() -> None:
    """iburst, 4 questions 2 s apart, then one each second with minpoll 0; 100 devices behind one address
    would be too many, 8 are not."""
    server = TimeServer()
    assert all(ask(server, at_s=k + device / 8) for k in range(600) for device in range(8))


def test_remembered_addresses_are_bounded() -> None:
    server = TimeServer()
    for k in range(3 * MAX_CLIENTS):
        ask(server, address=f"forged-{k}")
    assert server.clients == MAX_CLIENTS
