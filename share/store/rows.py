"""Values as rows of a map file, and back. A row is whole if its CRC-32 says so."""

from __future__ import annotations

import math
import sqlite3
import zlib
from typing import Any, TypeVar

import msgspec
import numpy as np

from share.errors import StoreError
from share.mapping.changes import KeepKeyframe, KeepLink, KeepPoses, KeepRun, KeptKeyframe
from share.mapping.loops import Key, Loop
from share.types import F64, Keyframe, checked_cov, checked_id, checked_pose
from share.wire import codec, messages

M = TypeVar("M")
Row = tuple[Any, ...]  # the columns of COLUMNS, without number and crc

COLUMNS = {
    "about": ("name", "value"),
    "run": ("key", "next", "codec", "hello"),
    "run_copy": ("key", "next", "codec", "hello"),
    "stretch": ("run", "nth"),
    "keyframe": ("run", "id", "stretch", "ordinal", "codec", "message"),
    "link": ("run", "id", "reference", "T_ref_body", "cov"),
    "loop": ("a_run", "a_id", "b_run", "b_id", "T_a_b", "cov", "inliers", "found"),
    "poses": ("keys", "T_map_body"),
}

_VOICE = "voice "  # with a run's key after it, a name in `about`: SHARE 0.1 passes over it
_READABLE = (3, 4, codec.VERSION)  # wire versions in which a Hello and a Keyframe are what they are now
_pack = msgspec.msgpack.encode
_frames = msgspec.msgpack.Decoder(list[bytes]).decode
_placed = msgspec.msgpack.Decoder(list[tuple[str, int, str]]).decode


def check(table: str, number: int, row: Row) -> int:
    """CRC-32 over the table's name, the row's number and its columns, as msgpack."""
    return zlib.crc32(_pack((table, number, *row)))


def is_whole(table: str, number: int, row_and_crc: Row) -> bool:
    *row, crc = row_and_crc
    try:
        return bool(check(table, number, tuple(row)) == crc)
    except (TypeError, OverflowError, ValueError):  # what is not even packable
        return False


def insert(connection: sqlite3.Connection, table: str, row: Row, number: int | None = None) -> None:
    """One row with its CRC, behind all others unless its number is given."""
    if number is None:
        behind = f"SELECT ifnull(max(number), 0) + 1 FROM {table}"
        number = int(connection.execute(behind).fetchone()[0])
    columns = ("number", *COLUMNS[table], "crc")
    marks = ", ".join("?" * len(columns))
    values = (number, *row, check(table, number, row))
    connection.execute(f"INSERT INTO {table}({', '.join(columns)}) VALUES({marks})", values)


# ---------------------------------------------------------------- values to rows


def of_run(run: KeepRun, next_keyframe: int) -> Row:
    return run.key, next_keyframe, codec.VERSION, _message(run.hello)


def of_voice(run: str, voice: str) -> Row:
    """Of `about`: the public key that speaks for a run. Where none does there is no row."""
    return _VOICE + run, voice


def of_keyframe(keyframe: KeepKeyframe, stretch: int, ordinal: int) -> Row:
    return (*keyframe.at, stretch, ordinal, codec.VERSION, _message(keyframe.keyframe))


def of_link(link: KeepLink) -> Row:
    return (*link.key, link.reference, _bytes(link.T_ref_body), _bytes(link.cov))


def of_loop(loop: Loop) -> Row:
    T_a_b, cov = _bytes(loop.T_a_b), _bytes(loop.cov)
    return (*loop.a, *loop.b, T_a_b, cov, int(loop.inliers), loop.found)


def of_poses(poses: KeepPoses) -> Row:
    keys = [(*key, name) for key, name in zip(poses.keys, poses.maps, strict=True)]
    return _pack(keys), _bytes(poses.T_map_body)


# ---------------------------------------------------------------- rows to values; ValueError if they are none


def run(row: Row) -> KeepRun:
    key, following, version, hello = row
    checked_id("next", _whole(following))
    return KeepRun(_text(key), _decoded(messages.Hello, version, hello))


def voices(about: list[tuple[int, Row]]) -> dict[str, str]:
    """By run, from the rows of `about`."""
    found = {name: value for _, (name, value) in about if isinstance(name, str) and isinstance(value, str)}
    return {name.removeprefix(_VOICE): value for name, value in found.items() if name.startswith(_VOICE)}


def keyframe(row: Row) -> KeptKeyframe:
    agent, id, stretch, ordinal, version, message = row
    for name, number in (("id", id), ("stretch", stretch), ("ordinal", ordinal)):
        checked_id(name, _whole(number))
    own = _decoded(Keyframe, version, message)
    if own.id != id:
        raise ValueError(f"keyframe {agent}:{id} says that it is {own.id}")
    return KeptKeyframe(_text(agent), own, stretch_name(agent, stretch), ordinal)


def stretch_name(run: str, nth: int) -> str:
    """As the atlas calls it."""
    return f"{run}/{nth}"


def link(row: Row) -> KeepLink:
    agent, id, reference, T, cov = row
    checked_id("reference", _whole(reference), -1)
    return KeepLink(_key(agent, id), reference, _pose(T), _cov(cov))


def loop(row: Row) -> Loop:
    a, a_id, b, b_id, T, cov, inliers, found = row
    if not (_whole(inliers) >= 0 and isinstance(found, float | None) and math.isfinite(found or 0.0)):
        raise ValueError(f"a loop with {inliers} inliers, found at {found}")
    return Loop(_key(a, a_id), _key(b, b_id), _pose(T), _cov(cov), inliers, found)


def poses(row: Row) -> KeepPoses:
    keys = _placed(row[0])
    T = _array(row[1], len(keys), 4, 4)
    for pose in T:
        checked_pose("pose", pose)
    return KeepPoses(tuple(_key(a, i) for a, i, _ in keys), T, tuple(name for *_, name in keys))


def _message(message: messages.Message) -> bytes:
    """Its frames on the wire, as one."""
    return _pack([bytes(frame) for frame in codec.encode(message)])


def _decoded(kind: type[M], version: int, data: bytes) -> M:
    if version not in _READABLE:
        raise StoreError(
            f"keyframes in it are of wire version {version}, this SHARE reads {codec.VERSION}: "
            "use the SHARE that wrote it"
        )
    if not isinstance(data, bytes):
        raise ValueError(f"expected bytes, found {type(data).__name__}")
    message = codec.decode(_frames(data), _READABLE)
    if not isinstance(message, kind):
        raise ValueError(f"is a {type(message).__name__}")
    return message


def _key(agent: Any, id: Any) -> Key:
    return Key(_text(agent), checked_id("id", _whole(id)))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"expected text, found {type(value).__name__}")
    return value


def _whole(value: Any) -> int:
    if type(value) is not int:
        raise ValueError(f"expected a whole number, found {type(value).__name__}")
    return value


def _pose(data: bytes) -> F64:
    return checked_pose("pose", _array(data, 4, 4))


def _cov(data: bytes) -> F64:
    return checked_cov("covariance", _array(data, 6, 6))


def _bytes(array: F64) -> bytes:
    return np.ascontiguousarray(array, "<f8").tobytes()


def _array(data: bytes, *shape: int) -> F64:
    if not isinstance(data, bytes):
        raise ValueError(f"expected bytes, found {type(data).__name__}")
    return np.frombuffer(data, "<f8").reshape(shape)
