"""What an edge has counted, over all lives of its mapper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_MERGES = tuple(("merges", what) for what in ("requested", "skipped", "done"))
_LOOPS = (("loops", "tried"), ("loops", "accepted"))
_OF_ALL = (
    *_LOOPS,
    *_MERGES,
    *((name,) for name in ("taken_out", "failed_jobs", "internal_errors", "forgotten_runs")),
    *((f"{kind}_ms", "n") for kind in ("place", "verify", "solve")),
)
_OF_AGENT = (
    *_LOOPS,
    *_MERGES,
    *((name,) for name in ("keyframes", "poses", "evaluations", "corrections", "bytes_up", "bytes_down")),
    *((name,) for name in ("bad_messages", "unexpected", "queries_skipped", "refused_messages")),
    ("doubted_keyframes",),
)
_MOST_RUNS = 4096  # that are remembered


class Totals:
    """A life begins to count at 0; `added` goes on where the one before it ended."""

    def __init__(self) -> None:
        self._before: Mapping[str, Any] = {}
        self._runs: dict[str, Mapping[str, Any]] = {}  # of agents, also those that the last life did not hear

    def ended(self, report: Mapping[str, Any]) -> None:
        """A life's last report, with what was `added`."""
        self._before = report
        for agent in report["agents"].values():
            self._runs.pop(agent["run"], None)
            self._runs[agent["run"]] = agent
        for run in list(self._runs)[:-_MOST_RUNS]:
            del self._runs[run]

    def added(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """A life's report, with the counts of those before it. An agent's are those of the same run."""
        if not self._before:
            return dict(report)
        out = _sum(report, self._before, _OF_ALL)
        out["agents"] = {
            name: _sum(agent, self._runs.get(agent["run"], {}), _OF_AGENT)
            for name, agent in report["agents"].items()
        }
        was = self._before["strangers"]
        out["strangers"] = {
            what: report["strangers"].get(what, 0) + was.get(what, 0)
            for what in sorted({*report["strangers"], *was})
        }
        return out


def _sum(
    now: Mapping[str, Any], before: Mapping[str, Any], paths: tuple[tuple[str, ...], ...]
) -> dict[str, Any]:
    out = dict(now)
    for path in paths:
        count = _at(before, path)
        if not count:
            continue
        if len(path) == 1:
            out[path[0]] = out.get(path[0], 0) + count
        else:
            inner = dict(out.get(path[0], {}))
            inner[path[1]] = inner.get(path[1], 0) + count
            out[path[0]] = inner
    return out


def _at(report: Mapping[str, Any], path: tuple[str, ...]) -> int:
    found: Any = report
    for key in path:
        if key not in found:
            return 0
        found = found[key]
    return int(found)
