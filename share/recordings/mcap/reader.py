"""Read recordings of ROS messages (MCAP, ROS bags), ours and others', as a Source; all samples of the IMU.

The calibration's `rostopic` assigns topics to streams, else the topics' names do. The rig comes from --calib,
else from our own record in the file, else from CameraInfo and /tf_static.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import ConfigError, DataError
from share.geometry import se3
from share.geometry.camera import Rig
from share.recordings.bags.opening import open_messages
from share.recordings.calibration import Calibration
from share.recordings.calibration_match import device_mismatch, fit_to_recording, unused_streams
from share.recordings.losses import DataLosses
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.rig import own_rig, own_serial
from share.recordings.message_file import MessageFile
from share.recordings.recording import UNBOUNDED_NS, Recording, select_time_range
from share.recordings.trajectory import Trajectory, read_tum
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, STREAMS, Measurement
from share.sensors.sequencer import rig_streams
from share.sensors.stamps import unwrap_stamps
from share.types import F64, I64

_IMAGE_TYPES = (ros.IMAGE, ros.COMPRESSED)
_TOPIC_HINTS = {  # parts of a topic's name, best first
    CAM0: ("/cam0/", "/infra1/", "/left/", "/color/", "/rgb/", "/camera/image"),
    CAM1: ("/cam1/", "/infra2/", "/right/"),
    DEPTH: ("/depth/", "depth_to_color/", "depth_registered/"),
}
_MAX_SKEW_NS = 2 * 10**9  # between log times and header stamps, when only a part is read


def open_mcap(path: Path, calibration: Calibration | None, frames: slice | None) -> McapSource:
    """Open the recording in `path`. Raises UsageError, DataError, ConfigError."""
    file = open_messages(path)
    topics = find_topics(file, calibration.topics if calibration else {})
    own = own_rig(file, topics, calibration is None)
    return McapSource(file, topics, calibration, own, frames)


class McapSource(Recording):
    """A recording of messages with those streams of `topics` (stream -> topic) that the rig has.

    Its stamps are log times, which equal the stamps in our recordings and are close to them in others'.
    """

    def __init__(
        self,
        file: MessageFile,
        topics: dict[str, str],
        calibration: Calibration | None,
        own: Rig | None,
        frames: slice | None,
    ) -> None:
        rig = calibration.rig if calibration else own
        if rig is None:
            raise ConfigError(f"{file.path}: contains no calibration; give one with --calib")
        recorded_rig = rig if calibration else _recorded_rig(rig, topics)
        self.name, self.rig = file.path.stem, fit_to_recording(recorded_rig, topics, file.path)
        self.file, self._own, self.serial = file, own, own_serial(file)
        self._topics = {stream: topics[stream] for stream in rig_streams(self.rig)}
        self.notes = unused_streams(topics, self.rig) + tuple(
            f"has no images of {s}: continuing without" for s in rig.cameras if s not in self.rig.cameras
        )
        if calibration:
            self.notes += device_mismatch(calibration.serials, self.serial)
        stamps = self.all_stamps()[CAM0] if frames is None else self._header_stamps()
        self.time_range = select_time_range(stamps, frames, str(file.path), self.rig.timeshift_ns)

    def all_stamps(self) -> dict[str, I64]:
        return {stream: self.file.log_times[topic] for stream, topic in self._topics.items()}

    def measurements(self) -> Iterator[Measurement]:
        streams = {topic: stream for stream, topic in self._topics.items()}
        for topic, log_ns, data in self.file.messages(streams, *self._log_range, losses=self.losses):
            try:
                message = ros.decode(data, self.file.topics[topic].kind, f"{self.file.path}: {topic}")
                stamp = ros.stamp_of(message)
                if not self.is_in_time_range(streams[topic], stamp):
                    continue
                payload = self._payload(message, topic, stamp, streams[topic])
            except DataError as error:  # skip this message only
                self.losses.add(f"messages of {topic}", str(log_ns), str(error))
                continue
            yield Measurement(streams[topic], stamp, payload)
        for topic in streams:
            self.losses.check(f"messages of {topic}", len(self.file.log_times[topic]))

    def _payload(self, message: Any, topic: str, stamp: int, stream: str) -> Any:
        where = f"{self.file.path}: {topic} at {stamp}"
        if stream == IMU:
            return ros.imu_values(message, where)
        camera, is_depth = self.rig.cameras[stream], stream == DEPTH
        if self.file.topics[topic].kind == ros.COMPRESSED:
            return ros.decode_compressed(message, where, camera, is_depth)
        return ros.RawImage(message, where, camera, is_depth)

    def truth(self) -> Trajectory | None:
        """Read truth/NAME.tum of a session, or NAME.truth.tum beside the recording."""
        path = self.file.path
        beside = path.with_name(path.stem + ".truth.tum")
        for file in (path.parent / "truth" / f"{path.stem}.tum", beside):
            if file.is_file():
                truth = read_tum(file, self.losses)
                return Trajectory(truth.stamps_ns, truth.T @ self._T_recorded_body)
        return None

    @cached_property
    def _T_recorded_body(self) -> F64:
        """Pose (4, 4) of our body in the recording's: they differ if only one of the two rigs has an IMU."""
        own = self._own
        if own is None or (own.imu is None) == (self.rig.imu is None):
            return np.eye(4)
        return own.T_body_cam0 @ se3.inverse(self.rig.T_body_cam0)

    @property
    def _log_range(self) -> tuple[int | None, int | None]:
        first = min(self.time_range.imu_from, self.time_range.image_from)
        last = max(self.time_range.imu_to, self.time_range.image_to)
        return (
            None if first <= -UNBOUNDED_NS else max(0, first - _MAX_SKEW_NS),
            None if last >= UNBOUNDED_NS else last + _MAX_SKEW_NS,
        )

    def _header_stamps(self) -> I64:
        """Return cam0's sorted header stamps (N,) ns, by one pass that decodes nothing else."""
        messages = self.file.messages([self._topics[CAM0]], losses=self.losses)
        return np.sort(ros.header_stamps([data for _, _, data in messages if len(data) >= 12]))


