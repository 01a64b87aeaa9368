"""A camera that is not there: the real SDK's `software_device`, fed by a test."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

SIZE = (640, 480)
T_GYRO_IR = (-0.00552, 0.0051, 0.01174)
BASELINE = 0.05


class Listed:
    """In place of `rs.context`, which does not list devices of software."""

    def __init__(self, devices: list[Any]) -> None:
        self.devices = devices

    def query_devices(self) -> list[Any]:
        return self.devices


class SoftwareCamera:
    """Stereo infrared and an IMU with the names and profiles of a D435i. `rs`: pyrealsense2."""

    def __init__(self, rs: Any, serial: str = "0123", firmware: str = "5.16.0.1", usb: str = "3.2") -> None:
        self.rs, self.device = rs, rs.software_device()
        told = rs.camera_info
        self.device.register_info(told.serial_number, serial)
        self.device.register_info(told.name, "Intel RealSense D435I")
        self.device.register_info(told.firmware_version, firmware)
        self.device.register_info(told.usb_type_descriptor, usb)
        self.stereo = self.device.add_sensor("Stereo Module")
        self.motion = self.device.add_sensor("Motion Module")
        self.cam = [self._video(index) for index in (1, 2)]
        self.accel = self._inertial(rs.stream.accel, 3, 250)
        self.gyro = self._inertial(rs.stream.gyro, 4, 400)
        self.cam[0].register_extrinsics_to(self.cam[1], self._shift(-BASELINE, 0.0, 0.0))
        self.cam[0].register_extrinsics_to(self.gyro, self._shift(*T_GYRO_IR))
        self._numbers = {id(p): itertools.count() for p in (*self.cam, self.accel, self.gyro)}
        self.context = Listed([self.device])

    def image(self, eye: int, stamp_us: int, pixels: np.ndarray, domain: Any = None, skip: int = 0) -> None:
        """Deliver a picture (480, 640) of eye 0 or 1; skip: frame numbers that are left out before it."""
        frame = self.rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = np.ascontiguousarray(pixels), SIZE[0], 1
        profile = self.cam[eye]
        for _ in range(skip):
            next(self._numbers[id(profile)])
        frame.profile = profile.as_video_stream_profile()
        self.stereo.on_video_frame(self._stamped(frame, profile, stamp_us, domain))

    def turn(self, stamp_us: int, x: float, y: float, z: float) -> None:
        self._move(self.gyro, stamp_us, x, y, z)

    def force(self, stamp_us: int, x: float, y: float, z: float) -> None:
        self._move(self.accel, stamp_us, x, y, z)

    def _move(self, profile: Any, stamp_us: int, *values: float) -> None:
        frame = self.rs.software_motion_frame()
        data = self.rs.vector()
        data.x, data.y, data.z = values
        frame.data, frame.profile = data, profile.as_motion_stream_profile()
        self.motion.on_motion_frame(self._stamped(frame, profile, stamp_us, None))

    def _stamped(self, frame: Any, profile: Any, stamp_us: int, domain: Any) -> Any:
        frame.timestamp = stamp_us / 1000
        frame.domain = self.rs.timestamp_domain.hardware_clock if domain is None else domain
        frame.frame_number = next(self._numbers[id(profile)])
        return frame

    def _video(self, index: int) -> Any:
        rs, stream = self.rs, self.rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = rs.stream.infrared, index, index, rs.format.y8
        stream.width, stream.height, stream.fps, stream.bpp = *SIZE, 30, 1
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = *SIZE, 385.0, 386.0, 320.5, 239.5
        lens.model = rs.distortion.brown_conrady
        stream.intrinsics = lens
        return self.stereo.add_video_stream(stream)

    def _inertial(self, kind: Any, uid: int, rate_hz: int) -> Any:
        stream = self.rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, rate_hz
        stream.fmt, stream.intrinsics = self.rs.format.motion_xyz32f, self.rs.motion_device_intrinsic()
        return self.motion.add_motion_stream(stream)

    def _shift(self, *metres: float) -> Any:
        told = self.rs.extrinsics()
        told.rotation, told.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], list(metres)
        return told
