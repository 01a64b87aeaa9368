"""The pose of the agent's body on the robot, from a drive that turns to both sides: hand-eye on the floor.

The base moves along its own x axis by what its wheels count; the body's heading is that of the base but for a
constant. So over any piece of the way, as complex numbers on the floor,

    D = a S + b E,   a = (1 + scale) exp(-i yaw),   b = exp(-i yaw) (x + i y)

with D the body's displacement, S the wheels' way summed along the body's heading, and E the change of
exp(i heading). That is linear in a and b. Wheel odometry's own heading, which drifts, is not used but for the
direction of one step. A delay of the wheels turns left and right bends against each other, and so falls
out of an eight. Roll and pitch are those of gravity in the body, since the floor is level; the height
does not show in such a drive.

`scale` is the camera's error of scale less that of the wheels' diameters, which the drive does not tell
apart. x and y are by the camera's scale, so the sigma has that part of them beside what the windows show. In
bends one wheel of another diameter moves the base's middle as another y would: the sigma of y has that too.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.geometry.se3 import from_rt
from share.types import F64, I64

_WINDOW_NS = 1_000_000_000
_BLOCK = 4  # windows that are left out together: slip and drift last longer than one
_MAX_GAP_NS = 300_000_000
_MAX_STEP_M = 0.3  # between two poses; more is a jump of the odometry's origin
_ITERATIONS = 10
_MIN_WAY_M, _MIN_TURN_DEG, _MIN_BLOCKS = 2.0, 180.0, 4
_MAX_SIGMA_M, _MAX_SIGMA_DEG, _MAX_SCALE = 0.01, 0.5, 0.1
_SCALE_SIGMA = 0.005  # of a camera at least: it may err as the wheels do, and the scale then shows less
_UNEQUAL_WHEELS_M = 0.0004  # of y: a quarter of a Create 3's wheel base, wheels unequal by 0.7 %


@dataclass(frozen=True, eq=False)
class MountingDrive:
    """A drive on a level floor. pose_ns (N,), T_odom_body (N, 4, 4): the agent's odometry, z up. wheel_ns
    (M,), wheels (M, 3): the robot's, x, y m and yaw rad. Both times in one clock, rising."""

    pose_ns: I64
    T_odom_body: F64
    wheel_ns: I64
    wheels: F64


@dataclass(frozen=True)
class DriveExtent:
    """How far a drive went, by the camera's turns and the wheels' way. Degrees, m."""

    way_m: float
    left_deg: float
    right_deg: float

    @property
    def missing(self) -> str | None:
        """The motion that the drive still lacks; None if it suffices."""
        if min(self.left_deg, self.right_deg) < _MIN_TURN_DEG:
            done = f"{self.left_deg:.0f}° to the left and {self.right_deg:.0f}° to the right so far"
            return f"turn by {_MIN_TURN_DEG:.0f}° and more to both sides, as in a figure of eight; {done}"
        if self.way_m < _MIN_WAY_M:
            return f"drive {_MIN_WAY_M:g} m and more, not only turn on the spot; {self.way_m:.1f} m so far"
        return None


@dataclass(frozen=True, eq=False)
class Mounting:
    """T_base_body (4, 4), and one sigma of its parts. scale: of the way by the camera to that by the wheels,
    less 1, all of which the sigmas of x and y take for the camera's. residual_m: rms over a second."""

    T_base_body: F64
    sigma_yaw_deg: float
    sigma_x_m: float
    sigma_y_m: float
    sigma_tilt_deg: float
    scale: float
    residual_m: float
    extent: DriveExtent

    def text(self) -> str:
        """Return what was found, for a person."""
        x, y, z = self.T_base_body[:3, 3]
        ahead = self.T_base_body[:3, 2]
        yaw, down = np.degrees(np.arctan2(ahead[1], ahead[0])), np.degrees(np.arcsin(-ahead[2]))
        return (
            f"the camera's body is {1e3 * x:.0f} ± {1e3 * self.sigma_x_m:.0f} mm ahead, "
            f"{1e3 * y:.0f} ± {1e3 * self.sigma_y_m:.0f} mm left, {1e3 * z:.0f} mm up (as given); it looks "
            f"{yaw:.1f} ± {self.sigma_yaw_deg:.1f}° to the left and "
            f"{down:.1f} ± {self.sigma_tilt_deg:.1f}° down\n"
            f"{self.extent.way_m:.1f} m driven; camera and wheels agree to "
            f"{1e3 * self.residual_m:.0f} mm a second and {100 * self.scale:+.1f} % of the way"
        )

    def report(self) -> dict[str, object]:
        """Return all of it as plain data."""
        return asdict(self) | {"T_base_body": self.T_base_body.tolist()}


