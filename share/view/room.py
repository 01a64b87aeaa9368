"""The room as a viewer draws it: events in, drawings of what has changed out.

It uses no clock, socket or file. Maps that are not joined yet stand beside each other; when two merge, one
moves into the other. A change names chunks of keyframes, paths and loops; a chunk is drawn once, however
often it changed since the last time, and only so many at a time: a viewer is never given a backlog.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from share.colours import Colour, agent_colour
from share.mapping.loops import KeyframeKey
from share.protocol.agent_health import is_lost
from share.types import F64
from share.view import drawing as dr
from share.view import events as ev
from share.view.agent_paths import PlacedKeyframe, RunPath
from share.view.drawing import frusta, lines, named, shifted
from share.view.floor import DrawnFloor
from share.view.loop_views import KeyframePictures, LoopLines, LoopViews, Pair, nearest_to_ray
from share.view.map_arrangement import MapArrangement
from share.view.pending_drawings import PendingDrawings

_LOOP_COLOUR, _FLASH_COLOUR, _CORRECTION_COLOUR = (170, 110, 255), (255, 70, 220), (255, 60, 60)
_MAX_CHUNKS = 12  # drawn at a time
_MAX_ANNOUNCEMENTS = 3  # in `ANNOUNCED_S`; the panel counts the others
_FLASH_S, _TEXT_S = 1.5, 8.0  # s, for which a new loop or correction, and a merge, are highlighted
_LEAST_CORRECTION_M = 0.005  # m; smaller corrections are not drawn


@dataclass(frozen=True)
class LastCorrection:
    """When a correction came, and by how much it moved the agent."""

    at_s: float
    moved_m: float


class DrawnRoom:
    """All runs, their keyframes and loops. Times are the viewer's, s."""

    def __init__(self) -> None:
        self._pending = PendingDrawings()
        self._next_number = 0
        self._begin()

    def _begin(self) -> None:
        """Reset to an empty map; mark all that is drawn for removal."""
        self.runs: dict[str, RunPath] = {}
        self.corrections: dict[str, LastCorrection] = {}  # by run
        self._loops, self._views = LoopLines(), KeyframePictures()
        self._arrangement = MapArrangement()
        self._colour_numbers: dict[str, int] = {}  # by name of agent
        self._pending.remove_all()
        self._moved_runs: set[str] = set()
        self._pictures: dict[str, bytes] = {}
        self._floor = DrawnFloor()
        self._announcements: list[dr.Announcement] = []
        self._announced_s: deque[float] = deque(maxlen=_MAX_ANNOUNCEMENTS)

    # ------------------------------------------------------------------ events

    def apply(self, event: ev.RoomEvent, now_s: float) -> None:
        match event:
            case ev.SessionBegun():
                self._begin()
            case ev.RunArrived():
                self._add_run(event)
            case ev.KeyframeArrived():
                self._add_keyframe(event)
            case ev.PoseArrived():
                self._add_pose(event)
            case ev.CorrectionArrived():
                self._correct(event, now_s)
            case ev.MapsSolved():
                self._solve(event)
            case ev.LoopAccepted():
                self._add_loop(event.a, event.b, now_s)
            case ev.LoopsRemoved():
                self._mark_loops(self._loops.remove(event.a, event.b))
            case ev.KeyframesRemoved():
                for key in event.keys:
                    self._remove_keyframe(key)
                self._arrange_maps()
            case ev.RunRemoved():
                self._remove_run(event.run)
            case ev.DecisionMade():
                self._announce(event, now_s)
            case ev.AgentsReported():
                self._update_presence(event)

    def _add_run(self, event: ev.RunArrived) -> None:
        if event.run not in self.runs:
            self.runs[event.run] = RunPath(self._next_number, event)
            self._next_number += 1
            self._colour_numbers.setdefault(event.name, len(self._colour_numbers))

    def _add_keyframe(self, event: ev.KeyframeArrived) -> None:
        if (run := self.runs.get(event.key.agent)) is None or event.key.id in run.keyframes:
            return
        one = run.add_keyframe(event)
        if event.jpeg:
            self._pictures[event.key.agent] = event.jpeg
            self._views.add(event.key, event.jpeg)
        if one.T_map_body is not None:
            self._mark(event.key.agent, one)

    def _add_pose(self, event: ev.PoseArrived) -> None:
        if (run := self.runs.get(event.run)) is None:
            return
        self._moved_runs.add(event.run)
        if (chunk := run.add_pose(event)) is not None:
            self._mark_path(event.run, chunk)
        if (oldest := run.forget_oldest_path()) is not None:
            self._mark_path(event.run, oldest)

    def _correct(self, event: ev.CorrectionArrived, now_s: float) -> None:
        if (run := self.runs.get(event.run)) is None:
            return
        before = run.place()
        moved = run.correct(event.map_id, event.T_map_odom, event.segment_keyframe)
        for one in moved:
            self._mark(event.run, one)
        self._moved_runs.add(event.run)
        self._arrange_maps()
        after = run.place()
        if before is None or after is None or before[0] != after[0]:
            return
        moved_m = float(np.linalg.norm(after[1][:3, 3] - before[1][:3, 3]))
        self.corrections[event.run] = LastCorrection(now_s, moved_m)
        if moved_m >= _LEAST_CORRECTION_M:
            ends = np.array([[before[1][:3, 3], after[1][:3, 3]]]) + self._arrangement.offset(after[0])
            drawing = lines(ends, _CORRECTION_COLOUR, 5.0)
            self._pending.show_until(f"/corrections/{run.number}", drawing, now_s + _FLASH_S)

    def _solve(self, event: ev.MapsSolved) -> None:
        poses = event.poses
        for key, map_id, T in zip(poses.keys, poses.map_ids, poses.T_map_body, strict=True):
            one = None if (run := self.runs.get(key.agent)) is None else run.keyframes.get(key.id)
            if one is not None and one.place(map_id, T, True):
                self._mark(key.agent, one)
                self._moved_runs.add(key.agent)
        self._arrange_maps()

    def _add_loop(self, a: KeyframeKey, b: KeyframeKey, now_s: float) -> None:
        chunk = self._loops.add(a, b)
        for key in (a, b):
            if (one := self._keyframe(key)) is not None:
                one.loop_chunks.add(chunk)
        self._mark_loops({chunk})
        if (ends := self._loop_ends([(a, b)])) is not None:
            drawing = lines(ends, _FLASH_COLOUR, 6.0)
            self._pending.show_until(f"/loops/new/{self._loops.count}", drawing, now_s + _FLASH_S)

    def _remove_keyframe(self, key: KeyframeKey) -> None:
        if (run := self.runs.get(key.agent)) is not None and (one := run.remove_keyframe(key.id)) is not None:
            self._forget(key, one)

    def _forget(self, key: KeyframeKey, one: PlacedKeyframe) -> None:
        """Forget all but the run's own knowledge of a keyframe that is removed."""
        self._mark(key.agent, one)
        self._arrangement.put(key, None)
        self._mark_loops(self._loops.remove_keyframe(key))
        self._views.remove(key)

    def _remove_run(self, name: str) -> None:
        if (run := self.runs.get(name)) is None:
            return
        for chunk in run.path_chunks:
            self._pending.remove(f"/paths/{run.number}/{chunk}")
        for one in run.keyframes.values():
            self._forget(KeyframeKey(name, one.id), one)
        run.remove_all()
        self._pending.remove(f"/agents/{run.number}")
        del self.runs[name]
        self.corrections.pop(name, None)
        self._arrange_maps()

    def _update_presence(self, event: ev.AgentsReported) -> None:
        for entry in event.agents.values():
            is_current = not entry["gone"] and not is_lost(entry)
            if (run := self.runs.get(entry["run"])) is not None and run.is_current != is_current:
                run.is_current = is_current
                self._moved_runs.add(entry["run"])

    def _announce(self, event: ev.DecisionMade, now_s: float) -> None:
        if event.event not in ev.MERGES:
            return
        title = event.event if event.agent is None else f"{event.event}: {event.agent}"
        if len(self._announced_s) < _MAX_ANNOUNCEMENTS or now_s - self._announced_s[0] >= dr.ANNOUNCED_S:
            self._announced_s.append(now_s)
            self._announcements.append(dr.Announcement(title, event.reason))
        for run in reversed(self.runs.values()):
            if run.shown.name == event.agent and (place := run.place()) is not None:
                position = place[1][:3, 3] + self._arrangement.offset(place[0]) + (0.0, 0.0, 0.5)
                self._pending.show_until("/texts/merge", dr.Text("", title, position), now_s + _TEXT_S)
                return

    # ------------------------------------------------------------------ what has changed

    def _mark(self, run_key: str, one: PlacedKeyframe) -> None:
        """Mark all that is drawn with a keyframe, which has another place."""
        run = self.runs[run_key]
        self._arrangement.put(KeyframeKey(run_key, one.id), one.map_id or None)
        for kind in ("points", "keyframes"):
            name = f"/{kind}/{run.number}/{one.chunk}"
            self._pending.put(name, partial(self._draw_keyframes, run, one.chunk, kind, name))
        for chunk in one.path_chunks:
            self._mark_path(run_key, chunk)
        self._mark_loops(one.loop_chunks)

    def _mark_path(self, run_key: str, chunk: int) -> None:
        run = self.runs[run_key]
        name = f"/paths/{run.number}/{chunk}"
        self._pending.put(name, partial(self._draw_path, run, chunk, name))

    def _mark_loops(self, chunks: Iterable[int]) -> None:
        for chunk in chunks:
            for kind, draw in (("loops", self._draw_loops), ("loop-marks", self._draw_loop_marks)):
                name = f"/{kind}/{chunk}"
                self._pending.put(name, partial(draw, chunk, name))

    def _arrange_maps(self) -> None:
        """Let maps move up to where one is gone."""
        for key in self._arrangement.close_gaps():
            if (one := self._keyframe(key)) is not None:
                self._mark(key.agent, one)
                self._moved_runs.add(key.agent)

    # ------------------------------------------------------------------ drawings

    def take_drawings(self, now_s: float) -> list[dr.Drawing]:
        """Return what has changed since the last call."""
        out: list[dr.Drawing] = [*self._announcements]
        self._announcements = []
        self._pending.expire(now_s)
        for key in sorted(self._moved_runs):
            if (run := self.runs.get(key)) is not None and (body := self._draw_body(run)):
                out.append(body)
                if key in self._pictures:
                    out.append(dr.Picture(body.name, self._pictures.pop(key)))
        self._moved_runs.clear()
        out += self._pending.take(_MAX_CHUNKS)
        if (floor := self._floor.take_change()) is not None:
            out.append(floor)
        return out

    def forget_moments(self, now_s: float) -> None:
        """Forget what is shown only for a while, where nobody looks: what is left to draw stays bounded."""
        self._announcements = []
        self._pending.expire(now_s)

    @property
    def waiting(self) -> int:
        """Number of things that have changed and are not drawn yet."""
        return len(self._pending)

    @property
    def has_shown(self) -> bool:
        """Whether a viewer was given a drawing that was not removed since."""
        return self._pending.has_shown

    def agent_place(self, run_key: str) -> F64 | None:
        """Return T_room_body (4, 4) of a run; None if unknown."""
        place = None if (run := self.runs.get(run_key)) is None else run.place()
        return None if place is None else shifted(place[1], self._arrangement.offset(place[0]))

    def colour(self, run: RunPath) -> Colour:
        """Return the colour of an agent, by the order in which they came."""
        return agent_colour(self._colour_numbers[run.shown.name])

    def _draw_body(self, run: RunPath) -> dr.AgentBody | None:
        if (place := run.place()) is None:
            return None
        shown = run.shown
        T = shifted(place[1], self._arrangement.offset(place[0]))
        is_current = run.state.has_pose and run.is_current
        name, colour = f"/agents/{run.number}", self.colour(run)
        self._pending.add_shown(name)
        return dr.AgentBody(
            name, shown.name, shown.kind, T, shown.T_body_cam0, shown.half_angles, colour, is_current
        )

    def _draw_keyframes(self, run: RunPath, chunk: int, kind: str, name: str) -> list[dr.Drawing]:
        placed = [(one, T) for one in run.chunks[chunk] if (T := self._T_room(one)) is not None]
        if not placed:
            self._floor.set_points(name, np.empty((0, 3)))
            return []
        T = np.array([T for _, T in placed])
        origin = T[:, :3, 3].mean(axis=0)
        T[:, :3, 3] -= origin
        if kind == "keyframes":
            return [dr.Lines(name, origin, frusta(T, run.shown), self.colour(run), 1.5)]
        points = np.concatenate(
            [one.points @ R.T + t for (one, _), R, t in zip(placed, T[:, :3, :3], T[:, :3, 3], strict=True)]
        )
        self._floor.set_points(name, points + origin)
        return (
            [] if not len(points) else [dr.Points(name, origin, points.astype(np.float32), self.colour(run))]
        )

    def _draw_path(self, run: RunPath, chunk: int, name: str) -> list[dr.Drawing]:
        placed = run.path(chunk)
        if len(placed) < 2:
            return []
        points = np.array([position + self._arrangement.offset(map_id) for map_id, position in placed])
        same_map = np.array([a[0] == b[0] for a, b in pairwise(placed)])
        segments = np.stack([points[:-1], points[1:]], axis=1)[same_map]
        return [named(lines(segments, self.colour(run), 3.0), name)] if len(segments) else []

    def _draw_loops(self, chunk: int, name: str) -> list[dr.Drawing]:
        ends = self._loop_ends(self._loops.chunk(chunk))
        return [] if ends is None else [named(lines(ends, _LOOP_COLOUR, 2.0), name)]

    def _draw_loop_marks(self, chunk: int, name: str) -> list[dr.Drawing]:
        ends = self._loop_ends(self._loops.chunk(chunk))
        return [] if ends is None else [dr.Marks(name, ends.mean(axis=1), _LOOP_COLOUR)]

    def loop_at(self, origin: F64, direction: F64) -> LoopViews | None:
        """Return the views of the loop nearest to a ray: origin (3,), direction (3,); None if far."""
        placed = [(pair, ends[0]) for pair in self._loops if (ends := self._loop_ends([pair])) is not None]
        middles = np.array([ends.mean(axis=0) for _, ends in placed])
        if (nearest := nearest_to_ray(middles, origin, direction)) is None:
            return None
        pair = placed[nearest][0]
        titles = [f"{self.runs[key.agent].shown.name}, keyframe {key.id}" for key in pair]
        jpegs = [self._views.get(key) for key in pair]
        return LoopViews((titles[0], titles[1]), (jpegs[0], jpegs[1]))

    def _loop_ends(self, loops: Iterable[Pair]) -> F64 | None:
        """Return the ends (N, 2, 3) of loops whose keyframes are placed; None without one."""
        out = []
        for pair in loops:
            ends = [T[:3, 3] for key in pair if (T := self._T_room(self._keyframe(key))) is not None]
            if len(ends) == 2:
                out.append(ends)
        return np.array(out) if out else None

    def _T_room(self, one: PlacedKeyframe | None) -> F64 | None:
        """Return the pose (4, 4) of a keyframe in the room; None if unknown."""
        if one is None or one.T_map_body is None:
            return None
        return shifted(one.T_map_body, self._arrangement.offset(one.map_id))

    def _keyframe(self, key: KeyframeKey) -> PlacedKeyframe | None:
        return None if (run := self.runs.get(key.agent)) is None else run.keyframes.get(key.id)

    @property
    def floor(self) -> dr.FloorGrid | None:
        return self._floor.grid