def find_topics(file: MessageFile, named: dict[str, str]) -> dict[str, str]:
    """Return the topic of each stream: as `named` (with or without image_transport's suffix), else by hints.

    Raises ConfigError if a named topic is missing, or if there is no cam0.
    """
    topics = {name: topic.kind for name, topic in file.topics.items() if len(file.log_times[name])}
    by_stream = {}
    for stream in STREAMS:
        kinds = (ros.IMU_MSG,) if stream == IMU else _IMAGE_TYPES
        candidates = [name for name, kind in topics.items() if kind in kinds]
        topic = _named_topic(named.get(stream), stream, candidates, file) or guess_topic(stream, candidates)
        if topic:
            by_stream[stream] = topic
    if CAM0 not in by_stream:
        images = [name for name, kind in topics.items() if kind in _IMAGE_TYPES]
        raise ConfigError(
            f"{file.path}: cannot tell which topic is cam0 (image topics: {', '.join(images) or 'none'}); "
            "name it as `rostopic` in a camchain file and give that with --calib"
        )
    return by_stream


def _named_topic(name: str | None, stream: str, candidates: list[str], file: MessageFile) -> str | None:
    """Return the candidate of this name; None without a name. Our own recordings' name, which every
    calibration that SHARE writes has, need not be there."""
    if name is None:
        return None
    for topic in (name, *(name + suffix for suffix in ros.SUFFIXES)):
        if topic in candidates:
            return topic
    if name == ros.TOPICS[stream]:
        return None
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


def _recorded_rig(rig: Rig, topics: dict[str, str]) -> Rig:
    """Return the rig without a partner of cam0 that was never recorded (broken camera), if another stream
    that gives scale was."""
    recorded = [s for s in (CAM1, DEPTH, IMU) if s in topics]
    if CAM1 not in topics and recorded:
        rig = replace(rig, cam1=None, T_cam1_cam0=None)
    if DEPTH not in topics and recorded:
        rig = replace(rig, depth=None, T_depth_cam0=None)
    return rig


# ---- All IMU samples, hours of them in less than a minute

_BATCH_MESSAGES = 20_000
_LOSS_KIND = "IMU messages"


def read_imu(file: MessageFile, progress: Callable[[int, int], None], losses: DataLosses) -> tuple[I64, F64]:
    """Return stamps (N,) ns, unwrapped, in the order of the log, and values (N, 6), rad/s and m/s^2.

    Images are skipped, and messages parsed in batches. progress: called with the samples read and their
    total. losses: gets damaged samples. Raises DataError without samples, or if more than 5 % are damaged.
    """
    imu_topics = [n for n, t in file.topics.items() if t.kind == ros.IMU_MSG and len(file.log_times[n])]
    topic = guess_topic(IMU, imu_topics)
    if topic is None:
        raise DataError(f"{file.path}: has no IMU samples; its topics: {', '.join(file.topics) or 'none'}")
    total, stamps, values = len(file.log_times[topic]), [], []
    messages = (data for _, _, data in file.messages([topic], losses=losses))
    while batch := list(islice(messages, _BATCH_MESSAGES)):
        intact = [data for data in batch if ros.is_imu_message(data)]
        for _ in range(len(batch) - len(intact)):
            where, what = f"{file.path}: {topic}", "a message is not sensor_msgs/Imu in little-endian CDR"
            losses.add(_LOSS_KIND, f"{losses.counts.get(_LOSS_KIND)}", f"{where}: {what}; record again")
        stamps.append(ros.header_stamps(intact))
        values.append(ros.parse_imu_batch(intact))
        progress(sum(map(len, stamps)), total)
    losses.check(_LOSS_KIND, total)
    if not stamps:
        raise DataError(f"{file.path}: {topic}: has no readable sample")
    return unwrap_stamps(np.concatenate(stamps)), np.concatenate(values)
