"""NTP packets against bytes made by hand from RFC 5905, and time stamps against dates of its figure 4."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.net.ntp import NtpMode, NtpPacket, from_stamp, log2_ns, short_ns, to_stamp, with_transmit_time

S = 1_000_000_000
YEAR = 31_556_952 * S
U64 = st.integers(0, 2**64 - 1)
U32 = st.integers(0, 2**32 - 1)
I8 = st.integers(-128, 127)
TIMES = st.integers(-70 * YEAR, 300 * YEAR)  # 1900 to 2270: eras 0, 1 and 2

# Figure 8, word by word: a server of stratum 2 that follows 192.0.2.1.
BY_HAND = bytes.fromhex(
    "64"  # leap 01, version 100, mode 100
    "02"  # stratum
    "06"  # poll: 2^6 s
    "ec"  # precision: 2^-20 s
    "00018000"  # root delay: 1.5 s
    "00000042"  # root dispersion: 66 / 65536 s
    "c0000201"  # reference id
    "83aa7e80 00000000"  # reference: 1 January 1970
    "0123456789abcdef"  # origin, as the client had it
    "876ce580 80000000"  # receive: 1 January 1972 and half a second
    "0000f680 40000000"  # transmit: 8 February 2036 and a quarter, era 1
)
PACKET = NtpPacket(
    NtpMode.SERVER,
    version=4,
    leap=1,
    stratum=2,
    poll=6,
    precision=-20,
    root_delay=3 << 15,
    root_dispersion=66,
    refid=bytes((192, 0, 2, 1)),
    reference=2_208_988_800 << 32,
    origin=0x0123456789ABCDEF,
    receive=(2_272_060_800 << 32) + (1 << 31),
    transmit=(63_104 << 32) + (1 << 30),
)

packets = st.builds(
    NtpPacket,
    mode=st.sampled_from(NtpMode),
    version=st.sampled_from([3, 4]),
    leap=st.integers(0, 3),
    stratum=st.integers(0, 16),
    poll=I8,
    precision=I8,
    root_delay=U32,
    root_dispersion=U32,
    refid=st.binary(min_size=4, max_size=4),
    reference=U64,
    origin=U64,
    receive=U64,
    transmit=U64,
)


def unix_ns(*date: int) -> int:
    return round(datetime(*date, tzinfo=UTC).timestamp()) * S


def test_a_packet_is_what_the_rfc_draws() -> None:
    assert NtpPacket.decode(BY_HAND) == PACKET
    assert PACKET.encode() == BY_HAND


def test_a_client_of_version_3_is_understood() -> None:
    packet = NtpPacket.decode(b"\x1b" + bytes(47))  # the question of many small SNTP clients
    assert packet == NtpPacket(NtpMode.CLIENT, version=3)


@given(packets)
def test_what_is_encoded_is_decoded(packet: NtpPacket) -> None:
    assert NtpPacket.decode(packet.encode()) == packet
    assert NtpPacket.decode(packet.encode() + bytes(20)) == packet  # a MAC follows


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "0 bytes; expected at least 48"),
        (BY_HAND[:47], "47 bytes; expected at least 48"),
        (BY_HAND + b"!", "49 bytes; expected at least 48"),
        (b"\x0b" + BY_HAND[1:], "NTP version 1; expected 3 or 4"),
        (b"\x2b" + BY_HAND[1:], "NTP version 5; expected 3 or 4"),
        (b"\x64\x11" + BY_HAND[2:], "stratum 17; expected at most 16"),
    ],
)
def test_malformed_packets_are_refused_with_the_reason(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        NtpPacket.decode(data)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_packet_or_a_value_error(data: bytes) -> None:
    try:
        packet = NtpPacket.decode(data)
    except ValueError:
        return
    assert packet.encode() == data[:48]


@pytest.mark.parametrize(
    "wrong", [{"stratum": 256}, {"leap": 4}, {"refid": b"TOOLONG"}, {"transmit": 1 << 64}]
)
def test_a_field_that_does_not_fit_is_a_value_error(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="out of range"):
        NtpPacket(NtpMode.CLIENT, **wrong).encode()  # type: ignore[arg-type]


def test_a_late_transmit_stamp_changes_nothing_else() -> None:
    late = NtpPacket.decode(with_transmit_time(BY_HAND, unix_ns(1999, 12, 31)))
    assert late.transmit == 3_155_587_200 << 32
    assert late.encode()[:40] == BY_HAND[:40]


# ------------------------------------------------------------------ stamps


@pytest.mark.parametrize(
    ("date", "era", "seconds"),  # RFC 5905, figure 4
    [
        ((1900, 1, 1), 0, 0),
        ((1970, 1, 1), 0, 2_208_988_800),
        ((1972, 1, 1), 0, 2_272_060_800),
        ((1999, 12, 31), 0, 3_155_587_200),
        ((2036, 2, 8), 1, 63_104),
    ],
)
def test_dates_of_the_rfc(date: tuple[int, int, int], era: int, seconds: int) -> None:
    at = unix_ns(*date)
    assert to_stamp(at) == (seconds << 32 or 1)  # 0 would be "unknown"
    assert from_stamp(to_stamp(at), at + 30 * YEAR) == at
    assert from_stamp(to_stamp(at), at - 30 * YEAR) == at
    assert (at // S + 2_208_988_800) >> 32 == era


def test_the_first_second_after_the_wrap_is_put_where_it_belongs() -> None:
    before = unix_ns(2036, 2, 7) + (6 * 3600 + 28 * 60 + 15) * S
    assert to_stamp(before) >> 32 == 2**32 - 1
    assert to_stamp(before + S) >> 32 == 0
    assert from_stamp(to_stamp(before + S) + (1 << 31), before) == before + 3 * S // 2


@given(TIMES, st.integers(-67 * YEAR, 67 * YEAR))
def test_a_stamp_comes_back_to_the_nanosecond_in_any_era(at: int, off: int) -> None:
    assert from_stamp(to_stamp(at), at + off) == at


@given(U64.filter(bool), TIMES)
def test_a_stamp_is_put_into_the_nearest_era(stamp: int, near: int) -> None:
    assert abs(from_stamp(stamp, near) - near) <= (S << 31) + 1


def test_unknown_is_no_time() -> None:
    with pytest.raises(ValueError, match="unknown"):
        from_stamp(0, 0)


def test_spans_are_rounded_up() -> None:
    assert [short_ns(x) for x in (0, 1, 1 << 15, 3 << 15)] == [0, 15_259, S // 2, 3 * S // 2]
    assert [log2_ns(x) for x in (-128, -30, -20, -1, 0, 4)] == [1, 1, 954, S // 2, S, 16 * S]
