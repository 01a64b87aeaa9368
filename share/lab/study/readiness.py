"""Whether all is well for a trial: one line each, with what to do where it is not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from share.files.reading import MB
from share.lab.study.floor import STUDY_NAME, find_markers
from share.protocol.agent_health import has_left
from share.types import AgentKind, TrackState
from share.wire.room_messages import RoomObject

LEAST_FREE_BYTES = 200 * MB
_ROBOT_AGE_S = 2.0  # of the newest word of its bridge
_TRACKING = (TrackState.OK, TrackState.WEAK, TrackState.VISION_ONLY)


@dataclass(frozen=True)
class RoomState:
    """What is known of the room. report: of the edge (/snapshot.json), None without an answer; trouble: why.
    robot_age_s: since the robot's bridge said where it is; None: it never did."""

    report: Mapping[str, Any] | None
    trouble: str
    objects: Mapping[int, RoomObject]
    robot_age_s: float | None
    free_bytes: int


@dataclass(frozen=True)
class Readiness:
    """name: what was looked at. text: what was found; where that is not well, with what to do."""

    name: str
    is_well: bool
    text: str

    @property
    def line(self) -> str:
        return f"{'ok  ' if self.is_well else 'WAIT'}  {self.name:<8} {self.text}"


def check_room(room: RoomState) -> list[Readiness]:
    """Return what was looked at, in order; only the disk and the edge where the edge does not answer."""
    disk = Readiness(
        "disk",
        room.free_bytes >= LEAST_FREE_BYTES,
        f"{room.free_bytes / 1e9:.1f} GB free"
        + ("" if room.free_bytes >= LEAST_FREE_BYTES else "; a trial needs 0.2: make room"),
    )
    if room.report is None:
        return [disk, Readiness("edge", False, f"no answer: {room.trouble}")]
    agents = {name: one for name, one in room.report["agents"].items() if not has_left(one)}
    return [
        disk,
        _edge(room.report),
        _agents(agents),
        _clocks(agents),
        _poses(agents),
        _maps(agents, room.objects),
        _robot(room),
        _marker(room),
    ]


def _edge(report: Mapping[str, Any]) -> Readiness:
    trouble = [*report.get("trouble", ()), *report.get("degraded", ())]
    if report.get("loading"):
        trouble.append("its map is being read; wait")
    return Readiness("edge", not trouble, "; ".join(trouble) or "answers")


def _agents(agents: Mapping[str, Mapping[str, Any]]) -> Readiness:
    lost = [f"{name} {one['state']}: {one['reason'] or 'look there'}" for name, one in agents.items()]
    bad = [text for text, one in zip(lost, agents.values(), strict=True) if one["state"] not in _TRACKING]
    kinds = [one["kind"] for one in agents.values()]
    for kind, what in ((AgentKind.AR, "headset"), (AgentKind.ROBOT, "robot")):
        if str(kind) not in kinds:
            bad.append(f"no {what}: start its `share agent … --kind {kind}`")
    return Readiness("agents", not bad, "; ".join(bad) or f"{', '.join(agents)} track")


def _clocks(agents: Mapping[str, Mapping[str, Any]]) -> Readiness:
    bad = [f"{name}: {line}" for name, line in _troubles(agents) if "clock" in line]
    known = [
        f"{name} {one['clock_error_ms']:.1f} ms"
        for name, one in agents.items()
        if one["clock_error_ms"] is not None
    ]
    unknown = [
        f"{name}: not known yet; wait" for name, one in agents.items() if one["clock_error_ms"] is None
    ]
    bad = bad or unknown
    return Readiness("clocks", not bad and bool(agents), "; ".join(bad) or ", ".join(known) or "no agent")


def _poses(agents: Mapping[str, Mapping[str, Any]]) -> Readiness:
    bad = [f"{name}: {line}" for name, line in _troubles(agents) if "pose" in line or "place" in line]
    bad += [f"{name}: none yet; wait" for name, one in agents.items() if one["pose_ms"] is None]
    fresh = [f"{name} {one['pose_ms']:.0f} ms old" for name, one in agents.items() if one["pose_ms"]]
    return Readiness("poses", not bad and bool(agents), "; ".join(bad) or ", ".join(fresh) or "no agent")


def _troubles(agents: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    return [(name, line) for name, one in agents.items() for line in one.get("trouble", ())]


def _maps(agents: Mapping[str, Mapping[str, Any]], objects: Mapping[int, RoomObject]) -> Readiness:
    maps = {name: one.get("map_id") for name, one in agents.items()}
    if not maps:
        return Readiness("map", False, "no agent")
    if None in maps.values() or len(set(maps.values())) > 1:
        text = ", ".join(f"{name} in {map_id or 'none yet'}" for name, map_id in maps.items())
        return Readiness("map", False, f"not one map: {text}; let all look at the same places")
    (map_id,) = set(maps.values())
    return Readiness("map", True, f"all in {map_id}")


def _robot(room: RoomState) -> Readiness:
    assert room.report is not None
    robots = room.report.get("robots", {})
    if len(robots) != 1:
        what = "no robot's bridge is connected" if not robots else f"several robots: {', '.join(robots)}"
        mend = "start `share robot bridge … --edge`" if not robots else "end all bridges but one"
        return Readiness("robot", False, f"{what}; {mend}")
    ((name, robot),) = robots.items()
    if robot["text"]:
        return Readiness("robot", False, f"{name}: {robot['text']}")
    if robot["pose"] is None:
        return Readiness("robot", False, f"{name}: its place is not known; let it see the room")
    if room.robot_age_s is None or room.robot_age_s > _ROBOT_AGE_S:
        return Readiness("robot", False, f"{name}: its bridge is silent; look there")
    x, y = robot["pose"][:2]
    return Readiness("robot", True, f"{name} at x {x:.2f} y {y:.2f} m in {robot['map_id']}")


def _marker(room: RoomState) -> Readiness:
    assert room.report is not None
    markers = find_markers(room.objects)
    if len(markers) != 1:
        if not markers:
            return Readiness(
                "marker",
                False,
                "none: place one where the plan has 0, 0, facing along its x (headset page, or "
                f"`share marker put X Y --yaw DEGREES --edge … --name {STUDY_NAME}-floor`)",
            )
        owners = ", ".join(one.owner for one in markers)
        return Readiness("marker", False, f"{len(markers)}, of {owners}: leave the floor's only")
    marker = markers[0]
    robots = [one["map_id"] for one in room.report.get("robots", {}).values() if one["map_id"]]
    if robots and robots[0] != marker.map_id:
        return Readiness(
            "marker", False, f"in {marker.map_id}, the robot in {robots[0]}: let them see the same places"
        )
    return Readiness("marker", True, f"of {marker.owner}, in {marker.map_id}")
