"""The plan on the status page: where agents are in their map and how they got there, seen from above.

A path is odometry's, moved into the map by the newest correction of its segment. Little is kept of each
agent, and little is done in the edge's loop: the page of a busy edge costs it nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import atan2, hypot
from pathlib import Path
from typing import Any

from share.protocol.edge_events import AddKeyframe, AddRun, DropRun, EdgeEffect, MapperResult
from share.protocol.peer import RestoredRun
from share.runtime.edge_observer import EdgeObserver
from share.types import F64
from share.wire.messages import Hello, PoseUpdate

_STEP_M, _MAX_STEP_M = 0.1, 0.2  # between points of a path; more, and it cuts across a bend
_MAX_POINTS = 600  # of a segment's path; beyond, every second is left out, and then the oldest are
_MAX_SEGMENTS = 8  # of a run; the oldest are forgotten
_KEPT_KEYFRAMES = 64  # newest, of a run; poses are relative to one of them
_MAX_AGENTS = 256  # that are drawn; beyond, those are whose keyframes came last
_UPDATE_EVERY = 4  # calls: poses are shown twenty times a second or more


@dataclass
class _PathSegment:
    first_keyframe: int
    path: list[tuple[float, float]] = field(default_factory=list)  # in odom
    step_m: float = _STEP_M
    T_map_odom: F64 | None = None
    map_id: str | None = None

    def extend(self, x: float, y: float) -> None:
        if self.path and hypot(x - self.path[-1][0], y - self.path[-1][1]) < self.step_m:
            return
        self.path.append((x, y))
        if len(self.path) > _MAX_POINTS and self.step_m < _MAX_STEP_M:
            self.path, self.step_m = self.path[::2], 2 * self.step_m
        del self.path[:-_MAX_POINTS]

    def in_map(self, points: Sequence[tuple[float, float]]) -> list[list[float]]:
        """Return points in the map, m to a centimetre; none without a correction."""
        if self.T_map_odom is None:
            return []
        T = self.T_map_odom
        (a, b), (c, d), (e, f) = T[0, :2].tolist(), T[1, :2].tolist(), T[:2, 3].tolist()
        return [[round(a * x + b * y + e, 2), round(c * x + d * y + f, 2)] for x, y in points]


@dataclass
class _Run:
    name: str
    kind: str
    T_body_cam0: F64
    keyframes: dict[int, F64] = field(default_factory=dict)  # T_odom_body
    segments: list[_PathSegment] = field(default_factory=list)
    T_odom_body: F64 | None = None  # newest

    def add_keyframe(self, id_: int, T_odom_body: F64, begins: bool) -> None:
        if begins or not self.segments:
            self.segments = [*self.segments, _PathSegment(id_)][-_MAX_SEGMENTS:]
            self.T_odom_body = None
        self.keyframes[id_] = T_odom_body
        if len(self.keyframes) > _KEPT_KEYFRAMES:
            del self.keyframes[next(iter(self.keyframes))]

    def add_pose(self, pose: PoseUpdate) -> None:
        T_odom_keyframe = self.keyframes.get(pose.keyframe)
        if pose.keyframe >= 0 and T_odom_keyframe is None:
            return
        T = pose.T_keyframe_body if T_odom_keyframe is None else T_odom_keyframe @ pose.T_keyframe_body
        self.T_odom_body = T
        if self.segments:
            self.segments[-1].extend(float(T[0, 3]), float(T[1, 3]))

    def correct(self, segment_keyframe: int, map_id: str, T_map_odom: F64) -> None:
        for segment in reversed(self.segments):
            if segment.first_keyframe <= segment_keyframe:
                segment.map_id, segment.T_map_odom = map_id, T_map_odom
                return

    def report(self) -> dict[str, Any]:
        parts = [
            {"map_id": one.map_id, "path": one.in_map(list(one.path))} for one in self.segments if one.map_id
        ]
        here, T = self.segments[-1] if self.segments else None, self.T_odom_body
        where = heading = None
        if here is not None and here.T_map_odom is not None and T is not None:
            where = here.in_map([(float(T[0, 3]), float(T[1, 3]))])[0]
            forward = (here.T_map_odom @ T @ self.T_body_cam0)[:2, 2]
            heading = round(atan2(float(forward[1]), float(forward[0])), 3)
        map_id = None if here is None else here.map_id
        return {"kind": self.kind, "map_id": map_id, "parts": parts, "position": where, "heading": heading}


class RoomPlan(EdgeObserver):
    """Keeps what is drawn. `report` may be called from any thread."""

    def __init__(self) -> None:
        self._runs: dict[str, _Run] = {}
        self._drawn: dict[str, str] = {}  # runs by name, the one whose keyframe came last is last
        self._calls = 0

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None:
        kept = {run.key: self._runs[run.key] for run in known if run.key in self._runs}
        self._runs = {run.key: kept.get(run.key) or _run_of(run.hello) for run in known}
        self._drawn = {name: key for name, key in self._drawn.items() if key in kept}

    def add_effect(self, effect: EdgeEffect) -> None:
        match effect:
            case AddRun():
                self._runs[effect.key] = _run_of(effect.hello)
                self._drawn.pop(effect.hello.name, None)
            case AddKeyframe() if (run := self._runs.get(effect.key)) is not None:
                keyframe = effect.keyframe
                run.add_keyframe(keyframe.id, keyframe.T_odom_body, keyframe.reference < 0)
                self._draw(run.name, effect.key)
            case DropRun() if (gone := self._runs.pop(effect.key, None)) is not None:
                if self._drawn.get(gone.name) == effect.key:
                    del self._drawn[gone.name]

    def _draw(self, name: str, key: str) -> None:
        self._drawn.pop(name, None)
        self._drawn[name] = key
        if len(self._drawn) > _MAX_AGENTS:
            del self._drawn[next(iter(self._drawn))]

    def add_result(self, result: MapperResult) -> None:
        for map_event in result.map_events:
            correction, run = map_event.correction, self._runs.get(map_event.agent or "")
            if correction is not None and run is not None:
                run.correct(correction.segment_keyframe, correction.map_id, correction.T_map_odom)

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None:
        self._calls += 1
        if self._calls % _UPDATE_EVERY == 0:
            for key, pose in poses.items():
                if (run := self._runs.get(key)) is not None:
                    run.add_pose(pose)

    def add_report(self, report: Mapping[str, Any]) -> None: ...

    def report(self) -> dict[str, Any]:
        """Return `/plan.json`: of each agent's newest run, by name, the parts of its path by map, and where
        it is. Runs without a place are left out."""
        drawn = [self._runs.get(key) for key in list(self._drawn.values())]
        reports = {run.name: run.report() for run in drawn if run is not None}
        return {"agents": {name: report for name, report in reports.items() if report["parts"]}}


def _run_of(hello: Hello) -> _Run:
    return _Run(hello.name, str(hello.kind), hello.rig.T_body_cam0)
