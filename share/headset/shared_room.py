"""What a headset page is shown of the agents in the map: newest poses, moves between maps, points.

It uses no clock, socket or file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from share.headset.frame_times import BodyMotion, LeastDelay, MotionEstimate
from share.headset.page_messages import MAX_POINTS, numbers, pose_fields
from share.mapping.agent_runs import AgentRuns
from share.protocol.known_maps import KnownMaps
from share.types import F32, F64, Correction
from share.view import events as ev
from share.view.agent_paths import RunPath

_NO_COV = np.zeros((6, 6))
_MAX_PATH = 100  # points of a path that a page is sent
_POINTS_PER_KEYFRAME = 100
GONE = "GONE"


class AgentMoved(NamedTuple):
    """An agent is in the map `new` now, in which its old one lies at T_new_old (4, 4)."""

    agent: str
    old: str
    new: str
    T_new_old: F64


@dataclass(eq=False)
class _RoomAgent:
    """A run of an agent. state: in the edge's report, where that is more than its pose's."""

    path: RunPath
    times: LeastDelay = field(default_factory=LeastDelay)
    motions: MotionEstimate = field(default_factory=MotionEstimate)
    motion: BodyMotion | None = None
    T_odom_body: F64 | None = None
    sigmas: tuple[float | None, float | None] = (None, None)  # m and rad, of the newest pose in the map
    time_ns: int = 0
    state: str = ""

    @property
    def name(self) -> str:
        return self.path.shown.name

    @property
    def is_there(self) -> bool:
        """Whether it is there and has said where it is, or that it is lost; runs of a map file have not."""
        return bool(self.time_ns) and self.state != GONE

    def add_pose(self, event: ev.PoseArrived) -> None:
        """Take a pose; not one whose keyframe has not come yet: the one before is shown so long."""
        time_ns = self.times.time_of(event.stamp_ns, event.received_ns, event.age_ms or 0.0)
        keyframe = self.path.keyframes.get(event.keyframe)
        if event.state.has_pose and keyframe is None and event.keyframe >= 0:
            return
        self.time_ns = time_ns
        self.path.add_pose(event)
        self.path.forget_oldest_path()
        self.sigmas = event.sigma_m, event.sigma_rad
        if not event.state.has_pose:
            self.motions.forget()
            self.T_odom_body = self.motion = None
            return
        T = event.T_keyframe_body if keyframe is None else keyframe.T_odom_body @ event.T_keyframe_body
        self.T_odom_body, self.motion = T, self.motions.add(event.stamp_ns, T)

    def fields(self, has_path: bool) -> dict[str, Any]:
        """Return the agent as a page is told."""
        shown, state = self.path.shown, self.state or str(self.path.state)
        place = self.path.place() if self.path.state.has_pose and self.state != GONE else None
        message: dict[str, Any] = {
            "agent": shown.name,
            "kind": str(shown.kind),
            "state": state,
            "map_id": None if place is None else place[0],
            "t_ms": round(self.time_ns / 1e6, 3),
            "position": None,
            "quaternion": None,
            "velocity": None,
            "angular_velocity": None,
            "sigma_m": None,
            "sigma_rad": None,
        }
        if place is None:
            return message
        message |= pose_fields(place[1])
        for name, sigma in zip(("sigma_m", "sigma_rad"), self.sigmas, strict=True):
            message[name] = None if sigma is None else round(sigma, 6)
        if self.motion is not None and self.T_odom_body is not None:
            R_map_odom = place[1][:3, :3] @ self.T_odom_body[:3, :3].T
            message["velocity"] = numbers(R_map_odom @ self.motion.velocity)
            message["angular_velocity"] = numbers(self.motion.angular_velocity)
        if has_path:
            message["path"] = self._path_in(place[0])
        return message

    def _path_in(self, map_id: str) -> list[list[float]]:
        """Return the newest part of the path, in this map."""
        points: list[F64] = []
        for chunk in self.path.path_chunks[-2:]:
            points += [position for where, position in self.path.path(chunk) if where == map_id]
        return [numbers(position, 3) for position in points[-_MAX_PATH:]]


class SharedRoom:
    """Follows the edge's events."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._runs: dict[str, _RoomAgent] = {}  # by run key
        self._presence = AgentRuns()  # present: those that are there
        self._maps = KnownMaps()
        self._changed: dict[str, None] = {}  # run keys
        self._moves: list[AgentMoved] = []

    def apply(self, event: ev.RoomEvent) -> None:
        match event:
            case ev.SessionBegun():
                self._begin()
            case ev.RunArrived():
                if event.run not in self._runs:
                    self._runs[event.run] = _RoomAgent(RunPath(len(self._runs), event))
                    self._presence.add(event.run, event.name)
                    self._presence.set_present(event.run, False)
            case ev.KeyframeArrived():
                self._add_keyframe(event)
            case ev.PoseArrived() if (run := self._runs.get(event.run)) is not None:
                run.add_pose(event)
                self._mark_changed(event.run, run)
            case ev.CorrectionArrived() if (run := self._runs.get(event.run)) is not None:
                self._correct(run, event)
            case ev.MapsSolved():
                self._solve(event)
            case ev.KeyframesRemoved():
                for key in event.keys:
                    if (run := self._runs.get(key.agent)) is not None:
                        run.path.remove_keyframe(key.id)
            case ev.RunRemoved():
                self._runs.pop(event.run, None)
                self._changed.pop(event.run, None)
                self._presence.remove(event.run)
                self._maps.forget(event.run)
            case ev.AgentsReported():
                self._report(event)

    def _add_keyframe(self, event: ev.KeyframeArrived) -> None:
        run = self._runs.get(event.key.agent)
        if run is None or event.key.id in run.path.keyframes:
            return
        if event.begins_segment:
            self._maps.begin_segment(event.key.agent, event.key.id)
            run.motions.forget()
        run.path.add_keyframe(event)

    def _correct(self, run: _RoomAgent, event: ev.CorrectionArrived) -> None:
        run.path.correct(event.map_id, event.T_map_odom, event.segment_keyframe)
        self._mark_changed(event.run, run)
        correction = Correction(event.T_map_odom, _NO_COV, event.map_id, 0, event.segment_keyframe)
        if (move := self._maps.add_correction(event.run, correction)) is not None:
            self._moves.append(AgentMoved(run.name, move.old, move.new, move.T_new_old))

    def _solve(self, event: ev.MapsSolved) -> None:
        poses = event.poses
        self._maps.add_solved(set(poses.map_ids))
        for key, map_id, T in zip(poses.keys, poses.map_ids, poses.T_map_body, strict=True):
            run = self._runs.get(key.agent)
            if run is not None and (one := run.path.keyframes.get(key.id)) is not None:
                one.place(map_id, T, True)
                self._mark_changed(key.agent, run)

    def _report(self, event: ev.AgentsReported) -> None:
        for entry in event.agents.values():
            if (run := self._runs.get(entry["run"])) is None:
                continue
            run.times.set_rtt(entry.get("rtt_ms"))
            state = GONE if entry["gone"] else "SILENT" if entry["state"] == "SILENT" else ""
            if state != run.state:
                run.state = state
                self._mark_changed(entry["run"], run)

    def _mark_changed(self, key: str, run: _RoomAgent) -> None:
        self._changed[key] = None
        if run.is_there != (key in self._presence.present()):
            self._presence.set_present(key, run.is_there)

    # ------------------------------------------------------------------ what pages are told

    def agents(self) -> list[dict[str, str]]:
        """Return name and kind of the agents that are there."""
        return [{"name": run.name, "kind": str(run.path.shown.kind)} for run in self._present()]

    def take_poses(self, has_paths: bool = False) -> list[dict[str, Any]]:
        """Return the newest pose of each agent that has another than at the last call."""
        changed = [self._runs[key] for key in self._changed if self._presence.is_latest(key)]
        self._changed = {}
        return [run.fields(has_paths) for run in changed if run.time_ns]

    def poses(self) -> list[dict[str, Any]]:
        """Return the newest pose of every agent that is there, with its path."""
        return [run.fields(True) for run in self._present()]

    def take_moves(self) -> list[AgentMoved]:
        """Return how agents changed their map since the last call."""
        moves, self._moves = self._moves, []
        return moves

    def _present(self) -> list[_RoomAgent]:
        """Return the latest run of each agent that is there."""
        return [self._runs[key] for key in self._presence.present() if self._presence.is_latest(key)]

    def points(self, map_id: str) -> F32:
        """Return points (N, 3) of a map, at most MAX_POINTS, spread over its keyframes."""
        parts = [
            np.asarray(
                one.points[:: 1 + len(one.points) // _POINTS_PER_KEYFRAME] @ one.T_map_body[:3, :3].T
                + one.T_map_body[:3, 3],
                np.float32,
            )
            for run in self._runs.values()
            for one in run.path.keyframes.values()
            if one.T_map_body is not None and one.map_id == map_id
        ]
        points: F32 = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
        return points[:: 1 + max(0, len(points) - 1) // MAX_POINTS]
