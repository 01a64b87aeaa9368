"""Run trackers over one agent's recording: SHARE's in this process, peers in interpreters of their own."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from share.config import Config
from share.errors import DataError, UsageError
from share.files.writing import open_new
from share.geometry import se3
from share.geometry.camera import Camera
from share.lab.peer_trackers import PeerTracker
from share.lab.peer_trackers.peer_wire import PeerFrame, read_line, write_frame, write_line
from share.recordings.trajectory import Trajectory
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.offline_tracking import track_frames
from share.runtime.pipeline import check_trackable, read_frames
from share.runtime.source import Source
from share.sensors.measurement import IMU
from share.sensors.sequencer import SequencerCounters
from share.types import F64

ShowFrames = Callable[[int], None]  # frames done


@dataclass
class TrackerRun:
    """Stamps and causal T_world_body of the frames with a pose, and CPU ms of every frame but the first,
    which sets up.

    `final`: the trajectory by the tracker's final map, if it corrects past poses.
    """

    stamps: list[int] = field(default_factory=list)
    poses: list[F64] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    final: Trajectory | None = None

    @property
    def trajectory(self) -> Trajectory:
        return _trajectory(self.stamps, self.poses)

    def add(self, stamp_ns: int, T_world_body: Any, cpu_s: float) -> None:
        if T_world_body is not None:
            self.stamps.append(stamp_ns)
            self.poses.append(np.asarray(T_world_body, np.float64))
        self.cpu_ms.append(1e3 * cpu_s)


def peer_version(peer: PeerTracker, python: Path) -> str | None:
    """Return the peer's name and version, None where that interpreter cannot run it."""
    try:
        process = subprocess.run([python, peer.path, "--version"], capture_output=True, check=False)
    except OSError:
        return None
    return str(json.loads(process.stdout)["version"]) if process.returncode == 0 else None


class _FaultsRaised(FaultGuard):
    def record(self, what: str, error: Exception) -> None:
        raise error


def strict_tracker(source: Source, settings: Config) -> GuardedTracker:
    """Return a tracker that ends the run when it fails: an experiment must not hide failures.

    Raises UsageError where none fits.
    """
    check_trackable(source.name, source.rig)
    return GuardedTracker(source.rig, settings, _FaultsRaised(lambda text: None))


def run_share(source: Source, settings: Config, show: ShowFrames = lambda done: None) -> TrackerRun:
    """Run SHARE's tracker. CPU time includes a frame's keyframe, not its decoding."""
    run, frames = TrackerRun(), read_frames(source, settings, SequencerCounters())
    for step in track_frames(frames, strict_tracker(source, settings)):
        run.add(step.frame.stamp_ns, step.result.T_odom_body, step.cpu_s)
        show(len(run.cpu_ms))
    run.cpu_ms = run.cpu_ms[1:]
    return run


def run_peer(
    source: Source, command: Sequence[str], log: Path | None = None, show: ShowFrames = lambda done: None
) -> TrackerRun:
    """Pass all frames in turn through a peer process that speaks `peer_wire`. `log`: file for its stderr.

    Raises DataError if it fails, UsageError where the rig is not stereo with an IMU.
    """
    run, calibration_values = TrackerRun(), rig_calibration(source)
    err = None if log is None else open_new(log)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=err) as peer:
        assert peer.stdin and peer.stdout
        try:
            write_line(peer.stdin, calibration_values)
            for frame in peer_frames(source):
                write_frame(peer.stdin, frame)
                answer = read_line(peer.stdout)
                if answer is None:
                    raise BrokenPipeError
                run.add(frame.stamp_ns, answer["T_world_body"], answer["cpu_s"])
                show(len(run.cpu_ms))
            peer.stdin.close()
            final = read_line(peer.stdout)
        except BrokenPipeError:
            where = "above" if log is None else str(log)
            raise DataError(f"the peer process ended at frame {len(run.cpu_ms)}; see {where}") from None
        finally:
            if err is not None:
                err.close()
    if final is not None and final["stamps_ns"]:
        run.final = _trajectory(final["stamps_ns"], final["T_world_body"])
    run.cpu_ms = run.cpu_ms[1:]
    return run


def can_run_peers(source: Source) -> bool:
    """Return whether peers can run on the recording: stereo with an IMU."""
    return source.rig.cam1 is not None and source.rig.imu is not None


def rig_calibration(source: Source) -> dict[str, Any]:
    """Return the rig as plain data. `R_rectified_cam0`: from cam0 to the rectified cam0.

    Raises UsageError where the rig is not stereo with an IMU, or has fisheye lenses.
    """
    rig = source.rig
    if rig.cam1 is None or rig.T_cam1_cam0 is None or rig.imu is None:
        raise UsageError(f"{source.name}: is {rig.kind}; other trackers need stereo+imu")
    if rig.cam0.is_fisheye or rig.cam1.is_fisheye:
        raise UsageError(f"{source.name}: has a fisheye lens; other trackers need radtan or no distortion")
    T_body_cam1 = rig.T_body_cam0 @ se3.inverse(rig.T_cam1_cam0)
    return {
        "cameras": [_camera(rig.cam0, rig.T_body_cam0), _camera(rig.cam1, T_body_cam1)],
        "imu": vars(rig.imu),
        "rate_hz": source.rate_hz,
        "R_rectified_cam0": _rectifying_rotation(rig.cam0, rig.cam1, rig.T_cam1_cam0).tolist(),
    }


def _camera(camera: Camera, T_body_cam: F64) -> dict[str, Any]:
    """Return a camera as plain data. `distortion`: k1, k2, p1, p2, k3, or fewer."""
    size = {"width": camera.width, "height": camera.height}
    distortion = list(camera.distortion)
    return size | {"K": camera.K.tolist(), "distortion": distortion, "T_body_cam": T_body_cam.tolist()}


def _rectifying_rotation(cam0: Camera, cam1: Camera, T_cam1_cam0: F64) -> F64:
    """Return R_rectified_cam0 (3, 3)."""
    (K0, D0), (K1, D1) = ((c.K, np.array([*c.distortion, *[0.0] * 5][:5])) for c in (cam0, cam1))
    size, R, t = (cam0.width, cam0.height), T_cam1_cam0[:3, :3].copy(), T_cam1_cam0[:3, 3:].copy()
    rectified = cv2.stereoRectify(K0, D0, K1, D1, size, R, t, flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1)
    return np.asarray(rectified[0], np.float64)


def peer_frames(source: Source) -> Iterator[PeerFrame]:
    """Yield all frames with both images, up to the last that an IMU sample follows. Stamps are in the
    cameras' clock."""
    samples = [
        (m.stamp_ns - source.rig.timeshift_ns, m.payload) for m in source.measurements() if m.stream == IMU
    ]
    samples.sort(key=lambda sample: sample[0])
    stamps = np.array([t for t, _ in samples], np.int64)
    values = np.array([v for _, v in samples], np.float64)
    done = 0
    for frame in read_frames(source, Config(), SequencerCounters()):
        end = int(np.searchsorted(stamps, frame.stamp_ns, "right")) + 1
        if frame.image1 is None or end > len(stamps):
            continue
        yield PeerFrame(frame.stamp_ns, stamps[done:end], values[done:end], frame.image0, frame.image1)
        done = end


def _trajectory(stamps_ns: Sequence[int], poses: Sequence[Any]) -> Trajectory:
    return Trajectory(np.array(stamps_ns, np.int64), np.array(poses, np.float64).reshape(-1, 4, 4))
