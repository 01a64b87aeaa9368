"""The edge's report as metrics in Prometheus' text format, by a table (docs/lookup/status.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from share.protocol.agent_health import has_left

if TYPE_CHECKING:
    from prometheus_client.core import Metric


@dataclass(frozen=True)
class MetricSpec:
    """One metric. path: dotted keys to its number in the report, or in each entry of the report's mapping
    `over`; of several paths with "+" between them the sum. labels: first the entry's key, then dotted keys in
    the entry.

    Names and units follow Prometheus, *Metric and label naming*; counters (..._total) only grow.
    """

    name: str
    help: str
    path: str
    over: str = ""
    labels: tuple[str, ...] = ()
    scale: float = 1.0  # from the report's unit to that in the name


_PER_AGENT = ("agents", ("agent", "kind"))
METRICS: tuple[MetricSpec, ...] = (
    MetricSpec("share_edge_uptime_seconds", "Time since the edge started.", "uptime_s"),
    MetricSpec("share_edge_waiting_keyframes", "Keyframes waiting for place recognition.", "waiting"),
    MetricSpec("share_edge_last_solve_age_seconds", "Time since the last pose graph solve.", "last_solve_s"),
    MetricSpec("share_edge_troubles", "Number of current problems; /health lists them.", "trouble"),
    MetricSpec("share_edge_degraded", "Number of losses of the map file; /health lists them.", "degraded"),
    MetricSpec("share_edge_failed_steps_total", "Steps of the mapper that raised an error.", "failed_steps"),
    MetricSpec("share_edge_refused_handshakes_total", "Refused attempts to connect.", "refused_handshakes"),
    MetricSpec("share_edge_maps", "Separate maps.", "maps+unlisted_maps"),
    MetricSpec("share_edge_map_keyframes", "Keyframes in a map.", "", "maps", ("map",)),
    MetricSpec("share_edge_unlisted_runs", "Earlier runs without metrics of their own.", "unlisted_runs"),
    MetricSpec("share_edge_room_agents", "Agents in a room of a site.", "agents", "rooms", ("room",)),
    MetricSpec("share_edge_room_keyframes", "Keyframes of a room.", "keyframes", "rooms", ("room",)),
    MetricSpec("share_edge_room_waiting_keyframes", "Waiting, of a room.", "waiting", "rooms", ("room",)),
    MetricSpec("share_edge_room_changes_total", "Agents that went on in another room.", "room_changes"),
    MetricSpec("share_edge_loops", "Loops in the maps.", "loops.in_map"),
    MetricSpec("share_edge_loops_waiting", "Loops waiting for a supporting loop.", "loops.waiting"),
    MetricSpec("share_edge_agent_gone", "1 if the agent has left or is silent.", "gone", *_PER_AGENT),
    MetricSpec(
        "share_edge_pose_age_seconds", "Age of the newest pose.", "pose_age_ms", *_PER_AGENT, scale=1e-3
    ),
    MetricSpec(
        "share_edge_last_message_age_seconds",
        "Time since the agent's last message.",
        "last_received_s",
        *_PER_AGENT,
    ),
    MetricSpec("share_edge_agent_troubles", "Number of its current problems.", "trouble", *_PER_AGENT),
    MetricSpec("share_edge_qoe", "Quality of experience, 0 to 1.", "qoe", *_PER_AGENT),
    MetricSpec("share_edge_qoe_target", "Target of the quality of experience.", "qoe_target", *_PER_AGENT),
    MetricSpec("share_edge_keyframe_rate_hertz", "Keyframes that it may send.", "rate_hz", *_PER_AGENT),
    MetricSpec("share_edge_delay_seconds", "Delay that it reports.", "delay_ms", *_PER_AGENT, scale=1e-3),
    MetricSpec(
        "share_edge_clock_error_seconds",
        "Bound of the error of its estimate of the edge's clock.",
        "clock_error_ms",
        *_PER_AGENT,
        scale=1e-3,
    ),
    MetricSpec(
        "share_edge_unacknowledged_seconds",
        "Age of its oldest keyframe that is not acknowledged.",
        "unacknowledged_ms",
        *_PER_AGENT,
        scale=1e-3,
    ),
    MetricSpec("share_edge_keyframes_total", "Keyframes applied.", "keyframes", *_PER_AGENT),
    MetricSpec("share_edge_poses_total", "Poses received.", "poses", *_PER_AGENT),
    MetricSpec("share_edge_evaluations_total", "Evaluations received.", "evaluations", *_PER_AGENT),
    MetricSpec("share_edge_corrections_total", "Corrections sent.", "corrections", *_PER_AGENT),
    MetricSpec("share_edge_received_bytes_total", "Bytes received.", "bytes_up", *_PER_AGENT),
    MetricSpec("share_edge_sent_bytes_total", "Bytes sent.", "bytes_down", *_PER_AGENT),
    MetricSpec("share_edge_bad_messages_total", "Malformed messages.", "bad_messages", *_PER_AGENT),
    MetricSpec(
        "share_edge_unexpected_messages_total", "Messages that only an edge sends.", "unexpected", *_PER_AGENT
    ),
    MetricSpec("share_edge_loops_tried_total", "Pairs of views verified.", "loops.tried", *_PER_AGENT),
    MetricSpec(
        "share_edge_loops_accepted_total", "Pairs of views accepted as loops.", "loops.accepted", *_PER_AGENT
    ),
    MetricSpec("share_edge_merges_total", "Loops added to a map.", "merges.done", *_PER_AGENT),
    MetricSpec("share_edge_merges_skipped_total", "Loops not added to a map.", "merges.skipped", *_PER_AGENT),
    MetricSpec(
        "share_edge_queries_skipped_total",
        "Keyframes without place recognition.",
        "queries_skipped",
        *_PER_AGENT,
    ),
    MetricSpec("share_edge_unidentified_bytes_total", "Bytes from unidentified peers.", "unjoined.bytes_up"),
    MetricSpec(
        "share_edge_unidentified_bad_messages_total",
        "Malformed messages from unidentified peers.",
        "unjoined.bad_messages",
    ),
)
_PER_WEARER = ("headset.wearers", ("wearer", "agent", "mode"))
METRICS += (
    MetricSpec("share_edge_headset_pages", "Headset pages that are connected.", "headset.pages"),
    MetricSpec("share_edge_headset_wrong_codes_total", "Wrong codes that were given.", "headset.wrong_codes"),
    MetricSpec(
        "share_edge_headset_connected", "1 if the wearer's page is connected.", "is_connected", *_PER_WEARER
    ),
    MetricSpec(
        "share_edge_headset_frames", "Frames that its page drew in its newest 2 s.", "frames", *_PER_WEARER
    ),
    MetricSpec(
        "share_edge_headset_late_frames",
        "Frames of these that were drawn over 20 ms after their pose's stamp.",
        "over_20ms",
        *_PER_WEARER,
    ),
    MetricSpec(
        "share_edge_headset_alignment_metres",
        "Standard deviation of where its own space is in the map.",
        "alignment_mm",
        *_PER_WEARER,
        scale=1e-3,
    ),
    MetricSpec(
        "share_edge_headset_drift_metres_per_second",
        "How fast that moves.",
        "drift_mm_s",
        *_PER_WEARER,
        scale=1e-3,
    ),
)
_INFO = ("share_edge_agent_info", "State of an agent as labels; always 1.", ("agent", "kind", "state", "map"))
_STEPS = ("share_edge_step_seconds", "Duration of a step of the mapper.")
_POSES = (
    "share_edge_pose_delay_seconds",
    "From the arrival of a frame at the agent until its pose was sent; of the newest 600 poses.",
)
_LAGS = (
    "share_edge_headset_lag_seconds",
    "From a pose's stamp until its frame was drawn; of a wearer's newest 2 s.",
)
_QUANTILES = {"p50": "0.5", "p95": "0.95", "p99": "0.99"}


def render_metrics(report: dict[str, Any]) -> tuple[bytes, str]:
    """Return the metrics as text and their media type. Metrics that the report lacks are omitted."""
    from prometheus_client.exposition import choose_encoder

    encode, media_type = choose_encoder("")
    agents = {label: _without_the_past(agent) for label, agent in _entries(report, "agents")}
    return encode(_Collector({**report, "agents": agents})), media_type


def _without_the_past(agent: Any) -> Any:
    """Return an agent's entry; of one that has left without the age and state that it had: an alert on them
    would never end."""
    if not isinstance(agent, dict) or not has_left(agent):
        return agent
    return {**agent, "state": "GONE", "pose_age_ms": None}


@dataclass(frozen=True)
class _Collector:
    """A collector for prometheus_client."""

    report: dict[str, Any]

    def collect(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        for row in METRICS:
            kind = CounterMetricFamily if row.name.endswith("_total") else GaugeMetricFamily
            metric = kind(row.name, row.help, labels=row.labels)
            for labels, number in _samples(self.report, row):
                metric.add_metric(labels, number)
            if metric.samples:
                yield metric
        yield _info(self.report)
        yield _steps(self.report)
        yield _poses(self.report)
        if (lags := _lags(self.report)).samples:
            yield lags


def _samples(report: dict[str, Any], row: MetricSpec) -> Iterator[tuple[list[str], float]]:
    for name, entry in _entries(report, row.over):
        numbers = [_as_number(_lookup(entry, path)) for path in row.path.split("+")]
        if known := [number for number in numbers if number is not None]:
            yield [name, *_labels(entry, row.labels[1:])][: len(row.labels)], sum(known) * row.scale


def _info(report: dict[str, Any]) -> Metric:
    from prometheus_client.core import GaugeMetricFamily

    metric = GaugeMetricFamily(_INFO[0], _INFO[1], labels=_INFO[2])
    for name, agent in _entries(report, "agents"):
        metric.add_metric([name, *_labels(agent, ("kind", "state", "map_id"))], 1)
    return metric


def _steps(report: dict[str, Any]) -> Metric:
    """Return a summary of each NAME_ms in the report that has percentiles."""
    from prometheus_client.core import Metric

    metric = Metric(*_STEPS, typ="summary")
    for key, times in report.items():
        if key.endswith("_ms") and isinstance(times, dict):
            _add_summary(metric, {"step": key.removesuffix("_ms")}, times)
    return metric


def _poses(report: dict[str, Any]) -> Metric:
    """Return a summary of the ages of each agent's poses."""
    from prometheus_client.core import Metric

    metric = Metric(*_POSES, typ="summary")
    for name, agent in _entries(report, "agents"):
        if isinstance(times := _lookup(agent, "pose_ages_ms"), dict) and times.get("n"):
            _add_summary(metric, {"agent": name, "kind": str(_lookup(agent, "kind"))}, times)
    return metric


