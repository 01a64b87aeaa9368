"""Metrics of one run of a session: a row for each agent, and one for the run."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Conditions:
    """Under which conditions a session was played. Runs that differ in the policy alone are compared.

    `clock`: real or virtual time. `error_source`: of the agents' estimated errors. `code`: digest of SHARE's
    code (`share.lab.evaluate.provenance`), empty where unknown.
    """

    session: str
    policy: str
    link: str
    seed: int
    clock: str = ""
    error_source: str = ""
    code: str = ""


@dataclass(frozen=True)
class AgentMetrics:
    """Metrics of one agent in one run; NaN where not measured.

    * latency_ms and its parts: docs/do/evaluate.md.
    * odom_ate_cm: of odom_n frames, SE3-aligned alone.
    * ate_cm: of the ate_n frames with a pose in the shared map, one alignment for all agents in it; NaN for
      an agent outside it.
    * rpe_*: rms over *_n pairs of poses in the map, from frame to frame and over 1 s.
    * metres: path length. shared_map_s: from the first agent's start until it shared a map.
    * qoe: mean over evaluations. estimated_error_cm: rms of the agent's estimated errors.
    """

    agent: str
    kind: str
    frames: int
    tracked: int
    latency_ms: float
    track_ms: float
    track_p50_ms: float
    track_p95_ms: float
    track_p99_ms: float
    over_20ms: float
    corrected: int
    corrected_ms: float
    corrected_p50_ms: float
    corrected_p95_ms: float
    corrected_p99_ms: float
    odom_ate_cm: float
    odom_n: int
    ate_cm: float
    ate_n: int
    rpe_frame_cm: float
    rpe_frame_deg: float
    rpe_frame_n: int
    rpe_1s_cm: float
    rpe_1s_deg: float
    rpe_1s_n: int
    metres: float
    shared_map_s: float
    keyframes: int
    sent: int
    rate_hz: float
    kb_up_s: float
    kb_down_s: float
    cpu_ms_per_frame: float
    qoe: float
    estimated_error_cm: float


@dataclass(frozen=True)
class RunMetrics:
    """Metrics of a run. joint_ate_cm: over all frames of the agents in the largest map, one alignment.
    Merges as counted by the edge."""

    conditions: Conditions
    agents: tuple[AgentMetrics, ...]
    agents_in_largest_map: int
    joint_ate_cm: float
    merges_requested: int
    merges_skipped: int
    merges_done: int

    @property
    def metres(self) -> float:
        """Path length of all agents together."""
        return sum(agent.metres for agent in self.agents)

    @property
    def merges_per_metre(self) -> float:
        return self.merges_done / self.metres if self.metres else math.nan

    def agents_of_kind(self, kind: str) -> list[AgentMetrics]:
        return [agent for agent in self.agents if agent.kind == kind]
