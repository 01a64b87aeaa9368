"""The figures of one run, for a person."""

from __future__ import annotations

import math

from share.cli.table import aligned
from share.metrics.figures import Conditions, RunFigures

_HEAD = ("agent", "latency", "frames", "95 %", "> 20 ms", "corrected", "95 %", "of", "odom ATE")
_HEAD_2 = ("map ATE", "RPE frame", "RPE 1 s", "in a map", "sent", "up", "QoE")


def table(run: RunFigures) -> str:
    """One run for a person."""
    rows = [(*_HEAD, *_HEAD_2)] + [
        (
            agent.agent,
            *(_told(v, "ms") for v in (agent.latency_ms, agent.track_ms, agent.track_p95_ms)),
            _told(100 * agent.over_20ms, "%"),
            *(_told(v, "ms") for v in (agent.corrected_ms, agent.corrected_p95_ms)),
            str(agent.corrected),
            _told(agent.odom_ate_cm, "cm", 2),
            _told(agent.ate_cm, "cm", 2),
            _told(10 * agent.rpe_frame_cm, "mm"),
            _told(agent.rpe_1s_cm, "cm", 2),
            _told(agent.joined_s, "s"),
            _told(agent.rate_hz, "Hz"),
            _told(agent.kb_up_s, "kB/s", 0),
            _told(agent.qoe, "", 2),
        )
        for agent in run.agents
    ]
    merges = (
        f"merges: {run.merges_requested} wanted, {run.merges_skipped} skipped, {run.merges_done} done, "
        f"{_told(run.merges_per_metre, 'a metre', 2)} over {run.metres:.0f} m"
    )
    together = f"{run.in_one_map} of {len(run.agents)} agents in one map"
    joint = f"joint ATE {_told(run.joint_ate_cm, 'cm', 2)}"
    return f"{_title(run.conditions)}\n{aligned(rows)}\n{together}, {joint}; {merges}"


def _title(conditions: Conditions) -> str:
    link = conditions.link or "loopback"
    return f"{conditions.session}: policy {conditions.policy}, {link}, seed {conditions.seed}"


def _told(value: float, unit: str, digits: int = 1) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f} {unit}".rstrip()
