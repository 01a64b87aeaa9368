"""What is drawn twice is drawn once, and is the same to the last bit as where it is drawn anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.rendered import D435I, box, furnished, looking, needs_opengl

from share.lab.emulate.render.gl import GlRenderer, GlRoom
from share.lab.emulate.types import SceneInstant
from share.types import F64

pytestmark = [pytest.mark.long, needs_opengl]
SMALL = replace(D435I, width=160, height=120, fx=96.0, fy=96.0, cx=79.5, cy=59.5)
ROOM = furnished(60, {"ann": (box(np.zeros(3), np.array([0.4, 0.4, 1.5]), 3),)})


def ann_at(x: float, y: float) -> F64:
    T = np.eye(4)
    T[:2, 3] = x, y
    return T[None]


def ahead(T_world_cam: F64, m: float) -> F64:
    return ann_at(*(T_world_cam[:2, 3] + m * T_world_cam[:2, 2]))


def counted(room: GlRoom, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many passes were drawn."""
    drawn, clear = [0], room._cleared_target

    def note(camera: object) -> object:
        drawn[0] += 1
        return clear(camera)  # type: ignore[arg-type]

    monkeypatch.setattr(room, "_cleared_target", note)
    return drawn


def test_a_camera_that_stands_sees_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    T = looking(0.4)
    barely = T.copy()
    barely[0, 3] += 1e-10  # a robot whose wheels run out
    room = GlRoom(ROOM)
    drawn = counted(room, monkeypatch)
    first = room.image(SMALL, SceneInstant(T, {"ann": ahead(T, -3.0)}))  # behind the camera
    again = room.image(SMALL, SceneInstant(barely, {"ann": ahead(T, -3.2)}))
    assert drawn == [1] and again is first and not first.flags.writeable
    anew = GlRoom(ROOM).image(SMALL, SceneInstant(barely, {"ann": ahead(T, -3.2)}))
    np.testing.assert_array_equal(again, anew)


def test_what_moves_is_drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    T = looking(0.4)
    room = GlRoom(ROOM)
    drawn = counted(room, monkeypatch)
    near, far = (room.image(SMALL, SceneInstant(T, {"ann": ahead(T, m)})) for m in (1.2, 1.4))
    assert drawn == [2] and np.abs(near - far).max() > 20
    moved = T.copy()
    moved[0, 3] += 1e-3
    room.image(SMALL, SceneInstant(moved, {"ann": ahead(T, 1.4)}))
    room.image(replace(SMALL, cx=79.7), SceneInstant(T, {"ann": ahead(T, 1.4)}))
    assert drawn == [4]
    np.testing.assert_array_equal(room.image(SMALL, SceneInstant(T, {"ann": ahead(T, 1.2)})), near)
    assert drawn == [4]


def test_a_picture_of_all_samples_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = GlRenderer(ROOM)
    drawn = counted(renderer._stage, monkeypatch)
    left, right = (SceneInstant(looking(yaw)) for yaw in (0.4, 0.41))
    pictures = [renderer.radiance(SMALL, [one]) for one in (left, right, left, right)]
    assert drawn == [6]  # three samples of a pixel, two cameras
    np.testing.assert_array_equal(pictures[0], pictures[2])
    np.testing.assert_array_equal(pictures[1], pictures[3])
    for k in range(12):  # what is kept is bounded
        renderer.radiance(SMALL, [SceneInstant(looking(0.1 * k))])
    assert len(renderer._stage._recent) <= 8
