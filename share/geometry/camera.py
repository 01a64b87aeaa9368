"""Cameras with a radial-tangential or a fisheye lens, IMU noise and bias, and the rig that holds them.

Pixel centres are at integers: the centre of the top-left pixel is (0, 0). Lens models: `share.geometry.lens`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.checks import checked_array, checked_pose
from share.geometry import se3
from share.geometry.lens import COEFFICIENT_COUNTS, EQUIDISTANT, RADTAN, Equidistant, Radtan, lens_model
from share.types import F64

MAX_TIMESHIFT_S = 1.0
BASELINE_RANGE_M = (0.005, 2.0)
MAX_PIXELS = 10**8  # of an image
_FOCAL_RANGE_PX = (1.0, 1e5)  # beyond, rounding errors dominate
_MAX_PRINCIPAL_POINT_PX = 1e6  # from the corner; the principal point may lie outside the image
_MAX_NOISE, _MAX_RATE_HZ = 1e3, 1e5  # of an IMU
_MAX_GYRO_BIAS, _MAX_ACCEL_BIAS = 0.5, 3.0  # rad/s, m/s^2
MAX_SENSOR_DISTANCE_M = 1e3  # of sensors on one body, also if given in millimetres, which `rig_check` reports
_RIGID = 1e-6  # a transform nearer to rigid than this is not changed
_MAX_DISTORTION = 1e4  # of a coefficient; k3 of a narrow lens is some hundreds
_MIN_DEPTH_RATIO = 0.02  # of a point to its depth in the first camera; below it counts as behind the camera


def rays(uv: F64) -> F64:
    """Return points (N, 3) at depth 1 on the rays through normalised coordinates (N, 2)."""
    return np.concatenate([uv, np.ones((len(uv), 1))], axis=1)


def project(q: F64) -> tuple[F64, F64]:
    """Project points given as q (N, 3) = R ray + rho t, of a ray with z = 1 at inverse depth rho.

    Return (x, y) / z (N, 2) and its derivative by q (N, 2, 3); NaN for points behind the camera.
    """
    z = np.where(q[:, 2] > _MIN_DEPTH_RATIO, q[:, 2], np.nan)
    uv = q[:, :2] / z[:, None]
    D = np.zeros((len(q), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1 / z
    D[:, :, 2] = -uv / z[:, None]
    return uv, D


def _alternatives(counts: tuple[int, ...]) -> str:
    *first, last = (str(count) for count in counts)
    return " or ".join([", ".join(first), last]) if first else last


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels, and distortion.

    distortion: () or (k1, k2, p1, p2) or (k1, k2, p1, p2, k3) of the `model` radtan, (k1, k2, k3, k4) of
    equidistant. Raises ValueError for values that no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: str = RADTAN

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENT_COUNTS:
            raise ValueError(
                f"lens model '{self.model:.40}' is not known; known: {', '.join(COEFFICIENT_COUNTS)}"
            )
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"resolution: {self.width}x{self.height} is not positive")
        if self.width * self.height > MAX_PIXELS:
            raise ValueError(
                f"resolution: {self.width}x{self.height} is above the maximum of {MAX_PIXELS:g} pixels"
            )
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"intrinsics: focal lengths {self.fx}, {self.fy} must be positive")
        if len(self.distortion) not in (counts := COEFFICIENT_COUNTS[self.model]):
            raise ValueError(
                f"distortion: {len(self.distortion)} coefficients, "
                f"expected {_alternatives(counts)} of {self.model}"
            )
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.distortion]).all():
            raise ValueError("intrinsics: has values that are not finite")
        shortest, longest = _FOCAL_RANGE_PX
        if not shortest <= min(self.fx, self.fy) <= max(self.fx, self.fy) <= longest:
            raise ValueError(
                f"intrinsics: focal lengths {self.fx:g}, {self.fy:g} px are not within {shortest:g} to "
                f"{longest:g}"
            )
        if max(abs(self.cx), abs(self.cy)) > _MAX_PRINCIPAL_POINT_PX:
            raise ValueError(
                f"intrinsics: principal point {self.cx:g}, {self.cy:g} px is beyond "
                f"{_MAX_PRINCIPAL_POINT_PX:g}"
            )
        if max(map(abs, self.distortion), default=0.0) > _MAX_DISTORTION:
            raise ValueError(f"distortion: has coefficients beyond {_MAX_DISTORTION:g}")

    @property
    def K(self) -> F64:
        """The intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def lens(self) -> Radtan | Equidistant | None:
        """The lens model; None without distortion."""
        return lens_model(self.model, self.distortion) if self.distortion else None

    @property
    def is_fisheye(self) -> bool:
        """Whether the size of a pixel in normalised coordinates grows much off the axis."""
        return self.model == EQUIDISTANT

    @property
    def is_bounded(self) -> bool:
        """Whether pixels of the image may have no normalised coordinates, because the lens model's range
        ends before."""
        return self.is_fisheye or ((distortion := self.lens) is not None and distortion.limit < math.inf)

    @property
    def field_of_view_rad(self) -> tuple[float, float]:
        """Horizontal and vertical field of view: 2 atan(size / 2 f), without distortion.

        Of a fisheye lens with its distortion, as far as there are normalised coordinates.
        """
        if isinstance(distortion := self.lens, Equidistant):
            sides = np.array([[self.width / (2 * self.fx), 0.0], [0.0, self.height / (2 * self.fy)]])
            half = np.arccos(distortion.directions(sides)[:, 2])
            across, upright = (2 * np.fmin(half, distortion.max_field_rad)).tolist()
            return across, upright
        return 2 * math.atan(self.width / (2 * self.fx)), 2 * math.atan(self.height / (2 * self.fy))

    @property
    def focal(self) -> float:
        """Mean focal length, px: converts an error in normalised coordinates to pixels."""
        return (self.fx + self.fy) / 2

    def project(self, points: F64) -> F64:
        """Points (..., 3) in the camera frame -> pixels (..., 2); NaN behind the camera and beyond the
        lens's range."""
        z = np.where(points[..., 2:] > 1e-6, points[..., 2:], np.nan)
        return self.distort(points[..., :2] / z)

    def project_wide(self, points: F64) -> F64:
        """Like `project`, but also beyond the normalised coordinates of a fisheye lens; NaN beyond its
        range."""
        if not isinstance(distortion := self.lens, Equidistant):
            return self.project(points)
        return distortion.distort_points(points) * (self.fx, self.fy) + (self.cx, self.cy)

    def distort(self, uv: F64) -> F64:
        """Normalised coordinates (..., 2) -> pixels (..., 2); NaN beyond the lens's range."""
        if self.distortion:
            uv = lens_model(self.model, self.distortion).distort(uv)
        return uv * (self.fx, self.fy) + (self.cx, self.cy)

    def normalise(self, px: F64, guess: F64 | None = None) -> F64:
        """Pixels (..., 2) -> undistorted normalised coordinates (x/z, y/z), to 1e-9 inside the image; NaN
        beyond the lens's range. guess: initial values, for fewer iterations."""
        observed = (px - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion:
            return observed
        return lens_model(self.model, self.distortion).undistort(observed, guess)

    def directions(self, px: F64) -> F64:
        """Pixels (..., 2) -> unit vectors (..., 3) in the camera frame, also without normalised
        coordinates; NaN beyond the lens's range."""
        observed = (px - (self.cx, self.cy)) / (self.fx, self.fy)
        if (distortion := self.lens) is not None:
            return distortion.directions(observed)
        ray = np.concatenate([observed, np.ones((*observed.shape[:-1], 1))], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def jacobian(self, uv: F64) -> F64:
        """d(pixel)/d(normalised coordinates) at (..., 2): (..., 2, 2)."""
        scale = np.array([[self.fx], [self.fy]])
        if not self.distortion:
            return np.broadcast_to(scale * np.eye(2), (*uv.shape, 2)).copy()
        return scale * lens_model(self.model, self.distortion).jacobian(uv)

    def to_image_plane(self, uv: F64) -> F64:
        """Normalised coordinates (..., 2) -> coordinates in which a pixel is 1 / focal everywhere: those
        of the image plane for a fisheye lens, unchanged for others."""
        return lens_model(self.model, self.distortion).distort(uv) if self.is_fisheye else uv

    def has_normalised(self, px: F64) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) have normalised coordinates."""
        if not self.is_bounded:
            return np.ones(px.shape[:-1], bool)
        return np.asarray(np.isfinite(self.normalise(px)).all(axis=-1))

    def is_inside(self, px: F64, border: float = 0.0) -> np.ndarray:
        """Return which pixels (..., 2) lie in the image, at least `border` px from its edge."""
        upper = (self.width - 1 - border, self.height - 1 - border)
        return np.asarray(((px >= border) & (px <= upper)).all(axis=-1))


@dataclass(frozen=True)
class ImuNoise:
    """Continuous-time noise: densities in rad/s/sqrt(Hz), m/s^2/sqrt(Hz); random walks as in Kalibr.
    Raises ValueError for values that no IMU has."""

    gyro_density: float
    accel_density: float
    gyro_walk: float
    accel_walk: float
    rate_hz: float

    def __post_init__(self) -> None:
        values = (self.gyro_density, self.accel_density, self.gyro_walk, self.accel_walk, self.rate_hz)
        if not all(0 <= value < np.inf for value in values):
            raise ValueError("IMU: has noise or a rate that is negative or not finite")
        if max(values[:4]) > _MAX_NOISE or self.rate_hz > _MAX_RATE_HZ:
            raise ValueError(f"IMU: has noise beyond {_MAX_NOISE:g} or a rate beyond {_MAX_RATE_HZ:g} Hz")


@dataclass(frozen=True, eq=False)
class ImuBias:
    """Bias of an IMU, known before or after a run: gyro rad/s, accel m/s^2 (3,), with a standard deviation
    for the axes of each. Raises ValueError for values that no IMU has."""

    gyro: F64
    accel: F64
    gyro_sigma: float
    accel_sigma: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "gyro", checked_array("gyro bias", self.gyro, (3,), np.float64))
        object.__setattr__(self, "accel", checked_array("accelerometer bias", self.accel, (3,), np.float64))
        for name, value, limit in (
            ("gyro", max(np.abs(self.gyro).max(), self.gyro_sigma), _MAX_GYRO_BIAS),
            ("accelerometer", max(np.abs(self.accel).max(), self.accel_sigma), _MAX_ACCEL_BIAS),
        ):
            if not value <= limit:
                raise ValueError(f"IMU: has a {name} bias beyond {limit:g}")
        if not (self.gyro_sigma > 0 and self.accel_sigma > 0):
            raise ValueError("IMU: the sigma of a bias must be positive")


def _extrinsics(name: str, value: F64) -> F64:
    """Return the nearest rigid transform, because a calibration may be rounded to three digits. Raises
    ValueError as `checked_pose`."""
    T = checked_pose(name, value, MAX_SENSOR_DISTANCE_M)
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() <= _RIGID:
        return T
    return checked_pose(name, se3.orthonormal(T), MAX_SENSOR_DISTANCE_M)


@dataclass(frozen=True, eq=False)
class Rig:
    """All cameras of one agent in its body frame (the IMU's; cam0's without an IMU).

    cam1 makes it stereo, depth makes it RGB-D; a depth camera need not be registered to cam0. timeshift_s:
    IMU time minus camera time, s, at most 1 s; what the camera stamps t happened when the IMU stamped t +
    timeshift_s (Kalibr's timeshift_cam_imu).
    """

    cam0: Camera
    T_body_cam0: F64
    cam1: Camera | None = None
    T_cam1_cam0: F64 | None = None
    depth: Camera | None = None
    T_depth_cam0: F64 | None = None
    imu: ImuNoise | None = None
    timeshift_s: float = 0.0

    def __post_init__(self) -> None:
        if (self.cam1 is None) != (self.T_cam1_cam0 is None):
            raise ValueError("cam1 and its extrinsics T_cam1_cam0 must be given together")
        if (self.depth is None) != (self.T_depth_cam0 is None):
            raise ValueError("depth and its extrinsics T_depth_cam0 must be given together")
        for name in ("T_body_cam0", "T_cam1_cam0", "T_depth_cam0"):
            T = getattr(self, name)
            if T is not None:
                object.__setattr__(self, name, _extrinsics(name, T))
        if self.T_cam1_cam0 is not None and not BASELINE_RANGE_M[0] <= self.baseline <= BASELINE_RANGE_M[1]:
            raise ValueError(
                f"T_cam1_cam0: the cameras are {self.baseline:g} m apart, not {BASELINE_RANGE_M[0]:g} to "
                f"{BASELINE_RANGE_M[1]:g}; translations are in metres"
            )
        if not abs(self.timeshift_s) <= MAX_TIMESHIFT_S:
            raise ValueError(f"timeshift_s: {self.timeshift_s} is not within {MAX_TIMESHIFT_S:g} s")

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras by name: cam0, cam1, depth."""
        return {k: c for k, c in (("cam0", self.cam0), ("cam1", self.cam1), ("depth", self.depth)) if c}

    def without_imu(self) -> Rig:
        """Return the same cameras without an IMU: the body is cam0."""
        return replace(self, imu=None, T_body_cam0=np.eye(4), timeshift_s=0.0)

    @property
    def kind(self) -> str:
        """`stereo`, `rgbd` or `mono`, with `+imu` if there is an IMU."""
        cameras = "stereo" if self.cam1 else "rgbd" if self.depth else "mono"
        return cameras + ("+imu" if self.imu else "")

    @property
    def timeshift_ns(self) -> int:
        """`timeshift_s` in ns."""
        return round(self.timeshift_s * 1e9)

    @property
    def baseline(self) -> float:
        """Distance between cam0 and cam1, m; 0 without cam1."""
        return 0.0 if self.T_cam1_cam0 is None else float(np.linalg.norm(self.T_cam1_cam0[:3, 3]))
