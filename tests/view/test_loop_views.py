"""A click on a loop shows what its two keyframes saw."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from share.mapping.loops import KeyframeKey
from share.types import AgentKind
from share.view import drawing as dr
from share.view import events as ev
from share.view import loop_views
from share.view.loop_views import KeyframePictures, nearest_to_ray
from share.view.room import DrawnRoom
from share.view.viewer import Viewer


def jpeg(shade: int, width: int = 640) -> bytes:
    return cv2.imencode(".jpg", np.full((width * 3 // 4, width), shade, np.uint8))[1].tobytes()


def shade_of(data: bytes) -> tuple[float, tuple[int, ...]]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return float(image.mean()), image.shape


def keyframe(name: str, id_: int, x: float, shade: int) -> ev.KeyframeArrived:
    T = np.eye(4)
    T[0, 3] = x
    return ev.KeyframeArrived(
        KeyframeKey(f"{name}-1", id_), id_ == 0, T, np.zeros((0, 3), np.float32), jpeg(shade)
    )


@pytest.fixture
def room() -> DrawnRoom:
    """Ann's keyframes at x = 0 and 4, bob's at 0.5 and 4.5, and a loop of each pair."""
    room = DrawnRoom()
    for name, x, shades in (("ann", 0.0, (20, 60)), ("bob", 0.5, (120, 200))):
        room.apply(ev.RunArrived(f"{name}-1", name, AgentKind.AR, np.eye(4), (0.8, 0.6)), 0.0)
        room.apply(keyframe(name, 0, x, shades[0]), 0.0)
        room.apply(keyframe(name, 1, x + 4.0, shades[1]), 0.0)
        room.apply(ev.CorrectionArrived(f"{name}-1", "A", np.eye(4), 0), 0.0)
    for id_ in (0, 1):
        room.apply(ev.LoopAccepted(KeyframeKey("ann-1", id_), KeyframeKey("bob-1", id_)), 0.0)
    return room


ABOVE = np.array([0.25, 0.0, 5.0])
DOWN = np.array([0.0, 0.0, -1.0])


def test_a_click_shows_both_views_of_the_loop_that_it_meets(room: DrawnRoom) -> None:
    for x, titles, shades in (
        (0.25, ("ann, keyframe 0", "bob, keyframe 0"), (20, 120)),
        (4.25, ("ann, keyframe 1", "bob, keyframe 1"), (60, 200)),
    ):
        views = room.loop_at(np.array([x, 0.0, 5.0]), DOWN)
        assert views is not None and views.titles == titles
        for data, shade in zip(views.jpegs, shades, strict=True):
            assert shade_of(data) == (pytest.approx(shade, abs=2), (240, 320))


def test_a_click_beside_all_loops_shows_nothing(room: DrawnRoom) -> None:
    assert room.loop_at(ABOVE, np.array([0.0, 1.0, 0.0])) is None
    assert DrawnRoom().loop_at(ABOVE, DOWN) is None


def test_loops_have_marks_to_click_until_they_are_removed(room: DrawnRoom) -> None:
    (marks,) = [one for one in room.take_drawings(0.0) if isinstance(one, dr.Marks)]
    assert np.allclose(marks.positions[:, 0], [0.25, 4.25])
    room.apply(ev.LoopsRemoved(KeyframeKey("ann-1", 0), KeyframeKey("bob-1", 0)), 0.0)
    (marks,) = [one for one in room.take_drawings(0.0) if isinstance(one, dr.Marks)]
    assert np.allclose(marks.positions[:, 0], [4.25])
    room.apply(ev.LoopsRemoved(KeyframeKey("ann-1", 1), KeyframeKey("bob-1", 1)), 0.0)
    assert dr.RemoveDrawing(marks.name) in room.take_drawings(0.0)


def test_a_picture_that_is_gone_is_said_to_be(room: DrawnRoom) -> None:
    room.apply(ev.KeyframesRemoved((KeyframeKey("ann-1", 0),)), 0.0)
    assert room.loop_at(ABOVE, DOWN) is None  # with its loop


def test_pictures_are_bounded_and_damaged_ones_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_views, "_KEPT", 3)
    pictures = KeyframePictures()
    keys = [KeyframeKey("ann-1", k) for k in range(5)]
    for k, key in enumerate(keys):
        pictures.add(key, jpeg(10 * k) if k != 1 else b"no image")
    assert [bool(pictures.get(key)) for key in keys] == [False, False, True, True, True]


def test_the_nearest_by_angle_is_meant() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 10.0], [0.0, 0.0, -5.0]])
    ray = np.array([0.03, 0.0, 1.0])
    assert nearest_to_ray(points, np.zeros(3), ray) == 1
    assert nearest_to_ray(points, np.zeros(3), np.array([1.0, 0.0, 0.0])) is None
    assert nearest_to_ray(np.zeros((0, 3)), np.zeros(3), ray) is None


class Page:
    """A window that was clicked once."""

    def __init__(self, *clicks: Any) -> None:
        self._clicks, self.shown = list(clicks), list[Any]()

    def is_watched(self) -> bool:
        return True

    def take_clicks(self) -> list[Any]:
        return [self._clicks.pop() for _ in range(len(self._clicks))]

    def show_views(self, browser: int, views: loop_views.LoopViews) -> None:
        self.shown.append((browser, views.titles))

    def disconnect_on_failure(self, browser: int) -> Any:
        return nullcontext()

    def draw(self, drawings: Any) -> None: ...

    def follow(self, place: Any) -> None: ...

    def show_panel(self, html: str, agents: Any) -> None: ...


def test_a_click_is_answered_in_its_browser_alone(room: DrawnRoom) -> None:
    clicks = (SimpleNamespace(browser=7, origin=ABOVE, direction=DOWN),)
    page = Page(*clicks, SimpleNamespace(browser=8, origin=ABOVE, direction=-DOWN))
    viewer = Viewer(None, page)  # type: ignore[arg-type]
    viewer._room = room
    viewer._draw(0.0)
    viewer._draw(1.0)
    assert page.shown == [(7, ("ann, keyframe 0", "bob, keyframe 0"))]
