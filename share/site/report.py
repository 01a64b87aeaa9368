"""edge.json of a site, from the reports of its rooms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from share.site.building import BuildingPose, RoomMap

_LINES = "refused", "trouble", "degraded", "agent_trouble"
_BY_NAME = "maps", "objects", "robots"
_UNLISTED = "unlisted_runs", "unlisted_maps", "unlisted_keyframes"
_COUNTS = "waiting", "failed_steps", "removed_keyframes", "internal_errors", "forgotten_runs", *_UNLISTED
_ROOM_FIELDS = "session", "policy", "asleep", "loading", "last_solve_s", "loops", "merges", *_COUNTS


def site_report(
    reports: Mapping[str, Mapping[str, Any]], poses: Mapping[RoomMap, BuildingPose]
) -> dict[str, Any]:
    """Return one report of all rooms. Agents are those of all rooms, each with its `room`; one that has been
    in several is reported by the one where it is now. Lines name their room. poses: of maps in the building;
    a room has that of its largest map. A run that is not listed is counted in every room that knows it."""
    first = next(iter(reports.values()))
    agents = _agents(reports)
    rooms = {
        room: {name: report[name] for name in _ROOM_FIELDS if name in report}
        | {
            "agents": sum(agent["room"] == room and not agent["gone"] for agent in agents.values()),
            "keyframes": sum(report.get("maps", {}).values()) + report.get("unlisted_keyframes", 0),
            "maps": len(report.get("maps", {})) + report.get("unlisted_maps", 0),
            **_place(room, report.get("maps", {}), poses),
        }
        for room, report in reports.items()
    }
    loading = [f"{room}: {report['loading']}" for room, report in reports.items() if "loading" in report]
    return {
        "session": first["session"],
        "policy": first["policy"],
        "rooms": rooms,
        "agents": agents,
        "clients": [
            {**client, "room": room} for room, report in reports.items() for client in report["clients"]
        ],
        "unjoined": _sum(report["unjoined"] for report in reports.values()),
        **{name: {key: one for report in reports.values() for key, one in report.get(name, {}).items()}
           for name in _BY_NAME},
        **{name: [f"room '{room}': {line}" for room, report in reports.items() for line in report[name]]
           for name in _LINES},
        **{name: sum(report.get(name, 0) for report in reports.values()) for name in _COUNTS},
        **{name: _sum(report.get(name, {}) for report in reports.values()) for name in ("loops", "merges")},
        **({"loading": "; ".join(loading)} if loading else {}),
        "version": first["version"],
        "config": first["config"],
    }  # fmt: skip


def _sum(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Return the sum of counts by name; unlike that of Counters it has zeros too."""
    total = Counter[str]()
    for one in counts:
        total.update(one)
    return dict(total)


def _place(room: str, maps: Mapping[str, int], poses: Mapping[RoomMap, BuildingPose]) -> dict[str, Any]:
    """Return `place` of a room in the building; nothing if no agent has walked there from another."""
    largest = max(maps, key=lambda map_id: maps[map_id], default=None)
    if largest is None or (pose := poses.get(RoomMap(room, largest))) is None:
        return {}
    T = np.round(pose.T_building_map, 6).tolist()
    return {"place": {"map_id": largest, "in_map_of": pose.reference.room, "T_building_map": T}}


def _agents(reports: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Agents by label. Of several with the same label the one that is here, or was last."""
    out: dict[str, Any] = {}
    for room, report in reports.items():
        for label, agent in report["agents"].items():
            known = out.get(label)
            if known is None or _recency(agent) > _recency(known):
                out[label] = {**agent, "room": room}
    return out


def _recency(agent: Mapping[str, Any]) -> tuple[bool, float]:
    last_received_s = agent.get("last_received_s")
    return not agent["gone"], -1e12 if last_received_s is None else -last_received_s


def site_plan(plans: Mapping[str, Mapping[str, Any]], agents: Mapping[str, Any]) -> dict[str, Any]:
    """Return /plan.json of a site, from those of its rooms. agents: of the site's report, by label; where an
    agent is, the plan of its room says."""
    out: dict[str, Any] = {}
    for room, plan in plans.items():
        for name, agent in plan["agents"].items():
            parts = [*out.get(name, {}).get("parts", ()), *agent["parts"]]
            is_here = agents.get(name, {}).get("room", room) == room
            out[name] = {**(agent if is_here or name not in out else out[name]), "parts": parts}
    return {"agents": out}
