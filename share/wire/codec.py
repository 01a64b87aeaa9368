"""Messages to frames of bytes and back; docs/wire.md has the byte layout.

The first frame is a small msgpack header: wire version, message code, scalar fields, and dtype and
shape of each array. Every array follows as a frame of its own, little-endian, C order, not copied.
Nothing is allocated for a declared size before the bytes that fill it are seen to be there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite, prod
from operator import attrgetter
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from share.errors import VersionError, WireError
from share.geometry.camera import Camera, ImuNoise, Rig
from share.types import (
    DESCRIPTOR_BYTES,
    F32,
    F64,
    I64,
    MAX_KEYPOINTS,
    MAX_M_S2,
    MAX_MAP_ID,
    MAX_NAME,
    MAX_RAD_S,
    MAX_STAMP_NS,
    AgentKind,
    Correction,
    Frame,
    ImuBatch,
    Keyframe,
    TrackState,
    View,
    Wait,
    checked_id,
    checked_stamp,
)
from share.wire import messages as m

VERSION = 5
OLDEST = 2  # from which on messages that tell versions, those of FROZEN, are what they are now
MAX_HEADER_BYTES = 4096
MAX_ARRAYS = 8
MAX_FRAME_BYTES = MAX_KEYPOINTS * DESCRIPTOR_BYTES  # the largest array of any message but Frame
MAX_IMAGE_BYTES = 4 * 1920 * 1200  # the largest of that: a depth image

Bytes = bytes | memoryview
Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Ids = Annotated[tuple[Int64, ...], Meta(max_length=m.MAX_HELD)]
Text = Annotated[str, Meta(max_length=m.MAX_TEXT)]
Reason = Annotated[str, Meta(max_length=m.MAX_REASON)]
Name = Annotated[str, Meta(max_length=MAX_NAME)]
MapId = Annotated[str, Meta(max_length=MAX_MAP_ID)]

_DTYPES = {code: np.dtype(code) for code in ("<f8", "<f4", "<i8", "|u1")}


class _Head(msgspec.Struct, array_like=True):
    """The beginning of every header, of this and of all other versions."""

    version: int
    code: Any = None


class _Header(msgspec.Struct, array_like=True):
    version: int
    code: int
    scalars: msgspec.Raw
    arrays: tuple[tuple[str, tuple[int, ...]], ...]


_encoder = msgspec.msgpack.Encoder(enc_hook=lambda scalar: scalar.item())  # numpy scalars
_read_head = msgspec.msgpack.Decoder(_Head).decode
_read_header = msgspec.msgpack.Decoder(_Header).decode


@dataclass(frozen=True)
class _Scalars:
    """Scalar fields by their paths, checked alike on the way out and in."""

    names: tuple[str, ...]
    getters: tuple[Callable[[object], Any], ...]
    decoder: msgspec.msgpack.Decoder[Any]

    @staticmethod
    def of(**fields: Any) -> _Scalars:
        decoder = msgspec.msgpack.Decoder(tuple[tuple(fields.values())])  # type: ignore[misc]
        return _Scalars(tuple(map(_name, fields)), tuple(map(attrgetter, fields)), decoder)

    def encode(self, message: object) -> bytes:
        raw = _encoder.encode([get(message) for get in self.getters])
        self.decode(raw)
        return raw

    def decode(self, raw: msgspec.Raw | bytes) -> dict[str, Any]:
        values = self.decoder.decode(raw)
        for value in values:
            if isinstance(value, float) and not isfinite(value):
                raise ValueError("a number is not finite")
        return dict(zip(self.names, values, strict=True))


@dataclass(frozen=True)
class _Array:
    """One array field; `None` in the shape is a length that the message chooses, up to `most`. One that is
    optional and not there has the shape (0,)."""

    path: str
    dtype: str
    shape: tuple[int | None, ...]
    optional: bool = False
    most: int = MAX_KEYPOINTS

    @cached_property
    def name(self) -> str:
        return _name(self.path)

    @cached_property
    def _getter(self) -> Callable[[object], Any]:
        return attrgetter(self.path)

    def get(self, message: object) -> NDArray[Any]:
        value = self._getter(message)
        absent = self.optional and value is None
        return np.ascontiguousarray(() if absent else value, _DTYPES[self.dtype])

    def decode(self, dtype: str, shape: tuple[int, ...], frame: Bytes) -> NDArray[Any] | None:
        if dtype not in _DTYPES:
            raise ValueError(f"{self.path}: unknown dtype {dtype[:8]!r}")
        if dtype != self.dtype or not self._admits(shape):
            raise ValueError(f"{self.path}: {dtype} of shape {shape[:4]}, expected {self.dtype} {self.shape}")
        size = prod(shape) * _DTYPES[dtype].itemsize
        if size > MAX_IMAGE_BYTES:
            raise ValueError(f"{self.path}: {size} bytes, at most {MAX_IMAGE_BYTES}")
        data = memoryview(frame)
        if data.nbytes != size:
            raise ValueError(f"{self.path}: {data.nbytes} bytes, its shape needs {size}")
        if not size:
            return None if self._is_absent(shape) else np.empty(shape, _DTYPES[dtype])
        # a short frame lies unaligned in its message: only then is it copied
        array = np.frombuffer(data, _DTYPES[dtype]).reshape(shape)
        return array if array.flags.aligned else array.copy()

    def _admits(self, shape: tuple[int, ...]) -> bool:
        return shape == self.shape or self._is_absent(shape) or self._fits(shape)

    def _fits(self, shape: tuple[int, ...]) -> bool:
        return len(shape) == len(self.shape) and all(
            0 <= have <= self.most if want is None else have == want
            for want, have in zip(self.shape, shape, strict=True)
        )

    def _is_absent(self, shape: tuple[int, ...]) -> bool:
        return self.optional and shape == (0,)


def _image(path: str, dtype: str = "|u1", optional: bool = False) -> _Array:
    return _Array(path, dtype, (None, None), optional, m.MAX_SIDE)


def _samples(path: str, dtype: str, *shape: int) -> _Array:
    return _Array(path, dtype, (None, *shape), most=m.MAX_SAMPLES)


def _frame(*, stamps_ns: I64, gyro: F64, accel: F64, **fields: Any) -> Frame:
    checked_id("index", fields["index"])
    for name in ("stamp_ns", "gap_ns"):
        checked_stamp(name, fields[name])
    if len(stamps_ns) and not -MAX_STAMP_NS <= stamps_ns.min() <= stamps_ns.max() <= MAX_STAMP_NS:
        raise ValueError("stamps_ns: are beyond any clock")
    imu = ImuBatch(stamps_ns, gyro, accel)
    if not (stamps_ns[1:] > stamps_ns[:-1]).all():
        raise ValueError("stamps_ns: do not rise")
    for name, samples, most in (("gyro", gyro, MAX_RAD_S), ("accel", accel, MAX_M_S2)):
        if np.abs(samples).max(initial=0.0) > most:
            raise ValueError(f"{name}: has values beyond {most:g}, which no IMU measures")
    depth: F32 | None = fields["depth"]
    if depth is not None and not (np.isfinite(depth) & (depth >= 0)).all():
        raise ValueError("depth: has values that are negative or not finite")
    return Frame(**fields, imu=imu)


@dataclass(frozen=True)
class _Layout:
    """How one type of message lies on the wire."""

    code: int
    build: Callable[..., m.Message]
    scalars: _Scalars = field(default_factory=lambda: _Scalars.of())
    arrays: tuple[_Array, ...] = ()


def _name(path: str) -> str:
    return path.rpartition(".")[2]


def _pose(path: str, optional: bool = False) -> _Array:
    return _Array(path, "<f8", (4, 4), optional)


def _hello(*, name: str, kind: AgentKind, run_id: int, streams: bool, **rig: Any) -> m.Hello:
    return m.Hello(name, kind, run_id, Rig(**rig), streams)


def _keyframe(*, uv: Any, points: Any, descriptors: Any, **fields: Any) -> Keyframe:
    return Keyframe(**fields, view=View(uv, points, descriptors))


_RIG: dict[str, Any] = {  # as maps by the names of their fields, checked by their own types
    "rig.cam0": Camera,
    "rig.cam1": Camera | None,
    "rig.depth": Camera | None,
    "rig.imu": ImuNoise | None,
    "rig.timeshift_s": float,
}
_LAYOUTS: dict[type, _Layout] = {
    m.Hello: _Layout(
        1,
        _hello,
        _Scalars.of(name=Name, kind=AgentKind, run_id=Int64, streams=bool, **_RIG),
        (
            _pose("rig.T_body_cam0"),
            _pose("rig.T_cam1_cam0", optional=True),
            _pose("rig.T_depth_cam0", optional=True),
        ),
    ),
    m.PoseUpdate: _Layout(
        2,
        m.PoseUpdate,
        _Scalars.of(stamp_ns=Int64, state=TrackState, keyframe=Int64),
        (_pose("T_keyframe_body"),),
    ),
    Keyframe: _Layout(
        3,
        _keyframe,
        _Scalars.of(id=Int64, reference=Int64, stamp_ns=Int64, follows=Int64, up_sigma=float),
        (
            _pose("T_ref_body"),
            _Array("cov", "<f8", (6, 6)),
            _pose("T_odom_body"),
            _Array("up", "<f8", (3,)),
            _Array("view.uv", "<f4", (None, 2)),
            _Array("view.points", "<f4", (None, 3)),
            _Array("view.descriptors", "|u1", (None, DESCRIPTOR_BYTES)),
        ),
    ),
    m.Evaluation: _Layout(
        4, m.Evaluation, _Scalars.of(keyframe=Int64, delay_ms=float, error_cm=float | None)
    ),
    m.Ping: _Layout(5, m.Ping, _Scalars.of(sequence=Int64, sent_ns=Int64)),
    m.Bye: _Layout(6, m.Bye),
    Frame: _Layout(
        7,
        _frame,
        _Scalars.of(stamp_ns=Int64, index=Int64, gap_ns=Int64),
        (
            _image("image0"),
            _image("image1", optional=True),
            _image("depth", "<f4", optional=True),
            _samples("imu.stamps_ns", "<i8"),
            _samples("imu.gyro", "<f8", 3),
            _samples("imu.accel", "<f8", 3),
        ),
    ),
    m.Status: _Layout(8, m.Status, _Scalars.of(state=TrackState, pose_age_ms=float, reason=Reason)),
    m.Welcome: _Layout(16, m.Welcome, _Scalars.of(session=Int64, next_keyframe=Int64)),
    m.Refused: _Layout(17, m.Refused, _Scalars.of(reason=Text)),
    m.Ack: _Layout(18, m.Ack, _Scalars.of(next_keyframe=Int64, held=Ids)),
    Correction: _Layout(
        19,
        Correction,
        _Scalars.of(map_id=MapId, revision=Int64, about=Int64, answers=Int64),
        (_pose("T_map_odom"), _Array("cov", "<f8", (6, 6))),
    ),
    m.Rate: _Layout(20, m.Rate, _Scalars.of(hz=float)),
    m.Pong: _Layout(
        21,
        m.Pong,
        _Scalars.of(sequence=Int64, sent_ns=Int64, received_ns=Int64, replied_ns=Int64, session=Int64),
    ),
    m.Tracked: _Layout(
        22,
        m.Tracked,
        _Scalars.of(
            index=Int64,
            stamp_ns=Int64,
            state=TrackState,
            keyframe=bool,
            new_stretch=bool,
            sound=bool,
            waits=Wait | None,
        ),
        (_pose("T_odom_body", optional=True),),
    ),
}
_BY_CODE = {layout.code: (cls, layout) for cls, layout in _LAYOUTS.items()}
FROZEN = (m.Ping, m.Pong, m.Refused)  # the same in all versions, so that two of them can tell each other

# Everything that msgspec, numpy and the validation of our own types raise on bad bytes.
_BAD = (msgspec.MsgspecError, ValueError, OverflowError, RecursionError)


def encode(message: m.Message, version: int | None = None) -> list[Bytes]:
    """Frames of a message; array frames are views on its (read-only) arrays. version: ours, or another one
    for a message of FROZEN.

    Raises WireError if a field does not fit the wire, so that what is sent can always be decoded.
    """
    version = VERSION if version is None else version
    assert version == VERSION or isinstance(message, FROZEN)
    layout = _LAYOUTS[type(message)]
    arrays = [spec.get(message) for spec in layout.arrays]
    table = [(spec.dtype, array.shape) for spec, array in zip(layout.arrays, arrays, strict=True)]
    try:
        scalars = msgspec.Raw(layout.scalars.encode(message))
    except _BAD as error:
        raise _wire_error(type(message).__name__, error) from None
    header = _encoder.encode((version, layout.code, scalars, table))
    return [header, *(array.data.cast("B") if array.size else b"" for array in arrays)]


def decode(frames: Sequence[Bytes], versions: Sequence[int] = (VERSION,)) -> m.Message:
    """The message in `frames`; its arrays may be read-only views on them. versions: for what was kept, those
    in which its kind has not changed. Raises WireError only, VersionError for any other version."""
    if not frames:
        raise WireError("empty message")
    if memoryview(frames[0]).nbytes > MAX_HEADER_BYTES:
        raise WireError(f"header of {memoryview(frames[0]).nbytes} bytes, at most {MAX_HEADER_BYTES}")
    try:
        _check_version(_read_head(frames[0]), versions)
        header = _read_header(frames[0])
    except _BAD as error:
        raise _wire_error("header", error) from None
    cls, layout = _BY_CODE.get(header.code, (None, None))
    if cls is None or layout is None:
        raise WireError(f"unknown message type {header.code}")
    try:
        return layout.build(**layout.scalars.decode(header.scalars), **_arrays(layout, header, frames))
    except _BAD as error:
        raise _wire_error(cls.__name__, error) from None


def size(frames: Sequence[Bytes]) -> int:
    """Bytes of a message, without what the transport adds (ZMTP: 2 or 9 bytes a frame)."""
    return sum([memoryview(frame).nbytes for frame in frames])


# A peer's own text in an error, as repr quotes it: of any length, its end would be cut off with the line's.
_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""")
_MOST_QUOTED = 40  # characters


