"""An agent's link through an emulated network, for experiments on one machine.

`Channel` models one direction, deterministically for given times and seed: TCP over Wi-Fi. Messages queue,
take time on the air, arrive in order and are never lost; a lost packet is resent, which costs time. Losses
come in bursts (Gilbert, Bell System Technical Journal 1960). Resends follow after two round trips and then
after doubling timeouts: RFC 8985 (tail loss probe), RFC 6298.

In virtual time, agents may share the air of an access point (`share.lab.evaluate.shared_air`); the channels
then add delay and jitter. `LinkAssignment` parses `--link`, which network each agent of a session goes
through.
"""

from __future__ import annotations

import math
import re
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from share.errors import UsageError
from share.files.yaml_file import read_yaml
from share.lab.evaluate.shared_air import HEADER_BYTES, PACKET_BYTES, AirModel
from share.net.transport import LINGER_MS, QUEUE_MESSAGES, AgentLink
from share.plain_data import from_mapping
from share.wire.codec import message_bytes
from share.wire.layouts import Bytes

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
    """Both directions between an agent and the edge. air: of an access point, shared by all agents with an
    equal network, in virtual time only; up and down then have no rate of their own."""

    up: ChannelModel = field(default_factory=ChannelModel)
    down: ChannelModel = field(default_factory=ChannelModel)
    air: AirModel | None = None

    def __post_init__(self) -> None:
        if self.air is not None and (self.up.mbps or self.down.mbps):
            raise ValueError("give either air.mbps, shared by all, or up.mbps and down.mbps")

    @property
    def round_trip_ms(self) -> float:
        """Mean round trip of a small message."""
        return sum(model.delay_ms + model.jitter_ms for model in (self.up, self.down))


def _shared(mbps: float) -> NetworkModel:
    """Return a network over shared air; one transmission in a hundred fails."""
    way = ChannelModel(0.0, 1.0, 0.7)
    return NetworkModel(way, way, AirModel(mbps, 0.01))


