"""Frozen value types used by all layers. Frames and units: docs/understand/architecture.md.

Arrays are checked for shape and dtype and made read-only on construction, so a value can be handed to
another thread without a copy. Poses are 4x4 matrices `T_a_b` with p_a = T_a_b p_b; covariances are 6x6 over
(rotation [rad], translation [m]), perturbed on the right: T = T_mean Exp(xi) (see `share.geometry.se3`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from share.checks import (
    MAX_ODOM_M,
    MAX_POSITION_M,
    MAX_SIGMA,
    checked_array,
    checked_cov,
    checked_id,
    checked_map_id,
    checked_pose,
    checked_sigma,
    checked_stamp,
    checked_up,
)
from share.earlier_poses import MAX_SPANS, EarlierPoses

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

DESCRIPTOR_BYTES = 32  # ORB: 256 bits

# Limits, checked on construction; see also `share.checks`.
MAX_KEYPOINTS = 2000  # per keyframe
MAX_NAME_LENGTH = 64  # characters, of an agent's name
MAX_RUN_KEY_LENGTH = MAX_NAME_LENGTH + 17
MAX_JPEG_BYTES = 64_000  # of a keyframe's image
MAX_SURFACES = 256  # in a keyframe's image; a tracker has some 80
MAX_PLANE = 1e3  # 1/m, of each component of a surface's plane: 1 mm from the camera
MAX_UV = 1e3  # normalised image coordinates: 89.9 degrees off the axis
MAX_GYRO_RAD_S = 1e3  # twenty times the range of the widest common gyroscope
MAX_ACCEL_M_S2 = 1e4  # twenty times that of the widest common accelerometer


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
    """ORB features of a keyframe, by which another keyframe recognises the place.

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

    @staticmethod
    def empty() -> View:
        none = np.zeros((0, 3), np.float32)
        return View(none[:, :2], none, np.zeros((0, DESCRIPTOR_BYTES), np.uint8))


@dataclass(frozen=True, eq=False)
class KeyframeImage:
    """The image of a keyframe, and the features that the tracker knows in it.

    jpeg (B,) uint8: cam0's image as a gray JPEG; empty if there is none. uv (N, 2) float32: features, in
    undistorted normalised coordinates. plane (N, 3) float32: the surface at each feature, n with n X = 1 for
    its points X in cam0, 1/m; so n (u, v, 1) is the inverse depth along a ray. rho_sigma (N,) float32:
    standard deviation of the feature's inverse depth, 1/m.
    """

    jpeg: U8
    uv: F32
    plane: F32
    rho_sigma: F32

    def __post_init__(self) -> None:
        n = len(self.uv)
        if n > MAX_SURFACES:
            raise ValueError(f"uv: {n} features, at most {MAX_SURFACES}")
        if len(self.jpeg) > MAX_JPEG_BYTES:
            raise ValueError(f"jpeg: {len(self.jpeg)} bytes, at most {MAX_JPEG_BYTES}")
        _set_fields(
            self,
            jpeg=checked_array("jpeg", self.jpeg, (None,), np.uint8),
            uv=checked_array("uv", self.uv, (n, 2), np.float32),
            plane=checked_array("plane", self.plane, (n, 3), np.float32),
            rho_sigma=checked_array("rho_sigma", self.rho_sigma, (n,), np.float32),
        )
        for name, values, limit in (("uv", self.uv, MAX_UV), ("plane", self.plane, MAX_PLANE)):
            if (np.abs(values) > limit).any():
                raise ValueError(f"{name}: values beyond {limit:g}")
        if not ((self.rho_sigma >= 0) & (self.rho_sigma <= MAX_SIGMA)).all():
            raise ValueError(f"rho_sigma: outside 0 .. {MAX_SIGMA:g}")

    @property
    def points(self) -> F32:
        """The features' points (N, 3) m, in cam0; NaN rows where the inverse depth is not positive."""
        ray = np.column_stack([self.uv, np.ones(len(self.uv), np.float32)])
        rho = (ray * self.plane).sum(axis=1, keepdims=True)
        return np.asarray(ray / np.where(rho > 1 / MAX_POSITION_M, rho, np.nan), np.float32)

    def without_jpeg(self) -> KeyframeImage:
        return replace(self, jpeg=np.zeros(0, np.uint8))

    @staticmethod
    def empty() -> KeyframeImage:
        none = np.zeros((0, 3), np.float32)
        return KeyframeImage(np.zeros(0, np.uint8), none[:, :2], none, none[:, 0])


