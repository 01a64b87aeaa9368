"""Errors of a real gyroscope and accelerometer, added to perfect measurements; and vibration.

Model of IEEE Std 952 and Kalibr: white noise of density n gives each sample sigma n sqrt(rate); the bias is a
random walk of density w, sigma w sqrt(dt) a step; a first-order Gauss-Markov part is its instability.

Vibration is motion too small for a picture, with large accelerations. A machine is four rotors, each with a
frequency of its own that drifts, and its double. A knock, as of a wheel on the edge of a tile or of a heel,
is a damped oscillation. Neither changes position or velocity in the end: their accelerations are second
derivatives of a displacement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.emulate.sensor.clock import Seed
from share.sensors.profile_types import InertialFacts
from share.sensors.stamps import unwrap_stamps
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
            unwrap_stamps(stamps, self.period_ns) for stamps in (self.gyro_ns, self.accel_ns)
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
    if not sensor.instability:
        return bias
    white = np.random.default_rng((*seed, 3)).standard_normal((n, 3))
    return bias + sensor.instability * _gauss_markov(
        white, np.exp(-1 / (sensor.rate_hz * sensor.instability_s))
    )


def saturate_and_quantise(values: F64, sensor: InertialFacts) -> F64:
    """Clip to +-range and round to multiples of `step` (0: no rounding)."""
    out: F64 = np.clip(values, -sensor.range, sensor.range)
    return np.rint(out / sensor.step) * sensor.step if sensor.step else out


# Vibration and knocks.

_ROTORS, _ROTOR_HZ, _WANDER_HZ, _WANDER_S = 4, (70.0, 110.0), 4.0, 2.0
_HARMONIC_AMPLITUDE = 0.5  # amplitude of the double frequency
_ROTATION_RATIO = 0.03  # rad/s of rotation for each m/s^2
_KNOCK_HZ, _KNOCK_S = (18.0, 40.0), 0.012  # frequency of the oscillation; time constant of its rise and decay
_GRID_HZ = 4000.0  # on which a knock is differentiated


def vibration_acceleration(seconds: F64, rms: float, seed: Seed) -> F64:
    """Return the acceleration (N, 3) m/s^2 at times (N,) s from the start, with `rms` on each axis. It does
    not depend on which other times are asked for."""
    grid = np.arange(0.0, max(float(seconds.max(initial=0.0)), 0.0) + _WANDER_S, _WANDER_S / 20)
    out = np.zeros((len(seconds), 3))
    decay = np.exp(-(grid[1] - grid[0]) / _WANDER_S) if len(grid) > 1 else 0.0
    for rotor in range(_ROTORS):
        rng = np.random.default_rng((*seed, 0, rotor))
        base, phase = rng.uniform(*_ROTOR_HZ), rng.uniform(0, 2 * np.pi, (2, 3))
        direction = rng.standard_normal((2, 3))
        wander = _gauss_markov(rng.standard_normal(len(grid)), decay) * _WANDER_HZ
        turns = np.concatenate([[0.0], np.cumsum((base + wander)[:-1] * np.diff(grid))])
        angle = 2 * np.pi * np.interp(seconds, grid, turns)[:, None]
        out += direction[0] * np.sin(angle + phase[0]) + _HARMONIC_AMPLITUDE * direction[1] * np.sin(
            2 * angle + phase[1]
        )
    rms_unscaled = np.sqrt(_ROTORS * (1 + _HARMONIC_AMPLITUDE**2) / 2)
    acceleration: F64 = rms / rms_unscaled * out
    return acceleration


def knock_acceleration(seconds: F64, peak: float, every_s: float, seed: Seed) -> F64:
    """Return the acceleration (N, 3) m/s^2 at times (N,) s: about `peak` each, at random times `every_s`
    apart."""
    rng = np.random.default_rng((*seed, 1))
    out, at, end = np.zeros((len(seconds), 3)), 0.0, float(seconds.max(initial=0.0))
    while (at := at + float(rng.exponential(every_s))) < end:
        hz, direction = rng.uniform(*_KNOCK_HZ), rng.standard_normal(3)
        t = np.arange(0.0, 20 * _KNOCK_S, 1 / _GRID_HZ)
        place = (t / _KNOCK_S) ** 3 * np.exp(-t / _KNOCK_S) * np.sin(2 * np.pi * hz * t)
        pulse = np.gradient(np.gradient(place, t), t)
        wave = np.interp(seconds - at, t, pulse / np.abs(pulse).max(), left=0.0, right=0.0)
        out += peak * wave[:, None] * direction / np.linalg.norm(direction)
    return out


def rotation_rates(acceleration: F64) -> F64:
    """Return angular rates (N, 3) rad/s of such a vibration: a force off the centre of mass also turns the
    body."""
    return _ROTATION_RATIO * np.roll(acceleration, 1, axis=1)


def _gauss_markov(white: F64, decay: float) -> F64:
    """Return x_k = a x_{k-1} + sqrt(1 - a^2) w_k for w (N, ...) and a = `decay`, stationary."""
    out = white.copy()
    out[1:] *= np.sqrt(1 - decay * decay)
    for k in range(1, len(out)):
        out[k] += decay * out[k - 1]
    return out
