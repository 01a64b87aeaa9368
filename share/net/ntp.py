"""NTP packets and time stamps (RFC 5905, sections 6 and 7.3). Time is Unix time in integer ns.

A stamp has 64 bits: seconds since 1900 and their binary fraction (0.23 ns). The seconds wrap every 136
years, next on 7 February 2036. A stamp does not tell its era, so `from_stamp` needs an approximate time.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from share.timing import SECOND_NS

PACKET_BYTES = 48  # the header; extension fields and a MAC may follow
KISS_STRATUM = 0  # of a refusal (kiss-o'-death)
UNSYNCHRONISED_STRATUM = 16
LEAP_UNKNOWN = 3  # leap indicator of an unsynchronised server

_UNIX_EPOCH_S = 2_208_988_800  # from 1900 to 1970
_ERA = 1 << 64
_VERSIONS = (3, 4)  # clients of version 3 (RFC 1305, 2030) read the same header
_LAYOUT = struct.Struct(">BBbbII4sQQQQ")


class NtpMode(IntEnum):
    """Association mode (figure 10)."""

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
    """The header (figure 8). Stamps are as sent; 0 means unknown.

    poll, precision: log2 of seconds. root_delay, root_dispersion: 2^-16 s, from the server to its reference.
    refid: the reference; in a kiss-o'-death, a code of four letters (section 7.4).
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
        """Return 48 bytes. Raises ValueError if a field is out of range."""
        if not (0 <= self.leap <= 3 and 0 <= self.version <= 7 and len(self.refid) == 4):
            raise ValueError(f"leap {self.leap}, version {self.version}, refid {self.refid!r}: out of range")
        head = self.leap << 6 | self.version << 3 | self.mode
        root = (self.root_delay, self.root_dispersion, self.refid)
        stamps = (self.reference, self.origin, self.receive, self.transmit)
        try:
            return _LAYOUT.pack(head, self.stratum, self.poll, self.precision, *root, *stamps)
        except struct.error as error:
            raise ValueError(f"a field is out of range: {error}") from None

    @classmethod
    def decode(cls, data: bytes) -> NtpPacket:
        """Decode the header; extensions are ignored. Raises ValueError."""
        if len(data) < PACKET_BYTES or len(data) % 4:
            raise ValueError(f"{len(data)} bytes; expected at least {PACKET_BYTES} and a multiple of 4")
        head, stratum, poll, precision, *rest = _LAYOUT.unpack_from(data)
        version = head >> 3 & 7
        if version not in _VERSIONS:
            raise ValueError(f"NTP version {version}; expected 3 or 4")
        if stratum > UNSYNCHRONISED_STRATUM:
            raise ValueError(f"stratum {stratum}; expected at most {UNSYNCHRONISED_STRATUM}")
        return cls(NtpMode(head & 7), version, head >> 6, stratum, poll, precision, *rest)


def with_transmit_time(packet: bytes, unix_ns: int) -> bytes:
    """Return an encoded packet with its transmit stamp set. Faster than encoding it: any time between reading
    the clock and sending is an error of the stamp."""
    return packet[: PACKET_BYTES - 8] + to_stamp(unix_ns).to_bytes(8, "big")


def to_stamp(unix_ns: int) -> int:
    """Return the stamp nearest to a time of any era; never 0, which means unknown."""
    return _to_fixed_point(unix_ns) % _ERA or 1


def from_stamp(stamp: int, near_ns: int) -> int:
    """Return the Unix time of a stamp in the era nearest to `near_ns`, which may be 68 years off.
    `from_stamp(to_stamp(t), near_ns)` is t. Raises ValueError for 0."""
    if stamp == 0:
        raise ValueError("a time stamp is 0, i.e. unknown")
    near = _to_fixed_point(near_ns)
    ahead = (stamp - near + _ERA // 2) % _ERA - _ERA // 2
    seconds, fraction = divmod(near + ahead, 1 << 32)
    return (seconds - _UNIX_EPOCH_S) * SECOND_NS + ((fraction * SECOND_NS + (1 << 31)) >> 32)


def _to_fixed_point(unix_ns: int) -> int:
    """Return the time since 1900 in 2^-32 s, without wrapping."""
    seconds, rest_ns = divmod(unix_ns, SECOND_NS)
    return ((seconds + _UNIX_EPOCH_S) << 32) + ((rest_ns << 32) + SECOND_NS // 2) // SECOND_NS


def short_ns(short: int) -> int:
    """Return a duration in 2^-16 s (section 6) as ns, rounded up since it is a bound."""
    return -(-short * SECOND_NS >> 16)


def log2_ns(exponent: int) -> int:
    """Return 2^exponent s (such as a clock's precision) as ns, rounded up."""
    return -(-SECOND_NS >> -exponent) if exponent < 0 else SECOND_NS << exponent
