"""Conversion of a RealSense's factory calibration to a `Rig`, body = IMU."""

from __future__ import annotations

from typing import Any

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import EQUIDISTANT
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.sample_processor import GYRO
from share.types import F64, checked_pose


def factory_rig(rs: Any, profiles: dict[str, Any], noise: ImuNoise | None) -> Rig:
    """Return the rig. profiles: SDK stream profiles of cam0 and, if read, of cam1, depth and gyro, by stream.

    noise: of the IMU; the factory gives none. Raises DataError for an unknown lens model or invalid values.
    """
    cam0 = profiles[CAM0]
    try:
        rig: dict[str, Any] = {"cam0": read_camera(rs, cam0), "T_body_cam0": np.eye(4)}
        if CAM1 in profiles:
            rig |= {
                "cam1": read_camera(rs, profiles[CAM1]),
                "T_cam1_cam0": read_extrinsics(cam0, profiles[CAM1]),
            }
        if DEPTH in profiles:
            rig |= {
                "depth": read_camera(rs, profiles[DEPTH]),
                "T_depth_cam0": read_extrinsics(cam0, profiles[DEPTH]),
            }
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
    intrinsics_data = profile.as_video_stream_profile().get_intrinsics()
    coefficients = tuple(float(c) for c in intrinsics_data.coeffs)
    if intrinsics_data.model == rs.distortion.kannala_brandt4:  # T265; the fifth coefficient is 0
        intrinsics = (intrinsics_data.fx, intrinsics_data.fy, intrinsics_data.ppx, intrinsics_data.ppy)
        return Camera(
            intrinsics_data.width, intrinsics_data.height, *intrinsics, coefficients[:4], EQUIDISTANT
        )
    if any(coefficients) and intrinsics_data.model != rs.distortion.brown_conrady:
        raise ValueError(
            f"distortion model {intrinsics_data.model} is unknown; calibrate with `share calibrate camera`"
        )
    return Camera(
        intrinsics_data.width,
        intrinsics_data.height,
        intrinsics_data.fx,
        intrinsics_data.fy,
        intrinsics_data.ppx,
        intrinsics_data.ppy,
        coefficients if any(coefficients) else (),
    )
