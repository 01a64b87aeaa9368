"""What a network does to messages, one direction: when each arrives. Times and randomness are passed in.

A reliable stream over a radio, as TCP over Wi-Fi is: messages wait for those before them, take their time on
the air, arrive in order, and none is lost; a packet that is lost is sent again, which costs time. Loss comes
in bursts (Gilbert, Bell System Technical Journal 1960). Sending again after two round trips, and then after
doubled time-outs: RFC 8985 (tail loss probe), RFC 6298.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

_PACKET_BYTES = 1448  # of Ethernet's 1500
_HEADER_BYTES = 66  # around each: Ethernet, IP, TCP with time stamps
_PROBE_MS = 10.0  # beyond two round trips, before the first packet is sent again
_TIMEOUT_MS = 200.0  # before the second, doubled with every further one
_MS = 1_000_000


@dataclass(frozen=True)
class Way:
    """mbps: of the air, 0 without a limit. jitter_ms: mean of what a message waits for others (exponential).
    loss: share of packets, up to a half; burst: how many in a row, on average."""

    mbps: float = 0.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    loss: float = 0.0
    burst: float = 1.0

    def __post_init__(self) -> None:
        if not (self.loss <= 0.5 and self.burst >= 1):
            raise ValueError("loss: at most 0.5; burst: at least 1")


@dataclass(frozen=True)
class Network:
    """Between one agent and the edge."""

    up: Way = field(default_factory=Way)
    down: Way = field(default_factory=Way)

    @property
    def round_trip_ms(self) -> float:
        """Of a small message, on average."""
        return sum(way.delay_ms + way.jitter_ms for way in (self.up, self.down))


NETWORKS = {
    # 802.11ac, 80 MHz, one stream, a few metres from an access point that is its own
    "wifi5": Network(Way(150.0, 1.0, 0.7, 0.0005, 2.0), Way(150.0, 1.0, 0.7, 0.0005, 2.0)),
    # the same, shared with a hall full of other devices
    "wifi-busy": Network(Way(15.0, 3.0, 8.0, 0.01, 4.0), Way(20.0, 3.0, 5.0, 0.01, 4.0)),
}


class Channel:
    """One direction between two ends. The same messages at the same times arrive at the same times, for one
    generator."""

    def __init__(self, way: Way, round_trip_ms: float, rng: np.random.Generator) -> None:
        self._way, self._round_trip_ms, self._rng = way, round_trip_ms, rng
        self._free_ns = 0  # when the air is free again
        self._last_ns = 0  # when the last message arrives
        self._losing = False

    def arrival_ns(self, size: int, now_ns: int) -> int:
        """Of a message of `size` bytes handed over at `now_ns`, which never falls."""
        way = self._way
        packets = max(1, math.ceil(size / _PACKET_BYTES))
        on_air_ms = 8e-3 * (size + packets * _HEADER_BYTES) / way.mbps if way.mbps else 0.0
        self._free_ns = max(now_ns, self._free_ns) + round(on_air_ms * _MS)
        late_ms = way.delay_ms + (self._rng.exponential(way.jitter_ms) if way.jitter_ms else 0.0)
        late_ms += self._again_ms(packets)
        self._last_ns = max(self._last_ns, self._free_ns + round(late_ms * _MS))
        return self._last_ns

    def _again_ms(self, packets: int) -> float:
        """Until the last of a message's packets has come through; those that are lost go again at once."""
        lost, late_ms = sum(self._is_lost() for _ in range(packets)), 0.0
        wait_ms, burst = 2 * self._round_trip_ms + _PROBE_MS, self._losing
        while lost:
            late_ms += wait_ms
            wait_ms = max(2 * wait_ms, _TIMEOUT_MS)
            self._losing = False  # a burst is over by then
            lost = sum(self._is_lost() for _ in range(lost))
        self._losing = burst  # for the next message, which is not the one that goes again
        return late_ms

    def _is_lost(self) -> bool:
        """The next packet: while losing, one in `burst` is the first that is not lost."""
        way = self._way
        if not way.loss:
            return False
        ends = 1 / way.burst
        begins = ends * way.loss / (1 - way.loss)
        self._losing = self._rng.random() < ((1 - ends) if self._losing else begins)
        return self._losing
