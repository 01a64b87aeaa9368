"""What a live RGB-D camera with an IMU gives, and the frames that come of any source."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from helpers.recordings import HEIGHT, STEP_NS, WIDTH, depth_mm, picture

from share.config import SequencerConfig
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.recordings.images import ArrayImage, decode_frame
from share.recordings.recording import Source
from share.sensors.measurement import Measurement
from share.sensors.sequencer import FrameMerger, SequencerCounters, rig_streams, sequence_frames
from share.types import Frame

CAMERA = Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.5, 23.5, (-0.1, 0.02, 0.001, -0.001))
RIG = Rig(
    cam0=CAMERA,
    T_body_cam0=se3.exp(np.array([0.1, 0.2, -0.3, 0.01, 0.02, 0.03])),
    depth=Camera(WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0),
    T_depth_cam0=se3.exp(np.array([0.0, 0.01, 0.0, 0.02, 0.0, 0.0])),
    imu=ImuNoise(1e-4, 2e-3, 2e-5, 3e-3, 200.0),
)


def live(count: int, depth_scale: float = 1000.0) -> Iterator[Measurement]:
    """What a camera gives: arrays, and IMU samples between them."""
    for i in range(count):
        stamp = 10**9 + i * STEP_NS
        for k in range(10):
            yield Measurement("imu", stamp - STEP_NS + (k + 1) * STEP_NS // 10, (0.1, k, 0.0, 0.0, 0.0, 9.8))
        yield Measurement("cam0", stamp, ArrayImage(picture(i)))
        yield Measurement("depth", stamp, ArrayImage(depth_mm(i) / np.float32(depth_scale)))


def frames(source: Source) -> list[Frame]:
    counters = SequencerCounters()
    merger = FrameMerger(
        rig_streams(source.rig),
        source.rate_hz,
        SequencerConfig(),
        counters,
        source.rig.timeshift_ns,
    )
    bundles = sequence_frames(source.measurements(), merger)
    return [decode_frame(bundle) for bundle in bundles]
