"""Frozen value types used by all layers. Frames and units: docs/understand/architecture.md.

Arrays are checked for shape and dtype and made read-only on construction, so a value can be handed to
another thread without a copy. Poses are 4x4 matrices `T_a_b` with p_a = T_a_b p_b; covariances are 6x6 over
(rotation [rad], translation [m]), perturbed on the right: T = T_mean Exp(xi) (see `share.geometry.se3`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

DESCRIPTOR_BYTES = 32  # ORB: 256 bits

# Limits, checked on construction so that no computation overflows; no real room or sensor comes near them.
MAX_KEYPOINTS = 2000  # per keyframe
MAX_NAME_LENGTH = 64  # characters, of an agent's name
MAX_MAP_ID_LENGTH = MAX_NAME_LENGTH + 32  # a run key has up to 17 characters more, a segment number up to 11
MAX_POSITION_M = 1e5  # m, of a position or a landmark
MAX_ODOM_M = 1e4  # m from the odometry origin; map poses, composed of several, stay below MAX_POSITION_M
MAX_UV = 1e3  # normalised image coordinates: 89.9 degrees off the axis
MAX_ID = 2**31 - 1  # of keyframes, frames and revisions: 13 years at 5 Hz
MAX_GYRO_RAD_S = 1e3  # twenty times the range of the widest common gyroscope
MAX_ACCEL_M_S2 = 1e4  # twenty times that of the widest common accelerometer
MAX_SIGMA = 1e6  # of any quantity, in its unit
MAX_STAMP_NS = 2**62  # either side of 0: 146 years; differences fit 64 bits


class AgentKind(StrEnum):
    """Kind of agent: a headset (AR; its wearer notices 20 ms of lag) or a robot."""

    AR = "ar"
    ROBOT = "robot"


class TrackState(StrEnum):
    """State of an agent's tracking. All but INITIALISING and LOST have a pose."""

    INITIALISING = "INITIALISING"
    OK = "OK"
    WEAK = "WEAK"
    LOST = "LOST"
    VISION_ONLY = "VISION_ONLY"
    INERTIAL_ONLY = "INERTIAL_ONLY"

    @property
    def has_pose(self) -> bool:
        return self not in (TrackState.INITIALISING, TrackState.LOST)


class WaitReason(StrEnum):
    """What a tracker needs before its first pose."""

    IMU = "imu"
    VIEW = "view"
    TILT = "tilt"
    SPEED = "speed"
    SCALE = "scale"

    @property
    def text(self) -> str:
        return _WAIT_TEXTS[self]


_WAIT_TEXTS = {  # for a person, after "waiting for"
    WaitReason.IMU: "the IMU's first samples",
    WaitReason.VIEW: "features in view",
    WaitReason.TILT: "the direction of gravity",
    WaitReason.SPEED: "its velocity",
    WaitReason.SCALE: "the scale: move the camera",
}


def checked_array(
    name: str, value: ArrayLike, shape: tuple[int | None, ...], dtype: DTypeLike, finite: bool = True
) -> NDArray[Any]:
    """Return `value` as a read-only array of `dtype`; None in `shape` admits any length.

    Raises ValueError naming the field if the shape differs or (unless `finite=False`) a value is
    not finite.
    """
    array = np.asarray(value, dtype)
    fits = array.shape == shape or (
        array.ndim == len(shape)
        and all(want in (None, have) for have, want in zip(array.shape, shape, strict=True))
    )
    if not fits:
        raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: has values that are not finite")
    array = array.view()
    array.flags.writeable = False
    return array


def checked_pose(name: str, value: ArrayLike, max_m: float = MAX_POSITION_M) -> F64:
    """Return `value` as a read-only rigid transform (4, 4). Raises ValueError if it is not one (tolerance
    1e-3) or its translation exceeds `max_m`."""
    T = checked_array(name, value, (4, 4), np.float64)
    rows = T.tolist()
    if not _is_rigid(*rows):
        raise ValueError(f"{name}: is not a rigid transform")
    if not max(abs(row[3]) for row in rows) <= max_m:
        raise ValueError(f"{name}: is more than {max_m:g} m away")
    return T


