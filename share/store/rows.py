"""Conversion between values and rows of a map file. Each row carries a CRC-32."""

from __future__ import annotations

import math
import sqlite3
import zlib
from dataclasses import replace
from typing import Any, TypeVar

import msgspec
import numpy as np

from share.agent_names import checked_run_key
from share.checks import checked_cov, checked_id, checked_map_id, checked_pose, is_pose
from share.errors import StoreError
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import (
    SaveKeyframe,
    SaveLink,
    SaveObject,
    SavePoses,
    SaveRun,
    SaveView,
    StoredKeyframe,
)
from share.types import F64, U8, Keyframe
from share.vision.packed_view import PackedView
from share.wire import codec, messages
from share.wire.room_messages import ObjectKind, RoomObject

M = TypeVar("M")
Row = tuple[Any, ...]  # columns as in COLUMNS, without number and crc

COLUMNS = {
    "about": ("name", "value"),
    "run": ("key", "next", "codec", "hello"),
    "run_copy": ("key", "next", "codec", "hello"),
    "stretch": ("run", "nth"),
    "keyframe": ("run", "id", "stretch", "ordinal", "codec", "message"),
    "link": ("run", "id", "reference", "T_ref_body", "cov"),
    "loop": ("a_run", "a_id", "b_run", "b_id", "T_a_b", "cov", "inliers", "found"),
    "poses": ("keys", "T_map_body"),
    "arrival": ("run", "id", "unix_s"),
    "image": ("run", "id", "jpeg"),
    "view": ("run", "id", "view"),
}

_OBJECT_PREFIX = "object "  # before an object's id, a name in `about`; an older SHARE ignores it
_CREDENTIAL_PREFIX = "voice "  # before a run's key, a name in `about`; SHARE 0.1 ignores it
FORGOTTEN_PREFIX = "forgotten "  # before the tag of a removed run, a name in `about`; likewise
_READABLE_VERSIONS = (
    3,
    4,
    5,
    6,
    7,
    codec.WIRE_VERSION,
)  # wire versions with today's Hello and a known Keyframe
_pack = msgspec.msgpack.encode
_decode_frames = msgspec.msgpack.Decoder(list[bytes]).decode
_decode_pose_keys = msgspec.msgpack.Decoder(list[tuple[str, int, str]]).decode


def row_crc(table: str, number: int, row: Row) -> int:
    """Return the CRC-32 of the table's name, the row's number and its columns, as msgpack."""
    return zlib.crc32(_pack((table, number, *row)))


def is_intact(table: str, number: int, row_and_crc: Row) -> bool:
    *row, crc = row_and_crc
    try:
        return bool(row_crc(table, number, tuple(row)) == crc)
    except (TypeError, OverflowError, ValueError):  # not encodable as msgpack
        return False


def insert(connection: sqlite3.Connection, table: str, row: Row, number: int | None = None) -> None:
    """Insert a row with its CRC, after all others unless its number is given."""
    if number is None:
        behind = f"SELECT ifnull(max(number), 0) + 1 FROM {table}"
        number = int(connection.execute(behind).fetchone()[0])
    columns = ("number", *COLUMNS[table], "crc")
    marks = ", ".join("?" * len(columns))
    values = (number, *row, row_crc(table, number, row))
    connection.execute(f"INSERT INTO {table}({', '.join(columns)}) VALUES({marks})", values)


# ---------------------------------------------------------------- values to rows


def run_row(run: SaveRun, next_keyframe: int) -> Row:
    return run.run_key, next_keyframe, codec.WIRE_VERSION, _encode_message(run.hello)


def credential_row(run: str, credential: str) -> Row:
    """Return the row of `about` with the public key of a run. A run without a key has no row."""
    return _CREDENTIAL_PREFIX + run, credential


def forgotten_row(tag: str, next_keyframe: int) -> Row:
    """Return the row of `about` of a removed run: its `public_tag`, and the id after all that it had."""
    return FORGOTTEN_PREFIX + tag, str(next_keyframe)


def object_name(object_id: int) -> str:
    """Return the name in `about` of an object of the room."""
    return f"{_OBJECT_PREFIX}{object_id}"


