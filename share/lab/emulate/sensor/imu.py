"""Errors of a real gyroscope and accelerometer, added to perfect measurements.

Model of IEEE Std 952 and Kalibr: white noise of density n gives each sample sigma n sqrt(rate); the bias is a
random walk of density w, sigma w sqrt(dt) a step; a first-order Gauss-Markov part is its instability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.emulate.sensor.clock import unwrapped_stamps
from share.lab.emulate.sensor.indexed_random import Seed
from share.sensors.profile_types import InertialFacts
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class ImuStreams:
    """Two streams, each with its own stamps of the device's clock: gyro (N, 3) rad/s, accel (M, 3) m/s^2.
    period_ns: after which stamps wrap, 0 = never."""

    gyro_ns: I64
    gyro: F64
    accel_ns: I64
    accel: F64
    period_ns: int = 0

    def to_batch(self) -> ImuBatch:
        """Return six values at the gyroscope's stamps with the acceleration interpolated, as drivers do,
        without stamps outside the accelerometer's span."""
        if not (len(self.gyro_ns) and len(self.accel_ns)):
            return ImuBatch.empty()
        gyro_ns, accel_ns = self._unwrapped()
        both = (gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])
        at, known = gyro_ns[both] - accel_ns[0], accel_ns - accel_ns[0]  # float64 holds these exactly
        accel = np.stack([np.interp(at, known, column) for column in self.accel.T], axis=1)
        return ImuBatch(self.gyro_ns[both], self.gyro[both], accel)

    def _unwrapped(self) -> tuple[I64, I64]:
        """Return stamps of both streams without wraps."""
        gyro_ns, accel_ns = (
            unwrapped_stamps(stamps, self.period_ns) for stamps in (self.gyro_ns, self.accel_ns)
        )
        if self.period_ns:  # both start within a period of the slower one: nearer than half a wrap
            accel_ns = accel_ns + self.period_ns * round((gyro_ns[0] - accel_ns[0]) / self.period_ns)
        return gyro_ns, accel_ns


def measured_samples(
    perfect: F64,
    sensor: InertialFacts,
    seed: Seed,
    noise: bool = True,
    bias: bool = True,
    limits: bool = True,
) -> F64:
    """Return (N, 3) of one sensor at its own rate with its errors, from the sample at which it was switched
    on.

    Deterministic for a given seed: a shorter series is the head of a longer one.
    """
    out = perfect.copy()
    if noise:
        white = np.random.default_rng((*seed, 0)).standard_normal(perfect.shape)
        out += sensor.density * np.sqrt(sensor.rate_hz) * white
    if bias:
        out += bias_series(sensor, len(perfect), seed)
    return saturate_and_quantise(out, sensor) if limits else out


def bias_series(sensor: InertialFacts, n: int, seed: Seed) -> F64:
    """Return the bias (n, 3): a start, uniform in +-sqrt(3) sigma; a random walk; and the Gauss-Markov
    part."""
    start = np.random.default_rng((*seed, 1)).uniform(-1, 1, 3) * np.sqrt(3) * sensor.start_bias
    steps = np.random.default_rng((*seed, 2)).standard_normal((n, 3)) * sensor.walk / np.sqrt(sensor.rate_hz)
    bias: F64 = start + np.cumsum(steps, axis=0)
    return bias + _gauss_markov(sensor, n, seed) if sensor.instability else bias


def _gauss_markov(sensor: InertialFacts, n: int, seed: Seed) -> F64:
    """Return x_k = a x_{k-1} + sigma sqrt(1 - a^2) w_k with a = exp(-dt / T), stationary from the start."""
    from scipy.signal import lfilter

    a = np.exp(-1 / (sensor.rate_hz * sensor.instability_s))
    white = np.random.default_rng((*seed, 3)).standard_normal((n, 3))
    white[1:] *= np.sqrt(1 - a * a)
    out: F64 = sensor.instability * lfilter([1.0], [1.0, -a], white, axis=0)
    return out


def saturate_and_quantise(values: F64, sensor: InertialFacts) -> F64:
    """Clip to +-range and round to multiples of `step` (0: no rounding)."""
    out: F64 = np.clip(values, -sensor.range, sensor.range)
    return np.rint(out / sensor.step) * sensor.step if sensor.step else out
