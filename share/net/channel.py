"""A model of one direction of a network link: when each message arrives. Times and randomness are passed in.

It models TCP over Wi-Fi: messages queue, take time on the air, arrive in order and are never lost; a lost
packet is resent, which costs time. Losses come in bursts (Gilbert, Bell System Technical Journal 1960).
Resends follow after two round trips and then after doubling timeouts: RFC 8985 (tail loss probe), RFC 6298.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

_PACKET_BYTES = 1448  # payload of Ethernet's 1500
_HEADER_BYTES = 66  # per packet: Ethernet, IP, TCP with time stamps
_PROBE_MS = 10.0  # added to two round trips before the first resend
_TIMEOUT_MS = 200.0  # before the second resend, doubled for each further one
_NS_PER_MS = 1_000_000


@dataclass(frozen=True)
class ChannelModel:
    """Parameters of one direction. mbps: rate, 0 for unlimited. jitter_ms: mean additional delay of a message
    (exponential). loss: fraction of packets lost, at most 0.5. burst: mean number of losses in a row."""

    mbps: float = 0.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    loss: float = 0.0
    burst: float = 1.0

    def __post_init__(self) -> None:
        if not (self.loss <= 0.5 and self.burst >= 1):
            raise ValueError("loss must be at most 0.5 and burst at least 1")


@dataclass(frozen=True)
class NetworkModel:
    """Both directions between an agent and the edge."""

    up: ChannelModel = field(default_factory=ChannelModel)
    down: ChannelModel = field(default_factory=ChannelModel)

    @property
    def round_trip_ms(self) -> float:
        """Mean round trip of a small message."""
        return sum(model.delay_ms + model.jitter_ms for model in (self.up, self.down))


NETWORK_PRESETS = {
    # 802.11ac, 80 MHz, one stream, a few metres from an access point without other devices
    "wifi5": NetworkModel(
        ChannelModel(150.0, 1.0, 0.7, 0.0005, 2.0), ChannelModel(150.0, 1.0, 0.7, 0.0005, 2.0)
    ),
    # the same, shared with a hall full of other devices
    "wifi-busy": NetworkModel(
        ChannelModel(15.0, 3.0, 8.0, 0.01, 4.0), ChannelModel(20.0, 3.0, 5.0, 0.01, 4.0)
    ),
}


class Channel:
    """One direction between two ends. Deterministic for a given generator state."""

    def __init__(self, model: ChannelModel, round_trip_ms: float, rng: np.random.Generator) -> None:
        self._model, self._round_trip_ms, self._rng = model, round_trip_ms, rng
        self._air_free_ns = 0
        self._last_arrival_ns = 0
        self._in_burst = False

    def arrival_ns(self, size: int, now_ns: int) -> int:
        """Return the arrival of a message of `size` bytes sent at `now_ns`, which must not decrease."""
        model = self._model
        packets = max(1, math.ceil(size / _PACKET_BYTES))
        on_air_ms = 8e-3 * (size + packets * _HEADER_BYTES) / model.mbps if model.mbps else 0.0
        self._air_free_ns = max(now_ns, self._air_free_ns) + round(on_air_ms * _NS_PER_MS)
        latency_ms = model.delay_ms + (self._rng.exponential(model.jitter_ms) if model.jitter_ms else 0.0)
        latency_ms += self._retransmit_ms(packets)
        self._last_arrival_ns = max(self._last_arrival_ns, self._air_free_ns + round(latency_ms * _NS_PER_MS))
        return self._last_arrival_ns

    def _retransmit_ms(self, packets: int) -> float:
        """Return the delay until all packets of a message have arrived; lost ones are resent together."""
        lost, latency_ms = sum(self._is_lost() for _ in range(packets)), 0.0
        wait_ms, burst = 2 * self._round_trip_ms + _PROBE_MS, self._in_burst
        while lost:
            latency_ms += wait_ms
            wait_ms = max(2 * wait_ms, _TIMEOUT_MS)
            self._in_burst = False  # a burst is over by then
            lost = sum(self._is_lost() for _ in range(lost))
        self._in_burst = burst  # resends do not change the state for the next message
        return latency_ms

    def _is_lost(self) -> bool:
        """Draw whether the next packet is lost; a burst ends with probability 1 / burst."""
        model = self._model
        if not model.loss:
            return False
        p_end = 1 / model.burst
        p_begin = p_end * model.loss / (1 - model.loss)
        self._in_burst = self._rng.random() < ((1 - p_end) if self._in_burst else p_begin)
        return self._in_burst