def find_mounting(drive: MountingDrive, height_m: float = 0.0) -> Mounting:
    """Return the mounting. height_m: of the body over base_link, measured. Raises DataError, with what to
    drive, where it is not determined to 1 cm and 0.5°."""
    R_body_level, sigma_tilt = _level(drive.T_odom_body[:, :3, :3])
    pieces = _Pieces(drive, R_body_level)
    extent = pieces.extent
    if extent.missing is not None:
        raise DataError(f"the drive does not show where the camera sits: {extent.missing}")
    if pieces.blocks < _MIN_BLOCKS:
        raise DataError(f"only {pieces.blocks * _BLOCK} s of poses and odometry go together; drive longer")
    fits = pieces.fits()
    yaw, x, y, scale = fits[0]
    spread = fits[1:] - fits[1:].mean(0)
    sigma = np.sqrt((len(spread) - 1) / len(spread) * (spread**2).sum(0))  # the jackknife's
    if not (np.isfinite(fits).all() and np.isfinite(sigma).all()):
        raise DataError("no mounting fits this drive: its odometry has values of no robot; drive again")
    if abs(scale) > _MAX_SCALE:
        raise DataError(
            f"camera and wheels differ by {100 * abs(scale):.0f} % of the way: are both this robot's, "
            "and did it drive on its wheels, not pushed with them lifted?"
        )
    if max(sigma[1:3]) > _MAX_SIGMA_M or np.degrees(sigma[0]) > _MAX_SIGMA_DEG:
        raise DataError(
            f"the place is known to {1e3 * max(sigma[1:3]):.0f} mm and {np.degrees(sigma[0]):.1f}° only; "
            "drive on, slowly, in eights, with texture in view"
        )
    c, s = np.cos(yaw), np.sin(yaw)
    R_base_level = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    T_base_body = from_rt(R_base_level @ R_body_level.T, np.array([x, y, height_m]))
    scale_sigma = max(abs(scale), _SCALE_SIGMA)
    sigma_x = float(np.hypot(sigma[1], scale_sigma * x))
    sigma_y = float(np.linalg.norm([sigma[2], scale_sigma * y, _UNEQUAL_WHEELS_M]))
    sigmas = float(np.degrees(sigma[0])), sigma_x, sigma_y
    return Mounting(T_base_body, *sigmas, sigma_tilt, float(scale), pieces.residual_m(), extent)


