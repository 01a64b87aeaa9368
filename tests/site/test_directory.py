from __future__ import annotations

import numpy as np

from share.mapping.loops import KeyframeKey
from share.mapping.places import PlaceAdded, PlaceNewsLog, PlaceRemoved, PlaceUnrecognised, coarse_words
from share.mapping.recognition.index import PlaceIndex
from share.site.directory import PlaceDirectory

RNG = np.random.default_rng(3)
ROOMS = {room: RNG.integers(0, 256, (20, 300, 32), np.uint8) for room in ("hall", "kitchen", "lab")}
INDEX = PlaceIndex()


def words(descriptors, flipped: float = 0.0, seed: int = 0):
    rng = np.random.default_rng(seed)
    flips = np.packbits(rng.random((len(descriptors), 256)) < flipped, axis=1)
    return coarse_words(INDEX.words(descriptors ^ flips))


def filled() -> PlaceDirectory:
    directory = PlaceDirectory()
    for room, keyframes in ROOMS.items():
        for id, descriptors in enumerate(keyframes):
            directory.update(room, PlaceAdded(KeyframeKey(f"{room}-run", id), words(descriptors)))
    return directory


def test_one_word_in_eight_everywhere_the_same():
    all_words = INDEX.words(ROOMS["hall"][0])
    coarse = coarse_words(all_words)
    assert len(coarse) == len(np.unique(coarse))
    assert 0.09 < len(coarse) / len(np.unique(all_words)) < 0.16
    assert set(coarse_words(all_words[:800]).tolist()) <= set(coarse.tolist())


def test_the_room_that_looks_like_a_keyframe_is_first():
    directory = filled()
    for room, keyframes in ROOMS.items():
        for seed in range(5):
            seen = words(keyframes[seed], flipped=0.04, seed=seed)
            ranking = directory.update("hall", PlaceUnrecognised(KeyframeKey("new", seed), seen))
            assert ranking is not None
            assert ranking.scores[0].room == room
            assert ranking.scores[0].score > 3 * max((s.score for s in ranking.scores[1:]), default=0.0)


def test_what_the_run_has_just_seen_counts_for_none():
    directory = filled()
    seen = words(ROOMS["lab"][4])
    ranking = directory.update("lab", PlaceUnrecognised(KeyframeKey("lab-run", 10), seen))
    assert ranking is not None
    assert all(one.score < 1 for one in ranking.scores)


def test_removed_keyframes_and_rooms_are_gone():
    directory = filled()
    directory.update("lab", PlaceRemoved(KeyframeKey("lab-run", 4)))
    directory.update("lab", PlaceRemoved(KeyframeKey("lab-run", 4)))  # again
    assert len(directory) == 59
    directory.remove_room("hall")
    assert len(directory) == 39
    ranking = directory.update("lab", PlaceUnrecognised(KeyframeKey("new", 0), words(ROOMS["hall"][0])))
    assert ranking is not None
    assert "hall" not in [one.room for one in ranking.scores]


def test_a_keyframe_without_words_is_nowhere():
    directory, log = PlaceDirectory(), PlaceNewsLog()
    log.add(KeyframeKey("ann", 0), np.zeros(0, np.uint32))
    log.add_unrecognised(KeyframeKey("ann", 0))
    log.add_unrecognised(KeyframeKey("ann", 7))  # was never described
    added, unrecognised = log.take()
    assert directory.update("lab", added) is None
    ranking = directory.update("lab", unrecognised)
    assert ranking is not None
    assert ranking.scores == ()
    assert len(directory) == 0
    assert log.take() == ()
