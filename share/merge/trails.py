"""What the agents said of themselves: keyframes on stretches of unbroken odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.graph.posegraph import Edge
from share.merge.join import Key
from share.types import F64, Keyframe


@dataclass(frozen=True, eq=False)
class Node:
    """A keyframe's place on its stretch. reference: the node that T_ref_body starts from, -1 for odom."""

    key: Key
    stretch: int
    ordinal: int
    reference: int
    T_ref_body: F64
    T_odom_body: F64


class Trails:
    """Nodes in the order of arrival, the odometry edges between them, and the stretches they make up."""

    def __init__(self, config: MergeConfig) -> None:
        self._config = config
        self.nodes: list[Node] = []
        self.edges: list[Edge] = []
        self.stretches: list[list[int]] = []  # node numbers, in order
        self._at: dict[Key, int] = {}
        self._current: dict[str, int] = {}  # agent -> stretch that it is on

    def add(self, agent: str, keyframe: Keyframe) -> int:
        """The number of the new node. Raises ValueError for a keyframe known already, or one whose
        reference is unknown: the caller applies each once and in order."""
        key = Key(agent, keyframe.id)
        if key in self._at:
            raise ValueError(f"keyframe {key} was added before")
        number = len(self.nodes)
        if keyframe.reference < 0:
            node = Node(key, len(self.stretches), 0, -1, keyframe.T_ref_body, keyframe.T_ref_body)
            self.stretches.append([])
            self._current[agent] = node.stretch
        else:
            reference = self.number(Key(agent, keyframe.reference))
            before = self.nodes[reference]
            T_odom_body = se3.orthonormal(before.T_odom_body @ keyframe.T_ref_body)
            ordinal = before.ordinal + 1
            node = Node(key, before.stretch, ordinal, reference, keyframe.T_ref_body, T_odom_body)
            self.edges.append(Edge(reference, number, keyframe.T_ref_body, self._believed(keyframe.cov)))
        self.nodes.append(node)
        self.stretches[node.stretch].append(number)
        self._at[key] = number
        return number

    def number(self, key: Key) -> int:
        """Raises ValueError if no such keyframe was added."""
        if key not in self._at:
            raise ValueError(f"keyframe {key} is not known")
        return self._at[key]

    def name(self, stretch: int) -> str:
        """`agent/n`: the n-th stretch of this agent."""
        agent = self.nodes[self.stretches[stretch][0]].key.agent
        earlier = sum(self.nodes[s[0]].key.agent == agent for s in self.stretches[:stretch])
        return f"{agent}/{earlier}"

    def current(self, agent: str) -> int | None:
        """The stretch that the agent is on now."""
        return self._current.get(agent)

    def is_neighbour(self, a: int, b: int) -> bool:
        """Near each other on one stretch, so that odometry knows their relative pose best."""
        first, second = self.nodes[a], self.nodes[b]
        near = abs(first.ordinal - second.ordinal) < self._config.min_loop_gap
        return first.stretch == second.stretch and near

    def _believed(self, cov: F64) -> F64:
        """Agents are surer of themselves than they should be; none is surer than the floor."""
        c = self._config
        floor = [np.radians(c.odometry_floor_deg) ** 2] * 3 + [c.odometry_floor_m**2] * 3
        return c.odometry_scale**2 * cov + np.diag(floor)
