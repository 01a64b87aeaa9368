"""Images between IMU samples: their place in the IMU's period does not matter."""

import numpy as np
import pytest
from helpers.imu_simulation import GRAVITY, NOISE
from helpers.imu_world import Path, imu_of

from share.odometry.imu_predictor import ImuBuffer
from share.odometry.imu_propagation import integrate

IMU_HZ, FRAME_HZ, SECONDS = 200.0, 20.0, 2.0
PHASES = 0.0, 0.1, 0.25, 0.5, 0.75, 0.9


def final_error_m(seed: int, phase: float) -> float:
    """The error after a chain of frames `phase` of an IMU's period after a sample, by a noisy IMU alone."""
    path, rng = Path(seed), np.random.default_rng(seed)
    t = np.arange(0, SECONDS + 0.1, 1 / IMU_HZ)
    imu, bg, ba = imu_of(path, t, np.zeros(3), np.zeros(3), rng, NOISE)
    buffer = ImuBuffer()
    buffer.samples = imu
    T, v, now_ns = path.poses(np.zeros(1))[0], path.velocity(np.zeros(1))[0], 0
    frames_s = np.arange(1, SECONDS * FRAME_HZ) / FRAME_HZ + phase / IMU_HZ
    for to_ns in [*np.rint(frames_s * 1e9).astype(int).tolist(), round(SECONDS * 1e9)]:
        samples = buffer.between(now_ns, to_ns, 10**8)
        assert samples is not None
        motion = integrate(T, v, bg[0], ba[0], samples, now_ns, to_ns, NOISE, GRAVITY)
        T, v, now_ns = motion.T, motion.v, to_ns
    return float(np.linalg.norm(T[:3, 3] - path.poses(np.array([SECONDS]))[0, :3, 3]))


@pytest.mark.parametrize("seed", range(5))
def test_error_is_the_same_at_every_fraction_of_an_imu_period(seed):
    errors = [final_error_m(seed, phase) for phase in PHASES]
    assert max(errors) < 1.05 * min(errors), errors
