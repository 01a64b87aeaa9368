"""The pipe between SHARE and a peer tracker in another interpreter. Both ends use it; it needs numpy only.

To the peer: a line of JSON with the calibration, then for every frame a line of JSON and the bytes of both
images. From the peer: a line of JSON for each frame: T_world_body, null without a pose, and cpu_s. After the
last one, a peer that corrects its past poses may send one more line: stamps_ns and T_world_body of its final
trajectory. Numbers are text that reads back exactly.
"""

from __future__ import annotations

import json
import os
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class PeerFrame(NamedTuple):
    """Both images (H, W) uint8 at stamp_ns; IMU stamps (N,) ns and samples (N, 6), gyro rad/s and
    accelerometer m/s^2, since the previous frame, up to the first after stamp_ns."""

    stamp_ns: int
    imu_ns: NDArray[np.int64]
    imu: NDArray[np.float64]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


def pose_matrix(t: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (4, 4) of a translation (3,) and a quaternion x y z w of any length."""
    x, y, z, w = q / np.linalg.norm(q)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = t
    return T


def claim_stdout() -> IO[bytes]:
    """Return this process's stdout, for answers only; whatever else is printed goes to stderr from now on."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return out


def write_line(stream: IO[bytes], values: dict[str, Any]) -> None:
    stream.write(json.dumps(values).encode() + b"\n")
    stream.flush()


def read_line(stream: IO[bytes]) -> dict[str, Any] | None:
    """Read a line; None at the end of the stream."""
    line = stream.readline()
    return json.loads(line) if line else None


def write_frame(stream: IO[bytes], frame: PeerFrame) -> None:
    images = (frame.left, frame.right)
    head = {"stamp_ns": frame.stamp_ns, "imu_ns": frame.imu_ns.tolist(), "imu": frame.imu.tolist()}
    write_line(stream, head | {"shapes": [image.shape for image in images]})
    for image in images:
        stream.write(image.tobytes())
    stream.flush()


def read_frame(stream: IO[bytes]) -> PeerFrame | None:
    """Read a frame; None at the end of the stream."""
    head = read_line(stream)
    if head is None:
        return None
    images = [np.frombuffer(stream.read(h * w), np.uint8).reshape(h, w) for h, w in head["shapes"]]
    imu = np.array(head["imu"], np.float64).reshape(-1, 6)
    return PeerFrame(head["stamp_ns"], np.array(head["imu_ns"], np.int64), imu, *images)
