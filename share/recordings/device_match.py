"""Of which device a calibration is, and whether that is the one at hand: no two units are alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from share.geometry.camera import Camera, Rig


def device_mismatch(named_serials: Sequence[str], serial: str | None) -> str | None:
    """A line where a calibration is of another device than `serial`; None where it is of that one, or where
    nobody knows. said: the serial numbers that it names, each once."""
    others = [one for one in named_serials if one != serial]
    if not others or not serial:
        return None
    return (
        f"the calibration is of device {', '.join(others)}, this is {serial}: poses will be less exact; "
        "give its own with --calib, or leave it out for the one that the device brings"
    )


def fit_to_device(calibrated: Rig, device_rig: Rig) -> Rig:
    """A calibration less the cameras that are not read. own: what the device says of itself, as it is read.

    Raises ValueError where an image has another size than the calibration's."""
    for name in ("cam0", "cam1", "depth"):
        calibrated_camera, device_camera = getattr(calibrated, name), getattr(device_rig, name)
        if (
            calibrated_camera is not None
            and device_camera is not None
            and _size(calibrated_camera) != _size(device_camera)
        ):
            raise ValueError(
                f"its {name} is {_size(calibrated_camera)}, the camera sends "
                f"{_size(device_camera)}; add "
                f"--mode {_size(calibrated_camera)}"
            )
    if device_rig.cam1 is None:
        calibrated = replace(calibrated, cam1=None, T_cam1_cam0=None)
    return calibrated if device_rig.depth is not None else replace(calibrated, depth=None, T_depth_cam0=None)


def uncalibrated_sensors(calibrated: Rig, device_rig: Rig) -> tuple[str, ...]:
    """A line for each camera, and the IMU, that is read and not in the calibration."""
    names = [
        name
        for name in ("cam1", "depth", "imu")
        if getattr(device_rig, name) and not getattr(calibrated, name)
    ]
    return tuple(f"{name} is not used: the calibration has no {name}" for name in names)


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
