"""Encode messages to byte frames and decode them; the layout is in docs/lookup/wire.md.

The first frame is a small msgpack header: wire version, message code, scalar fields, and dtype and shape of
each array. Each array follows in its own frame, little-endian, C order, not copied. A declared size is
compared with the bytes received before anything is allocated.
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
    MAX_ACCEL_M_S2,
    MAX_GYRO_RAD_S,
    MAX_KEYPOINTS,
    MAX_MAP_ID_LENGTH,
    MAX_NAME_LENGTH,
    MAX_STAMP_NS,
    AgentKind,
    Correction,
    Frame,
    ImuBatch,
    Keyframe,
    TrackState,
    View,
    WaitReason,
    checked_id,
    checked_stamp,
)
from share.wire import messages as m

WIRE_VERSION = 5
OLDEST_VERSION = 2  # the STABLE_MESSAGES have not changed since
MAX_HEADER_BYTES = 4096
MAX_ARRAYS = 8
MAX_FRAME_BYTES = MAX_KEYPOINTS * DESCRIPTOR_BYTES  # largest array of all messages but Frame
MAX_IMAGE_BYTES = 4 * 1920 * 1200  # largest array of a Frame: a depth image

Bytes = bytes | memoryview
Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Ids = Annotated[tuple[Int64, ...], Meta(max_length=m.MAX_BUFFERED)]
Text = Annotated[str, Meta(max_length=m.MAX_TEXT_LENGTH)]
Reason = Annotated[str, Meta(max_length=m.MAX_REASON_LENGTH)]
Name = Annotated[str, Meta(max_length=MAX_NAME_LENGTH)]
MapId = Annotated[str, Meta(max_length=MAX_MAP_ID_LENGTH)]

_DTYPES = {code: np.dtype(code) for code in ("<f8", "<f4", "<i8", "|u1")}


class _VersionHeader(msgspec.Struct, array_like=True):
    """The start of a header, the same in all versions."""

    version: int
    code: Any = None


class _Header(msgspec.Struct, array_like=True):
    version: int
    code: int
    scalars: msgspec.Raw
    arrays: tuple[tuple[str, tuple[int, ...]], ...]


_encoder = msgspec.msgpack.Encoder(enc_hook=lambda scalar: scalar.item())  # numpy scalars
_decode_version = msgspec.msgpack.Decoder(_VersionHeader).decode
_decode_header = msgspec.msgpack.Decoder(_Header).decode


@dataclass(frozen=True)
class _ScalarFields:
    """Scalar fields by attribute path, checked both when encoding and when decoding."""

    names: tuple[str, ...]
    getters: tuple[Callable[[object], Any], ...]
    decoder: msgspec.msgpack.Decoder[Any]

    @staticmethod
    def from_fields(**fields: Any) -> _ScalarFields:
        decoder = msgspec.msgpack.Decoder(tuple[tuple(fields.values())])  # type: ignore[misc]
        return _ScalarFields(tuple(map(_field_name, fields)), tuple(map(attrgetter, fields)), decoder)

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
class _ArrayField:
    """One array field. None in the shape: any length up to `max_length`. An absent optional array has the
    shape (0,)."""

    path: str
    dtype: str
    shape: tuple[int | None, ...]
    optional: bool = False
    max_length: int = MAX_KEYPOINTS

    @cached_property
    def name(self) -> str:
        return _field_name(self.path)

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
        if dtype != self.dtype or not self._is_valid_shape(shape):
            raise ValueError(f"{self.path}: {dtype} of shape {shape[:4]}, expected {self.dtype} {self.shape}")
        size = prod(shape) * _DTYPES[dtype].itemsize
        if size > MAX_IMAGE_BYTES:
            raise ValueError(f"{self.path}: {size} bytes, at most {MAX_IMAGE_BYTES}")
        data = memoryview(frame)
        if data.nbytes != size:
            raise ValueError(f"{self.path}: {data.nbytes} bytes, its shape needs {size}")
        if not size:
            return None if self._is_absent(shape) else np.empty(shape, _DTYPES[dtype])
        # copied only if unaligned, as short frames are in their message
        array = np.frombuffer(data, _DTYPES[dtype]).reshape(shape)
        return array if array.flags.aligned else array.copy()

    def _is_valid_shape(self, shape: tuple[int, ...]) -> bool:
        return shape == self.shape or self._is_absent(shape) or self._shape_matches(shape)

    def _shape_matches(self, shape: tuple[int, ...]) -> bool:
        return len(shape) == len(self.shape) and all(
            0 <= have <= self.max_length if want is None else have == want
            for want, have in zip(self.shape, shape, strict=True)
        )

    def _is_absent(self, shape: tuple[int, ...]) -> bool:
        return self.optional and shape == (0,)


def _image_field(path: str, dtype: str = "|u1", optional: bool = False) -> _ArrayField:
    return _ArrayField(path, dtype, (None, None), optional, m.MAX_IMAGE_SIDE)


def _imu_field(path: str, dtype: str, *shape: int) -> _ArrayField:
    return _ArrayField(path, dtype, (None, *shape), max_length=m.MAX_IMU_SAMPLES)


def _build_frame(*, stamps_ns: I64, gyro: F64, accel: F64, **fields: Any) -> Frame:
    checked_id("index", fields["index"])
    for name in ("stamp_ns", "gap_ns"):
        checked_stamp(name, fields[name])
    if len(stamps_ns) and not -MAX_STAMP_NS <= stamps_ns.min() <= stamps_ns.max() <= MAX_STAMP_NS:
        raise ValueError(f"stamps_ns: outside ±{MAX_STAMP_NS}")
    imu = ImuBatch(stamps_ns, gyro, accel)
    if not (stamps_ns[1:] > stamps_ns[:-1]).all():
        raise ValueError("stamps_ns: not strictly increasing")
    for name, samples, limit in (("gyro", gyro, MAX_GYRO_RAD_S), ("accel", accel, MAX_ACCEL_M_S2)):
        if np.abs(samples).max(initial=0.0) > limit:
            raise ValueError(f"{name}: values beyond {limit:g}, the limit of any IMU")
    depth: F32 | None = fields["depth"]
    if depth is not None and not (np.isfinite(depth) & (depth >= 0)).all():
        raise ValueError("depth: negative or non-finite values")
    return Frame(**fields, imu=imu)


@dataclass(frozen=True)
class _Layout:
    """Layout of one message type on the wire."""

    code: int
    build: Callable[..., m.Message]
    scalars: _ScalarFields = field(default_factory=lambda: _ScalarFields.from_fields())
    arrays: tuple[_ArrayField, ...] = ()


def _field_name(path: str) -> str:
    return path.rpartition(".")[2]


def _pose_field(path: str, optional: bool = False) -> _ArrayField:
    return _ArrayField(path, "<f8", (4, 4), optional)


def _build_hello(*, name: str, kind: AgentKind, run_id: int, streams_frames: bool, **rig: Any) -> m.Hello:
    return m.Hello(name, kind, run_id, Rig(**rig), streams_frames)


def _build_keyframe(*, uv: Any, points: Any, descriptors: Any, **fields: Any) -> Keyframe:
    return Keyframe(**fields, view=View(uv, points, descriptors))


_RIG_FIELDS: dict[str, Any] = {  # sent as maps by field name, checked by their types
    "rig.cam0": Camera,
    "rig.cam1": Camera | None,
    "rig.depth": Camera | None,
    "rig.imu": ImuNoise | None,
    "rig.timeshift_s": float,
}
_LAYOUTS: dict[type, _Layout] = {
    m.Hello: _Layout(
        1,
        _build_hello,
        _ScalarFields.from_fields(
            name=Name, kind=AgentKind, run_id=Int64, streams_frames=bool, **_RIG_FIELDS
        ),
        (
            _pose_field("rig.T_body_cam0"),
            _pose_field("rig.T_cam1_cam0", optional=True),
            _pose_field("rig.T_depth_cam0", optional=True),
        ),
    ),
    m.PoseUpdate: _Layout(
        2,
        m.PoseUpdate,
        _ScalarFields.from_fields(stamp_ns=Int64, state=TrackState, keyframe=Int64),
        (_pose_field("T_keyframe_body"),),
    ),
    Keyframe: _Layout(
        3,
        _build_keyframe,
        _ScalarFields.from_fields(
            id=Int64, reference=Int64, stamp_ns=Int64, predecessor=Int64, up_sigma=float
        ),
        (
            _pose_field("T_ref_body"),
            _ArrayField("cov", "<f8", (6, 6)),
            _pose_field("T_odom_body"),
            _ArrayField("up", "<f8", (3,)),
            _ArrayField("view.uv", "<f4", (None, 2)),
            _ArrayField("view.points", "<f4", (None, 3)),
            _ArrayField("view.descriptors", "|u1", (None, DESCRIPTOR_BYTES)),
        ),
    ),
    m.Evaluation: _Layout(
        4, m.Evaluation, _ScalarFields.from_fields(keyframe=Int64, delay_ms=float, error_cm=float | None)
    ),
    m.Ping: _Layout(5, m.Ping, _ScalarFields.from_fields(sequence=Int64, sent_ns=Int64)),
    m.Bye: _Layout(6, m.Bye),
    Frame: _Layout(
        7,
        _build_frame,
        _ScalarFields.from_fields(stamp_ns=Int64, index=Int64, gap_ns=Int64),
        (
            _image_field("image0"),
            _image_field("image1", optional=True),
            _image_field("depth", "<f4", optional=True),
            _imu_field("imu.stamps_ns", "<i8"),
            _imu_field("imu.gyro", "<f8", 3),
            _imu_field("imu.accel", "<f8", 3),
        ),
    ),
    m.Status: _Layout(
        8, m.Status, _ScalarFields.from_fields(state=TrackState, pose_age_ms=float, reason=Reason)
    ),
    m.Welcome: _Layout(16, m.Welcome, _ScalarFields.from_fields(session=Int64, next_keyframe=Int64)),
    m.Refused: _Layout(17, m.Refused, _ScalarFields.from_fields(reason=Text)),
    m.Ack: _Layout(18, m.Ack, _ScalarFields.from_fields(next_keyframe=Int64, buffered=Ids)),
    Correction: _Layout(
        19,
        Correction,
        _ScalarFields.from_fields(
            map_id=MapId, revision=Int64, segment_keyframe=Int64, answered_keyframe=Int64
        ),
        (_pose_field("T_map_odom"), _ArrayField("cov", "<f8", (6, 6))),
    ),
    m.Rate: _Layout(20, m.Rate, _ScalarFields.from_fields(hz=float)),
    m.Pong: _Layout(
        21,
        m.Pong,
        _ScalarFields.from_fields(
            sequence=Int64, sent_ns=Int64, received_ns=Int64, replied_ns=Int64, session=Int64
        ),
    ),
    m.RemoteTrackingResult: _Layout(
        22,
        m.RemoteTrackingResult,
        _ScalarFields.from_fields(
            index=Int64,
            stamp_ns=Int64,
            state=TrackState,
            is_keyframe=bool,
            new_segment=bool,
            is_consistent=bool,
            waiting_for=WaitReason | None,
        ),
        (_pose_field("T_odom_body", optional=True),),
    ),
}
_LAYOUT_BY_CODE = {layout.code: (cls, layout) for cls, layout in _LAYOUTS.items()}
STABLE_MESSAGES = (m.Ping, m.Pong, m.Refused)  # the same since OLDEST_VERSION: peers find a mismatch by them

# All that msgspec, numpy and our own validation raise on bad bytes.
_DECODE_ERRORS = (msgspec.MsgspecError, ValueError, OverflowError, RecursionError)


def encode(message: m.Message, version: int | None = None) -> list[Bytes]:
    """Return the frames of a message; array frames are views of its (read-only) arrays.

    version: another than ours only for STABLE_MESSAGES. Raises WireError if a field does not fit the wire, so
    every sent message can be decoded.
    """
    version = WIRE_VERSION if version is None else version
    assert version == WIRE_VERSION or isinstance(message, STABLE_MESSAGES)
    layout = _LAYOUTS[type(message)]
    arrays = [spec.get(message) for spec in layout.arrays]
    table = [(spec.dtype, array.shape) for spec, array in zip(layout.arrays, arrays, strict=True)]
    try:
        scalars = msgspec.Raw(layout.scalars.encode(message))
    except _DECODE_ERRORS as error:
        raise _wire_error(type(message).__name__, error) from None
    header = _encoder.encode((version, layout.code, scalars, table))
    return [header, *(array.data.cast("B") if array.size else b"" for array in arrays)]


def decode(frames: Sequence[Bytes], versions: Sequence[int] = (WIRE_VERSION,)) -> m.Message:
    """Return the message in `frames`; its arrays may be read-only views of them.

    versions: accepted ones; stored messages may have several. Raises VersionError for others, else WireError.
    """
    if not frames:
        raise WireError("empty message")
    if memoryview(frames[0]).nbytes > MAX_HEADER_BYTES:
        raise WireError(f"header of {memoryview(frames[0]).nbytes} bytes, at most {MAX_HEADER_BYTES}")
    try:
        _check_version(_decode_version(frames[0]), versions)
        header = _decode_header(frames[0])
    except _DECODE_ERRORS as error:
        raise _wire_error("header", error) from None
    cls, layout = _LAYOUT_BY_CODE.get(header.code, (None, None))
    if cls is None or layout is None:
        raise WireError(f"unknown message type {header.code}")
    try:
        return layout.build(**layout.scalars.decode(header.scalars), **_decode_arrays(layout, header, frames))
    except _DECODE_ERRORS as error:
        raise _wire_error(cls.__name__, error) from None


def message_bytes(frames: Sequence[Bytes]) -> int:
    """Return the size of a message without the transport's overhead (ZMTP: 2 or 9 bytes a frame)."""
    return sum([memoryview(frame).nbytes for frame in frames])


