"""Convert the SDK's data: frames to samples, the factory calibration to a rig with the body in the IMU.

Pixels are copied at once, since the SDK has few buffers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.checks import checked_pose
from share.errors import DataError
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import EQUIDISTANT, RADTAN
from share.recordings.images import ArrayImage
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample
from share.types import F32, F64

_INTEGER_TOLERANCE = 1e-3  # of the inverse of a depth unit


def to_sample(rs: Any, frame: Any, depth_unit_m: float, arrived_ns: int, epoch: int) -> DeviceSample:
    """Return a sample: an image, a depth map (m) or three IMU values, with the device's stamp in whole µs."""
    stream = _stream_name(rs, frame.profile)
    motion = stream in (ACCEL, GYRO)
    return DeviceSample(
        stream=stream,
        stamp_ns=round(frame.timestamp * 1e3) * 1000,
        payload=_motion_values(frame) if motion else ArrayImage(_pixels(frame, stream, depth_unit_m)),
        arrived_ns=arrived_ns,
        number=None if motion else int(frame.frame_number),  # the IMU's two streams may share a counter
        is_device_clock=frame.frame_timestamp_domain == rs.timestamp_domain.hardware_clock,
        epoch=epoch,
    )


def has_dots(rs: Any, frame: Any) -> bool | None:
    """Return whether the emitter was on; None if the frame lacks the metadata."""
    metadata = rs.frame_metadata_value
    # Not the laser power, which is only a setting.
    for kind in (metadata.frame_emitter_mode, metadata.frame_laser_power_mode):
        if frame.supports_frame_metadata(kind):
            return bool(frame.get_frame_metadata(kind))
    return None


def _stream_name(rs: Any, profile: Any) -> str:
    kind = profile.stream_type()
    if kind == rs.stream.infrared:
        return CAM0 if profile.stream_index() == 1 else CAM1
    return {rs.stream.depth: DEPTH, rs.stream.accel: ACCEL, rs.stream.gyro: GYRO}[kind]


def _motion_values(frame: Any) -> list[float]:
    motion = frame.as_motion_frame().get_motion_data()
    return [motion.x, motion.y, motion.z]


def _pixels(frame: Any, stream: str, depth_unit_m: float) -> NDArray[Any]:
    pixels = np.asarray(frame.get_data())
    return scale_depth(pixels, depth_unit_m) if stream == DEPTH else pixels.copy()


def scale_depth(steps: NDArray[np.uint16], unit_m: float) -> F32:
    """Return depth (H, W) in m. The SDK gives the unit in single precision. A unit near 1/n m is taken as
    exactly that, by division, so that whole millimetres are exact to the last bit."""
    n = round(1 / unit_m)
    if n and abs(1 / unit_m - n) < _INTEGER_TOLERANCE:
        return np.asarray(steps / np.float32(n))
    return np.asarray(steps * np.float32(unit_m))


# ---- The factory calibration


def factory_rig(rs: Any, profiles: dict[str, Any], noise: ImuNoise | None) -> Rig:
    """Return the rig. profiles: SDK stream profiles of cam0 and, if read, of cam1, depth and gyro, by stream.

    noise: of the IMU; the factory gives none. Raises DataError for an unknown lens model or invalid values.
    """
    cam0 = profiles[CAM0]
    try:
        rig: dict[str, Any] = {"cam0": read_camera(rs, cam0), "T_body_cam0": np.eye(4)}
        for name in (CAM1, DEPTH):
            if name in profiles:
                rig |= {name: read_camera(rs, profiles[name])}
                rig |= {f"T_{name}_cam0": read_extrinsics(cam0, profiles[name])}
        if GYRO in profiles and noise is not None:
            rig |= {"imu": noise, "T_body_cam0": read_extrinsics(cam0, profiles[GYRO])}
        return Rig(**rig)
    except ValueError as error:
        raise DataError(f"the camera's factory calibration: {error}") from None


def read_extrinsics(source: Any, target: Any) -> F64:
    """Return T_target_source (4, 4) of two stream profiles. The SDK's rotation is column-major."""
    extrinsics = source.get_extrinsics_to(target)
    T = np.eye(4)
    T[:3, :3] = np.reshape(extrinsics.rotation, (3, 3), order="F")
    T[:3, 3] = extrinsics.translation
    return se3.orthonormal(checked_pose("extrinsics", T))  # the SDK's single precision is rigid to 1e-7 only


def read_camera(rs: Any, profile: Any) -> Camera:
    """Return the intrinsics of a video stream profile. Raises ValueError for an unknown distortion model."""
    found = profile.as_video_stream_profile().get_intrinsics()
    distortion, model = tuple(float(c) for c in found.coeffs), RADTAN
    if found.model == rs.distortion.kannala_brandt4:  # T265; the fifth coefficient is 0
        distortion, model = distortion[:4], EQUIDISTANT
    elif not any(distortion):
        distortion = ()
    elif found.model != rs.distortion.brown_conrady:
        raise ValueError(f"distortion model {found.model} is unknown; calibrate it: `share calibrate camera`")
    return Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, distortion, model)