_SHARED_NAME = re.compile(r"shared-(\d{1,4}(?:\.\d{1,3})?)")
NETWORK_PRESETS = {
    # 802.11ac, 80 MHz, one stream, a few metres from an access point without other devices
    "wifi5": NetworkModel(
        ChannelModel(150.0, 1.0, 0.7, 0.0005, 2.0), ChannelModel(150.0, 1.0, 0.7, 0.0005, 2.0)
    ),
    # the same, shared with a hall full of other devices
    "wifi-busy": NetworkModel(
        ChannelModel(15.0, 3.0, 8.0, 0.01, 4.0), ChannelModel(20.0, 3.0, 5.0, 0.01, 4.0)
    ),
    # one access point for all agents, in virtual time: what a weak signal or busy neighbours leave of it
    "shared-150": _shared(150.0),
    "shared-15": _shared(15.0),
    "shared-8": _shared(8.0),
    "shared-5": _shared(5.0),
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
        packets = max(1, math.ceil(size / PACKET_BYTES))
        on_air_ms = 8e-3 * (size + packets * HEADER_BYTES) / model.mbps if model.mbps else 0.0
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


def load_network(name: str) -> NetworkModel:
    """Return a preset by its name, shared air of any rate as `shared-2.5`, or read a YAML file {up: {mbps,
    delay_ms, jitter_ms, loss, burst}, down: {…}, air: {mbps, loss}}. Raises UsageError, ConfigError."""
    if name in NETWORK_PRESETS:
        return NETWORK_PRESETS[name]
    if (rate := _SHARED_NAME.fullmatch(name)) is not None and 0.1 <= float(rate[1]) <= 1000:
        return _shared(float(rate[1]))
    path = Path(name)
    if not path.is_file():
        raise UsageError(f"--link: '{name}' is neither a file nor one of {', '.join(NETWORK_PRESETS)}")
    return from_mapping(NetworkModel, read_yaml(path).data, str(path))


def check_air_is_own(name: str, network: NetworkModel) -> None:
    """Raise UsageError where this network shares its air, which processes of their own cannot."""
    if network.air is not None:
        raise UsageError(
            f"--link {name}: air that agents share is emulated in virtual time only: "
            "share evaluate run --virtual"
        )


class EmulatedLink:
    """`AgentLink` around another one. It delays messages in both directions as the network would; outgoing
    ones are forwarded while `receive` waits. Delays are deterministic for a given seed."""

    def __init__(self, link: AgentLink, network: NetworkModel, seed: int) -> None:
        self._link = link
        up, down = np.random.default_rng(seed).spawn(2)
        self._up = Channel(network.up, network.round_trip_ms, up)
        self._down = Channel(network.down, network.round_trip_ms, down)
        self._outbound: deque[tuple[int, Sequence[Bytes]]] = deque()  # arrival, ns, and message, in order
        self._inbound: deque[tuple[int, list[bytes]]] = deque()  # the same

    def send(self, frames: Sequence[Bytes]) -> bool:
        self._forward_due()
        if len(self._outbound) >= QUEUE_MESSAGES:
            return False
        self._outbound.append((self._up.arrival_ns(message_bytes(frames), time.monotonic_ns()), frames))
        return True

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        end_ns = time.monotonic_ns() + timeout_ms * _NS_PER_MS
        while True:
            self._forward_due()
            now_ns = time.monotonic_ns()
            if self._inbound and self._inbound[0][0] <= now_ns:
                return self._inbound.popleft()[1]
            next_ns = min([end_ns, *(queue[0][0] for queue in (self._outbound, self._inbound) if queue)])
            if 0 < next_ns - now_ns < _NS_PER_MS:  # the link below counts in milliseconds
                time.sleep((next_ns - now_ns) * 1e-9)
                continue
            message = self._link.receive(max(0, next_ns - now_ns) // _NS_PER_MS)
            if message is None:
                return None  # timeout, a message to forward, or woken
            at_ns = self._down.arrival_ns(message_bytes(message), time.monotonic_ns())
            self._inbound.append((at_ns, message))

    def trouble(self) -> str | None:
        return self._link.trouble()

    def poll_connected(self) -> bool:
        return self._link.poll_connected()

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        end_ns = time.monotonic_ns() + LINGER_MS * _NS_PER_MS
        while self._outbound and self._outbound[0][0] < end_ns:
            time.sleep(max(0, self._outbound[0][0] - time.monotonic_ns()) * 1e-9)
            self._forward_due()
        self._link.close()

    def _forward_due(self) -> None:
        """Forward messages that have arrived at the edge by now; they are lost if there is no edge."""
        while self._outbound and self._outbound[0][0] <= time.monotonic_ns():
            self._link.send(self._outbound.popleft()[1])


@dataclass(frozen=True)
class LinkAssignment:
    """Networks of a session's agents, by preset name or file. default: for agents not in per_agent; None: no
    emulation."""

    default: str | None
    per_agent: Mapping[str, str]

    @classmethod
    def parse(cls, text: str | None) -> LinkAssignment:
        """Parse `wifi5` (all agents), `wifi5,bob=wifi-busy` (another one for bob) or `bob=far.yaml` (bob
        only).

        Raises UsageError or ConfigError if a network is unknown or malformed.
        """
        if text is None:
            return cls(None, {})
        if text in NETWORK_PRESETS or Path(text).is_file():  # a file's name may have any character
            pairs = [("", text)]
        else:
            pairs = [_parse_pair(part.strip()) for part in text.split(",")]
        for _, name in pairs:
            load_network(name)
        agents = [agent for agent, _ in pairs]
        if duplicates := [agent for agent in agents if agents.count(agent) > 1]:
            raise UsageError(
                f"--link: two links for {duplicates[0] or 'all'}; give one, and others as AGENT=LINK"
            )
        per_agent = dict(pairs)
        return cls(per_agent.pop("", None), per_agent)

    def check(self, agents: Collection[str], virtual: bool = False) -> None:
        """Raises UsageError if a link is assigned to an unknown agent, or shares its air in real time."""
        if not virtual:
            for name in filter(None, (self.default, *self.per_agent.values())):
                check_air_is_own(name, load_network(name))
        if unknown := [name for name in self.per_agent if name not in agents]:
            raise UsageError(f"--link: there is no agent '{unknown[0]}'; the agents are {', '.join(agents)}")

    def name_for(self, agent: str) -> str | None:
        return self.per_agent.get(agent, self.default)

    def network_for(self, agent: str) -> NetworkModel:
        """Return the agent's network; an ideal one if it has no link."""
        name = self.name_for(agent)
        return NetworkModel() if name is None else load_network(name)


def _parse_pair(part: str) -> tuple[str, str]:
    """Return the agent ("" for all) and the network's name."""
    agent, separator, name = part.partition("=")
    return (agent, name) if separator else ("", part)
