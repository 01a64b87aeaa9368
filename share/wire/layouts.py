"""The layout of each message: its code, the types of its scalars, dtype and shape of its arrays.

Bytes are checked against a layout both when a message is encoded and when it is decoded. The tables in
docs/lookup/wire.md say the same for people.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite, prod
from operator import attrgetter
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from share.checks import MAX_MAP_ID_LENGTH, MAX_STAMP_NS, checked_id, checked_stamp
from share.earlier_poses import MAX_SPANS, EarlierPoses
from share.geometry.camera import Camera, ImuNoise, Rig
from share.types import (
    DESCRIPTOR_BYTES,
    F32,
    F64,
    I64,
    MAX_ACCEL_M_S2,
    MAX_GYRO_RAD_S,
    MAX_JPEG_BYTES,
    MAX_KEYPOINTS,
    MAX_NAME_LENGTH,
    MAX_SURFACES,
    AgentKind,
    Correction,
    Frame,
    ImuBatch,
    Keyframe,
    KeyframeImage,
    TrackState,
    View,
    WaitReason,
)
from share.wire import messages as m
from share.wire import room_messages as r

MAX_ARRAYS = 16
MAX_FRAME_BYTES = max(MAX_KEYPOINTS * DESCRIPTOR_BYTES, MAX_JPEG_BYTES)  # of all messages but Frame
MAX_IMAGE_BYTES = 4 * 1920 * 1200  # largest array of a Frame: a depth image

Bytes = bytes | memoryview
Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Ids = Annotated[tuple[Int64, ...], Meta(max_length=m.MAX_BUFFERED)]
Text = Annotated[str, Meta(max_length=m.MAX_TEXT_LENGTH)]
Reason = Annotated[str, Meta(max_length=m.MAX_REASON_LENGTH)]
Name = Annotated[str, Meta(max_length=MAX_NAME_LENGTH)]
MapId = Annotated[str, Meta(max_length=MAX_MAP_ID_LENGTH)]
Answer = Annotated[str, Meta(max_length=r.MAX_ANSWER_LENGTH)]
Listed = Annotated[tuple[Int64, ...], Meta(max_length=r.MAX_LISTED)]

_DTYPES = {code: np.dtype(code) for code in ("<f8", "<f4", "<i8", "|u1")}

encode_plain = msgspec.msgpack.Encoder(enc_hook=lambda scalar: scalar.item()).encode  # numpy scalars too


class Header(msgspec.Struct, array_like=True):
    """The first frame of a message. arrays: dtype and shape of each."""

    version: int
    code: int
    scalars: msgspec.Raw
    arrays: tuple[tuple[str, tuple[int, ...]], ...]


def _field_name(path: str) -> str:
    return path.rpartition(".")[2]


@dataclass(frozen=True)
class ArrayField:
    """One array of a message, by its attribute path. None in the shape: any length up to `max_length`. An
    absent optional array has the shape (0,)."""

    path: str
    dtype: str
    shape: tuple[int | None, ...]
    optional: bool = False
    max_length: int = MAX_KEYPOINTS
    key: str = ""  # the name by which `build` takes it; by default that of the attribute

    @cached_property
    def name(self) -> str:
        return self.key or _field_name(self.path)

    @cached_property
    def _getter(self) -> Callable[[object], Any]:
        return attrgetter(self.path)

    def get(self, message: object) -> NDArray[Any]:
        value = self._getter(message)
        absent = self.optional and value is None
        return np.ascontiguousarray(() if absent else value, _DTYPES[self.dtype])

    def decode(self, dtype: str, shape: tuple[int, ...], frame: Bytes) -> NDArray[Any] | None:
        absent = self.optional and shape == (0,)
        if dtype != self.dtype or not (absent or self._matches(shape)):
            expected = f"expected {self.dtype} {self.shape}"
            raise ValueError(f"{self.path}: {dtype[:8]} of shape {shape[:4]}, {expected}")
        size = prod(shape) * _DTYPES[dtype].itemsize
        if size > MAX_IMAGE_BYTES:
            raise ValueError(f"{self.path}: {size} bytes, at most {MAX_IMAGE_BYTES}")
        data = memoryview(frame)
        if data.nbytes != size:
            raise ValueError(f"{self.path}: {data.nbytes} bytes, its shape needs {size}")
        if not size:
            return None if absent else np.empty(shape, _DTYPES[dtype])
        # copied only if unaligned, as short frames are in their message
        array = np.frombuffer(data, _DTYPES[dtype]).reshape(shape)
        return array if array.flags.aligned else array.copy()

    def _matches(self, shape: tuple[int, ...]) -> bool:
        return len(shape) == len(self.shape) and all(
            0 <= have <= self.max_length if want is None else have == want
            for want, have in zip(self.shape, shape, strict=True)
        )


class MessageLayout:
    """Layout of one message type. scalars: types by attribute path, checked both when encoding and when
    decoding. build: makes the message of all its fields by name."""

    def __init__(
        self, code: int, build: Callable[..., m.Message], *arrays: ArrayField, **scalars: Any
    ) -> None:
        self.code, self.build, self.arrays = code, build, arrays
        self._names, self._getters = tuple(map(_field_name, scalars)), tuple(map(attrgetter, scalars))
        self._decoder = msgspec.msgpack.Decoder(tuple[tuple(scalars.values())])  # type: ignore[misc]

    def encode_scalars(self, message: object) -> msgspec.Raw:
        raw = encode_plain([get(message) for get in self._getters])
        self.decode_scalars(raw)
        return msgspec.Raw(raw)

    def decode_scalars(self, raw: msgspec.Raw | bytes) -> dict[str, Any]:
        values = self._decoder.decode(raw)
        for value in values:
            if isinstance(value, float) and not isfinite(value):
                raise ValueError("a number is not finite")
        return dict(zip(self._names, values, strict=True))

    def decode_arrays(self, header: Header, frames: Sequence[Bytes]) -> dict[str, NDArray[Any] | None]:
        received, declared, expected = len(frames) - 1, len(header.arrays), len(self.arrays)
        if not received == declared == expected:
            raise ValueError(f"{received} array frames, {declared} declared, {expected} expected")
        return {
            array.name: array.decode(dtype, shape, frame)
            for array, (dtype, shape), frame in zip(self.arrays, header.arrays, frames[1:], strict=True)
        }


def _pose(path: str, optional: bool = False) -> ArrayField:
    return ArrayField(path, "<f8", (4, 4), optional)


def _image(path: str, dtype: str = "|u1", optional: bool = False) -> ArrayField:
    return ArrayField(path, dtype, (None, None), optional, m.MAX_IMAGE_SIDE)


def _imu(path: str, dtype: str, *shape: int) -> ArrayField:
    return ArrayField(path, dtype, (None, *shape), max_length=m.MAX_IMU_SAMPLES)


def _build_hello(*, name: str, kind: AgentKind, run_id: int, streams_frames: bool, **rig: Any) -> m.Hello:
    return m.Hello(name, kind, run_id, Rig(**rig), streams_frames)


def _build_keyframe(
    *,
    uv: Any,
    points: Any,
    descriptors: Any,
    jpeg: Any,
    feature_uv: Any,
    plane: Any,
    rho_sigma: Any,
    ids: Any,
    T_earlier_body: Any,
    earlier_cov: Any,
    **fields: Any,
) -> Keyframe:
    image = KeyframeImage(jpeg, feature_uv, plane, rho_sigma)
    earlier = EarlierPoses(ids, T_earlier_body, earlier_cov)
    return Keyframe(**fields, view=View(uv, points, descriptors), image=image, earlier=earlier)


def _build_keyframe_without_image(*, uv: Any, points: Any, descriptors: Any, **fields: Any) -> Keyframe:
    return Keyframe(**fields, view=View(uv, points, descriptors))


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


_RIG: dict[str, Any] = {  # sent as maps by field name, checked by their types
    "rig.cam0": Camera,
    "rig.cam1": Camera | None,
    "rig.depth": Camera | None,
    "rig.imu": ImuNoise | None,
    "rig.timeshift_s": float,
}
_KEYFRAME_ARRAYS = (
    _pose("T_ref_body"),
    ArrayField("cov", "<f8", (6, 6)),
    _pose("T_odom_body"),
    ArrayField("up", "<f8", (3,)),
    ArrayField("view.uv", "<f4", (None, 2)),
    ArrayField("view.points", "<f4", (None, 3)),
    ArrayField("view.descriptors", "|u1", (None, DESCRIPTOR_BYTES)),
)
_KEYFRAME_SCALARS: dict[str, Any] = {
    "id": Int64,
    "reference": Int64,
    "stamp_ns": Int64,
    "predecessor": Int64,
    "up_sigma": float,
}
LAYOUTS: dict[type, MessageLayout] = {
    m.Hello: MessageLayout(
        1,
        _build_hello,
        _pose("rig.T_body_cam0"),
        _pose("rig.T_cam1_cam0", optional=True),
        _pose("rig.T_depth_cam0", optional=True),
        **{"name": Name, "kind": AgentKind, "run_id": Int64, "streams_frames": bool} | _RIG,
    ),
    m.PoseUpdate: MessageLayout(
        2,
        m.PoseUpdate,
        _pose("T_keyframe_body"),
        stamp_ns=Int64,
        state=TrackState,
        keyframe=Int64,
        age_ms=float,
        sigma_m=float | None,
        sigma_rad=float | None,
    ),
    Keyframe: MessageLayout(
        3,
        _build_keyframe,
        *_KEYFRAME_ARRAYS,
        ArrayField("image.jpeg", "|u1", (None,), max_length=MAX_JPEG_BYTES),
        ArrayField("image.uv", "<f4", (None, 2), max_length=MAX_SURFACES, key="feature_uv"),
        ArrayField("image.plane", "<f4", (None, 3), max_length=MAX_SURFACES),
        ArrayField("image.rho_sigma", "<f4", (None,), max_length=MAX_SURFACES),
        ArrayField("earlier.ids", "<i8", (None,), max_length=MAX_SPANS),
        ArrayField("earlier.T_earlier_body", "<f4", (None, 4, 4), max_length=MAX_SPANS),
        ArrayField("earlier.cov", "<f4", (None, 6, 6), max_length=MAX_SPANS, key="earlier_cov"),
        **_KEYFRAME_SCALARS,
    ),
    m.Evaluation: MessageLayout(
        4,
        m.Evaluation,
        keyframe=Int64,
        delay_ms=float,
        error_cm=float | None,
        track_ms=float,
        rtt_ms=float,
        ack_ms=float,
        drift_cm=float,
    ),
    m.Ping: MessageLayout(5, m.Ping, sequence=Int64, sent_ns=Int64),
    m.Bye: MessageLayout(6, m.Bye),
    Frame: MessageLayout(
        7,
        _build_frame,
        _image("image0"),
        _image("image1", optional=True),
        _image("depth", "<f4", optional=True),
        _imu("imu.stamps_ns", "<i8"),
        _imu("imu.gyro", "<f8", 3),
        _imu("imu.accel", "<f8", 3),
        stamp_ns=Int64,
        index=Int64,
        gap_ns=Int64,
    ),
    m.Status: MessageLayout(
        8,
        m.Status,
        state=TrackState,
        pose_age_ms=float,
        reason=Reason,
        unacknowledged_ms=float,
        clock_error_ms=float | None,
    ),
    m.Welcome: MessageLayout(16, m.Welcome, session=Int64, next_keyframe=Int64, hold_ms=float),
    m.Refused: MessageLayout(17, m.Refused, reason=Text),
    m.Ack: MessageLayout(18, m.Ack, next_keyframe=Int64, buffered=Ids),
    Correction: MessageLayout(
        19,
        Correction,
        _pose("T_map_odom"),
        ArrayField("cov", "<f8", (6, 6)),
        map_id=MapId,
        revision=Int64,
        segment_keyframe=Int64,
        answered_keyframe=Int64,
    ),
    m.Rate: MessageLayout(
        20, m.Rate, hz=float, is_windowed=bool, pose_hz=float | None, jpeg_quality=int | None
    ),
    m.Pong: MessageLayout(
        21, m.Pong, sequence=Int64, sent_ns=Int64, received_ns=Int64, replied_ns=Int64, session=Int64
    ),
    m.RemoteTrackingResult: MessageLayout(
        22,
        m.RemoteTrackingResult,
        _pose("T_odom_body", optional=True),
        index=Int64,
        stamp_ns=Int64,
        state=TrackState,
        is_keyframe=bool,
        new_segment=bool,
        is_consistent=bool,
        waiting_for=WaitReason | None,
    ),
}
_PARTIES: dict[str, Any] = {"command": Int64, "robot": Name | None, "commander": Name}
_PLACE: dict[str, Any] = {"map_id": MapId | None, "x": float, "y": float}
LAYOUTS |= {  # of clients: docs/lookup/wire.md#clients
    r.ClientHello: MessageLayout(
        32, r.ClientHello, name=Name, run_id=Int64, drives_robot=bool, wants_objects=bool, wants_robots=bool
    ),
    r.PutObject: MessageLayout(
        33,
        r.PutObject,
        _pose("T_map_object"),
        request=Int64,
        object_id=Int64,
        kind=r.ObjectKind,
        map_id=MapId | None,
    ),
    r.RemoveObject: MessageLayout(34, r.RemoveObject, request=Int64, object_id=Int64),
    r.ObjectsSeen: MessageLayout(35, r.ObjectsSeen, session=Int64, revision=Int64),
    r.Goto: MessageLayout(36, r.Goto, **_PARTIES, **_PLACE, yaw=float | None, has_begun=bool),
    r.Cancel: MessageLayout(37, r.Cancel, **_PARTIES),
    r.CommandState: MessageLayout(
        38, r.CommandState, **_PARTIES, text=Answer, is_final=bool, is_reached=bool
    ),
    r.RobotPlace: MessageLayout(39, r.RobotPlace, robot=Name | None, **_PLACE, yaw=float, text=Answer),
    r.Receipt: MessageLayout(48, r.Receipt, request=Int64, reason=Answer),
    r.RoomObject: MessageLayout(
        49,
        r.RoomObject,
        _pose("T_map_object"),
        session=Int64,
        revision=Int64,
        object_id=Int64,
        kind=r.ObjectKind,
        owner=Name,
        map_id=MapId,
        removed=Answer,
    ),
    r.ObjectList: MessageLayout(
        50, r.ObjectList, session=Int64, revision=Int64, ids=Listed, revisions=Listed
    ),
}
MESSAGE_CODES = {message_type: layout.code for message_type, layout in LAYOUTS.items()}
MESSAGE_TYPES = {code: message_type for message_type, code in MESSAGE_CODES.items()}
KEYFRAME_WITHOUT_IMAGE = MessageLayout(
    3, _build_keyframe_without_image, *_KEYFRAME_ARRAYS, **_KEYFRAME_SCALARS
)
