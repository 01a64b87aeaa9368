"""NTP's packet and its time stamps (RFC 5905, sections 6 and 7.3). Time is Unix time in integer ns.

A stamp is 64 bits: seconds since 1900 and their binary fraction (0.23 ns). The seconds wrap every 136
years, next on 7 February 2036, so a stamp alone does not say which era it is of: `from_stamp` wants a time
that it is near to.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

PACKET_BYTES = 48  # the header; extension fields and a MAC may follow
SECOND_NS = 1_000_000_000
KISS_STRATUM = 0  # the stratum of an answer that is a refusal
UNSYNCHRONISED_STRATUM = 16  # the stratum of a server that does not know the time
LEAP_UNKNOWN = 3  # the leap indicator of such a server

_UNIX_EPOCH_S = 2_208_988_800  # from 1900 to 1970
_ERA = 1 << 64
_VERSIONS = (3, 4)  # clients of version 3 (RFC 1305, 2030) read the same header
_LAYOUT = struct.Struct(">BBbbII4sQQQQ")


class NtpMode(IntEnum):
    """Who speaks (figure 10)."""

    RESERVED = 0
    SYMMETRIC = 1
    SYMMETRIC_PASSIVE = 2
    CLIENT = 3
    SERVER = 4
    BROADCAST = 5
    CONTROL = 6
    PRIVATE = 7


@dataclass(frozen=True)
class NtpPacket:
    """The header, field by field (figure 8). Stamps are as they are sent; 0 is "unknown".

    poll, precision: log2 of seconds. root_delay, root_dispersion: 2^-16 s, from the server to what
    it has its time from. refid: what that is; of a KISS, four letters that say why (section 7.4).
    """

    mode: NtpMode
    version: int = 4
    leap: int = 0
    stratum: int = 0
    poll: int = 0
    precision: int = 0
    root_delay: int = 0
    root_dispersion: int = 0
    refid: bytes = bytes(4)
    reference: int = 0
    origin: int = 0
    receive: int = 0
    transmit: int = 0

    def encode(self) -> bytes:
        """48 bytes. Raises ValueError where a field does not fit."""
        if not (0 <= self.leap <= 3 and 0 <= self.version <= 7 and len(self.refid) == 4):
            raise ValueError(f"leap {self.leap}, version {self.version}, refid {self.refid!r}: does not fit")
        head = self.leap << 6 | self.version << 3 | self.mode
        root = (self.root_delay, self.root_dispersion, self.refid)
        stamps = (self.reference, self.origin, self.receive, self.transmit)
        try:
            return _LAYOUT.pack(head, self.stratum, self.poll, self.precision, *root, *stamps)
        except struct.error as error:
            raise ValueError(f"a field does not fit: {error}") from None

    @classmethod
    def decode(cls, data: bytes) -> NtpPacket:
        """What follows the header is not read. Raises ValueError with the reason."""
        if len(data) < PACKET_BYTES or len(data) % 4:
            raise ValueError(f"{len(data)} bytes; expected {PACKET_BYTES}, or more by whole words of 4")
        head, stratum, poll, precision, *rest = _LAYOUT.unpack_from(data)
        version = head >> 3 & 7
        if version not in _VERSIONS:
            raise ValueError(f"NTP version {version}; 3 and 4 are understood")
        if stratum > UNSYNCHRONISED_STRATUM:
            raise ValueError(f"stratum {stratum}; the most is {UNSYNCHRONISED_STRATUM}")
        return cls(NtpMode(head & 7), version, head >> 6, stratum, poll, precision, *rest)


def with_transmit_time(packet: bytes, unix_ns: int) -> bytes:
    """An encoded packet with its transmit stamp put in, quicker than making it anew: what is done between
    reading the clock and sending is an error of the time that is told."""
    return packet[: PACKET_BYTES - 8] + to_stamp(unix_ns).to_bytes(8, "big")


def to_stamp(unix_ns: int) -> int:
    """The stamp nearest to a time of any era; never 0, which would say "unknown"."""
    return _to_fixed_point(unix_ns) % _ERA or 1


def from_stamp(stamp: int, near_ns: int) -> int:
    """The time of a stamp, of all eras the one nearest to `near_ns`: right if that is less than 68
    years off. `from_stamp(to_stamp(t), near_ns)` is t. Raises ValueError for 0."""
    if stamp == 0:
        raise ValueError("a time stamp is 0, which is to say unknown")
    near = _to_fixed_point(near_ns)
    ahead = (stamp - near + _ERA // 2) % _ERA - _ERA // 2
    seconds, fraction = divmod(near + ahead, 1 << 32)
    return (seconds - _UNIX_EPOCH_S) * SECOND_NS + ((fraction * SECOND_NS + (1 << 31)) >> 32)


def _to_fixed_point(unix_ns: int) -> int:
    """Since 1900 in 2^-32 s, without an end."""
    seconds, rest_ns = divmod(unix_ns, SECOND_NS)
    return ((seconds + _UNIX_EPOCH_S) << 32) + ((rest_ns << 32) + SECOND_NS // 2) // SECOND_NS


def short_ns(short: int) -> int:
    """A span of time given in 2^-16 s (section 6), as ns, rounded up: it is a bound."""
    return -(-short * SECOND_NS >> 16)


def log2_ns(exponent: int) -> int:
    """2^exponent s as ns, rounded up. The precision of a clock comes as such an exponent."""
    return -(-SECOND_NS >> -exponent) if exponent < 0 else SECOND_NS << exponent
