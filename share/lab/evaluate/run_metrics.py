"""What one run of a session came to: a row of figures for each agent, and one for all."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Conditions:
    """Under which a session was played; runs that differ in the policy alone are compared.

    clock: in real or virtual time. told: what the edge took for an agent's error. code: which state of
    SHARE's (`share.runtime.machine`), empty where that is not known.
    """

    session: str
    policy: str
    link: str
    seed: int
    clock: str = ""
    told: str = ""
    code: str = ""


@dataclass(frozen=True)
class AgentMetrics:
    """Of one agent in one run; NaN is what could not be measured.

    latency_ms and its parts: docs/do/evaluate.md. odom_ate_cm: of odom_n frames, alone, SE3-aligned. ate_cm:
    of the in_map frames that have a pose in the shared map, one alignment for all who are in it; NaN for who
    did not come into it. rpe_*: of poses in the map, rms of *_n pairs, from frame to frame and over 1 s.
    metres: how far it went. joined_s: since the first agent came, until it shared a map. qoe: mean over
    evaluations; told_cm: rms of the errors that they told.
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
    in_map: int
    rpe_frame_cm: float
    rpe_frame_deg: float
    rpe_frame_n: int
    rpe_1s_cm: float
    rpe_1s_deg: float
    rpe_1s_n: int
    metres: float
    joined_s: float
    keyframes: int
    sent: int
    rate_hz: float
    kb_up_s: float
    kb_down_s: float
    cpu_ms_per_frame: float
    qoe: float
    told_cm: float


@dataclass(frozen=True)
class RunMetrics:
    """joint_ate_cm: over all frames of those in the largest map, one alignment. Merges as the edge counts."""

    conditions: Conditions
    agents: tuple[AgentMetrics, ...]
    in_one_map: int
    joint_ate_cm: float
    merges_requested: int
    merges_skipped: int
    merges_done: int

    @property
    def metres(self) -> float:
        """Of all agents together."""
        return sum(agent.metres for agent in self.agents)

    @property
    def merges_per_metre(self) -> float:
        return self.merges_done / self.metres if self.metres else math.nan

    def agents_of_kind(self, kind: str) -> list[AgentMetrics]:
        return [agent for agent in self.agents if agent.kind == kind]
