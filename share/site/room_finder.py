"""Decides when an agent is in another room than the one that serves it.

Its room does not recognise a keyframe -> the directory ranks the rooms that look like it -> the best ones
search it in their maps -> exactly one has it: the agent changes to that room. Rooms that look alike both have
it: the agent stays where it is until one of them alone does.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

from share.mapping.loops import KeyframeKey
from share.mapping.places import FoundPlace
from share.site.directory import RoomRanking
from share.timing import seconds_to_ns

_MAX_SEARCHED = 3  # rooms that search one keyframe
_MIN_SHARE_OF_BEST = 0.5  # of the best room's score: less similar rooms do not search
_STANDS_OUT = (
    1.3  # factor by which a room looks more like a keyframe than the room that does not recognise it
)
_CLEARLY_MORE = 2.0  # times the inliers of the second room; fewer: the rooms look alike
_ANSWER_S = 1.0  # within which all rooms answer; else a later keyframe is searched
_PAUSE_S = 1.0  # after a search in vain, unless a room looks much more like it than those that were asked
_MAX_RUNS = 10_000  # remembered


@dataclass(frozen=True, eq=False)
class RoomFound:
    """The run of `key` is in this room: its keyframe is at `place` in a map of it."""

    key: KeyframeKey
    room: str
    place: FoundPlace


@dataclass
class _Search:
    """One keyframe that some rooms search."""

    key: KeyframeKey
    score: float  # of the most similar room
    began_ns: int
    waiting: set[str]
    found: dict[str, FoundPlace] = field(default_factory=dict)


class RoomFinder:
    """Finds the rooms of runs, one keyframe of each at a time. Times: monotonic, ns."""

    def __init__(self) -> None:
        self._searches: dict[str, _Search] = {}  # by run
        self._in_vain: OrderedDict[str, tuple[_Search, int]] = OrderedDict()  # by run: and when it ended

    def choose_rooms(self, ranking: RoomRanking, now_ns: int) -> tuple[str, ...]:
        """Return the rooms that are to search a keyframe; none if nothing speaks for another room, or if a
        search for its run is going on."""
        run = ranking.key.agent
        search = self._searches.get(run)
        if search is not None and now_ns - search.began_ns < seconds_to_ns(_ANSWER_S):
            return ()
        scores = {one.room: one.score for one in ranking.scores}
        own, best = scores.pop(ranking.room, 0.0), max(scores.values(), default=0.0)
        if best <= _STANDS_OUT * max(own, self._failed_score(run, now_ns)):
            return ()
        least = max(_STANDS_OUT * own, _MIN_SHARE_OF_BEST * best)
        rooms = tuple(room for room, score in scores.items() if score > least)[:_MAX_SEARCHED]
        self._searches[run] = _Search(ranking.key, best, now_ns, set(rooms))
        return rooms

    def _failed_score(self, run: str, now_ns: int) -> float:
        """Return the score of the last search if it has just been in vain, else 0."""
        search, ended_ns = self._in_vain.get(run, (None, 0))
        is_recent = search is not None and now_ns - ended_ns < seconds_to_ns(_PAUSE_S)
        return search.score if search is not None and is_recent else 0.0

    def add_answer(
        self, room: str, key: KeyframeKey, place: FoundPlace | None, now_ns: int
    ) -> RoomFound | None:
        """Take in a room's answer. Return the room of the keyframe once all have answered and one has it."""
        search = self._searches.get(key.agent)
        if search is None or search.key != key or room not in search.waiting:
            return None
        search.waiting.remove(room)
        if place is not None:
            search.found[room] = place
        if search.waiting:
            return None
        del self._searches[key.agent]
        ranked = sorted(search.found.items(), key=lambda item: -item[1].inliers)
        if ranked and (len(ranked) == 1 or ranked[0][1].inliers >= _CLEARLY_MORE * ranked[1][1].inliers):
            return RoomFound(key, *ranked[0])
        self._in_vain[key.agent] = search, now_ns
        self._in_vain.move_to_end(key.agent)
        if len(self._in_vain) > _MAX_RUNS:
            self._in_vain.popitem(last=False)
        return None

    def forget(self, run: str) -> None:
        """Forget a run that has left, or has changed the room."""
        self._searches.pop(run, None)
        self._in_vain.pop(run, None)
