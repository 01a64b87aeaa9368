"""Read MCAP recordings with ROS 2 messages, ours and others', as a Source.

The calibration's `rostopic` assigns topics to streams, else the topics' names do. The rig comes from --calib,
else from our own record in the file, else from CameraInfo and /tf_static.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import ConfigError, DataError
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings.calibration import Calibration, config_errors
from share.recordings.device_match import device_mismatch
from share.recordings.losses import DataLosses
from share.recordings.mcap import images as ros_images
from share.recordings.mcap import rig as ros_rig
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.file import McapFile, damage_errors
from share.recordings.recording import UNBOUNDED_NS, Source, Span, select_span
from share.recordings.trajectory import Trajectory, read_tum
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, STREAMS, Measurement
from share.types import F64, I64

_IMAGE_TYPES = (ros.IMAGE, ros.COMPRESSED)
_TOPIC_HINTS = {  # parts of a topic's name, best first
    CAM0: ("/cam0/", "/infra1/", "/left/", "/color/", "/rgb/", "/camera/image"),
    CAM1: ("/cam1/", "/infra2/", "/right/"),
    DEPTH: ("/depth/", "depth_to_color/", "depth_registered/"),
}
_MAX_SKEW_NS = 2 * 10**9  # between log times and header stamps, when only a part is read


def open_mcap(path: Path, calibration: Calibration | None, frames: slice | None) -> Source:
    """Open the recording in `path`. Raises UsageError, DataError, ConfigError."""
    file = McapFile(path)
    topics = find_topics(file, calibration.topics if calibration else {})
    own = own_rig(file, topics, calibration is None)
    return McapSource(file, topics, calibration, own, frames)


class McapSource(Source):
    """An MCAP recording with those streams of `topics` (stream -> topic) that the rig has."""

    def __init__(
        self,
        file: McapFile,
        topics: dict[str, str],
        calibration: Calibration | None,
        own: Rig | None,
        frames: slice | None,
    ) -> None:
        rig = calibration.rig if calibration else own
        if rig is None:
            raise ConfigError(f"{file.path}: contains no calibration; give one with --calib")
        recorded_rig = rig if calibration else _recorded_rig(rig, topics)
        self.name, self.rig = file.path.stem, _fit_rig(recorded_rig, topics, file.path)
        self._file, self._own, self.serial = file, own, own_serial(file)
        self.losses = DataLosses()
        cameras = ros_rig.rig_cameras(self.rig)
        used = {s for s in topics if s in cameras or (s == IMU and self.rig.imu)}
        self._topics = {s: topics[s] for s in used}
        self.notes = tuple(
            f"{topics[s]} is not used: the calibration has no {s}" for s in topics if s not in used
        ) + tuple(
            f"has no images of {s}: continuing without" for s in ros_rig.rig_cameras(rig) if s not in cameras
        )
        if calibration and (warning := device_mismatch(calibration.serials, self.serial)):
            self.notes += (warning,)
        self._span = self._find_span(frames)

    def stamps(self) -> dict[str, I64]:
        """Return log times, which equal the stamps in our recordings and are close to them in others'."""
        out = {}
        for stream in (s for s in STREAMS if s in self._topics):
            times, (lo, hi) = self._file.log_times[self._topics[stream]], self._span.limits(stream)
            out[stream] = times[(times > lo) & (times <= hi)]
        return out

    def measurements(self) -> Iterator[Measurement]:
        streams = {topic: stream for stream, topic in self._topics.items()}
        kinds = {topic: self._file.topics[topic].kind for topic in streams}
        cameras = ros_rig.rig_cameras(self.rig)
        for topic, log_ns, data in self._file.messages(streams, *self._log_range, losses=self.losses):
            stream = streams[topic]
            try:
                message = _decode(self._file, data, kinds[topic], topic)
                stamp = ros.stamp_of(message)
                lo, hi = self._span.limits(stream)
                if not lo < stamp <= hi:
                    continue
                payload = (
                    _imu_values(message, f"{self._file.path}: {topic} at {stamp}")
                    if stream == IMU
                    else self._image(message, topic, stamp, cameras[stream], stream)
                )
            except DataError as error:  # skip this message only
                self.losses.add(f"messages of {topic}", str(log_ns), str(error))
                continue
            yield Measurement(stream, stamp, payload)
        self._check_losses()

    def _check_losses(self) -> None:
        for topic in self._topics.values():
            self.losses.check(f"messages of {topic}", len(self._file.log_times[topic]))

    def truth(self) -> Trajectory | None:
        path = truth_path(self._file.path)
        if path is None:
            return None
        truth = read_tum(path, self.losses)
        return Trajectory(truth.stamps_ns, truth.T @ self._T_recorded_body)

    @cached_property
    def _T_recorded_body(self) -> F64:
        """Pose (4, 4) of our body in the recording's: they differ if only one of the two rigs has an IMU."""
        own = self._own
        if own is None or (own.imu is None) == (self.rig.imu is None):
            return np.eye(4)
        return own.T_body_cam0 @ se3.inverse(self.rig.T_body_cam0)

    @property
    def _log_range(self) -> tuple[int | None, int | None]:
        first = min(self._span.imu_from, self._span.image_from)
        last = max(self._span.imu_to, self._span.image_to)
        return (
            None if first <= -UNBOUNDED_NS else max(0, first - _MAX_SKEW_NS),
            None if last >= UNBOUNDED_NS else last + _MAX_SKEW_NS,
        )

    def _find_span(self, frames: slice | None) -> Span:
        times = self._file.log_times[self._topics[CAM0]]
        if len(times) == 0:
            raise DataError(f"{self._file.path}: {self._topics[CAM0]} has no images")
        stamps = times if frames is None else self._header_stamps()
        return select_span(stamps, frames, str(self._file.path), self.rig.timeshift_ns)

    def _header_stamps(self) -> I64:
        """Return cam0's sorted header stamps (N,) ns, by one pass that decodes nothing else."""
        messages = self._file.messages([self._topics[CAM0]], losses=self.losses)
        heads = (data[4:12] for _, _, data in messages if len(data) >= 12)
        pairs = np.frombuffer(b"".join(heads), "<u4").reshape(-1, 2).astype(np.int64)
        return np.sort(pairs[:, 0] * 10**9 + pairs[:, 1])

    def _image(self, message: Any, topic: str, stamp: int, camera: Camera, stream: str) -> Any:
        where, is_depth = f"{self._file.path}: {topic} at {stamp}", stream == DEPTH
        if self._file.topics[topic].kind == ros.COMPRESSED:
            return ros_images.decode_compressed(message, where, camera, is_depth)
        return ros_images.RawImage(message, where, camera, is_depth)


