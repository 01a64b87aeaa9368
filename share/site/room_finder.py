"""Decides when an agent is in another room than the one that serves it.

Its room does not recognise a keyframe -> the directory ranks the rooms that look like it -> the best ones
search it in their maps -> one of them alone has it: a find. Of rooms that look alike both have it: no find.
Rooms are furnished alike, so one find is not enough (docs/lab/edge-load.md): the agent changes to a room
whose finds agree with odometry, and are two more than those of any other.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field

import numpy as np

from share.geometry import se3
from share.mapping.loops import KeyframeKey
from share.mapping.places import FoundPlace
from share.site.directory import RoomRanking
from share.timing import seconds_to_ns
from share.types import F64

_MAX_SEARCHED = 3  # rooms that search one keyframe
_MIN_SHARE_OF_BEST = 0.5  # of the best room's score: less similar rooms do not search
_STANDS_OUT = (
    1.3  # factor by which a room looks more like a keyframe than the room that does not recognise it
)
_CLEARLY_MORE = 2.0  # times the inliers of the second room; fewer: the rooms look alike
_ANSWER_S = 1.0  # within which all rooms answer; else a later keyframe is searched
_PAUSE_S = 1.0  # after a search in vain, unless a room looks much more like it than those that were asked
_LEAD = 2  # finds that a room has more than any other
# by which two finds may differ from odometry: 3 sigmas of both, 5 cm and 0.7 degrees each, and of odometry
# over some 5 m, 1 % and 1 degree
_AGREE_M, _AGREE_RAD = 0.25, 0.09
_VIEW_M, _VIEW_RAD = 0.08, 0.09  # more than who stands still sways: finds from one view are one
_MAX_FINDS = 8  # of a run, the newest
_MAX_RUNS = 1024  # remembered


@dataclass(frozen=True, eq=False)
class RoomFound:
    """The run of `key` is in this room: its keyframe is at `place` in a map of it."""

    key: KeyframeKey
    room: str
    place: FoundPlace


@dataclass
class _Search:
    """One keyframe that some rooms search. T_odom_body (4, 4): its pose by odometry."""

    key: KeyframeKey
    T_odom_body: F64
    score: float  # of the most similar room
    began_ns: int
    waiting: set[str]
    found: dict[str, FoundPlace] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Find:
    """A room that alone has a keyframe, at `place`. T_odom_body (4, 4): of the keyframe."""

    room: str
    place: FoundPlace
    T_odom_body: F64

    def agrees_with(self, other: _Find) -> bool:
        """Return whether both lie in one map of the room as odometry says."""
        if (self.room, self.place.map_id) != (other.room, other.place.map_id):
            return False
        by_odometry = other.place.T_map_body @ _motion(other.T_odom_body, self.T_odom_body)
        return _is_within(_motion(by_odometry, self.place.T_map_body), _AGREE_M, _AGREE_RAD)

    def is_view_of(self, other: _Find) -> bool:
        return _is_within(_motion(other.T_odom_body, self.T_odom_body), _VIEW_M, _VIEW_RAD)


@dataclass
class _Run:
    """What is known of one. finds: in its present odometry segment, at different views."""

    search: _Search | None = None
    failed_score: float = 0.0  # of the last search in vain
    failed_ns: int = 0
    finds: deque[_Find] = field(default_factory=lambda: deque(maxlen=_MAX_FINDS))

    def score_to_beat(self, now_ns: int) -> float:
        """Return the score of the last search if it has just been in vain, else 0."""
        return self.failed_score if now_ns - self.failed_ns < seconds_to_ns(_PAUSE_S) else 0.0

    def is_confirmed(self, find: _Find) -> bool:
        """Remember a find. Return whether its room has enough of them."""
        agreeing = [one for one in self.finds if find.agrees_with(one)]
        if not any(find.is_view_of(one) for one in agreeing):
            self.finds.append(find)
            agreeing.append(find)
        others = Counter(one.room for one in self.finds if one.room != find.room)
        return len(agreeing) >= max(others.values(), default=0) + _LEAD


class RoomFinder:
    """Finds the rooms of runs, one keyframe of each at a time. Times: monotonic, ns."""

    def __init__(self) -> None:
        self._runs: OrderedDict[str, _Run] = OrderedDict()  # those searched last at the end

    def choose_rooms(self, ranking: RoomRanking, T_odom_body: F64, now_ns: int) -> tuple[str, ...]:
        """Return the rooms that are to search a keyframe; none if nothing speaks for another room, or if a
        search for its run is going on. T_odom_body (4, 4): of the keyframe."""
        run = self._runs.get(ranking.key.agent, _Run())
        if run.search is not None and now_ns - run.search.began_ns < seconds_to_ns(_ANSWER_S):
            return ()
        scores = {one.room: one.score for one in ranking.scores}
        own, best = scores.pop(ranking.room, 0.0), max(scores.values(), default=0.0)
        if best <= _STANDS_OUT * max(own, run.score_to_beat(now_ns)):
            return ()
        least = max(_STANDS_OUT * own, _MIN_SHARE_OF_BEST * best)
        rooms = tuple(room for room, score in scores.items() if score > least)[:_MAX_SEARCHED]
        run.search = _Search(ranking.key, T_odom_body, best, now_ns, set(rooms))
        self._remember(ranking.key.agent, run)
        return rooms

    def _remember(self, key: str, run: _Run) -> None:
        self._runs[key] = run
        self._runs.move_to_end(key)
        if len(self._runs) > _MAX_RUNS:
            self._runs.popitem(last=False)

    def add_answer(
        self, room: str, key: KeyframeKey, place: FoundPlace | None, now_ns: int
    ) -> RoomFound | None:
        """Take in a room's answer. Return the room of the keyframe once all have answered, one has it, and
        earlier finds confirm it."""
        run = self._runs.get(key.agent)
        search = None if run is None else run.search
        if run is None or search is None or search.key != key or room not in search.waiting:
            return None
        search.waiting.remove(room)
        if place is not None:
            search.found[room] = place
        if search.waiting:
            return None
        run.search = None
        ranked = sorted(search.found.items(), key=lambda item: -item[1].inliers)
        if ranked and (len(ranked) == 1 or ranked[0][1].inliers >= _CLEARLY_MORE * ranked[1][1].inliers):
            found = RoomFound(key, *ranked[0])
            return found if run.is_confirmed(_Find(*ranked[0], search.T_odom_body)) else None
        run.failed_score, run.failed_ns = search.score, now_ns
        return None

    def begin_segment(self, key: str) -> None:
        """Drop the finds of a run, and its search, since its odometry begins anew."""
        if (run := self._runs.get(key)) is not None:
            run.search = None
            run.finds.clear()

    def forget(self, key: str) -> None:
        """Forget a run that has left, or has changed the room."""
        self._runs.pop(key, None)


def _motion(T_a_body: F64, T_a_later: F64) -> F64:
    """Return the pose (4, 4) of the second relative to the first."""
    motion: F64 = se3.inverse(T_a_body) @ T_a_later
    return motion


def _is_within(T: F64, metres: float, radians: float) -> bool:
    return bool(np.linalg.norm(T[:3, 3]) < metres and se3.rotation_angle(T) < radians)