def _cut(found: re.Match[str]) -> str:
    text = found[0]
    return text if len(text) <= _MOST_QUOTED + 2 else f"{text[:_MOST_QUOTED]}…{text[0]}"


def _wire_error(where: str, error: Exception) -> WireError:
    """One short printable line: what of `error` is the peer's own text is cut, and quoted so that its end is
    seen."""
    told = _QUOTED.sub(_cut, str(error))
    line = "".join(c if c.isprintable() else "?" for c in f"{where}: {told}")
    return WireError(line[:200])


def _check_version(head: _Head, versions: Sequence[int]) -> None:
    if head.version not in versions:
        raise VersionError(head.version, head.code if isinstance(head.code, int) else None, VERSION)


def code_of(kind: type[m.Message]) -> int:
    """By which a header says that its message is of this kind."""
    return _LAYOUTS[kind].code


def _arrays(layout: _Layout, header: _Header, frames: Sequence[Bytes]) -> dict[str, NDArray[Any] | None]:
    if not len(header.arrays) == len(layout.arrays) == len(frames) - 1:
        raise ValueError(
            f"{len(frames) - 1} array frames, {len(header.arrays)} declared, {len(layout.arrays)} expected"
        )
    return {
        spec.name: spec.decode(dtype, shape, frame)
        for spec, (dtype, shape), frame in zip(layout.arrays, header.arrays, frames[1:], strict=True)
    }
