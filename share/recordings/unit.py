"""Of which device a calibration is, and whether that is the one at hand: no two units are alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from share.geometry.camera import Camera, Rig


def of_another(said: Sequence[str], serial: str | None) -> str | None:
    """A line where a calibration is of another device than `serial`; None where it is of that one, or where
    nobody knows. said: the serial numbers that it names, each once."""
    others = [one for one in said if one != serial]
    if not others or not serial:
        return None
    return (
        f"the calibration is of device {', '.join(others)}, this is {serial}: poses will be less exact; "
        "give its own with --calib, or leave it out for the one that the device brings"
    )


def as_read(given: Rig, own: Rig) -> Rig:
    """A calibration less the cameras that are not read. own: what the device says of itself, as it is read.

    Raises ValueError where an image has another size than the calibration's."""
    for name in ("cam0", "cam1", "depth"):
        wanted, there = getattr(given, name), getattr(own, name)
        if wanted is not None and there is not None and _size(wanted) != _size(there):
            raise ValueError(
                f"its {name} is {_size(wanted)}, the camera sends {_size(there)}; add --mode {_size(wanted)}"
            )
    if own.cam1 is None:
        given = replace(given, cam1=None, T_cam1_cam0=None)
    return given if own.depth is not None else replace(given, depth=None, T_depth_cam0=None)


def unused(given: Rig, own: Rig) -> tuple[str, ...]:
    """A line for each camera, and the IMU, that is read and not in the calibration."""
    names = [name for name in ("cam1", "depth", "imu") if getattr(own, name) and not getattr(given, name)]
    return tuple(f"{name} is not used: the calibration has no {name}" for name in names)


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
