"""The edge's report as Prometheus reads it: a table of what is called what, and the text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prometheus_client.core import Metric


@dataclass(frozen=True)
class MetricSpec:
    """One metric: `path`, keys with dots between, leads to its number in the report, or in each entry of
    the report's mapping `over`. Labels: the entry's own key, then paths in the entry.

    Names and units after Prometheus: *Metric and label naming*; ..._total only grows.
    """

    name: str
    help: str
    path: str
    over: str = ""
    labels: tuple[str, ...] = ()
    scale: float = 1.0  # to the unit in its name


_PER_AGENT = ("agents", ("agent", "kind"))
METRICS = (
    MetricSpec("share_edge_uptime_seconds", "Time since the edge began.", "uptime_s"),
    MetricSpec("share_edge_waiting_keyframes", "Keyframes that wait to be looked up.", "waiting"),
    MetricSpec("share_edge_last_solve_age_seconds", "Time since poses were solved for.", "last_solve_s"),
    MetricSpec("share_edge_troubles", "What is wrong now; /health says what.", "trouble"),
    MetricSpec("share_edge_failed_jobs_total", "Jobs that raised an error.", "failed_steps"),
    MetricSpec(
        "share_edge_refused_handshakes_total", "Attempts to connect without a key.", "refused_handshakes"
    ),
    MetricSpec("share_edge_maps", "Maps, each apart from the others.", "maps"),
    MetricSpec("share_edge_map_keyframes", "Keyframes in a map.", "", "maps", ("map",)),
    MetricSpec("share_edge_loops", "Loops in the maps.", "loops.in_map"),
    MetricSpec("share_edge_loops_waiting", "Loops that wait for a witness.", "loops.waiting"),
    MetricSpec("share_edge_agent_gone", "1 where the agent said bye or is silent.", "gone", *_PER_AGENT),
    MetricSpec(
        "share_edge_pose_age_seconds", "Age of the newest pose.", "pose_age_ms", *_PER_AGENT, scale=1e-3
    ),
    MetricSpec("share_edge_heard_age_seconds", "Time since the agent was heard.", "heard_s", *_PER_AGENT),
    MetricSpec("share_edge_keyframes_total", "Keyframes applied.", "keyframes", *_PER_AGENT),
    MetricSpec("share_edge_poses_total", "Poses received.", "poses", *_PER_AGENT),
    MetricSpec("share_edge_evaluations_total", "Evaluations received.", "evaluations", *_PER_AGENT),
    MetricSpec("share_edge_corrections_total", "Corrections sent.", "corrections", *_PER_AGENT),
    MetricSpec("share_edge_received_bytes_total", "Bytes received.", "bytes_up", *_PER_AGENT),
    MetricSpec("share_edge_sent_bytes_total", "Bytes sent.", "bytes_down", *_PER_AGENT),
    MetricSpec("share_edge_bad_messages_total", "Messages that were malformed.", "bad_messages", *_PER_AGENT),
    MetricSpec(
        "share_edge_unexpected_messages_total", "Messages that only an edge sends.", "unexpected", *_PER_AGENT
    ),
    MetricSpec("share_edge_loops_tried_total", "Pairs of views verified.", "loops.tried", *_PER_AGENT),
    MetricSpec("share_edge_loops_accepted_total", "Pairs of views believed.", "loops.accepted", *_PER_AGENT),
    MetricSpec("share_edge_merges_total", "Loops merged into a map.", "merges.done", *_PER_AGENT),
    MetricSpec(
        "share_edge_merges_skipped_total", "Loops that were not merged.", "merges.skipped", *_PER_AGENT
    ),
    MetricSpec(
        "share_edge_queries_skipped_total", "Keyframes not looked up.", "queries_skipped", *_PER_AGENT
    ),
    MetricSpec(
        "share_edge_stranger_bytes_total", "Bytes from peers that are no agents.", "unjoined.bytes_up"
    ),
    MetricSpec(
        "share_edge_stranger_bad_messages_total", "Malformed, from such peers.", "unjoined.bad_messages"
    ),
)
_INFO = ("share_edge_agent_info", "What an agent is now; always 1.", ("agent", "kind", "state", "map"))
_JOBS = ("share_edge_job_seconds", "Time of a job of the worker.")
_QUANTILES = {"p50": "0.5", "p95": "0.95", "p99": "0.99"}


def render_metrics(report: dict[str, Any]) -> tuple[bytes, str]:
    """The metrics and their media type. What the report lacks is left out, what else it has passed over."""
    from prometheus_client.exposition import choose_encoder

    encode, media_type = choose_encoder("")
    return encode(_Collector(report)), media_type


@dataclass(frozen=True)
class _Collector:
    """What prometheus_client calls a collector."""

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
        yield _jobs(self.report)


def _samples(report: dict[str, Any], row: MetricSpec) -> Iterator[tuple[list[str], float]]:
    for name, entry in _entries(report, row.over):
        number = _as_number(_lookup(entry, row.path))
        if number is not None:
            yield [name, *_labels(entry, row.labels[1:])][: len(row.labels)], number * row.scale


def _info(report: dict[str, Any]) -> Metric:
    from prometheus_client.core import GaugeMetricFamily

    metric = GaugeMetricFamily(_INFO[0], _INFO[1], labels=_INFO[2])
    for name, agent in _entries(report, "agents"):
        metric.add_metric([name, *_labels(agent, ("kind", "state", "map_id"))], 1)
    return metric


def _jobs(report: dict[str, Any]) -> Metric:
    """Every NAME_ms of the report that has percentiles."""
    from prometheus_client.core import Metric

    metric = Metric(*_JOBS, typ="summary")
    for key, times in report.items():
        if not key.endswith("_ms") or not isinstance(times, dict):
            continue
        job, count = {"job": key.removesuffix("_ms")}, _as_number(times.get("n")) or 0.0
        for name, quantile in _QUANTILES.items():
            if (ms := _as_number(times.get(name))) is not None:
                metric.add_sample(_JOBS[0], {**job, "quantile": quantile}, ms * 1e-3)
        metric.add_sample(f"{_JOBS[0]}_sum", job, count * (_as_number(times.get("mean")) or 0.0) * 1e-3)
        metric.add_sample(f"{_JOBS[0]}_count", job, count)
    return metric


def _entries(report: dict[str, Any], over: str) -> Iterator[tuple[str, Any]]:
    if not over:
        yield "", report
    elif isinstance(entries := _lookup(report, over), dict):
        yield from ((str(name), entry) for name, entry in entries.items())


def _labels(entry: Any, paths: tuple[str, ...]) -> list[str]:
    """Empty, which to Prometheus is absent, where there is nothing."""
    return ["" if (value := _lookup(entry, path)) is None else str(value) for path in paths]


def _lookup(tree: Any, path: str) -> Any:
    """What `path` leads to; None if nothing."""
    for key in path.split(".") if path else ():
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _as_number(value: Any) -> float | None:
    """Of a mapping or list: how many are in it."""
    if isinstance(value, dict | list | tuple):
        return float(len(value))
    return float(value) if isinstance(value, int | float) else None
