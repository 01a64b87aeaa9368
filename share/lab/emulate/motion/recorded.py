"""Recorded motions: from an EuRoC or TUM-VI folder to the path of its IMU, placed in a room.

The path is known at every instant by a batch fit of IMU and motion capture (`share.lab.mocap.path`). A folder
has one of two forms. ASL, as published: mav0/imu0/data.csv, ground truth, and sensor.yaml files or
dso/{camchain,imu_config}.yaml. Plain: imu0.csv, groundtruth.csv, and Kalibr's two chains there or in
../calib. Images are not needed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from share.errors import DataError, UsageError
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.emulate.types import GRAVITY, stamps_within
from share.lab.mocap.factors import interpolate_samples
from share.lab.mocap.files import read_mocap
from share.lab.mocap.fit import MocapFit, fit_mocap
from share.lab.mocap.path import FittedPath
from share.lab.mocap.state import MocapFitOptions
from share.lab.mocap.trajectory import MocapTrajectory
from share.recordings import tables
from share.recordings.calibration import CAMCHAIN, IMU_CHAIN, imu_noise, kalibr_T_imu_cam
from share.recordings.folders import TRUTH_FOLDERS
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """A `MotionPath` from start_ns to end_ns, within the nodes of `fit`.

    imu: the fitted samples, which reach beyond the span. T_world_fit (4, 4): pose of the fit's world.
    """

    fit: MocapFit
    imu: ImuBatch
    start_ns: int
    end_ns: int
    T_world_fit: F64

    @property
    def gaps(self) -> I64:
        """Return (G, 2) ns: gaps of the motion capture too long to bridge by the IMU."""
        gaps = self.fit.gaps
        keep = (gaps[:, 1] > self.start_ns) & (gaps[:, 0] < self.end_ns)
        return gaps[keep].clip(self.start_ns, self.end_ns)

    @cached_property
    def recorded(self) -> ImuBatch:
        """Return the IMU's samples within the span, as recorded."""
        keep = (self.imu.stamps_ns >= self.start_ns) & (self.imu.stamps_ns <= self.end_ns)
        return self.imu.take(keep)

    def poses(self, stamps_ns: I64) -> F64:
        """Return T_world_body (N, 4, 4). Raises ValueError outside the span."""
        return self.T_world_fit @ self._pose_and_velocity(stamps_ns)[0]

    def velocity(self, stamps_ns: I64) -> F64:
        """Return the body's velocity in the world (N, 3) m/s. Raises ValueError outside the span."""
        return np.asarray(self._pose_and_velocity(stamps_ns)[1] @ self.T_world_fit[:3, :3].T, np.float64)

    def inertial(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return angular rate (N, 3) rad/s and specific force (N, 3) m/s^2 as recorded less the biases,
        linear between samples, so with the real IMU's noise. Raises ValueError outside the span."""
        stamps = stamps_within(stamps_ns, self.start_ns, self.end_ns)
        gyro, accel = (
            interpolate_samples(self.imu, stamps, self.imu.gyro),
            interpolate_samples(self.imu, stamps, self.imu.accel),
        )
        nodes = ImuBatch(self.fit.stamps_ns, self.fit.gyro_bias, self.fit.accel_bias)
        return gyro - interpolate_samples(nodes, stamps, nodes.gyro), accel - interpolate_samples(
            nodes, stamps, nodes.accel
        )

    def transformed(self, T_world_old: F64) -> RecordedPath:
        """Return the same motion turned about the vertical and shifted by T_world_old (4, 4). Raises
        ValueError if that would tilt gravity."""
        if not np.allclose(T_world_old[2, :3], (0, 0, 1), atol=1e-9):
            raise ValueError("T_world_old: turns about more than the vertical")
        return replace(self, T_world_fit=T_world_old @ self.T_world_fit)

    @cached_property
    def _fitted_path(self) -> FittedPath:
        return FittedPath(self.fit, self.imu)

    def _pose_and_velocity(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return T_fit_body (N, 4, 4) and velocity (N, 3) in the fit's world."""
        return self._fitted_path.pose_and_velocity(stamps_within(stamps_ns, self.start_ns, self.end_ns))


_MARGIN_S = 5.0  # fitted before and after the wanted span: the ends of a batch are the least certain
_MIN_SPAN_S = 1.0

# Figures: docs/understand/mocap-fit.md. EuRoC's ground truth is an estimate from this very IMU and its
# clock; that of
# TUM-VI and EuRoC's raw vicon0 is motion capture.
EUROC_OPTIONS = MocapFitOptions(
    sigma_position=0.0015,
    sigma_rotation=np.radians(0.3),
    within_s=0,
    offset_sigma=1e-5,
    drift_sigma=1e-8,
    gravity=GRAVITY,
)
TUMVI_OPTIONS = MocapFitOptions(
    sigma_position=0.0005, sigma_rotation=np.radians(0.3), gravity=GRAVITY, max_bridged_s=1.0
)
_RAW_MOCAP_FOLDERS = ("mocap0", "vicon0")


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """A recorded motion. T_body_cam0 (4, 4): pose of its first camera. noise: of its IMU's data sheet.
    notes: text about the fit."""

    path: RecordedPath
    T_body_cam0: F64
    noise: ImuNoise
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _MotionFiles:
    """The files of a recording, in either form of folder."""

    imu: Path
    truth: Path
    mounting: Callable[[], tuple[F64, ImuNoise]]


def open_recorded_motion(
    folder: Path, options: MocapFitOptions, start: float = 0.0, seconds: float | None = None
) -> RecordedMotion:
    """Return the motion in `folder` from `start` s after IMU and ground truth both began, for `seconds` or to
    the end.

    options: EUROC_OPTIONS or TUMVI_OPTIONS; the raw motion capture of an ASL folder is fitted as TUM-VI's.
    Raises UsageError for a missing folder or a start beyond the end, DataError or ConfigError for damaged or
    inconsistent files.
    """
    files = _find_files(folder)
    if files.truth.parent.name in _RAW_MOCAP_FOLDERS:
        options = TUMVI_OPTIONS
    T_body_cam0, noise = files.mounting()
    imu, mocap = _read_imu(files.imu), read_mocap(files.truth, allow_unseen=False)
    first, last = _span(folder, imu, mocap, start, seconds)
    margin = round(_MARGIN_S * 1e9)
    imu_part = _imu_between(imu, first - margin, last + margin)
    try:
        mocap_fit = fit_mocap(imu_part, noise, mocap.between(first - margin, last + margin), options)
    except DataError as error:
        raise type(error)(f"{folder}: {error}") from None
    start_ns, end_ns = max(first, int(mocap_fit.stamps_ns[0])), min(last, int(mocap_fit.stamps_ns[-1]))
    path = RecordedPath(mocap_fit, imu_part, start_ns, end_ns, np.eye(4))
    return RecordedMotion(path, T_body_cam0, noise, (_fit_note(path),))


def _find_files(folder: Path) -> _MotionFiles:
    if (folder / "groundtruth.csv").is_file():
        return _plain_files(folder)
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if (root / "imu0" / "data.csv").is_file():
        return _asl_files(root)
    raise UsageError(
        f"{folder}: no recorded motion is here; expected mav0/imu0/data.csv or groundtruth.csv and imu0.csv"
    )


def _plain_files(folder: Path) -> _MotionFiles:
    calib = folder if (folder / CAMCHAIN).is_file() else folder.parent / "calib"

    def mounting() -> tuple[F64, ImuNoise]:
        T = kalibr_T_imu_cam(read_yaml(calib / CAMCHAIN).section("cam0"))
        return T, imu_noise(read_yaml(calib / IMU_CHAIN).section("imu0"), "update_rate")

    return _MotionFiles(folder / "imu0.csv", folder / "groundtruth.csv", mounting)


def _asl_files(root: Path) -> _MotionFiles:
    truth = next(
        (root / name / "data.csv" for name in TRUTH_FOLDERS if (root / name / "data.csv").is_file()), None
    )
    if truth is None:
        raise DataError(f"{root}: has no ground truth; expected one of {', '.join(TRUTH_FOLDERS)}")
    dso = root.parent / "dso"

    def mounting() -> tuple[F64, ImuNoise]:
        if (dso / "camchain.yaml").is_file():  # TUM-VI
            T = kalibr_T_imu_cam(read_yaml(dso / "camchain.yaml").section("cam0"))
            return T, imu_noise(read_yaml(dso / "imu_config.yaml"), "update_rate")
        imu, cam0 = read_yaml(root / "imu0" / "sensor.yaml"), read_yaml(root / "cam0" / "sensor.yaml")
        return se3.inverse(imu.pose("T_BS")) @ cam0.pose("T_BS"), imu_noise(imu, "rate_hz")

    return _MotionFiles(root / "imu0" / "data.csv", truth, mounting)


def _read_imu(path: Path) -> ImuBatch:
    stamps, values = tables.read_table(path, 7)
    return ImuBatch(stamps, values[:, :3], values[:, 3:])


def _span(
    folder: Path, imu: ImuBatch, mocap: MocapTrajectory, start: float, seconds: float | None
) -> tuple[int, int]:
    """Return the first and last stamp of the wanted span."""
    begin = max(int(imu.stamps_ns[0]), int(mocap.stamps_ns[0]))
    end = min(int(imu.stamps_ns[-1]), int(mocap.stamps_ns[-1]))
    if end <= begin:
        raise DataError(f"{folder}: IMU and ground truth do not overlap in time; give files of one recording")
    first = begin + round(start * 1e9)
    last = end if seconds is None else min(end, first + round(seconds * 1e9))
    if start < 0 or last - first < _MIN_SPAN_S * 1e9:
        available_s, remaining_s = (end - begin) * 1e-9, (last - first) * 1e-9
        raise UsageError(
            f"{folder}: {remaining_s:.1f} "
            f"s are left from {start:g} "
            f"s on, of {available_s:.1f} s of IMU and truth; "
            f"at least {_MIN_SPAN_S:g} s are needed"
        )
    return first, last


def _imu_between(imu: ImuBatch, start_ns: int, end_ns: int) -> ImuBatch:
    keep = (imu.stamps_ns >= start_ns) & (imu.stamps_ns <= end_ns)
    return imu.take(keep)


def _fit_note(path: RecordedPath) -> str:
    mocap_fit, residuals, body = path.fit, path.fit.residuals, path.fit.T_body_mocap
    turned, arm = np.degrees(se3.rotation_angle(body)), 1e3 * np.linalg.norm(body[:3, 3])
    gaps_s = float(np.diff(path.gaps, axis=1).sum()) * 1e-9
    return (
        f"fitted to {residuals.position_mm:.1f} mm and "
        f"{residuals.rotation_deg:.2f} "
        f"deg (rms) of the motion capture; "
        f"its body is {turned:.2f} deg and {arm:.0f} mm from "
        f"the IMU, its world "
        f"{mocap_fit.tilt_deg:.2f} deg off "
        f"level, its clock {-mocap_fit.offset_ns * 1e-6:+.1f} ms from the IMU's; {gaps_s:.1f} s have no truth"
    )
