"""A directory of places: a coarse index over the keyframes of all rooms, which ranks the rooms that a
keyframe could be in. A room's own map confirms it, or does not (`share.mapping.places`)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

from share.mapping.loops import KeyframeKey
from share.mapping.places import PlaceAdded, PlaceNews, PlaceRemoved, PlaceUnrecognised
from share.mapping.recognition.index import U32, PlaceIndex

_RANKED_KEYFRAMES = 64  # the most similar ones, of all rooms
_OWN_RECENT = 30  # keyframes of the same run that a keyframe is not compared with: it overlaps with them


@dataclass(frozen=True)
class RoomScore:
    """score: of the room's most similar keyframe. Scores compare within one ranking only."""

    room: str
    score: float


@dataclass(frozen=True)
class RoomRanking:
    """The rooms with similar keyframes, best first, for a keyframe that its own room does not recognise."""

    room: str
    key: KeyframeKey
    scores: tuple[RoomScore, ...]


class PlaceDirectory:
    """Keyframes of all rooms by their coarse words. A keyframe is in one room."""

    def __init__(self) -> None:
        self._index = PlaceIndex()
        self._next_id = count()
        self._ids: dict[KeyframeKey, int] = {}
        self._places: dict[int, tuple[str, KeyframeKey]] = {}

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def nbytes(self) -> int:
        return self._index.nbytes

    def update(self, room: str, news: PlaceNews) -> RoomRanking | None:
        """Take in what a room's map tells. Return the ranking for a keyframe that it does not recognise."""
        match news:
            case PlaceAdded(key, words):
                self._add(room, key, words)
            case PlaceRemoved(key):
                self._remove(key)
            case PlaceUnrecognised(key, words):
                return RoomRanking(room, key, self._rank(key, words))
        return None

    def remove_room(self, room: str) -> None:
        """Forget all keyframes of a room."""
        for key in [key for one, key in self._places.values() if one == room]:
            self._remove(key)

    def _add(self, room: str, key: KeyframeKey, words: U32) -> None:
        self._remove(key)
        if len(words):
            id = self._ids[key] = next(self._next_id)
            self._places[id] = room, key
            self._index.add_words(id, words)

    def _remove(self, key: KeyframeKey) -> None:
        if (id := self._ids.pop(key, None)) is not None:
            del self._places[id]
            self._index.remove(id)

    def _rank(self, key: KeyframeKey, words: U32) -> tuple[RoomScore, ...]:
        """Best score of each room; what the run has seen just before counts for none."""
        recent = (KeyframeKey(key.agent, key.id - n) for n in range(_OWN_RECENT))
        excluded = [self._ids[near] for near in recent if near in self._ids]
        best: dict[str, float] = {}
        for candidate in self._index.query_words(words, _RANKED_KEYFRAMES, excluded):
            best.setdefault(self._places[candidate.id][0], candidate.score)
        return tuple(RoomScore(room, score) for room, score in best.items())
