"""Faults of cameras and IMU, applied to a sound recording. One table: `FAULTS`.

Pure functions of the frames, with fixed seeds. Temporary faults start at 40 % of the recording, moving panels
at 25 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import moving_panel
import numpy as np
from moving_panel import Panel, draw_panel

from share.geometry.camera import Camera, Rig
from share.geometry.interpolation import interpolate
from share.recordings.trajectory import Trajectory
from share.sensors.measurement import IMU, Measurement
from share.types import F32, F64, U8, Frame, ImuBatch

Frames = list[Frame]
FrameFilter = Callable[[Frames, Rig, Trajectory], Frames]
MeasurementFilter = Callable[[Sequence[Measurement]], list[Measurement]]

_FAULT_START, _MOVER_START, _MOVER_S = 0.4, 0.25, 10.0
_DROP_SHARE, _GAP_FACTOR = 0.2, 2.5  # gap as in the sequencer: longer than this many usual steps
_BLACK_S, _WALL_S, _FADE_S = 2.0, 3.0, 0.5
_EXPOSURE_STEP_S = 1.5
_BAD_STAMP_SHARE = 0.02  # of images, for each kind of bad stamp
_STAMP_JUMP_NS, _STAMP_BACK_NS = 40_000_000, 500_000_000
_CLIPPED_SHARE = 0.05  # of samples
_MAX_BLUR_RAD = 3.0 * 0.008  # rad/s times s


class Fault(NamedTuple):
    """description: for the user. change_frames: changes frames; change_measurements: changes measurements
    before the sequencer."""

    description: str
    change_frames: FrameFilter | None = None
    change_measurements: MeasurementFilter | None = None


def apply_fault(fault: Fault, frames: Frames, rig: Rig, truth: Trajectory) -> Frames:
    """Return the frames with the fault. truth: body poses in the world, which moving panels need."""
    return frames if fault.change_frames is None else fault.change_frames(frames, rig, truth)


# ------------------------------------------------------------------ frames and stamps


def drop20(frames: Frames, *_: object) -> Frames:
    """Drop 20 % of the frames. IMU samples of a dropped frame come with the next one, as from the
    sequencer."""
    is_dropped = np.random.default_rng(1).random(len(frames)) < _DROP_SHARE
    usual = np.median(np.diff([frame.stamp_ns for frame in frames]))
    out: Frames = []
    pending_imu: list[ImuBatch] = []
    for frame, dropped in zip(frames, is_dropped, strict=True):
        pending_imu.append(frame.imu)
        if dropped:
            continue
        step = frame.stamp_ns - out[-1].stamp_ns if out else 0
        gap = step if step > _GAP_FACTOR * usual else 0
        out.append(replace(frame, index=len(out), imu=ImuBatch.empty().concatenate(*pending_imu), gap_ns=gap))
        pending_imu = []
    return out


def bad_stamps(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Give some images wrong stamps, the same for all images of a frame (matched by their index in their
    stream)."""
    rng = np.random.default_rng(12)
    error_kinds = rng.choice(4, len(measurements), p=[1 - 3 * _BAD_STAMP_SHARE, *[_BAD_STAMP_SHARE] * 3])
    jumps = _STAMP_JUMP_NS * rng.choice([-1, 1], len(measurements))
    stamps_seen: dict[str, list[int]] = {}
    out = []
    for m in measurements:
        if m.stream != IMU:
            past = stamps_seen.setdefault(m.stream, [])
            k = len(past)
            past.append(m.stamp_ns)
            stamps_by_kind = (
                m.stamp_ns,
                past[max(k - 1, 0)],
                m.stamp_ns - _STAMP_BACK_NS,
                m.stamp_ns + int(jumps[k]),
            )
            m = Measurement(m.stream, stamps_by_kind[error_kinds[k]], m.payload)
        out.append(m)
    return out


# ------------------------------------------------------------------ light


def black(frames: Frames, *_: object) -> Frames:
    return _change_during(frames, _BLACK_S, lambda frame, _: _change_images(frame, np.zeros_like))


def covered(frames: Frames, *_: object) -> Frames:
    rng = np.random.default_rng(3)

    def dark(frame: Frame, _: float) -> Frame:
        return _change_images(frame, lambda image: _gray(4 + _noise(image, 2.0, rng)))

    return _change_during(frames, _BLACK_S, dark)