def _level(R_odom_body: F64) -> tuple[F64, float]:
    """Return R_body_level (3, 3), of a frame with z up and x where the body looks, and the sigma of its tilt,
    degrees."""
    ups = R_odom_body[:, 2, :]  # of the world, in the body
    up = ups.mean(0)
    up /= np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = ahead - (ahead @ up) * up
    x /= np.linalg.norm(x)
    off = np.linalg.norm(np.cross(ups, up), axis=1)
    blocks = max(1, len(ups) // 100)
    return np.stack([x, np.cross(up, x), up], axis=1), float(np.degrees(np.sqrt((off**2).mean() / blocks)))


class _Pieces:
    """The drive in windows of a second. Rows: windows."""

    def __init__(self, drive: MountingDrive, R_body_level: F64) -> None:
        x = drive.T_odom_body[:, :3, :3] @ R_body_level[:, 0]
        self._time_ns = drive.pose_ns
        self._heading = np.unwrap(np.arctan2(x[:, 1], x[:, 0]))
        self._place = drive.T_odom_body[:, 0, 3] + 1j * drive.T_odom_body[:, 1, 3]
        self._wheel_ns = drive.wheel_ns
        steps, yaw = np.diff(drive.wheels[:, :2], axis=0), drive.wheels[:, 2]
        middle = yaw[:-1] + np.angle(np.exp(1j * np.diff(yaw))) / 2
        way = steps[:, 0] * np.cos(middle) + steps[:, 1] * np.sin(middle)
        self._way = np.concatenate([[0.0], np.cumsum(way)])
        self._first, self._last = self._windows()
        turns = np.diff(self._heading)
        is_near = np.diff(self._time_ns) <= _MAX_GAP_NS
        self.extent = DriveExtent(
            float(np.abs(way).sum()),
            float(np.degrees(turns[is_near & (turns > 0)].sum())),
            float(np.degrees(-turns[is_near & (turns < 0)].sum())),
        )
        self.blocks = len(self._first) // _BLOCK

    def _windows(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first and last pose of each window without a gap or a jump."""
        t = self._time_ns
        if len(t) < 2 or len(self._wheel_ns) < 2:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        is_bad = (np.diff(t) > _MAX_GAP_NS) | (np.abs(np.diff(self._place)) > _MAX_STEP_M)
        bad = np.concatenate([[0], np.cumsum(is_bad)])
        wheel_bad = np.concatenate([[0], np.cumsum(np.diff(self._wheel_ns) > _MAX_GAP_NS)])
        edges = np.searchsorted(t, np.arange(t[0], t[-1], _WINDOW_NS))
        first, last = edges[:-1], edges[1:]
        begin, end = t[first], t[last]
        is_good = (bad[first] == bad[last]) & (begin >= self._wheel_ns[0]) & (end <= self._wheel_ns[-1])
        k = len(self._wheel_ns) - 1
        before, after = (np.searchsorted(self._wheel_ns, one).clip(0, k) for one in (begin, end))
        is_good &= wheel_bad[before] == wheel_bad[after]
        return first[is_good], last[is_good]

    @cached_property
    def _equations(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """A (n, 2) and D (n,)."""
        way = np.interp(self._time_ns, self._wheel_ns, self._way)
        middle = (self._heading[:-1] + self._heading[1:]) / 2
        along = np.concatenate([[0.0], np.cumsum(np.diff(way) * np.exp(1j * middle))])
        turned = np.exp(1j * self._heading)
        i, j = self._first, self._last
        A = np.stack([along[j] - along[i], turned[j] - turned[i]], axis=1)
        return A, self._place[j] - self._place[i]

    @cached_property
    def _solution(self) -> tuple[NDArray[np.complex128], F64]:
        """(a, b) by all windows, and their weights (n,)."""
        return self._solve(*self._equations)

    def _solve(
        self, A: NDArray[np.complex128], D: NDArray[np.complex128]
    ) -> tuple[NDArray[np.complex128], F64]:
        """Return (a, b) with Cauchy weights, and the weights (n,)."""
        weight = np.ones(len(D))
        for _ in range(_ITERATIONS):
            AW = A.conj().T * weight
            ab = np.linalg.solve(AW @ A + 1e-12 * np.eye(2), AW @ D).astype(np.complex128)
            error = np.abs(D - A @ ab)
            weight = 1 / (1 + (error / (2.5 * max(float(np.median(error)), 1e-6))) ** 2)
        return ab, weight

    def residual_m(self) -> float:
        (A, D), (ab, weight) = self._equations, self._solution
        return float(np.sqrt((weight * np.abs(D - A @ ab) ** 2).sum() / weight.sum()))

    def fits(self) -> F64:
        """Return yaw, x, y, scale of all windows, then without each block in turn (1 + blocks, 4)."""
        A, D = self._equations
        block = np.arange(len(D)) // _BLOCK
        without = (self._solve(A[block != k], D[block != k])[0] for k in range(self.blocks))
        return np.array([_parts(ab) for ab in (self._solution[0], *without)])


def _parts(ab: NDArray[np.complex128]) -> tuple[float, float, float, float]:
    a, b = ab
    yaw = -float(np.angle(a))
    t = b * np.exp(1j * yaw)
    return yaw, float(t.real), float(t.imag), float(np.abs(a)) - 1