def object_row(stored: SaveObject) -> Row:
    """Return the row of `about` with an object of the room: JSON."""
    one = stored.object
    fields = {
        "kind": one.kind,
        "owner": one.owner,
        "map": one.map_id,
        "home": stored.home_map,
        "T": one.T_map_object.tolist(),
    }
    return object_name(one.object_id), msgspec.json.encode(fields).decode()


def keyframe_row(keyframe: SaveKeyframe, segment: int, ordinal: int) -> Row:
    """Return the row of a keyframe, without its JPEG."""
    sent = keyframe.keyframe
    message = _encode_message(replace(sent, image=sent.image.without_jpeg()))
    return (*keyframe.keyframe_key, segment, ordinal, codec.WIRE_VERSION, message)


def image_row(key: KeyframeKey, jpeg: U8) -> Row:
    return *key, jpeg.tobytes()


def view_row(view: SaveView) -> Row:
    return *view.key, view.view.to_bytes()


def link_row(link: SaveLink) -> Row:
    return (*link.key, link.reference, _encode_array(link.T_ref_body), _encode_array(link.cov))


def loop_row(loop: Loop) -> Row:
    T_a_b, cov = _encode_array(loop.T_a_b), _encode_array(loop.cov)
    return (*loop.a, *loop.b, T_a_b, cov, int(loop.inliers), loop.found_share)


def arrival_row(key: KeyframeKey, unix_s: float) -> Row:
    return *key, int(unix_s)


def poses_row(poses: SavePoses) -> Row:
    keys = [(*key, name) for key, name in zip(poses.keys, poses.map_ids, strict=True)]
    return _pack(keys), _encode_array(poses.T_map_body)


# ---------------------------------------------------------------- rows to values; ValueError if they are none


def read_run(row: Row) -> SaveRun:
    key, next_id, version, hello = row
    checked_id("next", _checked_int(next_id))
    return SaveRun(checked_run_key(_checked_text(key)), _decode_message(messages.Hello, version, hello))


def read_credentials(about: list[tuple[int, Row]]) -> dict[str, str]:
    """Return credentials by run, from the rows of `about`."""
    texts = {name: value for _, (name, value) in about if isinstance(name, str) and isinstance(value, str)}
    return {
        name.removeprefix(_CREDENTIAL_PREFIX): value
        for name, value in texts.items()
        if name.startswith(_CREDENTIAL_PREFIX)
    }


def read_forgotten_runs(about: list[tuple[int, Row]]) -> tuple[dict[str, int], int]:
    """Return the next keyframes of removed runs by tag, oldest first, from the rows of `about`, and the
    number of unreadable ones."""
    out, lost_count = dict[str, int](), 0
    for _, (name, value) in about:
        if isinstance(name, str) and name.startswith(FORGOTTEN_PREFIX):
            try:
                next_keyframe = checked_id("next", int(_checked_text(value)))
            except ValueError:
                lost_count += 1
            else:
                out[name.removeprefix(FORGOTTEN_PREFIX)] = next_keyframe
    return out, lost_count


class _ObjectFields(msgspec.Struct):
    kind: ObjectKind
    owner: str
    map: str
    home: str
    T: list[list[float]]


def read_objects(about: list[tuple[int, Row]]) -> tuple[tuple[SaveObject, ...], int]:
    """Return the objects of the room, from the rows of `about`, and the number of unreadable ones."""
    out, lost_count = [], 0
    for _, (name, value) in about:
        if isinstance(name, str) and name.startswith(_OBJECT_PREFIX):
            try:
                out.append(_read_object(name, _checked_text(value)))
            except (ValueError, msgspec.MsgspecError):
                lost_count += 1
    return tuple(out), lost_count


def _read_object(name: str, value: str) -> SaveObject:
    fields = msgspec.json.decode(value, type=_ObjectFields)
    object_id, T = int(name.removeprefix(_OBJECT_PREFIX)), np.array(fields.T, np.float64)
    if object_name(object_id) != name:  # 007, which is not where object 7 is written
        raise ValueError(f"{name!r} is no object's name")
    one = RoomObject(0, 0, object_id, fields.kind, fields.owner, fields.map, T)
    return SaveObject(one, checked_map_id(fields.home))


