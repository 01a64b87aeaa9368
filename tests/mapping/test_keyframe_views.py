"""Views and images of the map's keyframes: described once, decoded while in use, removed for good."""

from __future__ import annotations

import tracemalloc
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import rig_of

from share.mapping.loops import KeyframeKey
from share.mapping.recognition import keyframe_views
from share.mapping.recognition.keyframe_views import KeyframeViews
from share.mapping.steps import DescribeStep
from share.types import U8, Keyframe, KeyframeImage, View
from share.vision.keyframe_images import Surfaces
from share.vision.packed_view import PackedView

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


class Archive:
    """A map file: images of all keyframes but those in `unwritten`, and the views that it is given."""

    def __init__(self, unwritten: Collection[int] = ()) -> None:
        self.views: dict[KeyframeKey, PackedView] = {}
        self.unwritten, self.reads = unwritten, 0

    def jpeg(self, key: KeyframeKey) -> U8 | None:
        self.reads += 1
        return image(key.id).jpeg if self.has_jpeg(key) else None

    def view(self, key: KeyframeKey) -> PackedView | None:
        self.reads += 1
        return self.views.get(key)

    def has_jpeg(self, key: KeyframeKey) -> bool:
        return key.id not in self.unwritten

    def has_view(self, key: KeyframeKey) -> bool:
        return key in self.views


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


def filled(archive: Archive | None, count: int) -> KeyframeViews:
    """With `count` described keyframes, of which the archive has the views too."""
    views = KeyframeViews(archive)
    for k in range(count):
        views.add(k, key(k), keyframe(k, image=image(k)), RIG)
        packed = views.describe(k, view(k))
        if archive is not None and packed is not None:
            archive.views[key(k)] = packed
    return views


def test_what_the_map_file_has_is_forgotten_and_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit in ("_KEPT_JPEGS", "_KEPT_VIEWS", "_DECODED_IMAGES"):
        monkeypatch.setattr(keyframe_views, limit, 4)
    archive = Archive()
    views = filled(archive, 20)
    assert archive.reads == 0
    for k in (19, 3, 3, 19):
        assert np.array_equal(views.by_node[k].view.descriptors, view(k).descriptors)
        found = views.image(k)
        assert found is not None and found.source.jpeg.tobytes() == image(k).jpeg.tobytes()
        assert np.array_equal(found.plane, SURFACE.plane)
    assert archive.reads == 2  # of keyframe 3, once
    views.remove(3)
    assert views.image(3) is None and 3 not in views.by_node


def test_what_is_not_written_yet_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyframe_views, "_KEPT_JPEGS", 4)
    monkeypatch.setattr(keyframe_views, "_DECODED_IMAGES", 1)
    views = filled(Archive(unwritten={0, 1, 2}), 30)
    for k in range(3):
        assert views.image(k) is not None


def test_without_a_map_file_everything_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyframe_views, "_KEPT_VIEWS", 4)
    views = filled(None, 20)
    assert all(len(views.by_node[k].view) == 30 and views.image(k) is not None for k in range(20))


@pytest.mark.slow
@pytest.mark.long
def test_memory_a_keyframe_with_a_map_file_is_that_of_the_index(monkeypatch: pytest.MonkeyPatch) -> None:
    """800 features and an image of 20 kB: 50 kB where they stay."""
    monkeypatch.setattr(keyframe_views, "_KEPT_JPEGS", 50)
    monkeypatch.setattr(keyframe_views, "_KEPT_VIEWS", 50)
    jpeg = np.zeros(20_000, np.uint8)
    archive, used = Archive(), []
    views = KeyframeViews(archive)
    tracemalloc.start()
    for k in range(900):
        picture = replace(image(), jpeg=jpeg.copy())
        views.add(k, key(k), keyframe(k, image=picture), RIG)
        packed = views.describe(k, view(k, 800))
        assert packed is not None
        archive.views[key(k)] = PackedView.pack(View.empty())
        used.append(tracemalloc.get_traced_memory()[0] - views.index.nbytes)
    tracemalloc.stop()
    assert (used[-1] - used[299]) / 600 < 5000


def test_restored_keyframes_are_indexed_all_over_the_map_at_first() -> None:
    archive = Archive()
    archive.views = {key(k): PackedView.pack(view(k)) for k in range(200) if k != 50}
    views = KeyframeViews(archive)
    sent = [keyframe(k, image=image().without_jpeg()) for k in range(200)]
    views.restore([(one.id, key(one.id), one, RIG) for one in sent])
    assert archive.reads == 0
    first = [entry.node_id for entry in views.next_restored()]
    assert max(first) > 180 and max(np.diff(sorted(first))) < 40
    order = list(first)
    while entries := views.next_restored():
        order += [entry.node_id for entry in entries]
        views.index_words({entry.node_id: views.index.words(entry.descriptors) for entry in entries})
    assert sorted(order) == [k for k in range(200) if k != 50]
    assert views.next_undescribed() == 50  # the file has no view of it


def test_a_restored_keyframe_may_be_removed_before_it_is_indexed() -> None:
    archive = Archive()
    archive.views = {key(k): PackedView.pack(view(k)) for k in range(4)}
    views = KeyframeViews(archive)
    sent = [keyframe(k, image=image().without_jpeg()) for k in range(4)]
    views.restore([(one.id, key(one.id), one, RIG) for one in sent])
    views.remove(2)
    entries = views.next_restored()
    views.remove(1)
    views.index_words({entry.node_id: views.index.words(entry.descriptors) for entry in entries})
    assert len(views.index) == 2 and views.next_restored() == []
