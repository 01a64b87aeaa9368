"""What a room tells a directory of places over many rooms, and how it finds a keyframe of another room's
agent in its own map, which stays as it is."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import Rig
from share.mapping.atlas import Atlas
from share.mapping.loops import KeyframeKey
from share.mapping.recognition.index import U32
from share.mapping.recognition.keyframe_views import KeyframeViews
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView, Refusal, Verification
from share.mapping.steps import DescribeStep, Job, QueryStep, VerifyStep
from share.types import F64, Keyframe

NO_NODE = -1  # in steps for a keyframe that is not in the map
_WORDS_PER_COARSE = 8  # words of the full vocabulary for each that a directory keeps
_HASH = np.uint32(2654435761)  # Knuth's multiplicative hash: spreads neighbouring words
_LATEST_WORDS = 64  # keyframes whose words are remembered for a question about them
_MAX_CHECKED = 3  # candidates that are verified for a keyframe of another room
_MAX_REQUESTS = 8  # that wait; older ones are dropped, since their agents have moved on


@dataclass(frozen=True, eq=False)
class PlaceAdded:
    """A keyframe has been described. words (N,): distinct, of the coarse vocabulary."""

    key: KeyframeKey
    words: U32


@dataclass(frozen=True)
class PlaceRemoved:
    """A keyframe is no longer in the map."""

    key: KeyframeKey


@dataclass(frozen=True, eq=False)
class PlaceUnrecognised:
    """A keyframe looks like nothing that other runs, or the map of its room, have seen. words: as above."""

    key: KeyframeKey
    words: U32


PlaceNews = PlaceAdded | PlaceRemoved | PlaceUnrecognised


@dataclass(frozen=True, eq=False)
class FindKeyframe:
    """To a mapper: find this keyframe of an agent of another room in the map. rig: the agent's."""

    key: KeyframeKey
    keyframe: Keyframe
    rig: Rig


@dataclass(frozen=True, eq=False)
class FoundPlace:
    """Where a keyframe is in a map: T_map_body (4, 4), cov (6, 6) of the relative pose to the keyframe that
    it was verified with, perturbed on the right, and the inliers of that."""

    map_id: str
    T_map_body: F64
    cov: F64
    inliers: int


@dataclass(frozen=True, eq=False)
class KeyframeSought:
    """Answer to `FindKeyframe`. place: None if no keyframe of the map sees what it sees."""

    key: KeyframeKey
    place: FoundPlace | None


def coarse_words(words: U32) -> U32:
    """Return the distinct words (N,) of the coarse vocabulary: one in eight of all, everywhere the same."""
    chosen: U32 = np.unique(words[(words * _HASH) >> np.uint32(29) == 0])
    return chosen


class PlaceNewsLog:
    """Collects what a directory of places needs to know of one map."""

    def __init__(self) -> None:
        self._news: list[PlaceNews] = []
        self._latest: OrderedDict[KeyframeKey, U32] = OrderedDict()

    def add(self, key: KeyframeKey, words: U32) -> None:
        """Record a described keyframe. words: of its descriptors (`PlaceIndex.words`)."""
        coarse = coarse_words(words)
        self._latest[key] = coarse
        if len(self._latest) > _LATEST_WORDS:
            self._latest.popitem(last=False)
        self._news.append(PlaceAdded(key, coarse))

    def remove(self, key: KeyframeKey) -> None:
        self._news.append(PlaceRemoved(key))

    def add_unrecognised(self, key: KeyframeKey) -> None:
        """Record that a look-up has found nothing. Only newly described keyframes count."""
        if (words := self._latest.get(key)) is not None:
            self._news.append(PlaceUnrecognised(key, words))

    @property
    def has_any(self) -> bool:
        return bool(self._news)

    def take(self) -> tuple[PlaceNews, ...]:
        """Return the news since the last call."""
        news, self._news = tuple(self._news), []
        return news


class KeyframeSearch:
    """Finds keyframes of agents of other rooms in the map of `atlas`, a job each."""

    def __init__(self, atlas: Atlas, views: KeyframeViews, max_candidates: int) -> None:
        self._atlas, self._views, self._max_candidates = atlas, views, max_candidates
        self._requests: deque[FindKeyframe] = deque()
        self._answers: list[KeyframeSought] = []

    def add(self, request: FindKeyframe) -> None:
        self._requests.append(request)
        if len(self._requests) > _MAX_REQUESTS:
            self._answers.append(KeyframeSought(self._requests.popleft().key, None))

    @property
    def has_answers(self) -> bool:
        return bool(self._answers)

    def take_answers(self) -> tuple[KeyframeSought, ...]:
        """Return the answers since the last call."""
        answers, self._answers = tuple(self._answers), []
        return answers

    def next_job(self) -> Job | None:
        """Return the job for the oldest request; None if none waits."""
        return self._find(self._requests.popleft()) if self._requests else None

    def _find(self, request: FindKeyframe) -> Job:
        """Describe -> query -> verify the first candidates. The answer comes with the last step's events."""
        try:
            yield from self._look_up(request)
        except Exception:
            self._answers.append(KeyframeSought(request.key, None))
            raise

    def _look_up(self, request: FindKeyframe) -> Job:
        keyframe, image, view = request.keyframe, None, request.keyframe.view
        if len(keyframe.image.jpeg):
            image = ImageView(keyframe.image, request.rig.cam0, request.rig.T_body_cam0)
            if not len(view):
                view = yield DescribeStep(NO_NODE, image)
                yield []
        query = CameraView(view, request.rig.cam0.focal, request.rig.T_body_cam0, keyframe.up)
        found = yield QueryStep(self._views.index, NO_NODE, query, self._max_candidates, ())
        place = None
        for candidate in [one.id for one in found[:_MAX_CHECKED]]:
            if candidate not in self._views.by_node:
                continue  # removed meanwhile
            images = image, self._views.image(candidate)
            step = VerifyStep(NO_NODE, query, candidate, self._views.by_node[candidate], *images)
            yield []  # events of the step before; then the candidate may be removed
            if (place := self._place(candidate, (yield step))) is not None:
                break
        self._answers.append(KeyframeSought(request.key, place))
        yield []

    def _place(self, candidate: int, outcome: Verification | Refusal) -> FoundPlace | None:
        """Return where the verified keyframe is in the map; None if it was refused."""
        if isinstance(outcome, Refusal) or candidate not in self._views.by_node:
            return None
        key = self._atlas.key(candidate)
        T_map_body = se3.orthonormal(self._atlas.pose(key) @ outcome.T_c_q)
        return FoundPlace(self._atlas.map_id(key), T_map_body, outcome.cov, outcome.inliers)