def checked_id(name: str, value: int, minimum: int = 0) -> int:
    """Return `value`. Raises ValueError outside `minimum` .. MAX_ID."""
    if not minimum <= value <= MAX_ID:
        raise ValueError(f"{name}: {value} is outside {minimum} .. {MAX_ID}")
    return value


def checked_stamp(name: str, value: int) -> int:
    """Return `value`, ns. Raises ValueError beyond ±MAX_STAMP_NS."""
    if abs(value) > MAX_STAMP_NS:
        raise ValueError(f"{name}: {value} ns is beyond any clock")
    return value


def checked_up(name: str, value: ArrayLike) -> F64:
    """Return `value` as a read-only unit vector (3,), or zeros if unknown. Raises ValueError (tolerance
    1e-3)."""
    up = checked_array(name, value, (3,), np.float64)
    x, y, z = up.tolist()
    if any(up) and not abs(x * x + y * y + z * z - 1) <= 1e-3:
        raise ValueError(f"{name}: is not a unit vector")
    return up


def _is_rigid(x: list[float], y: list[float], z: list[float], bottom: list[float]) -> bool:
    """Return whether the rows of T (4, 4), finite, are a rigid transform. Plain floats, which take a fraction
    of numpy's time: every pose of every message is checked."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), (p, q, r, s) = x, y, z, bottom
    return (
        # R R' = 1; squares first: once they are bounded nothing below overflows
        abs(a * a + b * b + c * c - 1) <= 1e-3
        and abs(d * d + e * e + f * f - 1) <= 1e-3
        and abs(g * g + h * h + i * i - 1) <= 1e-3
        and abs(a * d + b * e + c * f) <= 1e-3
        and abs(a * g + b * h + c * i) <= 1e-3
        and abs(d * g + e * h + f * i) <= 1e-3
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0  # det R
        and max(abs(p), abs(q), abs(r), abs(s - 1)) <= 1e-9
    )


def checked_cov(name: str, value: ArrayLike) -> F64:
    """Return `value` as a read-only covariance (6, 6). Raises ValueError unless symmetric and positive
    semidefinite: another one would stop the solver for the whole map."""
    cov = checked_array(name, value, (6, 6), np.float64)
    size = np.abs(cov).max()
    if size > 1e12 or np.abs(cov - cov.T).max() > 1e-6 * size:
        raise ValueError(f"{name}: is not symmetric, or exceeds 1e12")
    if size and np.linalg.eigvalsh(cov)[0] < -1e-9 * size:
        raise ValueError(f"{name}: has a negative variance")
    return cov


def checked_sigma(name: str, value: float) -> float:
    """Return `value` as a float. Raises ValueError if it is negative or exceeds MAX_SIGMA."""
    sigma = float(value)
    if not 0 <= sigma <= MAX_SIGMA:
        raise ValueError(f"{name}: {sigma} is outside 0 .. {MAX_SIGMA:g}")
    return sigma


def _set_fields(obj: object, **values: object) -> None:
    """Replace fields of a frozen dataclass in its __post_init__."""
    for key, value in values.items():
        object.__setattr__(obj, key, value)


@dataclass(frozen=True, eq=False)
class ImuBatch:
    """Consecutive IMU samples: stamps (N,) ns, gyro (N, 3) rad/s, accel (N, 3) m/s^2, body frame."""

    stamps_ns: I64
    gyro: F64
    accel: F64

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _set_fields(
            self,
            stamps_ns=checked_array("stamps_ns", self.stamps_ns, (n,), np.int64),
            gyro=checked_array("gyro", self.gyro, (n, 3), np.float64),
            accel=checked_array("accel", self.accel, (n, 3), np.float64),
        )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def take(self, selection: slice | I64 | NDArray[np.bool_]) -> ImuBatch:
        """Return these samples, by slice, indices or mask (N,)."""
        return ImuBatch._from_checked(self.stamps_ns[selection], self.gyro[selection], self.accel[selection])

    def concatenate(self, *others: ImuBatch) -> ImuBatch:
        """Return the samples of all batches in order."""
        columns = zip(*((part.stamps_ns, part.gyro, part.accel) for part in (self, *others)), strict=True)
        return ImuBatch._from_checked(*map(np.concatenate, columns))

    @staticmethod
    def _from_checked(stamps_ns: I64, gyro: F64, accel: F64) -> ImuBatch:
        """Return a batch of arrays that come from checked batches."""
        out = object.__new__(ImuBatch)
        for array in (stamps_ns, gyro, accel):
            array.flags.writeable = False
        _set_fields(out, stamps_ns=stamps_ns, gyro=gyro, accel=accel)
        return out

    @staticmethod
    def empty() -> ImuBatch:
        return ImuBatch(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Frame:
    """Images of all cameras at one time, and the IMU samples since the previous frame, up to the first one
    not before this frame.

    image0, image1: (H, W) uint8. depth: (Hd, Wd) float32 m in the depth camera, 0 = no reading.
    gap_ns: time since the previous frame if that is longer than the stream's rate explains, else 0.
    """

    stamp_ns: int
    index: int
    image0: U8
    image1: U8 | None = None
    depth: F32 | None = None
    imu: ImuBatch = field(default_factory=ImuBatch.empty)
    gap_ns: int = 0


@dataclass(frozen=True, eq=False)
class FeatureStatistics:
    """The features that the tracker found in cam0's image, input of the error model.

    px (N, 2) float32. inlier (N,) bool. depth (N,): m in cam0, NaN if unknown. expected: number of features
    that should have been in view. mapped: number of the tracker's landmarks with a depth.
    """

    px: F32
    inlier: NDArray[np.bool_]
    depth: F64
    expected: int
    mapped: int

    def __post_init__(self) -> None:
        n = len(self.px)
        _set_fields(
            self,
            px=checked_array("px", self.px, (n, 2), np.float32),
            inlier=checked_array("inlier", self.inlier, (n,), np.bool_),
            depth=checked_array("depth", self.depth, (n,), np.float64, finite=False),
        )


@dataclass(frozen=True, eq=False)
class View:
    """The features of a keyframe from which another agent's keyframe recognises and verifies the place.

    uv (N, 2) float32: undistorted normalised coordinates (x/z, y/z) in cam0. points (N, 3)
    float32: m, in cam0, NaN rows where depth is unknown. descriptors (N, 32) uint8: ORB.
    """

    uv: F32
    points: F32
    descriptors: U8

    def __post_init__(self) -> None:
        n = len(self.uv)
        if n > MAX_KEYPOINTS:
            raise ValueError(f"uv: {n} keypoints, at most {MAX_KEYPOINTS}")
        _set_fields(
            self,
            uv=checked_array("uv", self.uv, (n, 2), np.float32),
            points=checked_array("points", self.points, (n, 3), np.float32, finite=False),
            descriptors=checked_array("descriptors", self.descriptors, (n, DESCRIPTOR_BYTES), np.uint8),
        )
        if (np.abs(self.uv) > MAX_UV).any():
            raise ValueError(f"uv: values beyond {MAX_UV:g}")
        if (np.abs(self.points) > MAX_POSITION_M).any():  # NaN does not
            raise ValueError(f"points: more than {MAX_POSITION_M:g} m away (use NaN for unknown depth)")

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True, eq=False)
class KeyframeCandidate:
    """A keyframe that the tracker offers, before the rate decides whether it is sent.

    T_odom_body (4, 4): as published. T_previous_body (4, 4): motion since the previous candidate by the
    filter's present estimate, which may differ from that of the two published T_odom_body; for the first of a
    segment it is T_odom_body. cov (6, 6): of T_previous_body. up (3,): unit vector against gravity in the
    body frame, zeros if unknown; up_sigma: of both its angles, rad. new_segment: odometry broke before this
    keyframe. frames_ago: frames tracked since its own, while its view was extracted.
    """

    T_odom_body: F64
    T_previous_body: F64
    cov: F64
    up: F64
    up_sigma: float
    view: View
    new_segment: bool = False
    frames_ago: int = 0

    def __post_init__(self) -> None:
        _set_fields(
            self,
            T_odom_body=checked_pose("T_odom_body", self.T_odom_body),
            T_previous_body=checked_pose("T_previous_body", self.T_previous_body),
            cov=checked_cov("cov", self.cov),
            up=checked_up("up", self.up),
            up_sigma=checked_sigma("up_sigma", self.up_sigma),
        )


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe on the wire: its pose relative to the previous sent keyframe, and its view.

    id: per agent run, rising from 0. reference: id of the sent keyframe to which T_ref_body (4, 4) and its
    covariance cov (6, 6) are relative, or -1: T_ref_body is T_odom_body and an odometry segment starts.
    T_odom_body (4, 4): the published odometry pose, by which a correction moves odometry; T_ref_body is more
    accurate, since the filter later improves its past. up (3,): unit vector against gravity in the body
    frame, zeros if unknown; up_sigma: of both its angles, rad. predecessor: id of the keyframe to apply
    before this one, -1 for none; at least the reference, and more at the start of a segment, so that a
    reordering network cannot make it overtake.
    """

    id: int
    reference: int
    stamp_ns: int
    T_ref_body: F64
    cov: F64
    T_odom_body: F64
    up: F64
    up_sigma: float
    view: View
    predecessor: int = -1

    def __post_init__(self) -> None:
        checked_id("id", self.id)
        checked_stamp("stamp_ns", self.stamp_ns)
        if not -1 <= self.reference < self.id:
            raise ValueError(f"reference: {self.reference} must lie in -1 .. {self.id - 1}")
        predecessor = max(self.reference, self.predecessor)
        if not predecessor < self.id:
            raise ValueError(f"predecessor: {predecessor} must lie in -1 .. {self.id - 1}")
        _set_fields(
            self,
            predecessor=predecessor,
            T_ref_body=checked_pose("T_ref_body", self.T_ref_body, MAX_ODOM_M),
            cov=checked_cov("cov", self.cov),
            T_odom_body=checked_pose("T_odom_body", self.T_odom_body, MAX_ODOM_M),
            up=checked_up("up", self.up),
            up_sigma=checked_sigma("up_sigma", self.up_sigma),
        )


@dataclass(frozen=True, eq=False)
class Correction:
    """The pose T_map_odom (4, 4) of an agent's odometry in the shared map, with its covariance (6, 6).

    map_id: names the map; poses are comparable only within one map. revision: rises with every correction
    to this agent. segment_keyframe: id of a keyframe of the odometry segment that it applies to.
    answered_keyframe: id of the agent's keyframe that led to it; -1 if another agent's did.
    """

    T_map_odom: F64
    cov: F64
    map_id: str
    revision: int
    segment_keyframe: int
    answered_keyframe: int = -1

    def __post_init__(self) -> None:
        if not (0 < len(self.map_id) <= MAX_MAP_ID_LENGTH and self.map_id.isprintable()):
            raise ValueError(f"map_id: 1 to {MAX_MAP_ID_LENGTH} printable characters")
        checked_id("revision", self.revision)
        checked_id("segment_keyframe", self.segment_keyframe)
        checked_id("answered_keyframe", self.answered_keyframe, minimum=-1)
        _set_fields(
            self,
            T_map_odom=checked_pose("T_map_odom", self.T_map_odom),
            cov=checked_cov("cov", self.cov),
        )