def exposure(frames: Frames, *_: object) -> Frames:
    gains = (1.0, 3.0, 1.0, 1 / 3)

    def lit(frame: Frame, s: float) -> Frame:
        gain = np.float32(gains[int(s / _EXPOSURE_STEP_S) % 4])
        return _change_images(frame, lambda image: _gray(image * gain), keep_depth=True)

    return [lit(frame, s) for frame, s in zip(frames, _seconds(frames), strict=True)]


def white_wall(frames: Frames, *_: object) -> Frames:
    rng = np.random.default_rng(4)

    def fade(frame: Frame, s: float) -> Frame:
        contrast = 1 - 0.97 * min(1.0, s / _FADE_S, (_WALL_S - s) / _FADE_S)
        return _change_images(
            frame, lambda image: _gray(contrast * image + (1 - contrast) * 170 + _noise(image, 2.0, rng))
        )

    return _change_during(frames, _WALL_S, fade)


def blur(frames: Frames, rig: Rig, *_: object) -> Frames:
    """Box blur along the image motion that the gyro predicts for the image's middle during the exposure."""
    imu = ImuBatch.empty().concatenate(*(frame.imu for frame in frames))
    fastest = np.quantile(np.linalg.norm(imu.gyro, axis=1), 0.99) if len(imu) else 0.0
    if fastest == 0:
        return frames
    turn = np.stack([np.interp(_stamps(frames), imu.stamps_ns, axis) for axis in imu.gyro.T], axis=1)
    turn *= _MAX_BLUR_RAD / fastest  # rad, in the body frame
    in_cam = turn @ rig.T_body_cam0[:3, :3]
    R = np.eye(3) if rig.T_cam1_cam0 is None else rig.T_cam1_cam0[:3, :3]
    cams = (rig.cam0, in_cam), (rig.cam1 or rig.cam0, in_cam @ R.T)
    return [
        _blur_frame(frame, [_blur_kernel(camera, w[k]) for camera, w in cams])
        for k, frame in enumerate(frames)
    ]


# ------------------------------------------------------------------ IMU


def imu_silent_1s(frames: Frames, *_: object) -> Frames:
    return _change_during(frames, 1.0, lambda frame, _: _without_imu(frame))


def imu_dead(frames: Frames, *_: object) -> Frames:
    return _change_during(frames, np.inf, lambda frame, _: _without_imu(frame))


def imu_never(frames: Frames, *_: object) -> Frames:
    return [_without_imu(frame) for frame in frames]


def saturating(frames: Frames, *_: object) -> Frames:
    """Clip gyro and accelerometer at the magnitude that 5 % of their samples exceed."""
    imu = ImuBatch.empty().concatenate(*(frame.imu for frame in frames))
    limits = [np.quantile(np.abs(x).max(axis=1), 1 - _CLIPPED_SHARE) for x in (imu.gyro, imu.accel)]

    def clip(b: ImuBatch) -> ImuBatch:
        return ImuBatch(b.stamps_ns, b.gyro.clip(-limits[0], limits[0]), b.accel.clip(-limits[1], limits[1]))

    return [replace(frame, imu=clip(frame.imu)) for frame in frames]


# ------------------------------------------------------------------ moving panels

_SMALL_PANEL, _LARGE_PANEL = Panel(0.9, 1.4, seed=5), Panel(1.1, 1.4, seed=6)  # m


def panel_comes(frames: Frames, rig: Rig, truth: Trajectory) -> Frames:
    return _with_panel(frames, rig, truth, _SMALL_PANEL, moving_panel.path_comes)


def panel_follows(frames: Frames, rig: Rig, truth: Trajectory) -> Frames:
    return _with_panel(frames, rig, truth, _SMALL_PANEL, moving_panel.path_follows)


def panel_rests(frames: Frames, rig: Rig, truth: Trajectory) -> Frames:
    """A control experiment: a panel at rest shows that motion does harm, not how the panel is drawn."""
    return panel_starts(frames, rig, truth, speed=0.0)


def panel_starts(frames: Frames, rig: Rig, truth: Trajectory, speed: float = 0.15) -> Frames:
    def path(t: F64, T_world_cam: F64, begin: float, last: float) -> F64:
        return moving_panel.path_starts(t, T_world_cam, rig.cam0, _LARGE_PANEL, last, speed)

    return _with_panel(frames, rig, truth, _LARGE_PANEL, path)


