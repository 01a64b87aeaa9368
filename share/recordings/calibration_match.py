"""Match a calibration to the recording or the device at hand: its streams, image sizes and unit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from share.errors import ConfigError
from share.geometry.camera import Camera, Rig
from share.sensors.measurement import IMU
from share.sensors.sequencer import rig_streams


def device_mismatch(named_serials: Sequence[str], serial: str | None) -> tuple[str, ...]:
    """Return a warning if a calibration is of another device than `serial`, since units of one model differ;
    none if it is not, or unknown.

    named_serials: the distinct serial numbers that the calibration names.
    """
    others = [one for one in named_serials if one != serial]
    if not others or not serial:
        return ()
    return (
        f"the calibration is of device {', '.join(others)}, this is {serial}: poses will be less accurate; "
        "give the calibration of this device with --calib, or leave it out for the device's own",
    )


def unused_streams(streams: Mapping[str, str], rig: Rig) -> tuple[str, ...]:
    """Return a note for each stream that is there and that the calibration lacks. streams: names to print."""
    used = rig_streams(rig)
    return tuple(
        f"{name} is not used: the calibration has no {stream}"
        for stream, name in streams.items()
        if stream not in used
    )


def fit_to_recording(rig: Rig, recorded: Collection[str], where: object) -> Rig:
    """Return the rig, without the IMU if none was recorded. Raises ConfigError if a camera was not."""
    if missing := [stream for stream in rig.cameras if stream not in recorded]:
        raise ConfigError(
            f"{where}: the calibration has {missing[0]}, the recording does not; give another --calib"
        )
    return rig.without_imu() if rig.imu and IMU not in recorded else rig


def fit_to_device(calibrated: Rig, device_rig: Rig) -> Rig:
    """Return a calibration without the cameras that the device does not deliver.

    device_rig: the device's own calibration of the streams in use. Raises ValueError for an image size that
    differs from the calibration's."""
    for name, camera in calibrated.cameras.items():
        device_camera = device_rig.cameras.get(name, camera)
        if _size(camera) != _size(device_camera):
            raise ValueError(
                f"its {name} is {_size(camera)}, the camera sends {_size(device_camera)}; add "
                f"--mode {_size(camera)}"
            )
    if device_rig.cam1 is None:
        calibrated = replace(calibrated, cam1=None, T_cam1_cam0=None)
    return calibrated if device_rig.depth is not None else replace(calibrated, depth=None, T_depth_cam0=None)


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
