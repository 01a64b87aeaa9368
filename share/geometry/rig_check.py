"""Check a rig for what a tracker needs, beyond what `share.geometry.camera` demands of cameras and IMUs.

A rig that fails has a mistake in its calibration: it would give no poses, or wrong ones.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.camera import BASELINE_RANGE_M, Camera, ImuNoise, Rig, rays
from share.geometry.lens import MAX_FIELD_DEG
from share.types import F64

_MIN_SIDE_PX = 32  # of an image
_FIELD_RANGE_DEG = (5.0, 170.0)  # from edge to edge
_MAX_ASPECT = 2.0  # ratio of fx and fy, and of the focal lengths of two cameras
_GRID = (17, 13)  # pixels at which a lens is checked
_ROUND_TRIP_PX = 0.5  # error of normalising and distorting
_MAX_FOLDED = 0.1  # part of an image without a ray
_MIN_OVERLAP = 0.2  # part of an image that the other camera must see
_MIN_USABLE = 0.4  # part of a fisheye lens's image within `MAX_FIELD_DEG`
_OVERLAP_DEPTHS_M = (1.0, 5.0)  # at which the overlap of two cameras is computed
_MAX_ROLL_DEG = 30.0  # between two cameras
_MAX_LEVER_M = 10.0  # from the IMU to the camera
_DENSITY_RANGE = {"gyroscope": (1e-7, 1.0), "accelerometer": (1e-6, 10.0)}  # rad/s, m/s^2 by sqrt(Hz)
_MAX_WALK = 1.0


def rig_problem(rig: Rig) -> str | None:
    """Return why no tracker can use this rig, and how to repair it; None if one can."""
    return next(_rig_problems(rig), None)


def lens_problem(camera: Camera) -> str | None:
    """Return why no tracker can use this camera, and how to repair it; None if one can."""
    return next(_lens_problems(camera), None)


def _rig_problems(rig: Rig) -> Iterator[str]:
    if rig.imu is None and rig.cam1 is None and rig.depth is None:
        yield "one camera alone gives no scale; stereo, depth or an IMU is needed"
    for name, camera in rig.cameras.items():
        yield from (f"{name}: {problem}" for problem in _lens_problems(camera))
    if rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        yield from _stereo_problems(rig.cam0, rig.cam1, rig.T_cam1_cam0)
    if rig.depth is not None and rig.T_depth_cam0 is not None:
        yield from _depth_problems(rig.cam0, rig.depth, rig.T_depth_cam0)
    if rig.imu is not None:
        yield from _imu_problems(rig.imu, float(np.linalg.norm(rig.T_body_cam0[:3, 3])))


def _lens_problems(camera: Camera) -> Iterator[str]:
    size = f"{camera.width}x{camera.height}"
    if min(camera.width, camera.height) < _MIN_SIDE_PX:
        yield f"images of {size} px hold no features; use at least {_MIN_SIDE_PX} px a side"
    if not 0 <= camera.cx < camera.width or not 0 <= camera.cy < camera.height:
        yield (
            f"the principal point {camera.cx:g}, {camera.cy:g} lies outside an image of {size}; is the "
            "calibration of another resolution?"
        )
    if not 1 / _MAX_ASPECT <= camera.fx / camera.fy <= _MAX_ASPECT:
        yield (
            f"focal lengths {camera.fx:g} and {camera.fy:g} px differ, but pixels are nearly square; "
            "calibrate again"
        )
    with np.errstate(all="ignore"):
        uv, is_valid = _round_trip(camera)
    if camera.is_fisheye and (beyond := _is_beyond_field(camera)).any():  # not used, and not wrong
        if 1 - beyond.mean() < _MIN_USABLE:
            yield (
                f"{100 * beyond.mean():.0f} % of its image lie beyond {MAX_FIELD_DEG:g} degrees off the "
                "axis, where nothing is tracked; give focal lengths in pixels of the recorded images"
            )
            return
        uv, is_valid = uv[~beyond], is_valid[~beyond]
    folded = 1 - is_valid.mean()
    if folded > _MAX_FOLDED:
        yield (
            f"its distortion folds {100 * folded:.0f} % of the image; calibrate again, with the board in the "
            "corners of the image"
        )
        return
    across, (lowest, highest) = _field_deg(uv[is_valid]), _FIELD_RANGE_DEG
    if not lowest <= across.min() <= across.max() <= highest:
        yield (
            f"its field of view is {across[0]:.3g} by {across[1]:.3g} degrees, not within {lowest:g} to "
            f"{highest:g}; give focal lengths in pixels of the recorded images"
        )


def _pixel_grid(camera: Camera) -> F64:
    """Return pixels (N, 2) all over the image."""
    x, y = np.linspace(0, camera.width - 1, _GRID[0]), np.linspace(0, camera.height - 1, _GRID[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _is_beyond_field(camera: Camera) -> NDArray[np.bool_]:
    """Return which pixels of the grid have a ray, but no normalised coordinates."""
    z = camera.directions(_pixel_grid(camera))[:, 2]
    return np.asarray(z < np.cos(np.radians(MAX_FIELD_DEG)))


def _round_trip(camera: Camera) -> tuple[F64, NDArray[np.bool_]]:
    """Return the normalised coordinates (N, 2) of the pixel grid, and which (N,) are valid: not mirrored,
    and mapped back to the pixel."""
    px = _pixel_grid(camera)
    uv = camera.normalise(px)
    back = np.abs(camera.distort(uv) - px).max(axis=1)
    upright = np.linalg.det(camera.jacobian(uv)) > 0
    return uv, (back < _ROUND_TRIP_PX) & upright


def _field_deg(uv: F64) -> F64:
    """Return the horizontal and vertical angle (2,), degrees, that the rays (N, 2) span."""
    out: F64 = np.degrees(np.ptp(np.arctan(uv), axis=0))
    return out


def _stereo_problems(cam0: Camera, cam1: Camera, T_cam1_cam0: F64) -> Iterator[str]:
    if not 1 / _MAX_ASPECT <= cam0.focal / cam1.focal <= _MAX_ASPECT:
        yield (
            f"cam1: focal length {cam1.focal:g} px, but {cam0.focal:g} px in cam0; both need similar lenses "
            "and resolutions"
        )
    shared = _overlap(cam0, cam1, T_cam1_cam0)
    if shared < _MIN_OVERLAP:
        yield (
            f"T_cam1_cam0: cam1 sees {100 * shared:.0f} % of what cam0 sees; check that it takes coordinates "
            "of cam0 to cam1, not the inverse"
        )
    roll = abs(np.degrees(np.arctan2(T_cam1_cam0[1, 0], T_cam1_cam0[0, 0])))
    if roll > _MAX_ROLL_DEG:
        yield (
            f"T_cam1_cam0: cam1's images are turned by {roll:.0f} degrees against cam0's; rotate them and "
            "their calibration"
        )


def _depth_problems(cam0: Camera, depth: Camera, T_depth_cam0: F64) -> Iterator[str]:
    apart = float(np.linalg.norm(T_depth_cam0[:3, 3]))
    if apart > BASELINE_RANGE_M[1]:
        yield f"T_depth_cam0: the depth camera is {apart:g} m from cam0; give translations in metres"
    shared = _overlap(cam0, depth, T_depth_cam0)
    if shared < _MIN_OVERLAP:
        yield (
            f"T_depth_cam0: the depth camera sees {100 * shared:.0f} % of what cam0 sees; check that it "
            "takes coordinates of cam0 to the depth camera, not the inverse"
        )


def _overlap(camera: Camera, other: Camera, T_other_camera: F64) -> float:
    """Return the part of the camera's image that the other camera sees, at the better of two depths."""
    with np.errstate(all="ignore"):
        uv, known = _round_trip(camera)
        other_uv, valid = _round_trip(other)
        widest = np.abs(other_uv[valid]).max(axis=0, initial=0.0)
        shares = []
        for z in _OVERLAP_DEPTHS_M:
            points = se3.transform(T_other_camera, rays(uv[known]) * z)
            within = (points[:, 2:] > 0) & (np.abs(points[:, :2] / points[:, 2:]) <= widest)
            inside = other.is_inside(np.nan_to_num(other.project(points), nan=-1.0))
            shares.append(float((within.all(axis=1) & inside).mean()) if len(points) else 0.0)
    return max(shares)


def _imu_problems(imu: ImuNoise, lever_m: float) -> Iterator[str]:
    densities = {"gyroscope": imu.gyro_density, "accelerometer": imu.accel_density}
    for name, density in densities.items():
        lowest, highest = _DENSITY_RANGE[name]
        if not lowest <= density <= highest:
            yield (
                f"IMU: {name}_noise_density {density:g} is not within {lowest:g} to {highest:g}; "
                "calibrate it with `share calibrate imu`"
            )
    if max(imu.gyro_walk, imu.accel_walk) > _MAX_WALK:
        yield (f"IMU: a random walk is above {_MAX_WALK:g}; calibrate it with `share calibrate imu`")
    if lever_m > _MAX_LEVER_M:
        yield (
            f"T_cam_imu: the camera is {lever_m:g} m from the IMU, more than {_MAX_LEVER_M:g}; give "
            "translations in metres"
        )