@dataclass(frozen=True, eq=False)
class OdometryKeyframe:
    """A keyframe of odometry, before the rate decides whether it is sent.

    T_odom_body (4, 4): as published. T_previous_body (4, 4): motion since the previous one by the
    filter's present estimate, which may differ from that of the two published T_odom_body; for the first of a
    segment it is T_odom_body. cov (6, 6): of T_previous_body. up (3,): unit vector against gravity in the
    body frame, zeros if unknown; up_sigma: of both its angles, rad. new_segment: odometry broke before this
    keyframe. view, image: as in `Keyframe`. earlier: relative to earlier ones.
    """

    T_odom_body: F64
    T_previous_body: F64
    cov: F64
    up: F64
    up_sigma: float
    view: View
    new_segment: bool = False
    image: KeyframeImage = field(default_factory=KeyframeImage.empty)
    earlier: EarlierPoses = field(default_factory=EarlierPoses.empty)

    @property
    def points(self) -> F32:
        """Known points (N, 3) m, in cam0, NaN rows where depth is unknown."""
        return np.concatenate([self.view.points, self.image.points])

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
    """A keyframe on the wire: its pose relative to the previous sent keyframe, and its image.

    id: per agent run, rising from 0. reference: id of the sent keyframe to which T_ref_body (4, 4) and its
    covariance cov (6, 6) are relative, or -1: T_ref_body is T_odom_body and an odometry segment starts.
    T_odom_body (4, 4): the published odometry pose, by which a correction moves odometry; T_ref_body is more
    accurate, since the filter later improves its past. up (3,): unit vector against gravity in the body
    frame, zeros if unknown; up_sigma: of both its angles, rad. predecessor: id of the keyframe to apply
    before this one, -1 for none; at least the reference, and more at the start of a segment, so that a
    reordering network cannot make it overtake. view: its ORB features, if the agent finds them; the edge
    finds those of a keyframe with an image. earlier: relative to keyframes before the reference, of the same
    segment; the edge ignores those that it does not have.
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
    image: KeyframeImage = field(default_factory=KeyframeImage.empty)
    earlier: EarlierPoses = field(default_factory=EarlierPoses.empty)

    @cached_property
    def nbytes(self) -> int:
        """Bytes of its variable arrays."""
        view, image, earlier = self.view, self.image, self.earlier
        arrays = (view.uv, view.points, view.descriptors, image.jpeg, image.uv, image.plane, image.rho_sigma)
        return sum(array.nbytes for array in (*arrays, earlier.ids, earlier.T_earlier_body, earlier.cov))

    @property
    def points(self) -> F32:
        """Known points (N, 3) m, in cam0, NaN rows where depth is unknown."""
        return np.concatenate([self.view.points, self.image.points])

    def __post_init__(self) -> None:
        checked_id("id", self.id)
        checked_stamp("stamp_ns", self.stamp_ns)
        if len(self.earlier) > MAX_SPANS:
            raise ValueError(f"earlier: {len(self.earlier)} keyframes, at most {MAX_SPANS}")
        if len(self.earlier) and not 0 <= self.earlier.ids.min() <= self.earlier.ids.max() < self.id:
            raise ValueError(f"earlier: ids must lie in 0 .. {self.id - 1}")
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
        checked_map_id(self.map_id)
        checked_id("revision", self.revision)
        checked_id("segment_keyframe", self.segment_keyframe)
        checked_id("answered_keyframe", self.answered_keyframe, minimum=-1)
        _set_fields(
            self,
            T_map_odom=checked_pose("T_map_odom", self.T_map_odom),
            cov=checked_cov("cov", self.cov),
        )