def _with_panel(
    frames: Frames,
    rig: Rig,
    truth: Trajectory,
    panel: Panel,
    path: Callable[[F64, F64, float, float], F64],
) -> Frames:
    """Draw the panel; frames without a true pose stay unchanged."""
    known, T_world_body = interpolate(*truth, _stamps(frames))
    t = _seconds(frames)
    T_body_panel = np.full((len(frames), 4, 4), np.nan)
    T_world_cam = T_world_body @ rig.T_body_cam0
    T_world_panel = path(t[known], T_world_cam, float(_MOVER_START * t[-1]), _MOVER_S)
    T_body_panel[known] = rig.T_body_cam0 @ np.linalg.inv(T_world_cam) @ T_world_panel
    return draw_panel(frames, rig, panel, T_body_panel)


# ------------------------------------------------------------------ helpers


def _stamps(frames: Frames) -> np.ndarray:
    return np.array([frame.stamp_ns for frame in frames], np.int64)


def _seconds(frames: Frames) -> F64:
    stamps_ns = _stamps(frames)
    out: F64 = (stamps_ns - stamps_ns[0]) * 1e-9
    return out


def _change_during(frames: Frames, seconds: float, change: Callable[[Frame, float], Frame]) -> Frames:
    """Apply `change`, which gets the seconds since the fault began, for `seconds`."""
    since = _seconds(frames) - _FAULT_START * _seconds(frames)[-1]
    return [change(f, float(s)) if 0 <= s < seconds else f for f, s in zip(frames, since, strict=True)]


def _change_images(frame: Frame, change: Callable[[U8], U8], keep_depth: bool = False) -> Frame:
    """Change the images; set the depth to 0 unless `keep_depth`."""
    image1 = None if frame.image1 is None else change(frame.image1)
    depth = frame.depth if keep_depth or frame.depth is None else np.zeros_like(frame.depth)
    return replace(frame, image0=change(frame.image0), image1=image1, depth=depth)


def _gray(image: F32) -> U8:
    out: U8 = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return out


def _noise(image: U8, sigma: float, rng: np.random.Generator) -> F32:
    return np.float32(sigma) * rng.standard_normal(image.shape, np.float32)


def _without_imu(frame: Frame) -> Frame:
    return replace(frame, imu=ImuBatch.empty())


def _blur_kernel(camera: Camera, turn: F64) -> F32:
    """Return the blur kernel of a camera that turns by `turn` (3,) rad: a line as long as the motion in the
    image's middle."""
    motion_px = np.array([-turn[1] * camera.fx, turn[0] * camera.fy])
    half = int(np.ceil(np.abs(motion_px).max() / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for along in np.linspace(-0.5, 0.5, 8 * half + 1):
        x, y = half + along * motion_px
        i, j, u, v = int(x), int(y), x % 1, y % 1
        kernel[j : j + 2, i : i + 2] += np.outer([1 - v, v], [1 - u, u]).astype(np.float32)
    out: F32 = kernel / kernel.sum()
    return out


def _blur_frame(frame: Frame, kernels: Sequence[F32]) -> Frame:
    def through(image: U8, kernel: F32) -> U8:
        return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8)

    image1 = None if frame.image1 is None else through(frame.image1, kernels[1])
    return replace(frame, image0=through(frame.image0, kernels[0]), image1=image1)


FAULTS: dict[str, Fault] = {
    "clean": Fault("as recorded"),
    "drop20": Fault("20 % of the frames are dropped", drop20),
    "stamps": Fault(
        "2 % of the images have the stamp of the one before, 2 % one 0.5 s back, 2 % one 40 ms off",
        change_measurements=bad_stamps,
    ),
    "black": Fault("2 s of black, no depth", black),
    "covered": Fault("2 s of dark noise, no depth", covered),
    "exposure": Fault("light times 3, 1, 1/3, 1 in turns of 1.5 s", exposure),
    "white_wall": Fault("3 s before a white wall: 3 % of the contrast, noise", white_wall),
    "blur": Fault("motion blur, as of 8 ms at 3 rad/s where the gyro is at its 99th percentile", blur),
    "imu_silent_1s": Fault("no IMU for 1 s", imu_silent_1s),
    "imu_dead": Fault("no IMU from then on", imu_dead),
    "imu_never": Fault("no IMU at all", imu_never),
    "saturating": Fault(
        "gyro and accelerometer clipped at the magnitude that 5 % of their samples exceed", saturating
    ),
    "mover_rests": Fault("a panel that is part of the room and stays: no fault", panel_rests),
    "mover_comes": Fault("a panel comes in and sways 1 m before the camera for 10 s", panel_comes),
    "mover_starts": Fault("a panel that was part of the room moves off at 0.15 m/s for 10 s", panel_starts),
    "mover_along": Fault("a panel moves with the camera, fixed in its view, for 10 s", panel_follows),
}