def find_topics(file: McapFile, named: dict[str, str]) -> dict[str, str]:
    """Return the topic of each stream: as `named` (with or without image_transport's suffix), else by hints.

    Raises ConfigError if a named topic is missing, or if there is no cam0.
    """
    topics = {name: topic.kind for name, topic in file.topics.items() if len(file.log_times[name])}
    by_stream = {}
    for stream in STREAMS:
        kinds = (ros.IMU_MSG,) if stream == IMU else _IMAGE_TYPES
        candidates = [name for name, kind in topics.items() if kind in kinds]
        topic = (
            _named_topic(named[stream], candidates, file)
            if stream in named
            else guess_topic(stream, candidates)
        )
        if topic:
            by_stream[stream] = topic
    if CAM0 not in by_stream:
        images = [name for name, kind in topics.items() if kind in _IMAGE_TYPES]
        raise ConfigError(
            f"{file.path}: cannot tell which topic is cam0 (image topics: {', '.join(images) or 'none'}); "
            "name it as `rostopic` in a camchain file and give that with --calib"
        )
    return by_stream


def _named_topic(name: str, candidates: list[str], file: McapFile) -> str:
    for topic in (name, *(name + suffix for suffix in ros.SUFFIXES)):
        if topic in candidates:
            return topic
    known = ", ".join(candidates) or "none"
    raise ConfigError(f"{file.path}: has no topic {name}, which the calibration names; topics: {known}")


def guess_topic(stream: str, candidates: list[str]) -> str | None:
    """Return the shortest candidate with the best hint; for an IMU one named imu, or the shortest."""
    if stream == IMU:
        return min(
            candidates, key=lambda name: (not name.endswith(("/imu0", "/imu")), len(name), name), default=None
        )
    depth = [name for name in candidates if "depth" in name]
    pool = depth if stream == DEPTH else [name for name in candidates if name not in depth]
    for hint in _TOPIC_HINTS[stream]:
        matching = [name for name in pool if hint in name + "/"]
        if matching:
            return min(matching, key=lambda name: (len(name), name))
    return None


def own_rig(file: McapFile, topics: dict[str, str], needed: bool) -> Rig | None:
    """Return the rig in our record of the file, else (if `needed`) that of CameraInfo; None if unknown."""
    record = _rig_record(file)
    if "rig" in record:
        return ros_rig.rig_from_json(record["rig"], str(file.path))
    return _rig_from_messages(file, topics) if needed else None


