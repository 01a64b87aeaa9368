"""The metrics of one run as text tables."""

from __future__ import annotations

import math

from share.cli.table import aligned_table
from share.lab.evaluate.run_metrics import AgentMetrics, Conditions, RunMetrics

_LATENCY_COLUMNS = ("", "latency", "frames", "50 %", "95 %", "99 %", "> 20 ms")
_CORRECTED_COLUMNS = ("corrected", "50 %", "95 %", "99 %", "of")
_ERROR_COLUMNS = ("", "odom ATE", "of", "map ATE", "of", "RPE frame", "", "RPE 1 s", "", "of")
_SHARING_COLUMNS = ("in a map", "sent", "up", "down", "QoE", "reported error")


def run_table(run: RunMetrics) -> str:
    """Return two tables with a line per agent, latency and then errors and sharing, and the merges."""
    latency = aligned_table(
        [(*_LATENCY_COLUMNS, *_CORRECTED_COLUMNS), *(_latency_cells(agent) for agent in run.agents)]
    )
    errors = aligned_table(
        [(*_ERROR_COLUMNS, *_SHARING_COLUMNS), *(_error_cells(agent) for agent in run.agents)]
    )
    merges = (
        f"merges: {run.merges_requested} requested, {run.merges_skipped} skipped, {run.merges_done} done, "
        f"{_value_text(run.merges_per_metre, 'a metre', 2)} over {run.metres:.0f} m"
    )
    joined_text = f"{run.agents_in_largest_map} of {len(run.agents)} agents in one map"
    joint_text = f"joint ATE {_value_text(run.joint_ate_cm, 'cm', 2)}"
    return f"{_title(run.conditions)}\n{latency}\n\n{errors}\n{joined_text}, {joint_text}; {merges}"


def _latency_cells(agent: AgentMetrics) -> tuple[str, ...]:
    frames = agent.track_ms, agent.track_p50_ms, agent.track_p95_ms, agent.track_p99_ms
    corrected = agent.corrected_ms, agent.corrected_p50_ms, agent.corrected_p95_ms, agent.corrected_p99_ms
    return (
        agent.agent,
        *(_value_text(value, "ms") for value in (agent.latency_ms, *frames)),
        _value_text(100 * agent.over_20ms, "%"),
        *(_value_text(value, "ms") for value in corrected),
        str(agent.corrected),
    )


def _error_cells(agent: AgentMetrics) -> tuple[str, ...]:
    return (
        agent.agent,
        _value_text(agent.odom_ate_cm, "cm", 2),
        str(agent.odom_n),
        _value_text(agent.ate_cm, "cm", 2),
        str(agent.ate_n),
        _value_text(10 * agent.rpe_frame_cm, "mm"),
        _value_text(agent.rpe_frame_deg, "°", 3),
        _value_text(agent.rpe_1s_cm, "cm", 2),
        _value_text(agent.rpe_1s_deg, "°", 2),
        str(agent.rpe_1s_n),
        _value_text(agent.shared_map_s, "s"),
        _value_text(agent.rate_hz, "Hz"),
        _value_text(agent.kb_up_s, "kB/s", 0),
        _value_text(agent.kb_down_s, "kB/s", 0),
        _value_text(agent.qoe, "", 2),
        _value_text(agent.estimated_error_cm, "cm", 2),
    )


def _title(conditions: Conditions) -> str:
    c = conditions
    where = f"{c.session}: policy {c.policy}, {c.link or 'loopback'}, seed {c.seed}"
    return f"{where}; in {c.clock}, evaluations report {c.error_source}"


def _value_text(value: float, unit: str, digits: int = 1) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f} {unit}".rstrip()