def read_keyframe(row: Row) -> StoredKeyframe:
    agent, id, segment, ordinal, version, message = row
    for name, number in (("id", id), ("stretch", segment), ("ordinal", ordinal)):
        checked_id(name, _checked_int(number))
    decoded = _decode_message(Keyframe, version, message)
    if decoded.id != id:
        raise ValueError(f"the message of keyframe {agent}:{id} has id {decoded.id}")
    return StoredKeyframe(_checked_text(agent), decoded, segment_name(agent, segment), ordinal)


def read_segment(row: Row) -> str:
    """Return the name of a segment."""
    run, nth = row
    return segment_name(checked_run_key(_checked_text(run)), checked_id("nth", _checked_int(nth)))


def segment_name(run: str, nth: int) -> str:
    """Return the segment's name in the mapper."""
    return f"{run}/{nth}"


def read_link(row: Row) -> SaveLink:
    agent, id, reference, T, cov = row
    checked_id("reference", _checked_int(reference), -1)
    return SaveLink(_checked_key(agent, id), reference, _decode_pose(T), _decode_cov(cov))


def read_loop(row: Row) -> Loop:
    a, a_id, b, b_id, T, cov, inliers, found_at = row
    if not (
        _checked_int(inliers) >= 0 and isinstance(found_at, float | None) and math.isfinite(found_at or 0.0)
    ):
        raise ValueError(f"a loop with {inliers} inliers, found at {found_at}")
    return Loop(
        _checked_key(a, a_id), _checked_key(b, b_id), _decode_pose(T), _decode_cov(cov), inliers, found_at
    )


def read_arrival(row: Row) -> tuple[KeyframeKey, int]:
    """Return a keyframe and when it came, unix s."""
    agent, id, unix_s = row
    return _checked_key(agent, id), _checked_int(unix_s)


def read_image(row: Row) -> tuple[KeyframeKey, U8]:
    """Return a keyframe and its JPEG (B,)."""
    agent, id, jpeg = row
    return _checked_key(agent, id), np.frombuffer(_checked_bytes(jpeg), np.uint8)


def read_view(row: Row) -> tuple[KeyframeKey, PackedView]:
    agent, id, view = row
    return _checked_key(agent, id), PackedView.from_bytes(_checked_bytes(view))


def read_poses(row: Row) -> SavePoses:
    """Return the valid poses. Raises ValueError if there is none, or what is not one at all."""
    keys = _decode_pose_keys(row[0])
    T = _decode_array(row[1], len(keys), 4, 4)
    valid = [i for i, pose in enumerate(T) if is_pose(pose)]
    if keys and not valid:
        raise ValueError("poses: none is valid")
    taken = [keys[i] for i in valid]
    return SavePoses(
        tuple(_checked_key(a, i) for a, i, _ in taken), T[valid], tuple(name for *_, name in taken)
    )


def _encode_message(message: messages.Message) -> bytes:
    """Return the message's wire frames, packed."""
    return _pack([bytes(frame) for frame in codec.encode(message)])


def _decode_message(kind: type[M], version: int, data: bytes) -> M:
    if version not in _READABLE_VERSIONS:
        raise StoreError(
            f"its keyframes have wire version {version}, this SHARE reads {codec.WIRE_VERSION}: "
            "use the SHARE that wrote it"
        )
    message = codec.decode(_decode_frames(_checked_bytes(data)), _READABLE_VERSIONS)
    if not isinstance(message, kind):
        raise ValueError(f"is a {type(message).__name__}")
    return message


def _checked_key(agent: Any, id: Any) -> KeyframeKey:
    return KeyframeKey(_checked_text(agent), checked_id("id", _checked_int(id)))


def _checked_bytes(value: Any) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError(f"expected bytes, found {type(value).__name__}")
    return value


def _checked_text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"expected text, found {type(value).__name__}")
    return value


def _checked_int(value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"expected a whole number, found {type(value).__name__}")
    return value


def _decode_pose(data: bytes) -> F64:
    return checked_pose("pose", _decode_array(data, 4, 4))


def _decode_cov(data: bytes) -> F64:
    return checked_cov("covariance", _decode_array(data, 6, 6))


def _encode_array(array: F64) -> bytes:
    return np.ascontiguousarray(array, "<f8").tobytes()


def _decode_array(data: bytes, *shape: int) -> F64:
    return np.frombuffer(_checked_bytes(data), "<f8").reshape(shape)
