"""What the robot's device measures while it drives: frames drawn from the true path, with their IMU samples.

The device and its errors are the emulator's. The exposure of a frame follows the frames before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

import numpy as np

from share.geometry.camera import Rig
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.sensor.imager import Exposure
from share.lab.emulate.stage import T_body_camera, downsized, image_motion_px
from share.lab.emulate.types import START_NS, RoomRenderer, SceneInstant
from share.lab.robot.body import BodyPath
from share.sensors.measurement import CAM0, CAM1
from share.timing import seconds_to_ns
from share.types import F32, F64, I64, U8, Frame, ImuBatch

MARGIN_NS = seconds_to_ns(0.02)  # the path has to be known so long after a frame: half an exposure, IMU
_EXPOSURE_FRAMES = 40  # from which the next exposure follows
_METER_FACTOR = 8
_STEADY_PX = 0.01  # half the renderer's own error; fans shake a robot that stands by a fifth of it

Others = Callable[[I64], list[dict[str, F64]]]  # parts of other agents at each of session times (N,)


class RobotSensors:
    """Stereo camera and IMU on a body.

    others: the bodies of the other agents. sees_bare_wall: whether a bare wall fills the view, for faults.
    """

    def __init__(
        self,
        rig: Rig,
        device: EmulatedDevice,
        renderer: RoomRenderer,
        body: BodyPath,
        others: Others,
        seconds: float,
    ) -> None:
        self.rig = rig
        self._device, self._renderer, self._body, self._others = device, renderer, body, others
        self._pictures = device.picture_times(START_NS, START_NS + seconds_to_ns(seconds))
        self._imu_errors = device.imu_errors(seconds + 1.0)
        self._recent: deque[tuple[int, float]] = deque(maxlen=_EXPOSURE_FRAMES)  # true time, brightness
        self._imu_until_ns = START_NS  # stamp of the newest sample that a frame has
        self._drawn_from: F64 | None = None  # pose of the body at the newest sharp picture that was drawn
        self.sees_bare_wall = False

    @property
    def frame_times_ns(self) -> list[int]:
        """Session times of all frames."""
        times: list[int] = (self._pictures.true_ns - START_NS).tolist()
        return times

    def restart(self, now_ns: int) -> None:
        """Forget what was measured before a session time."""
        self._imu_until_ns = now_ns + START_NS

    def frame(self, number: int) -> Frame:
        """Return frame `number` of `frame_times_ns`; each in turn, once its path is known."""
        true_ns = int(self._pictures.true_ns[number])
        stamp_ns = int(self._pictures.stamp_ns[number])
        images = self._images(number, true_ns)
        return Frame(stamp_ns, number, images[0], images[1], imu=self._imu(true_ns, stamp_ns))

    def _images(self, number: int, true_ns: int) -> list[U8]:
        index, shot = int(self._pictures.index[number]), self._exposure(true_ns)
        views = self._views(true_ns, shot)
        developed = []
        for k, (stream, camera) in enumerate(((CAM0, self.rig.cam0), (CAM1, self.rig.cam1))):
            assert camera is not None
            T_body_cam = T_body_camera(self.rig, stream)
            at = [SceneInstant(T @ T_body_cam, parts) for T, parts in views]
            radiance = self._renderer.radiance(camera, at)
            if self.sees_bare_wall:
                radiance = np.full_like(radiance, radiance.mean())
            if k == 0:
                self._recent.append((true_ns, float(radiance.mean())))
            developed.append(self._device.develop_image(radiance, index, k, shot))
        return developed

    def _exposure(self, true_ns: int) -> Exposure:
        if not self._recent:
            self._recent.append((true_ns, float(self._meter(true_ns).mean())))
            return self._device.exposures(*_columns(self._recent))[0]
        # the newest frame's own brightness does not count yet
        times, brightness = _columns([*self._recent, (true_ns, self._recent[-1][1])])
        return self._device.exposures(times, brightness)[len(times) - 1]

    def _meter(self, true_ns: int) -> F32:
        camera, T_body_cam = downsized(self.rig.cam0, _METER_FACTOR), T_body_camera(self.rig, CAM0)
        T = self._body.part(true_ns - START_NS, true_ns - START_NS).poses(np.array([true_ns]))[0]
        return self._renderer.radiance(camera, [SceneInstant(T @ T_body_cam)])

    def _views(self, true_ns: int, shot: Exposure) -> list[tuple[F64, dict[str, F64]]]:
        half_ns = seconds_to_ns(shot.exposure_ms * 5e-4)
        first_ns, last_ns = max(true_ns - half_ns, START_NS), true_ns + half_ns
        path = self._body.part(first_ns - START_NS, last_ns - START_NS)
        first, last = path.poses(np.array([first_ns, last_ns]))
        motion_px = float(image_motion_px(self.rig, first[None], last[None])[0])
        offsets = self._device.blur_offsets(shot, motion_px)
        times = np.maximum(true_ns + np.rint(offsets * 1e9).astype(np.int64), first_ns)
        poses = path.poses(times)
        if len(poses) == 1:
            poses = self._steady(poses)
        return list(zip(poses, self._others(times - START_NS), strict=True))

    def _steady(self, pose: F64) -> F64:
        """Return the pose (1, 4, 4) of the picture before where this one moves by less than _STEADY_PX: what
        is drawn from the same pose is drawn once."""
        before = self._drawn_from
        if before is None or float(image_motion_px(self.rig, before, pose)[0]) >= _STEADY_PX:
            self._drawn_from = pose
            return pose
        return before

    def _imu(self, true_ns: int, stamp_ns: int) -> ImuBatch:
        """Return the samples since the frame before, up to the first one not before this frame."""
        first_ns = max(self._imu_until_ns - MARGIN_NS, START_NS)
        path = self._body.part(first_ns - START_NS, true_ns + MARGIN_NS - START_NS)
        batch = self._device.imu_streams(path, self._imu_errors).to_batch()
        last = int(np.searchsorted(batch.stamps_ns, stamp_ns))
        new = batch.take(slice(int(np.searchsorted(batch.stamps_ns, self._imu_until_ns, "right")), last + 1))
        if len(new):
            self._imu_until_ns = int(new.stamps_ns[-1])
        return new


def _columns(rows: Iterable[tuple[int, float]]) -> tuple[I64, F64]:
    times, values = zip(*rows, strict=True)
    return np.array(times, np.int64), np.array(values, np.float64)
