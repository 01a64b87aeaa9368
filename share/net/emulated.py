"""An agent's link through an emulated network (`share.net.channel`), for experiments on one machine."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import UsageError
from share.files.yaml_file import read_yaml
from share.net.channel import NETWORKS, Channel, Network
from share.net.transport import LINGER_MS, QUEUE_MESSAGES, AgentLink
from share.plain_data import from_mapping
from share.wire.codec import Bytes, size

_MS = 1_000_000


def network(name: str) -> Network:
    """By its name, or of a YAML file {up: {mbps, delay_ms, jitter_ms, loss, burst}, down: {…}}. Raises
    UsageError, ConfigError."""
    if name in NETWORKS:
        return NETWORKS[name]
    path = Path(name)
    if not path.is_file():
        raise UsageError(f"--link: '{name}' is no file and none of {', '.join(NETWORKS)}")
    return from_mapping(Network, read_yaml(path).data, str(path))


class ShapedLink:
    """`AgentLink` around another. What is sent is handed on once it would have arrived, and what arrives is
    handed out once it would have: while `receive` waits, which may return early for that. Same seed, same
    delays."""

    def __init__(self, link: AgentLink, network: Network, seed: int) -> None:
        self._link = link
        up, down = np.random.default_rng(seed).spawn(2)
        self._up = Channel(network.up, network.round_trip_ms, up)
        self._down = Channel(network.down, network.round_trip_ms, down)
        self._going: deque[tuple[int, Sequence[Bytes]]] = deque()  # in order, with when they arrive
        self._coming: deque[tuple[int, list[bytes]]] = deque()

    def send(self, frames: Sequence[Bytes]) -> bool:
        self._hand_on()
        if len(self._going) >= QUEUE_MESSAGES:
            return False
        self._going.append((self._up.arrival_ns(size(frames), time.monotonic_ns()), frames))
        return True

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        end_ns = time.monotonic_ns() + timeout_ms * _MS
        while True:
            self._hand_on()
            now_ns = time.monotonic_ns()
            if self._coming and self._coming[0][0] <= now_ns:
                return self._coming.popleft()[1]
            next_ns = min([end_ns, *(queue[0][0] for queue in (self._going, self._coming) if queue)])
            if 0 < next_ns - now_ns < _MS:  # the link below counts in milliseconds
                time.sleep((next_ns - now_ns) * 1e-9)
                continue
            message = self._link.receive(max(0, next_ns - now_ns) // _MS)
            if message is None:
                return None  # time is up, something goes on, or it was woken
            at_ns = self._down.arrival_ns(size(message), time.monotonic_ns())
            self._coming.append((at_ns, message))

    def trouble(self) -> str | None:
        return self._link.trouble()

    def connected(self) -> bool:
        return self._link.connected()

    def wake(self) -> None:
        self._link.wake()

    def close(self) -> None:
        end_ns = time.monotonic_ns() + LINGER_MS * _MS
        while self._going and self._going[0][0] < end_ns:
            time.sleep(max(0, self._going[0][0] - time.monotonic_ns()) * 1e-9)
            self._hand_on()
        self._link.close()

    def _hand_on(self) -> None:
        """What has arrived at the edge by now; if there is none, it is lost."""
        while self._going and self._going[0][0] <= time.monotonic_ns():
            self._link.send(self._going.popleft()[1])


# ---- Which emulated network each agent of a session goes through, as a person writes it.


@dataclass(frozen=True)
class Links:
    """Names or files. usual: for who has none of its own; None: this machine's own. own: by agent."""

    usual: str | None
    own: Mapping[str, str]

    @classmethod
    def parse(cls, text: str | None) -> Links:
        """`wifi5`, all; `wifi5,bob=wifi-busy`, all but Bob; `bob=far.yaml`, Bob alone.

        Raises UsageError or ConfigError where one of them is no network.
        """
        if text is None:
            return cls(None, {})
        if text in NETWORKS or Path(text).is_file():  # a file's name may have any character
            pairs = [("", text)]
        else:
            pairs = [_pair(part.strip()) for part in text.split(",")]
        for _, name in pairs:
            network(name)
        whose = [agent for agent, _ in pairs]
        if twice := [agent for agent in whose if whose.count(agent) > 1]:
            raise UsageError(f"--link: two for {twice[0] or 'all'}; give one, and others as AGENT=LINK")
        own = dict(pairs)
        return cls(own.pop("", None), own)

    def check(self, agents: Collection[str]) -> None:
        """Raises UsageError where a link is that of an agent who is not there."""
        if unknown := [name for name in self.own if name not in agents]:
            raise UsageError(f"--link: no agent is called '{unknown[0]}'; there are {', '.join(agents)}")

    def of(self, agent: str) -> str | None:
        return self.own.get(agent, self.usual)

    def network(self, agent: str) -> Network:
        """One without limits where it has no link."""
        name = self.of(agent)
        return Network() if name is None else network(name)


def _pair(part: str) -> tuple[str, str]:
    """An agent, "" for all, and its network."""
    agent, found, name = part.partition("=")
    return (agent, name) if found else ("", part)
