"""Read RealSense SDK recordings (.db3): infrared, depth and IMU, repaired as those of a live camera."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError, UsageError
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings.calibration import Calibration
from share.recordings.device_match import device_mismatch
from share.recordings.images import EncodedImage
from share.recordings.losses import DataLosses
from share.recordings.mcap.rig import rig_cameras
from share.recordings.realsense_db3 import Db3
from share.recordings.recording import Source, select_span
from share.recordings.trajectory import Trajectory
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, Measurement
from share.sensors.profile import load_profile
from share.sensors.sample_processor import ACCEL, GYRO, SampleProcessor
from share.types import F64, I64, checked_pose

_UNIT_RANGE_M = (1e-6, 1.0)  # valid depth units
_RATE_RANGE_HZ = (0.1, 1e5)  # valid stream rates
_DEFAULT_PROFILE = "d435i"  # for the IMU, whose extrinsics and noise the SDK does not record
_DEFAULT_PROFILE_NOTE = (
    f"the recording has no IMU extrinsics and noise; using those of profile {_DEFAULT_PROFILE}; give --calib "
    "for this device's own"
)


def open_db3(path: Path, calibration: Calibration | None, frames: slice | None) -> Source:
    """Open the recording in `path`. Raises UsageError, DataError."""
    file = Db3(path)
    if CAM0 not in file.streams:
        raise UsageError(
            f"{path}: has no compressed left infrared images (Infrared 1); record with that stream"
        )
    if calibration is not None:
        warning = device_mismatch(calibration.serials, file.serial)
        return RealSenseRecording(file, calibration.rig, () if warning is None else (warning,), frames)
    rig = read_recorded_rig(file)
    return RealSenseRecording(file, rig, (_DEFAULT_PROFILE_NOTE,) if rig.imu else (), frames)


class RealSenseRecording(Source):
    """An SDK recording with the streams of its rig."""

    def __init__(self, file: Db3, rig: Rig, notes: tuple[str, ...], frames: slice | None) -> None:
        self.name, self.rig, self.notes, self.serial = file.path.stem, rig, notes, file.serial
        self._file, self._cameras = file, rig_cameras(rig)
        if missing := sorted(self._cameras.keys() - file.streams.keys()):
            raise UsageError(
                f"{file.path}: the calibration has {missing[0]}, the recording does not; give another --calib"
            )
        unit = f"{file.streams.get(DEPTH, '').rpartition('/')[0]}/option/Depth_Units/value"
        self._depth_scale = 1 / file.read_number(unit, None, 0.001, *_UNIT_RANGE_M)
        self._span = select_span(self._all_stamps[CAM0], frames, str(file.path), rig.timeshift_ns)

    def stamps(self) -> dict[str, I64]:
        out = {}
        for stream, stamps in self._all_stamps.items():
            lo, hi = self._span.limits(stream)
            out[stream] = stamps[(stamps > lo) & (stamps <= hi)]
        return out

    def measurements(self) -> Iterator[Measurement]:
        for m in self._repair(images=True):
            lo, hi = self._span.limits(m.stream)
            if lo < m.stamp_ns <= hi:
                yield m if m.stream == IMU else Measurement(m.stream, m.stamp_ns, self._image(m))

    def truth(self) -> Trajectory | None:
        return None

    @cached_property
    def _all_stamps(self) -> dict[str, I64]:
        stamps_by_stream: dict[str, list[int]] = {name: [] for name in self._cameras}
        if self.rig.imu:
            stamps_by_stream[IMU] = []
        for m in self._repair(images=False):
            stamps_by_stream[m.stream].append(m.stamp_ns)
        if not stamps_by_stream[CAM0]:
            raise DataError(f"{self._file.path}: has no images")
        return {name: np.array(stamps, np.int64) for name, stamps in stamps_by_stream.items()}

    def _repair(self, images: bool) -> Iterator[Measurement]:
        streams = [*self._cameras, *((ACCEL, GYRO) if self.rig.imu else ())]
        return repair_samples(self._file, streams, images, self.losses)

    def _image(self, m: Measurement) -> EncodedImage:
        camera, scale = self._cameras[m.stream], self._depth_scale if m.stream == DEPTH else 0.0
        where = f"{self._file.path}: {m.stream} at {m.stamp_ns}"
        return EncodedImage(m.payload, where, camera.width, camera.height, scale)


def repair_samples(
    file: Db3, streams: Collection[str], images: bool, losses: DataLosses
) -> Iterator[Measurement]:
    """Yield the measurements of `streams`, repaired as a live camera's (`SampleProcessor`).

    images: with pixels. losses: gets damaged samples. Raises DataError.
    """
    rates = {
        name: file.read_number(f"{file.streams[name]}/info", "fps", 30.0, *_RATE_RANGE_HZ) for name in streams
    }
    intake = SampleProcessor(rates)
    for sample in file.samples(losses, images):
        yield from intake.feed(sample)
    yield from intake.flush()


def read_recorded_imu(file: Db3, losses: DataLosses) -> tuple[I64, F64]:
    """Return IMU stamps (N,) ns and values (N, 6) wx wy wz ax ay az, rad/s and m/s^2.

    losses: gets damaged samples. Raises DataError.
    """
    if missing := [name for name in (ACCEL, GYRO) if name not in file.streams]:
        raise DataError(f"{file.path}: has no {' and no '.join(missing)}; record both")
    samples = [(m.stamp_ns, m.payload) for m in repair_samples(file, (ACCEL, GYRO), False, losses)]
    if not samples:
        raise DataError(f"{file.path}: has no IMU samples")
    stamps, values = zip(*samples, strict=True)
    return np.array(stamps, np.int64), np.array(values)


def read_recorded_rig(file: Db3) -> Rig:
    """Return the rig: cameras as recorded, the IMU, if any, as in the default profile. Raises DataError."""
    lenses = {name: _read_camera(file, name) for name in (CAM0, CAM1, DEPTH) if name in file.streams}
    rig: dict[str, Any] = {"cam0": lenses[CAM0], "T_body_cam0": np.eye(4)}
    for name in (CAM1, DEPTH):
        if name in lenses:
            rig |= {
                name: lenses[name],
                f"T_{name}_cam0": _read_extrinsics(file, name) @ se3.inverse(_read_extrinsics(file, CAM0)),
            }
    if ACCEL in file.streams and GYRO in file.streams:
        default_rig = load_profile(_DEFAULT_PROFILE).rig()
        rig |= {"imu": default_rig.imu, "T_body_cam0": default_rig.T_body_cam0}
    try:
        return Rig(**rig)
    except ValueError as error:
        raise DataError(f"{file.path}: {error}") from None


def _read_camera(file: Db3, stream: str) -> Camera:
    fields = file.text_fields(f"{file.streams[stream]}/camera_info")
    try:
        width, height = int(fields["width"]), int(fields["height"])
        fx, fy, cx, cy = (float(fields[key]) for key in ("fx", "fy", "ppx", "ppy"))
        coefficients = tuple(float(c) for c in fields["coeffs"].split(","))
        if any(coefficients) and fields["model"] != "Brown Conrady":
            raise ValueError(f"distortion model {fields['model']} is not known; give --calib")
        return Camera(width, height, fx, fy, cx, cy, coefficients if any(coefficients) else ())
    except (KeyError, ValueError) as error:
        raise DataError(f"{file.path}: calibration of {stream}: {error}") from None


def _read_extrinsics(file: Db3, stream: str) -> F64:
    """Read T_stream_reference (4, 4); all streams share the reference. The rotation is stored by columns."""
    fields = file.text_fields(file.find_topic(f"{file.streams[stream]}/tf/ref_"))
    try:
        T = np.eye(4)
        T[:3, :3] = np.reshape([float(v) for v in fields["rotation"].split(",")], (3, 3), order="F")
        T[:3, 3] = [float(v) for v in fields["translation"].split(",")]
        return se3.orthonormal(checked_pose("extrinsics", T))
    except (KeyError, ValueError) as error:
        raise DataError(f"{file.path}: extrinsics of {stream}: {error}; give --calib") from None
