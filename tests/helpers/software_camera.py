"""A camera that is not there: the real SDK's `software_device`, fed by a test."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

SIZE = (640, 480)
T_GYRO_IR = (-0.00552, 0.0051, 0.01174)
BASELINE = 0.05
DEPTH_UNIT_M = 0.0005


class Listed:
    """In place of `rs.context`, which does not list devices of software."""

    def __init__(self, devices: list[Any]) -> None:
        self.devices = devices

    def query_devices(self) -> list[Any]:
        return self.devices


class SoftwareCamera:
    """Stereo infrared, depth and an IMU with the names and profiles of a D435i. `rs`: pyrealsense2.

    rate_hz: of images; lens: fx, fy, cx, cy of all of them, px; depth: it has a depth stream too. accel_hz,
    gyro_hz: all that the IMU offers; it delivers by the first."""

    def __init__(
        self,
        rs: Any,
        serial: str = "0123",
        firmware: str = "5.16.0.1",
        usb: str = "3.2",
        rate_hz: int = 30,
        lens: tuple[float, float, float, float] = (385.0, 386.0, 320.5, 239.5),
        depth: bool = False,
        accel_hz: tuple[int, ...] = (250,),
        gyro_hz: tuple[int, ...] = (400,),
    ) -> None:
        self.rs, self.device = rs, rs.software_device()
        self._rate_hz, self._lens = rate_hz, lens
        reported = rs.camera_info
        self.device.register_info(reported.serial_number, serial)
        self.device.register_info(reported.name, "Intel RealSense D435I")
        self.device.register_info(reported.firmware_version, firmware)
        self.device.register_info(reported.usb_type_descriptor, usb)
        self.stereo = self.device.add_sensor("Stereo Module")
        self.motion = self.device.add_sensor("Motion Module")
        self.cam = [self._video(rs.stream.infrared, index) for index in (1, 2)]
        if depth:
            self.stereo.add_read_only_option(rs.option.depth_units, DEPTH_UNIT_M)
        self.depth = self._video(rs.stream.depth, 0) if depth else None
        self.accel, *_ = [self._inertial(rs.stream.accel, 3, hz) for hz in accel_hz]
        self.gyro, *_ = [self._inertial(rs.stream.gyro, 4, hz) for hz in gyro_hz]
        self.cam[0].register_extrinsics_to(self.cam[1], self._shift(-BASELINE, 0.0, 0.0))
        if depth:
            self.cam[0].register_extrinsics_to(self.depth, self._shift(0.0, 0.0, 0.0))
        self.cam[0].register_extrinsics_to(self.gyro, self._shift(*T_GYRO_IR))
        self._numbers = {id(p): itertools.count() for p in (*self.cam, self.depth, self.accel, self.gyro)}
        self.context = Listed([self.device])

    def image(self, eye: int, stamp_us: int, pixels: np.ndarray, domain: Any = None, skip: int = 0) -> None:
        """Deliver a picture (480, 640) of eye 0 or 1; skip: frame numbers that are left out before it."""
        for _ in range(skip):
            next(self._numbers[id(self.cam[eye])])
        self._picture(self.cam[eye], stamp_us, pixels, domain)

    def far(self, stamp_us: int, steps: np.ndarray) -> None:
        """Deliver a depth map (480, 640) uint16 in steps of DEPTH_UNIT_M."""
        self._picture(self.depth, stamp_us, steps, None)

    def _picture(self, profile: Any, stamp_us: int, pixels: np.ndarray, domain: Any) -> None:
        frame = self.rs.software_video_frame()
        frame.pixels, frame.bpp = np.ascontiguousarray(pixels), pixels.itemsize
        frame.stride, frame.depth_units = SIZE[0] * pixels.itemsize, DEPTH_UNIT_M
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

    def _video(self, kind: Any, index: int) -> Any:
        rs, stream = self.rs, self.rs.video_stream()
        deep = kind == rs.stream.depth
        stream.type, stream.index, stream.uid = kind, index, 5 if deep else index
        stream.fmt, stream.bpp = (rs.format.z16, 2) if deep else (rs.format.y8, 1)
        stream.width, stream.height, stream.fps = *SIZE, self._rate_hz
        lens = rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = *SIZE, *self._lens
        lens.model = rs.distortion.brown_conrady
        stream.intrinsics = lens
        return self.stereo.add_video_stream(stream)

    def _inertial(self, kind: Any, uid: int, rate_hz: int) -> Any:
        stream = self.rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, rate_hz
        stream.fmt, stream.intrinsics = self.rs.format.motion_xyz32f, self.rs.motion_device_intrinsic()
        return self.motion.add_motion_stream(stream)

    def _shift(self, *metres: float) -> Any:
        reported = self.rs.extrinsics()
        reported.rotation, reported.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], list(metres)
        return reported
