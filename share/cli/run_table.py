"""The figures of one run, for a person."""

from __future__ import annotations

import math

from share.cli.table import aligned
from share.lab.evaluate.figures import AgentFigures, Conditions, RunFigures

_LATENCY = ("", "latency", "frames", "50 %", "95 %", "99 %", "> 20 ms")
_CORRECTED = ("corrected", "50 %", "95 %", "99 %", "of")
_ERRORS = ("", "odom ATE", "of", "map ATE", "of", "RPE frame", "", "RPE 1 s", "", "of")
_SHARED = ("in a map", "sent", "up", "down", "QoE", "told")


def table(run: RunFigures) -> str:
    """One run for a person: latency, then errors and what was shared, a line an agent each."""
    latency = aligned([(*_LATENCY, *_CORRECTED), *(_latency(agent) for agent in run.agents)])
    errors = aligned([(*_ERRORS, *_SHARED), *(_errors(agent) for agent in run.agents)])
    merges = (
        f"merges: {run.merges_requested} wanted, {run.merges_skipped} skipped, {run.merges_done} done, "
        f"{_told(run.merges_per_metre, 'a metre', 2)} over {run.metres:.0f} m"
    )
    together = f"{run.in_one_map} of {len(run.agents)} agents in one map"
    joint = f"joint ATE {_told(run.joint_ate_cm, 'cm', 2)}"
    return f"{_title(run.conditions)}\n{latency}\n\n{errors}\n{together}, {joint}; {merges}"


def _latency(agent: AgentFigures) -> tuple[str, ...]:
    frames = agent.track_ms, agent.track_p50_ms, agent.track_p95_ms, agent.track_p99_ms
    corrected = agent.corrected_ms, agent.corrected_p50_ms, agent.corrected_p95_ms, agent.corrected_p99_ms
    return (
        agent.agent,
        *(_told(value, "ms") for value in (agent.latency_ms, *frames)),
        _told(100 * agent.over_20ms, "%"),
        *(_told(value, "ms") for value in corrected),
        str(agent.corrected),
    )


def _errors(agent: AgentFigures) -> tuple[str, ...]:
    return (
        agent.agent,
        _told(agent.odom_ate_cm, "cm", 2),
        str(agent.odom_n),
        _told(agent.ate_cm, "cm", 2),
        str(agent.in_map),
        _told(10 * agent.rpe_frame_cm, "mm"),
        _told(agent.rpe_frame_deg, "°", 3),
        _told(agent.rpe_1s_cm, "cm", 2),
        _told(agent.rpe_1s_deg, "°", 2),
        str(agent.rpe_1s_n),
        _told(agent.joined_s, "s"),
        _told(agent.rate_hz, "Hz"),
        _told(agent.kb_up_s, "kB/s", 0),
        _told(agent.kb_down_s, "kB/s", 0),
        _told(agent.qoe, "", 2),
        _told(agent.told_cm, "cm", 2),
    )


def _title(conditions: Conditions) -> str:
    c = conditions
    where = f"{c.session}: policy {c.policy}, {c.link or 'loopback'}, seed {c.seed}"
    return f"{where}; in {c.clock}, evaluations tell {c.told}"


def _told(value: float, unit: str, digits: int = 1) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f} {unit}".rstrip()
