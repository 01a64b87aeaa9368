"""A simulated room in which things break: the edge, an agent, the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from share.lab.evaluate.emulated_network import NetworkModel
from share.lab.evaluate.simulation import SimulatedRun, Simulation
from share.protocol import agent_events as aev
from share.protocol import edge_events as ed
from share.protocol.common_events import Connected
from share.timing import seconds_to_ns
from share.wire.layouts import Bytes
from share.wire.messages import Hello

_RECONNECT_NS = seconds_to_ns(0.3)  # until an agent's link has found an edge that is back


class BreakableRoom(Simulation):
    """What reaches an edge that is down is lost, as is what its mapper was doing. What is sent during an
    outage of the network arrives after it, as over TCP."""

    _edge_life, _is_edge_up = 1, True
    _outage_end_ns = 0
    _outage_of = ""

    # ------------------------------------------------------------ the edge

    def kill_edge(self) -> None:
        """End the edge and its mapper at once. Without a store its map is gone."""
        self._is_edge_up = False
        self._edge_life += 1

    def start_edge(self) -> None:
        """Start an edge again; the agents' links find it."""
        self._is_edge_up = True
        self._start_edge(self._edge_life)
        for member in self._members.values():
            self.schedule(_RECONNECT_NS, lambda member=member: self._to_agent(member, Connected()))  # type: ignore[misc]

    def _to_edge(self, event: ed.EdgeEvent) -> None:
        if self._is_edge_up:
            super()._to_edge(event)

    def _schedule_mapper(self, delay_ns: int, action: Callable[[], None]) -> None:
        life = self._edge_life

        def act() -> None:
            if life == self._edge_life:
                action()

        self.schedule(delay_ns, act)

    # ------------------------------------------------------------ an agent

    def kill_agent(self, name: str) -> None:
        """End the newest run of an agent at once."""
        del self._members[self.run_of(name).peer]

    def start_agent(self, hello: Hello, network: NetworkModel, seed: int) -> None:
        """Start another run of an agent, whose frames are pushed."""
        self._add_member(hello, iter(()), network, np.random.default_rng((seed, hello.run_id)).spawn(2))
        self.schedule(_RECONNECT_NS, lambda: self._to_agent(self.run_of(hello.name), Connected()))

    def run_of(self, name: str) -> SimulatedRun:
        """Return the newest run of an agent. Raises KeyError without one."""
        runs = [member for member in self._members.values() if member.name == name]
        if not runs:
            raise KeyError(name)
        return runs[-1]

    def has_run(self, name: str) -> bool:
        return any(member.name == name for member in self._members.values())

    def _to_agent(self, member: SimulatedRun, event: aev.AgentEvent) -> None:
        if self._members.get(member.peer) is member:
            super()._to_agent(member, event)

    # ------------------------------------------------------------ the network

    def cut_network(self, name: str, seconds: float) -> None:
        """Let nothing through between an agent and the edge for some time."""
        self._outage_of, self._outage_end_ns = name, self.now_ns + seconds_to_ns(seconds)

    def _held_ns(self, member: SimulatedRun) -> int:
        return max(0, self._outage_end_ns - self.now_ns) if member.name == self._outage_of else 0

    def _send_up(self, member: SimulatedRun, frames: Sequence[Bytes]) -> None:
        if held_ns := self._held_ns(member):
            self.schedule(held_ns, lambda: self._send_up(member, frames))
        else:
            super()._send_up(member, frames)

    def _send_down(self, effect: ed.SendToPeer) -> None:
        member = self._members.get(effect.peer_id)
        if member is None:
            return
        if held_ns := self._held_ns(member):
            self.schedule(held_ns, lambda: self._send_down(effect))
        else:
            super()._send_down(effect)
