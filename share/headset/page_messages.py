"""Messages of a headset page, JSON (docs/lookup/headset.md), and what becomes of them on the edge's wire.

Every number is bounded and every text short before anything is done with it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from share.errors import one_line
from share.geometry import se3
from share.types import F64
from share.wire.room_messages import (
    Cancel,
    CommandState,
    Goto,
    ObjectKind,
    PutObject,
    RemoveObject,
    RobotPlace,
    RoomObject,
)

SCHEMA = 1
MAX_PAGE_BYTES = 16_000  # of a message of a page
MAX_POINTS = 20_000  # that a page is sent of a map
POINTS_PER_PART = 10_000  # 160 kB of text

_Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Count = Annotated[int, Meta(ge=0, le=2**53)]
_Time = Annotated[float, Meta(ge=-1e15, le=1e15)]
_Millis = Annotated[float, Meta(ge=0, le=1e7)]
_Id = Annotated[int, Meta(ge=0, le=2**31 - 1)]
_Text = Annotated[str, Meta(max_length=200)]
_Secret = Annotated[str, Meta(max_length=2048)]
_Three = tuple[_Number, _Number, _Number]
_Four = tuple[_Number, _Number, _Number, _Number]
MessageError = msgspec.DecodeError


class PageHello(Struct, tag_field="type", tag="hello"):
    """First message: with a code and the wearer's name, or with the session of a welcome."""

    schema: Literal[1]
    code: _Text | None = None
    name: _Text | None = None
    agent: _Text | None = None
    session: _Secret | None = None


class PagePing(Struct, tag_field="type", tag="ping"):
    n: _Count
    sent_ms: _Time


class PageSeen(Struct, tag_field="type", tag="seen"):
    """The page has handled the poses up to message `n`."""

    n: _Count


class PagePut(Struct, tag_field="type", tag="put"):
    request: _Count
    id: _Id
    kind: Literal["cube", "marker"]
    position: _Three
    quaternion: _Four
    map_id: _Text | None = None


class PageRemove(Struct, tag_field="type", tag="remove"):
    request: _Count
    id: _Id


class PageGoto(Struct, tag_field="type", tag="goto"):
    command: _Count
    x: _Number
    y: _Number
    robot: _Text | None = None
    map_id: _Text | None = None
    yaw: _Number | None = None


class PageCancel(Struct, tag_field="type", tag="cancel"):
    command: _Count
    robot: _Text | None = None


class PagePoints(Struct, tag_field="type", tag="points"):
    map_id: _Text


class PageMeasured(Struct, tag_field="type", tag="measured"):
    """What a page measured in two seconds: times from a pose's stamp until its frame was drawn; over_20ms:
    how many of `frames` came later. alignment_mm: sigma; drift_mm_s: of the alignment."""

    mode: Literal["align", "follow"]
    frames: Annotated[int, Meta(ge=0, le=10**6)]
    over_20ms: Annotated[int, Meta(ge=0, le=10**6)]
    p50_ms: _Millis | None = None
    p95_ms: _Millis | None = None
    p99_ms: _Millis | None = None
    alignment_mm: _Millis | None = None
    drift_mm_s: _Number | None = None


PageRequest = PagePut | PageRemove
PageCommand = PageGoto | PageCancel
PageMessage = PageHello | PagePing | PageSeen | PageRequest | PageCommand | PagePoints | PageMeasured
_decoder: msgspec.json.Decoder[PageMessage] = msgspec.json.Decoder(PageMessage)


class OtherSchemaError(MessageError):
    """A page speaks another schema: it was loaded before the edge's release was another."""


class _AnyHello(Struct, tag_field="type", tag="hello"):
    schema: int


_hello_decoder = msgspec.json.Decoder(_AnyHello)


def decode_page(data: str | bytes) -> PageMessage:
    """Return the message of a page. Raises MessageError, with a line for a person; OtherSchemaError for a
    hello of another schema."""
    try:
        return _decoder.decode(data)
    except msgspec.DecodeError as error:
        if _is_of_another_schema(data):
            raise OtherSchemaError(
                "this page is of another release than the edge: load it again in the browser"
            ) from None
        raise MessageError(one_line(f"not a message of this page: {error}")[:300]) from None
    except (ValueError, RecursionError):
        raise MessageError("not a message of this page") from None


def _is_of_another_schema(data: str | bytes) -> bool:
    try:
        return _hello_decoder.decode(data).schema != SCHEMA
    except (ValueError, RecursionError):  # msgspec.DecodeError too
        return False


def as_request(page: PageRequest, number: int) -> PutObject | RemoveObject:
    """Return a page's request as one on the wire. Raises ValueError, with a line for a person."""
    if isinstance(page, PageRemove):
        return RemoveObject(number, page.id)
    T = pose_of(page.position, page.quaternion)
    return PutObject(number, page.id, ObjectKind(page.kind), page.map_id or None, T)


def as_command(page: PageCommand, number: int) -> Goto | Cancel:
    """Return a page's command as one on the wire. Raises ValueError, with a line for a person."""
    if isinstance(page, PageCancel):
        return Cancel(number, page.robot or None)
    return Goto(number, page.robot or None, "", page.map_id or None, page.x, page.y, page.yaw)


def pose_of(position: tuple[float, ...], quaternion: tuple[float, ...]) -> F64:
    """Return a pose (4, 4) of m and x y z w. Raises ValueError."""
    q = np.array(quaternion)
    if not abs(np.linalg.norm(q) - 1.0) <= 1e-2:
        raise ValueError("quaternion: its length is not 1")
    return se3.from_quat(np.array(position), q / np.linalg.norm(q))


# ---------------------------------------------------------------- to a page


def numbers(values: F64, digits: int = 5) -> list[float]:
    return [round(value, digits) for value in values.tolist()]


def pose_fields(T: F64) -> dict[str, Any]:
    return {"position": numbers(T[:3, 3]), "quaternion": numbers(se3.quat_from_matrix(T[:3, :3]), 6)}


def object_fields(one: RoomObject) -> dict[str, Any]:
    about = {"id": one.object_id, "kind": str(one.kind), "owner": one.owner, "map_id": one.map_id}
    return about | pose_fields(one.T_map_object)


def robot_fields(place: RobotPlace) -> dict[str, Any]:
    x, y, yaw = (round(value, 4) for value in (place.x, place.y, place.yaw))
    return {"robot": place.robot, "map_id": place.map_id, "x": x, "y": y, "yaw": yaw, "text": place.text}


def command_fields(state: CommandState, command: int | None) -> dict[str, Any]:
    """command: the page's number; None: of another commander."""
    ends = {"is_final": state.is_final, "is_reached": state.is_reached}
    about = {"command": command, "robot": state.robot, "commander": state.commander, "text": state.text}
    return {"type": "command", **about, **ends}


def encode_page(message: dict[str, Any]) -> str:
    return msgspec.json.encode(message).decode()
