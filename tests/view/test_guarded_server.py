"""Of a browser, three kinds of small and finite messages are taken."""

from __future__ import annotations

from typing import Any

import pytest

msgspec = pytest.importorskip("msgspec", reason="viser is not installed")

from share.view.guarded_server import is_taken  # noqa: E402

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [1.0, 2.0, 3.0],
    "fov": 1.0,
    "near": 0.01,
    "far": 1e3,
    "image_height": 500,
    "image_width": 800,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
CLICK: dict[str, Any] = {
    "type": "SceneNodeClickMessage",
    "name": "/loop-marks/0",
    "instance_index": 3,
    "ray_origin": [0, 0, 0],
    "ray_direction": [0.1, 0, 1],
    "screen_pos": [0.5, 0.5],
    "modifier": None,
    "owner": "",
}
CHOICE = {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": "follow ann"}}


@pytest.mark.parametrize("message", [CAMERA, CLICK, CHOICE, CHOICE | {"updates": {"value": True}}])
def test_what_the_page_sends_is_taken(message: Any) -> None:
    assert is_taken(msgspec.msgpack.encode(message))


@pytest.mark.parametrize(
    "message",
    [
        CAMERA | {"position": [1.0, 2.0]},
        CAMERA | {"position": [float("nan"), 0.0, 0.0]},
        CAMERA | {"look_at": [float("inf"), 0.0, 0.0]},
        CAMERA | {"image_height": "5"},
        {k: v for k, v in CAMERA.items() if k != "fov"},
        CLICK | {"ray_direction": None},
        CLICK | {"name": "x" * 1000},
        CHOICE | {"updates": {"removed": True}},
        CHOICE | {"updates": {"value": "orbit", "removed": True}},
        CHOICE | {"updates": {"value": "x" * 1000}},
        {"type": "FileTransferStartUpload", "part_count": 0},
        {"type": "FileTransferPart", "content": b"x"},
        {"type": "ShareUrlRequest"},
        {"type": "GuiFormDirtyMessage", "uuid": "u"},
        {},
        [],
        None,
    ],
)
def test_what_it_has_no_reason_to_send_is_not(message: Any) -> None:
    assert not is_taken(msgspec.msgpack.encode(message))


@pytest.mark.parametrize("data", ["text", b"", b"\xc1", b"\x91" * 10**5])
def test_what_is_no_message_is_not(data: Any) -> None:
    assert not is_taken(data)
