"""Views and images of the map's keyframes: described once, decoded while in use, removed for good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import rig_of

from share.mapping.loops import KeyframeKey
from share.mapping.recognition import keyframe_views
from share.mapping.recognition.keyframe_views import KeyframeViews
from share.mapping.steps import DescribeStep
from share.types import Keyframe, KeyframeImage, View
from share.vision.keyframe_images import Surfaces

RIG = rig_of()
OTHERS = 3
SURFACE = Surfaces(np.array([[0.1, 0.2]]), np.array([[0.0, 0.0, 0.5]]), np.array([0.01]))


def key(id: int) -> KeyframeKey:
    return KeyframeKey("ann-1", id)


def view(seed: int, n: int = 30) -> View:
    rng = np.random.default_rng(seed)
    return View(rng.normal(size=(n, 2)), rng.normal(size=(n, 3)), rng.integers(0, 256, (n, 32)))


def image(gray: int = 0) -> KeyframeImage:
    return SURFACE.with_image(np.full((RIG.cam0.height, RIG.cam0.width), gray, np.uint8))


def keyframe(id: int, view: View | None = None, image: KeyframeImage | None = None) -> Keyframe:
    eye, cov, up = np.eye(4), 1e-6 * np.eye(6), np.array([0.0, 0.0, 1.0])
    found = Keyframe(id, id - 1, id, eye, cov, eye, up, 0.01, view or View.empty(), id - 1)
    return found if image is None else replace(found, image=image)


def some_views() -> KeyframeViews:
    """With `OTHERS` keyframes, beside which a word says something."""
    views = KeyframeViews()
    for k in range(OTHERS):
        views.add(100 + k, key(k), keyframe(k, view(100 + k)), RIG)
    return views


def indexed(views: KeyframeViews) -> int:
    return len(views.index) - OTHERS


def best(views: KeyframeViews, descriptors: np.ndarray) -> int:
    return views.index.query(descriptors, 8)[0].id


def test_a_keyframe_that_comes_with_its_features_is_indexed_at_once() -> None:
    views = some_views()
    views.add(3, key(0), keyframe(0, view(1)), RIG)
    assert best(views, view(1).descriptors) == 3
    assert views.image(3) is views.undescribed_image(3) is views.next_undescribed() is None
    assert list(views.with_image()) == []


def test_a_keyframe_with_an_image_is_indexed_once_it_is_described() -> None:
    views = some_views()
    views.add(3, key(0), keyframe(0, image=image()), RIG)
    views.add(4, key(1), keyframe(1, image=image()), RIG)
    assert indexed(views) == 0 and len(views.by_node[3].view) == 0
    assert views.next_undescribed() == 4  # the newest
    assert views.undescribed_image(3) is views.image(3) is not None
    views.describe(3, view(1))
    assert best(views, view(1).descriptors) == 3
    assert views.by_node[3].up.tolist() == [0, 0, 1] and len(views.by_node[3].view) == 30
    assert views.undescribed_image(3) is None and views.image(3) is not None
    views.describe(4, View.empty())
    assert views.next_undescribed() is None
    assert list(views.with_image()) == [3, 4]


def test_an_image_that_came_with_its_features_is_not_described_again() -> None:
    views = some_views()
    views.add(3, key(0), keyframe(0, view(1), image()), RIG)
    assert views.next_undescribed() is None and views.image(3) is not None
    assert best(views, view(1).descriptors) == 3
    views.remove(3)
    assert indexed(views) == 0


@pytest.mark.parametrize("is_described", [True, False])
def test_a_removed_keyframe_leaves_nothing(is_described: bool) -> None:
    views = some_views()
    views.add(3, key(0), keyframe(0, image=image()), RIG)
    views.add(5, key(1), keyframe(1, image=image()), RIG)
    step = DescribeStep(3, views.undescribed_image(3))
    if is_described:
        views.describe(3, view(1))
    views.remove(3)
    assert (indexed(views), views.next_undescribed()) == (0, 5)
    assert views.image(3) is None and 3 not in views.by_node and 3 not in views.with_image()
    step.run()  # removed while it was described
    views.describe(3, view(1))
    assert indexed(views) == 0 and 3 not in views.by_node


def test_a_keyframe_without_features_and_image_is_removed_too() -> None:
    views = some_views()
    views.add(3, key(0), keyframe(0), RIG)
    views.remove(3)
    assert 3 not in views.by_node and indexed(views) == 0


def test_restored_keyframes_are_indexed_later_and_images_described() -> None:
    views = some_views()
    restored = [keyframe(0, view(1)), keyframe(1, image=image())]
    views.restore([(1 + one.id, key(one.id), one, RIG) for one in restored])
    assert indexed(views) == 0 and views.next_undescribed() == 2
    (entry,) = views.next_restored()
    assert views.next_restored() == []
    words = {entry.node_id: views.index.words(entry.descriptors)}
    views.index_words(words)
    views.index_words(words)
    assert indexed(views) == 1 and best(views, view(1).descriptors) == 1
    views.describe(2, view(2))
    assert best(views, view(2).descriptors) == 2
    for node in (1, 2):
        views.remove(node)
    assert indexed(views) == 0


def test_the_images_last_used_stay_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyframe_views, "_DECODED_IMAGES", 2)
    views = some_views()
    for node in range(4):
        views.add(node, key(node), keyframe(node, image=image(50 * node)), RIG)
    first, second = views.image(0), views.image(1)
    assert views.image(0) is first and views.image(1) is second
    assert views.image(0) is first  # used last
    views.image(2)
    assert views.image(0) is first
    assert views.image(1) is not second
    for node in range(4):
        decoded = views.image(node)
        assert decoded is not None and decoded.pixels is not None
        assert abs(int(decoded.pixels[0, 0]) - 50 * node) < 3
    views.remove(3)
    assert views.image(3) is None
