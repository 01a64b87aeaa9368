"""What a tracker needs of a rig, beyond what cameras and IMUs can be at all (`share.geometry.camera`).

A rig that lacks it is a mistake in a calibration: it would give no poses, or wrong ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.camera import BASELINE_M, Camera, ImuNoise, Rig, rays
from share.geometry.lens import WIDEST_DEG
from share.types import F64

_LEAST_PX = 32  # of an image's side: less holds no features
_FIELD_DEG = (5.0, 170.0)  # from edge to edge, as the lens has it
_SQUARE = 2.0  # times that a pixel may be longer than wide, or a camera's focal length than another's
_GRID = (17, 13)  # of pixels that a lens is tried at
_EXACT_PX = 0.5  # of the way there and back
_FOLDED, _SHARED = 0.1, 0.2  # parts of an image: that may have no ray; that another camera has to see
_USED = 0.4  # part of a fisheye lens's image that has to be of use
_SEEN_M = (1.0, 5.0)  # what is held before two cameras
_ROLL_DEG = 30.0  # by which two images may be turned against each other
_LEVER_M = 10.0  # from the IMU to the camera
_DENSITY = {"gyroscope": (1e-7, 1.0), "accelerometer": (1e-6, 10.0)}  # rad/s, m/s^2, both by sqrt(Hz)
_MOST_WALK = 1.0


def objection(rig: Rig) -> str | None:
    """Why no tracker can use this rig, and how to mend it; None if one can."""
    return next(_objections(rig), None)


def lens_objection(camera: Camera) -> str | None:
    """The same of one camera."""
    return next(_of_lens(camera), None)


def _objections(rig: Rig) -> Iterator[str]:
    if rig.imu is None and rig.cam1 is None and rig.depth is None:
        yield "one camera alone gives no scale; stereo, depth or an IMU is needed"
    for name, camera in (("cam0", rig.cam0), ("cam1", rig.cam1), ("depth", rig.depth)):
        if camera is not None:
            yield from (f"{name}: {why}" for why in _of_lens(camera))
    if rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        yield from _of_pair(rig.cam0, rig.cam1, rig.T_cam1_cam0)
    if rig.depth is not None and rig.T_depth_cam0 is not None:
        yield from _of_depth(rig.cam0, rig.depth, rig.T_depth_cam0)
    if rig.imu is not None:
        yield from _of_imu(rig.imu, float(np.linalg.norm(rig.T_body_cam0[:3, 3])))


def _of_lens(camera: Camera) -> Iterator[str]:
    size = f"{camera.width}x{camera.height}"
    if min(camera.width, camera.height) < _LEAST_PX:
        yield f"images of {size} px hold no features; at least {_LEAST_PX} px a side are needed"
    if not 0 <= camera.cx < camera.width or not 0 <= camera.cy < camera.height:
        yield (
            f"the principal point {camera.cx:g}, {camera.cy:g} lies outside an image of {size}; is the "
            "calibration of another resolution?"
        )
    if not 1 / _SQUARE <= camera.fx / camera.fy <= _SQUARE:
        yield f"focal lengths {camera.fx:g} and {camera.fy:g} px: pixels are nearly square; calibrate again"
    with np.errstate(all="ignore"):
        uv, known = _tried(camera)
    if camera.fisheye and (beyond := _beyond(camera)).any():  # of no use, and no fault
        if 1 - beyond.mean() < _USED:
            yield (
                f"{100 * beyond.mean():.0f} % of its image lie beyond {WIDEST_DEG:g} degrees off the axis, "
                "where nothing is tracked; focal lengths are in pixels of the images that are recorded"
            )
            return
        uv, known = uv[~beyond], known[~beyond]
    folded = 1 - known.mean()
    if folded > _FOLDED:
        yield (
            f"its distortion folds {100 * folded:.0f} % of the image; calibrate again, with boards in the "
            "corners"
        )
        return
    across, (least, most) = _field(uv[known]), _FIELD_DEG
    if not least <= across.min() <= across.max() <= most:
        yield (
            f"it would see {across[0]:.3g} by {across[1]:.3g} degrees, not {least:g} to {most:g}; focal "
            "lengths are in pixels of the images that are recorded"
        )


def _pixels(camera: Camera) -> F64:
    """(N, 2) all over the image."""
    x, y = np.linspace(0, camera.width - 1, _GRID[0]), np.linspace(0, camera.height - 1, _GRID[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _beyond(camera: Camera) -> NDArray[np.bool_]:
    """Which of the pixels that are tried have a ray, but no normalised coordinates."""
    z = camera.directions(_pixels(camera))[:, 2]
    return np.asarray(z < np.cos(np.radians(WIDEST_DEG)))


def _tried(camera: Camera) -> tuple[F64, NDArray[np.bool_]]:
    """Of pixels all over the image their normalised coordinates (N, 2), and which (N,) really are: the same
    way up as in the middle, and back to where they came from."""
    px = _pixels(camera)
    uv = camera.normalise(px)
    back = np.abs(camera.distort(uv) - px).max(axis=1)
    upright = np.linalg.det(camera.jacobian(uv)) > 0
    return uv, (back < _EXACT_PX) & upright


def _field(uv: F64) -> F64:
    """Across and upright (2,), degrees: what the rays (N, 2) span."""
    out: F64 = np.degrees(np.ptp(np.arctan(uv), axis=0))
    return out


def _of_pair(cam0: Camera, cam1: Camera, T_cam1_cam0: F64) -> Iterator[str]:
    if not 1 / _SQUARE <= cam0.focal / cam1.focal <= _SQUARE:
        yield f"cam1: focal length {cam1.focal:g} px, but {cam0.focal:g} of cam0; they must look alike"
    shared = _shared(cam0, cam1, T_cam1_cam0)
    if shared < _SHARED:
        yield (
            f"T_cam1_cam0: cam1 sees {100 * shared:.0f} % of what cam0 sees; look whether it takes "
            "coordinates of cam0 to cam1, and not the other way round"
        )
    roll = abs(np.degrees(np.arctan2(T_cam1_cam0[1, 0], T_cam1_cam0[0, 0])))
    if roll > _ROLL_DEG:
        yield (
            f"T_cam1_cam0: cam1's images are turned by {roll:.0f} degrees against cam0's; turn them upright, "
            "and their calibration"
        )


def _of_depth(cam0: Camera, depth: Camera, T_depth_cam0: F64) -> Iterator[str]:
    apart = float(np.linalg.norm(T_depth_cam0[:3, 3]))
    if apart > BASELINE_M[1]:
        yield f"T_depth_cam0: the depth camera is {apart:g} m from cam0; translations are in metres"
    shared = _shared(cam0, depth, T_depth_cam0)
    if shared < _SHARED:
        yield (
            f"T_depth_cam0: the depth camera sees {100 * shared:.0f} % of what cam0 sees; look whether it "
            "takes coordinates of cam0 to the depth camera"
        )


def _shared(camera: Camera, other: Camera, T_other_camera: F64) -> float:
    """The part of the camera's image that the other sees, where things are neither near nor far."""
    with np.errstate(all="ignore"):
        uv, known = _tried(camera)
        theirs, valid = _tried(other)
        widest = np.abs(theirs[valid]).max(axis=0, initial=0.0)
        seen = []
        for z in _SEEN_M:
            points = se3.transform(T_other_camera, rays(uv[known]) * z)
            within = (points[:, 2:] > 0) & (np.abs(points[:, :2] / points[:, 2:]) <= widest)
            inside = other.inside(np.nan_to_num(other.project(points), nan=-1.0))
            seen.append(float((within.all(axis=1) & inside).mean()) if len(points) else 0.0)
    return max(seen)


def _of_imu(imu: ImuNoise, lever_m: float) -> Iterator[str]:
    told = {"gyroscope": imu.gyro_density, "accelerometer": imu.accel_density}
    for name, density in told.items():
        least, most = _DENSITY[name]
        if not least <= density <= most:
            yield (
                f"IMU: {name}_noise_density {density:g} is no sensor's, which has {least:g} to {most:g}; "
                "calibrate it with `share calibrate imu`"
            )
    if max(imu.gyro_walk, imu.accel_walk) > _MOST_WALK:
        yield (
            f"IMU: a random walk above {_MOST_WALK:g} is no sensor's; calibrate it with `share calibrate imu`"
        )
    if lever_m > _LEVER_M:
        yield (
            f"T_cam_imu: the camera is {lever_m:g} m from the IMU, more than {_LEVER_M:g}; translations are "
            "in metres"
        )
