"""Where a browser's camera looks from."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from share.view.window import _BrowserCamera

FOV = 1.2


def client(width: int, height: int) -> Any:
    camera = SimpleNamespace(
        image_width=width, image_height=height, fov=FOV, position=np.zeros(3), look_at=np.zeros(3)
    )
    choice = SimpleNamespace(value="orbit", on_update=lambda act: None)
    gui = SimpleNamespace(add_dropdown=lambda *of, **more: choice)
    return SimpleNamespace(camera=camera, gui=gui, atomic=nullcontext)


def height_in_window(camera: Any, point: Any) -> float:
    """-1 at the lower edge, 1 at the upper one."""
    ahead = camera.look_at - camera.position
    ahead /= np.linalg.norm(ahead)
    up = np.cross(np.cross(ahead, [0.0, 0.0, 1.0]), ahead)
    to = np.asarray(point) - camera.position
    return float(to @ up / np.linalg.norm(up) / (to @ ahead) / np.tan(FOV / 2))


@pytest.mark.parametrize(("size", "expected"), [((1440, 900), 0.0), ((390, 844), 0.5)])
def test_the_room_is_shown_above_the_panel_of_a_narrow_window(size: tuple[int, int], expected: float) -> None:
    browser = client(*size)
    _BrowserCamera(browser, ()).look_at_room(None)
    assert height_in_window(browser.camera, [0.0, 0.0, 0.0]) == pytest.approx(expected, abs=0.05)


def test_an_agent_that_is_followed_stays_where_it_is_seen() -> None:
    browser = client(390, 844)
    camera = _BrowserCamera(browser, ("ann",))
    camera._choice.value = "follow ann"
    T, seen = np.eye(4), []
    for x in (0.0, 0.5, 1.0, 7.0):
        T[0, 3] = x
        camera.follow(lambda name: T.copy())
        seen.append(height_in_window(browser.camera, T[:3, 3]))
    np.testing.assert_allclose(seen, seen[0], atol=1e-9)
    assert seen[0] > 0.4