def _lags(report: dict[str, Any]) -> Metric:
    """Return the quantiles of each wearer's lag; a page says no more of it."""
    from prometheus_client.core import Metric

    metric = Metric(*_LAGS, typ="summary")
    for name, wearer in _entries(report, _PER_WEARER[0]):
        labels = dict(zip(_PER_WEARER[1], [name, *_labels(wearer, _PER_WEARER[1][1:])], strict=True))
        for key, quantile in _QUANTILES.items():
            if (ms := _as_number(_lookup(wearer, f"{key}_ms"))) is not None:
                metric.add_sample(metric.name, {**labels, "quantile": quantile}, ms * 1e-3)
    return metric


def _add_summary(metric: Metric, labels: dict[str, str], times: dict[str, Any]) -> None:
    count = _as_number(times.get("n")) or 0.0
    for name, quantile in _QUANTILES.items():
        if (ms := _as_number(times.get(name))) is not None:
            metric.add_sample(metric.name, {**labels, "quantile": quantile}, ms * 1e-3)
    sum_s = count * (_as_number(times.get("mean")) or 0.0) * 1e-3
    metric.add_sample(f"{metric.name}_sum", labels, sum_s)
    metric.add_sample(f"{metric.name}_count", labels, count)


def _entries(report: dict[str, Any], over: str) -> Iterator[tuple[str, Any]]:
    if not over:
        yield "", report
    elif isinstance(entries := _lookup(report, over), dict):
        yield from ((str(name), entry) for name, entry in entries.items())


def _labels(entry: Any, paths: tuple[str, ...]) -> list[str]:
    """Return the label values; empty, i.e. absent to Prometheus, where the entry has none."""
    return ["" if (value := _lookup(entry, path)) is None else str(value) for path in paths]


def _lookup(tree: Any, path: str) -> Any:
    """Return the value at the dotted `path`, None if absent."""
    for key in path.split(".") if path else ():
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _as_number(value: Any) -> float | None:
    """Return a number, the length of a mapping or list, or None."""
    if isinstance(value, dict | list | tuple):
        return float(len(value))
    return float(value) if isinstance(value, int | float) else None
