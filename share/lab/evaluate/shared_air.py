"""The air of one access point, shared by all its agents: one half-duplex channel.

Stations, the access point among them, take turns as by the distributed coordination function of IEEE 802.11:
each draws a backoff, the smallest transmits, equal ones collide and draw from twice as many slots. A
transmission is an aggregate of at most `_AGGREGATE_MS`; a keyframe on slow air needs several, between which
others get theirs. Source: G. Bianchi, *Performance Analysis of the IEEE 802.11 Distributed Coordination
Function*, JSAC 18(3), 2000. Not modelled: hidden stations, rate adaptation, RTS.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

PACKET_BYTES = 1448  # payload of Ethernet's 1500
HEADER_BYTES = 66  # per packet: Ethernet, IP, TCP with time stamps
_MAC_BYTES = 40  # per packet: 802.11 header, check sequence, delimiter of the aggregate
_SLOT_US, _AIFS_US = 9.0, 43.0  # 5 GHz; best effort
_PREAMBLE_US, _ACK_US = 40.0, 48.0  # of 802.11n; SIFS and a block acknowledgement at 24 Mbit/s
_CW_MIN, _CW_MAX = 15, 1023  # slots
_AGGREGATE_MS = 4.0  # as Linux's ath9k limits it
_TCP_ACKS = 0.5  # a packet


@dataclass(frozen=True)
class AirModel:
    """Parameters of the air. mbps: rate of all stations. loss: fraction of transmissions that fail, at most
    0.5."""

    mbps: float
    loss: float = 0.0

    def __post_init__(self) -> None:
        if not (self.mbps > 0 and 0 <= self.loss <= 0.5):
            raise ValueError("mbps must be positive and loss 0 to 0.5")


@dataclass(eq=False)
class _AirMessage:
    """A message on its way: packets that are left, and bytes of each. link: the agent from or to which."""

    link: str
    packets: int
    packet_bytes: float
    deliver: Callable[[], None]


@dataclass(eq=False)
class _Station:
    """A station: its queue, remaining backoff in slots (-1: to be drawn), and contention window."""

    queue: deque[_AirMessage] = field(default_factory=deque)
    backoff: int = -1
    window: int = _CW_MIN


Schedule = Callable[[int, Callable[[], None]], None]  # after a delay, ns


class SharedAir:
    """The channel of an access point. Deterministic for a given generator state.

    schedule(delay_ns, action): calls `action` later. busy_ns, collisions, transmissions: so far.
    """

    def __init__(self, model: AirModel, rng: np.random.Generator, schedule: Schedule) -> None:
        self.mbps = model.mbps  # may be changed while it is in use
        self._loss, self._rng, self._schedule = model.loss, rng, schedule
        self._stations: dict[str, _Station] = {}
        self._is_busy = False
        self.busy_ns = self.collisions = self.transmissions = 0

    def send(self, station: str, link: str, size: int, deliver: Callable[[], None]) -> None:
        """Queue a message of `size` bytes at a station; `deliver` is called when all of it has arrived.

        link: the agent that sends or gets it; a transmission carries messages of one link.
        """
        packets = max(1, math.ceil(size / PACKET_BYTES))
        queued = _AirMessage(link, packets, size / packets + HEADER_BYTES + _MAC_BYTES, deliver)
        self._stations.setdefault(station, _Station()).queue.append(queued)
        if not self._is_busy:
            self._contend()

    def _contend(self) -> None:
        """Let the waiting stations contend once, and schedule the end of the transmission."""
        waiting = [station for station in self._stations.values() if station.queue]
        self._is_busy = bool(waiting)
        if not waiting:
            return
        for station in waiting:
            if station.backoff < 0:
                station.backoff = int(self._rng.integers(station.window + 1))
        slots = min(station.backoff for station in waiting)
        winners = [station for station in waiting if station.backoff == slots]
        for station in waiting:
            station.backoff -= slots
        loads = [self._load(winner) for winner in winners]
        busy_us = _AIFS_US + slots * _SLOT_US + max(self._air_us(*load) for load in loads)
        self.transmissions += 1
        is_collision = len(winners) > 1
        self.collisions += is_collision
        is_sent = not is_collision and not (self._loss and self._rng.random() < self._loss)
        if is_sent:
            busy_us += self._tcp_ack_us(loads[0][0])
        for winner in winners:
            winner.backoff = -1
            winner.window = _CW_MIN if is_sent else min(2 * winner.window + 1, _CW_MAX)
        busy_ns = round(busy_us * 1e3)
        self.busy_ns += busy_ns
        packets = loads[0][0]
        self._schedule(busy_ns, lambda: self._end(winners[0], packets if is_sent else 0))

    def _load(self, station: _Station) -> tuple[int, float]:
        """Return packets and bytes of a station's next transmission: at least a packet."""
        packets, size, link = 0, 0.0, station.queue[0].link
        limit = _AGGREGATE_MS * 1e3 * self.mbps / 8
        for message in station.queue:
            if message.link != link:
                break
            fitting = min(message.packets, max(packets == 0, int((limit - size) // message.packet_bytes)))
            packets, size = packets + fitting, size + fitting * message.packet_bytes
            if fitting < message.packets:
                break
        return packets, size

    def _air_us(self, packets: int, size: float) -> float:
        return _PREAMBLE_US + 8 * size / self.mbps + _ACK_US

    def _tcp_ack_us(self, packets: int) -> float:
        """Return the air time, on average, of the receiver's TCP acknowledgements, which it sends as one
        aggregate."""
        count = _TCP_ACKS * packets
        access_us = _AIFS_US + _CW_MIN / 2 * _SLOT_US + self._air_us(0, 0.0)
        return min(1.0, count) * access_us + 8 * count * (HEADER_BYTES + _MAC_BYTES) / self.mbps

    def _end(self, station: _Station, packets: int) -> None:
        """End a transmission that carried so many packets of the station's queue."""
        arrived = []
        while packets:
            message = station.queue[0]
            taken = min(packets, message.packets)
            message.packets, packets = message.packets - taken, packets - taken
            if not message.packets:
                arrived.append(station.queue.popleft())
        self._contend()
        for message in arrived:
            message.deliver()
