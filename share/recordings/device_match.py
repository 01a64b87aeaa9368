"""Check that a calibration belongs to the device at hand: units of one model differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from share.geometry.camera import Camera, Rig


def device_mismatch(named_serials: Sequence[str], serial: str | None) -> str | None:
    """Return a warning if a calibration is of another device than `serial`; None if it is not, or unknown.

    named_serials: the distinct serial numbers that the calibration names.
    """
    others = [one for one in named_serials if one != serial]
    if not others or not serial:
        return None
    return (
        f"the calibration is of device {', '.join(others)}, this is {serial}: poses will be less accurate; "
        "give the calibration of this device with --calib, or leave it out for the device's own"
    )


def fit_to_device(calibrated: Rig, device_rig: Rig) -> Rig:
    """Return a calibration without the cameras that the device does not deliver.

    device_rig: the device's own calibration of the streams in use. Raises ValueError for an image size that
    differs from the calibration's."""
    for name in ("cam0", "cam1", "depth"):
        calibrated_camera, device_camera = getattr(calibrated, name), getattr(device_rig, name)
        if (
            calibrated_camera is not None
            and device_camera is not None
            and _size(calibrated_camera) != _size(device_camera)
        ):
            raise ValueError(
                f"its {name} is {_size(calibrated_camera)}, the camera sends {_size(device_camera)}; add "
                f"--mode {_size(calibrated_camera)}"
            )
    if device_rig.cam1 is None:
        calibrated = replace(calibrated, cam1=None, T_cam1_cam0=None)
    return calibrated if device_rig.depth is not None else replace(calibrated, depth=None, T_depth_cam0=None)


def uncalibrated_sensors(calibrated: Rig, device_rig: Rig) -> tuple[str, ...]:
    """Return a note for each sensor that the device delivers and the calibration lacks."""
    names = [
        name
        for name in ("cam1", "depth", "imu")
        if getattr(device_rig, name) and not getattr(calibrated, name)
    ]
    return tuple(f"{name} is not used: the calibration has no {name}" for name in names)


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
