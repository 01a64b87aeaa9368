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
_NS_PER_MS = 1_000_000


@dataclass(frozen=True)
class ChannelModel:
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
class NetworkModel:
    """Between one agent and the edge."""

    up: ChannelModel = field(default_factory=ChannelModel)
    down: ChannelModel = field(default_factory=ChannelModel)

    @property
    def round_trip_ms(self) -> float:
        """Of a small message, on average."""
        return sum(model.delay_ms + model.jitter_ms for model in (self.up, self.down))


NETWORK_PRESETS = {
    # 802.11ac, 80 MHz, one stream, a few metres from an access point that is its own
    "wifi5": NetworkModel(
        ChannelModel(150.0, 1.0, 0.7, 0.0005, 2.0), ChannelModel(150.0, 1.0, 0.7, 0.0005, 2.0)
    ),
    # the same, shared with a hall full of other devices
    "wifi-busy": NetworkModel(
        ChannelModel(15.0, 3.0, 8.0, 0.01, 4.0), ChannelModel(20.0, 3.0, 5.0, 0.01, 4.0)
    ),
}


class Channel:
    """One direction between two ends. The same messages at the same times arrive at the same times, for one
    generator."""

    def __init__(self, model: ChannelModel, round_trip_ms: float, rng: np.random.Generator) -> None:
        self._model, self._round_trip_ms, self._rng = model, round_trip_ms, rng
        self._air_free_ns = 0  # when the air is free again
        self._last_arrival_ns = 0  # when the last message arrives
        self._in_burst = False

    def arrival_ns(self, size: int, now_ns: int) -> int:
        """Of a message of `size` bytes handed over at `now_ns`, which never falls."""
        model = self._model
        packets = max(1, math.ceil(size / _PACKET_BYTES))
        on_air_ms = 8e-3 * (size + packets * _HEADER_BYTES) / model.mbps if model.mbps else 0.0
        self._air_free_ns = max(now_ns, self._air_free_ns) + round(on_air_ms * _NS_PER_MS)
        latency_ms = model.delay_ms + (self._rng.exponential(model.jitter_ms) if model.jitter_ms else 0.0)
        latency_ms += self._retransmit_ms(packets)
        self._last_arrival_ns = max(self._last_arrival_ns, self._air_free_ns + round(latency_ms * _NS_PER_MS))
        return self._last_arrival_ns

    def _retransmit_ms(self, packets: int) -> float:
        """Until the last of a message's packets has come through; those that are lost go again at once."""
        lost, latency_ms = sum(self._is_lost() for _ in range(packets)), 0.0
        wait_ms, burst = 2 * self._round_trip_ms + _PROBE_MS, self._in_burst
        while lost:
            latency_ms += wait_ms
            wait_ms = max(2 * wait_ms, _TIMEOUT_MS)
            self._in_burst = False  # a burst is over by then
            lost = sum(self._is_lost() for _ in range(lost))
        self._in_burst = burst  # for the next message, which is not the one that goes again
        return latency_ms

    def _is_lost(self) -> bool:
        """The next packet: while losing, one in `burst` is the first that is not lost."""
        model = self._model
        if not model.loss:
            return False
        p_end = 1 / model.burst
        p_begin = p_end * model.loss / (1 - model.loss)
        self._in_burst = self._rng.random() < ((1 - p_end) if self._in_burst else p_begin)
        return self._in_burst
