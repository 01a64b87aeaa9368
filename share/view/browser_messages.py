"""What the live room takes of a browser: where its camera is, what it chose and where it clicked.

viser trusts browsers: it calls handlers with whatever they send, and collects uploads without a limit. What
is not one of these three messages, well formed, finite and small, never reaches it.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]
_Three = tuple[_Number, _Number, _Number]
_Text = Annotated[str, Meta(max_length=200)]


class _CameraMessage(Struct, tag_field="type", tag="ViewerCameraMessage"):
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Three
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Three
    up_direction: _Three


class _NewValue(Struct, forbid_unknown_fields=True):
    value: _Text | bool


class _Choice(Struct, tag_field="type", tag="GuiUpdateMessage"):
    uuid: _Text
    updates: _NewValue


class _SceneClick(Struct, tag_field="type", tag="SceneNodeClickMessage"):
    name: _Text
    ray_origin: _Three
    ray_direction: _Three
    screen_pos: tuple[_Number, _Number]
    instance_index: int | None = None
    modifier: _Text | None = None
    owner: _Text = ""


_decoder = msgspec.msgpack.Decoder(_CameraMessage | _Choice | _SceneClick)


def is_taken(data: Any) -> bool:
    """Return whether a message of a browser is one that the room takes."""
    if not isinstance(data, bytes):
        return False
    try:
        _decoder.decode(data)
    except (msgspec.DecodeError, ValueError, RecursionError):
        return False
    return True
