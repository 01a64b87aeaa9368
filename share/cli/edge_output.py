"""What `share edge` and `share site` print: the map that they open, keys, events, a summary."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from share.event_kinds import EventKind

if TYPE_CHECKING:
    from share.cli.stderr import Stderr
    from share.net.keys import EdgeKeys
    from share.store.map_store import MapStore


def open_map(stderr: Stderr, path: Path) -> MapStore:
    """Open the map file; print what it holds and what is damaged. Raises UsageError, ShareError."""
    from share.store.map_store import MapStore

    store = MapStore.open(path)
    map_rows = store.rows().tables
    for complaint in store.problems:
        stderr.print_line(f"map {path}: {complaint}")
    if not store.writable:
        stderr.print_line(
            f"map {path}: {store.read_only_reason}; it is used as it is, and nothing new is stored"
        )
    counts = (
        f"{len(map_rows['keyframe'])} keyframes of {len(map_rows['run'])} runs, {len(map_rows['loop'])} loops"
    )
    stderr.print_line(f"map {path}: {counts}")
    return store


def print_access(stderr: Stderr, keys: EdgeKeys | None, allowed: Collection[str]) -> None:
    """Print the edge's key and the names that it has authorized, or without keys what everybody may do."""
    if keys is not None:
        names = ", ".join(sorted(keys.allowed.names_by_key().values()))
        stderr.print_line(f"public key '{keys.own.public}'; authorized: {names or 'none yet'}")
    if allowed:
        stderr.print_line(f"every program on this machine is allowed {' and '.join(sorted(allowed))}")


_SHOWN_EVENTS: set[EventKind] = {  # without -v
    "internal error",
    "agent joined",
    "left",
    "reconnected",
    "silent",
    "expired",
    "client joined",
    "client left",
    "objects moved",
    "object removed",
    "robot commanded",
    "robot answered",
    "refused",
    "room full",
    "room changed",
    "connection refused",
    "maps merged",
    "merge undone",
    "step failed",
    "write failed",
    "mapper died",
    "solver died",
    "odometry suspect",
    "map",
    "tracking lost",
}


def print_event(stderr: Stderr, verbose: bool, event: dict[str, Any]) -> None:
    """Print a line of events.jsonl; with `verbose` every one."""
    if verbose or event["event"] in _SHOWN_EVENTS:
        agent = f" {event['agent']}:" if event["agent"] else ""
        room = f" {event['room']}:" if "room" in event else ""
        stderr.print_line(f"{event['t_s']:9.3f} s{room} {event['event']}:{agent} {event['reason']}")


def run_summary(report: dict[str, Any]) -> str:
    """Return a line for each agent that the report lists, and one about loops."""
    lines = [_agent_summary(name, agent) for name, agent in report["agents"].items()]
    if unlisted := report["unlisted_runs"]:
        lines.append(f"and {unlisted} earlier runs")
    if loops := report.get("loops"):  # absent until the mapper has reported
        done = report["merges"]["done"]
        lines.append(f"loops: {loops['tried']} tried, {loops['accepted']} accepted; {done} merges")
    return "\n".join(lines)


def _agent_summary(name: str, a: dict[str, Any]) -> str:
    up = f"{a['bytes_up'] / 1e6:.2f} MB up"
    if "frames_streamed" in a:
        done = f"{a['frames_tracked']} of {a['frames_streamed']} frames tracked"
        return f"{name}: {done}, {a['frames_dropped']} dropped, {up}"
    where = a.get("map_id") or "none yet"
    room = f"room '{a['room']}', " if "room" in a else ""
    return f"{name}: {a['keyframes']} keyframes, {a['corrections']} corrections, {up}, in {room}map {where}"
