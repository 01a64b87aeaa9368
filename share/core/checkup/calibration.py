"""The calibration: is it of this device, and the right way round?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.core.checkup import Finding, fail, ok, skipped, warn
from share.geometry.camera import Rig
from share.geometry.se3 import angle, inverse
from share.types import F64

_OLD_DAYS = 365.0
_NEAR_M, _NEAR_RAD = 0.01, np.deg2rad(5.0)  # units of one model differ by millimetres and a degree or two
_BASELINE = 0.05  # relative
_DEVICE = "serial number"
_CALIBRATE = "calibrate again: docs/data.md says which files; give the folder with --calib"


def calibration(
    rig: Rig, age_days: float, T_imu_cam0: F64, baseline_m: float, size: tuple[int, int]
) -> Finding:
    """Against what the profile says of such devices: T_imu_cam0 (4, 4), baseline_m, size of images where no
    --mode is given."""
    if rig.imu is None:
        return fail("calibration", "has no IMU chain, kalibr_imu_chain.yaml", _CALIBRATE)
    if rig.T_cam1_cam0 is not None and (wrong := _baseline(rig.T_cam1_cam0, baseline_m)):
        return fail("calibration", wrong, _CALIBRATE)
    if not _near(rig.T_body_cam0, T_imu_cam0):
        return _elsewhere(rig.T_body_cam0, T_imu_cam0)
    found = (rig.cam0.width, rig.cam0.height)
    words = f"{found[0]}x{found[1]}"
    mode = "" if found == size else f"; goes with --mode {words} only"
    what = f"cameras ({words}) and IMU, {age_days:.0f} days old{mode}"
    return ok("calibration", what) if age_days <= _OLD_DAYS else warn("calibration", what, _CALIBRATE)


def device(said: Sequence[str], there: Sequence[str]) -> Finding:
    """Whether it is of a camera that is plugged in. said, there: serial numbers, each once."""
    if not said:
        return skipped(_DEVICE, "the calibration names no serial number")
    if len(said) > 1:
        return warn(_DEVICE, f"its files are of different devices: {', '.join(said)}", *_own(there))
    if not there:
        return skipped(_DEVICE, f"the calibration is of {said[0]}; no camera told its serial number")
    if said[0] in there:
        return ok(_DEVICE, f"{said[0]}, as the calibration says")
    return warn(_DEVICE, f"the calibration is of {said[0]}, plugged in is {', '.join(there)}", *_own(there))


def _own(there: Sequence[str]) -> tuple[str, ...]:
    what = "what the factory measured; then --calib with that folder"
    return tuple(f"share calibrate realsense {one} --out calib/{one}  # {what}" for one in there)


def _baseline(T_cam1_cam0: F64, baseline_m: float) -> str | None:
    """What is wrong with where cam1 is; None: nothing. Right of cam0, so x of cam0's origin is negative."""
    found = float(np.linalg.norm(T_cam1_cam0[:3, 3]))
    if abs(found - baseline_m) > _BASELINE * baseline_m:
        return f"baseline {found * 1e3:.1f} mm, the device has {baseline_m * 1e3:.1f} mm"
    return (
        "cam1 lies left of cam0: T_cn_cnm1 is inverted, or they are swapped"
        if T_cam1_cam0[0, 3] > 0
        else None
    )


def _elsewhere(found: F64, expected: F64) -> Finding:
    if _near(inverse(found), expected):
        mend = "swap the names T_cam_imu and T_imu_cam in the file, or invert the matrix"
        return fail("calibration", "the extrinsics to the IMU are inverted", mend)
    away = 1e3 * float(np.linalg.norm(found[:3, 3] - expected[:3, 3]))
    turned = np.rad2deg(angle(inverse(found) @ expected))
    what = f"cam0 is {away:.0f} mm and {turned:.0f}° from where such devices have it, by the IMU"
    return warn("calibration", what, _CALIBRATE)


def _near(a: F64, b: F64) -> bool:
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) <= _NEAR_M and angle(inverse(a) @ b) <= _NEAR_RAD)