# A peer's text in an error, as repr quotes it. It may have any length, so it is cut before the line is.
_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""")
_MAX_QUOTED = 40  # characters


def _shorten_quote(match: re.Match[str]) -> str:
    text = match[0]
    return text if len(text) <= _MAX_QUOTED + 2 else f"{text[:_MAX_QUOTED]}…{text[0]}"


def _wire_error(where: str, error: Exception) -> WireError:
    """Return a WireError of one short printable line; quotes of the peer's text are cut but stay closed."""
    text = _QUOTED.sub(_shorten_quote, str(error))
    line = "".join(c if c.isprintable() else "?" for c in f"{where}: {text}")
    return WireError(line[:200])


def _check_version(header: _VersionHeader, versions: Sequence[int]) -> None:
    if header.version not in versions:
        raise VersionError(
            header.version, header.code if isinstance(header.code, int) else None, WIRE_VERSION
        )


def message_code(message_type: type[m.Message]) -> int:
    """Return the code of a message type in headers."""
    return _LAYOUTS[message_type].code


def _decode_arrays(
    layout: _Layout, header: _Header, frames: Sequence[Bytes]
) -> dict[str, NDArray[Any] | None]:
    if not len(header.arrays) == len(layout.arrays) == len(frames) - 1:
        raise ValueError(
            f"{len(frames) - 1} array frames, {len(header.arrays)} declared, {len(layout.arrays)} expected"
        )
    return {
        spec.name: spec.decode(dtype, shape, frame)
        for spec, (dtype, shape), frame in zip(layout.arrays, header.arrays, frames[1:], strict=True)
    }