def own_serial(file: McapFile) -> str | None:
    """Return the device's serial number; None if unknown."""
    return _rig_record(file).get("serial")


def _rig_record(file: McapFile) -> dict[str, str]:
    """Return our metadata record of the device; empty for other recordings, or if damaged."""
    try:
        return file.metadata(ros.RIG_RECORD)
    except damage_errors():
        return {}


def _rig_from_messages(file: McapFile, topics: dict[str, str]) -> Rig | None:
    """Return the rig of CameraInfo and /tf_static, None without cam0's CameraInfo.

    Raises ConfigError for a recording with an IMU, whose noise no message states.
    """
    infos: dict[str, Any] = {s: _camera_info(file, topics[s]) for s in (CAM0, CAM1, DEPTH) if s in topics}
    if infos[CAM0] is None:
        return None
    if IMU in topics:
        raise ConfigError(
            f"{file.path}: noise and extrinsics of IMU {topics[IMU]} are missing; give a folder with both "
            "Kalibr chains with --calib, or only a camchain to track without the IMU"
        )
    missing = [topics[s] for s, info in infos.items() if info is None]
    if missing:
        raise ConfigError(f"{file.path}: {missing[0]} has no CameraInfo; give the calibration with --calib")
    where = str(file.path)
    transforms = (_decode(file, d, ros.TF, ros.TF_STATIC) for _, _, d in file.messages([ros.TF_STATIC]))
    tree = ros_rig.FrameTree(transforms, where)
    cams = {s: ros_rig.from_camera_info(info, f"{where}: {topics[s]}") for s, info in infos.items()}
    T = {s: tree.find(info.header.frame_id, infos[CAM0].header.frame_id) for s, info in infos.items()}
    if any(pose is None for pose in T.values()):
        raise ConfigError(f"{where}: /tf_static lacks the extrinsics of the cameras; give --calib")
    with config_errors(where):
        return Rig(cams[CAM0], np.eye(4), cams.get(CAM1), T.get(CAM1), cams.get(DEPTH), T.get(DEPTH))


def _camera_info(file: McapFile, topic: str) -> Any | None:
    """Return the first CameraInfo of an image topic; None if there is none."""
    for suffix in ros.SUFFIXES:
        topic = topic.removesuffix(suffix)
    name = topic.rpartition("/")[0] + "/camera_info"
    if name not in file.topics:
        return None
    first = next(file.messages([name]), None)
    return None if first is None else _decode(file, first[2], ros.CAMERA_INFO, name)


def _recorded_rig(rig: Rig, topics: dict[str, str]) -> Rig:
    """Return the rig without a partner of cam0 that was never recorded (broken camera), if another stream
    that gives scale was."""
    recorded = [s for s in (CAM1, DEPTH, IMU) if s in topics]
    if CAM1 not in topics and recorded:
        rig = replace(rig, cam1=None, T_cam1_cam0=None)
    if DEPTH not in topics and recorded:
        rig = replace(rig, depth=None, T_depth_cam0=None)
    return rig


def _fit_rig(rig: Rig, topics: dict[str, str], path: Path) -> Rig:
    """Return the rig, without the IMU if none was recorded. Raises ConfigError if a camera is missing."""
    for stream in ros_rig.rig_cameras(rig):
        if stream not in topics:
            raise ConfigError(
                f"{path}: the calibration has {stream}, the recording does not; give another --calib"
            )
    if rig.imu and IMU not in topics:
        return rig.without_imu()
    return rig


def _decode(file: McapFile, data: bytes, kind: str, topic: str) -> Any:
    """Decode a message. Raises DataError."""
    try:
        return ros.decode(data, kind)
    except Exception as error:  # rosbags raises many kinds on invalid bytes
        raise DataError(f"{file.path}: {topic}: a message cannot be read ({error})") from None


def _imu_values(message: Any, where: str) -> tuple[float, ...]:
    w, a = message.angular_velocity, message.linear_acceleration
    values = (w.x, w.y, w.z, a.x, a.y, a.z)
    if not math.isfinite(sum(values)):
        raise DataError(f"{where}: the sample has values that are not finite")
    return values


def truth_path(recording: Path) -> Path | None:
    """Return truth/NAME.tum of a session, or NAME.truth.tum beside the recording; None if neither exists."""
    beside = recording.with_name(recording.stem + ".truth.tum")
    paths = (recording.parent / "truth" / f"{recording.stem}.tum", beside)
    return next((path for path in paths if path.is_file()), None)
