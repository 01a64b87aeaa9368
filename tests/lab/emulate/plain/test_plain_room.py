import functools

import numpy as np
import pytest

from share.lab.emulate.plain.room import make_room, room_boxes

pytestmark = pytest.mark.long
room = functools.cache(make_room)


def test_the_room_depends_on_the_seed_alone():
    one, same, other = room(3), make_room(3), room(0)
    assert np.array_equal(one.atlas, same.atlas) and np.array_equal(one.boxes, same.boxes)
    assert one.boxes.shape != other.boxes.shape or not np.allclose(one.boxes, other.boxes)
    h = min(len(one.atlas), len(other.atlas))
    assert (one.atlas[:h] != other.atlas[:h]).mean() > 0.5


def test_furniture_stands_in_the_room_and_leaves_free_floor():
    for seed in range(3):
        boxes = room_boxes(seed, (8.0, 6.0, 3.0))
        assert len(boxes) >= 6
        lower, upper = boxes[1:, 0], boxes[1:, 1]
        assert (upper > lower).all() and (lower >= 0).all() and (upper <= boxes[0, 1]).all()
        middle = (8.0 / 2, 6.0 / 2)
        for lo, hi in zip(lower[1:], upper[1:], strict=True):  # all but the column
            gap = np.maximum(0, np.maximum(lo[:2] - middle, middle - hi[:2]))
            assert np.hypot(*gap) > 2.0


def test_no_two_faces_look_alike():
    """Equal windows anywhere in the atlas would fool place recognition."""
    atlas = room(0).atlas.astype(np.float32)
    rng, windows = np.random.default_rng(0), []
    while len(windows) < 400:
        y, x = rng.integers(0, [atlas.shape[0] - 64, atlas.shape[1] - 64])
        window = atlas[y : y + 64 : 2, x : x + 64 : 2].ravel()
        if window.std() > 12:
            windows.append((window - window.mean()) / window.std() / np.sqrt(window.size))
    likeness = np.array(windows) @ np.array(windows).T - np.eye(len(windows))
    assert np.percentile(likeness.max(axis=1), 90) < 0.9
