"""Read all IMU samples of an MCAP recording, hours of them in less than a minute.

Images are skipped, and messages are parsed in batches rather than one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from share.errors import DataError
from share.recordings.losses import DataLosses
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.file import McapFile
from share.recordings.mcap.reader import guess_topic
from share.sensors.measurement import IMU
from share.sensors.stamps import WRAP_NS
from share.types import F64, I64

_LITTLE_ENDIAN = 1  # bit of byte 1 of the encapsulation header (OMG DDSI-RTPS 10.2)
_NUMBERS = 4 + 9 + 3 + 9 + 3 + 9  # doubles: orientation, rate and acceleration, each with its covariance
_RATE, _FORCE = slice(13, 16), slice(25, 28)
_BATCH_MESSAGES = 20_000
_LOSS_KIND = "IMU messages"


def read_imu(file: McapFile, progress: Callable[[int, int], None], losses: DataLosses) -> tuple[I64, F64]:
    """Return stamps (N,) ns, unwrapped, in the order of the log, and values (N, 6), rad/s and m/s^2.

    progress: called with the samples read and their total. losses: gets damaged samples. Raises DataError if
    there are no samples, or more than 5 % are damaged.
    """
    imu_topics = [n for n, t in file.topics.items() if t.kind == ros.IMU_MSG and len(file.log_times[n])]
    topic = guess_topic(IMU, imu_topics)
    if topic is None:
        raise DataError(f"{file.path}: has no IMU samples; its topics: {', '.join(file.topics) or 'none'}")
    total, stamps, values = len(file.log_times[topic]), [], []
    messages = (data for _, _, data in file.messages([topic], losses=losses))
    for batch in _batches(messages):
        one, numbers = _parse_batch(_intact_messages(batch, f"{file.path}: {topic}", losses))
        stamps.append(one)
        values.append(numbers)
        progress(sum(map(len, stamps)), total)
    losses.check(_LOSS_KIND, total)
    if not stamps:
        raise DataError(f"{file.path}: {topic}: has no readable sample")
    return unwrap_stamps(np.concatenate(stamps)), np.concatenate(values)


def unwrap_stamps(stamps_ns: I64) -> I64:
    """Unwrap the stamps (N,) ns of a D4xx, whose counter restarts every 71 minutes."""
    back = np.diff(stamps_ns, prepend=stamps_ns[:1]) < -WRAP_NS // 2
    return np.asarray(stamps_ns + WRAP_NS * np.cumsum(back), np.int64)


def _batches(messages: Iterator[bytes]) -> Iterator[list[bytes]]:
    while batch := list(islice(messages, _BATCH_MESSAGES)):
        yield batch


def _intact_messages(batch: list[bytes], where: str, losses: DataLosses) -> list[bytes]:
    """Return the messages that are sensor_msgs/Imu in little-endian CDR; count the others as losses.

    Layout: stamp, frame name of any length, doubles to the end.
    """
    intact = [
        data
        for data in batch
        if len(data) >= 16 and data[1] & 1 == _LITTLE_ENDIAN and len(data) == _expected_size(data)
    ]
    for _ in range(len(batch) - len(intact)):
        reason = f"{where}: a message is not sensor_msgs/Imu in little-endian CDR; record again"
        losses.add(_LOSS_KIND, f"{losses.counts.get(_LOSS_KIND)}", reason)
    return intact


def _parse_batch(batch: list[bytes]) -> tuple[I64, F64]:
    heads = np.frombuffer(b"".join(data[4:12] for data in batch), "<u4").reshape(-1, 2).astype(np.int64)
    tails = np.frombuffer(b"".join(data[-8 * _NUMBERS :] for data in batch), "<f8").reshape(-1, _NUMBERS)
    values = np.concatenate([tails[:, _RATE], tails[:, _FORCE]], axis=1)
    return heads[:, 0] * 10**9 + heads[:, 1], values


def _expected_size(data: bytes) -> int:
    """Return the size of a message by the length of its frame name; doubles are aligned to 8 bytes."""
    name_end = 12 + int.from_bytes(data[12:16], "little")
    return 4 + -(-name_end // 8) * 8 + 8 * _NUMBERS
