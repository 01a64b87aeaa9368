"""Predict the state at the time of an image: by IMU samples, at constant velocity where some are missing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from share.config import InertialConfig
from share.geometry.camera import ImuNoise
from share.odometry import filter
from share.odometry.imu_buffer import ImuBuffer, constant_velocity_samples, fill_clipped, gyro_only_samples
from share.odometry.imu_propagation import integrate, noise_with_vibration, noise_without_axes, scaled_noise
from share.odometry.state import FilterState
from share.types import F64, ImuBatch

_MAX_REST_RATE = 0.03  # rad/s
_MAX_REST_M_S = 0.3  # a smooth ride looks like rest to an IMU, but not to the filter's velocity
_ZERO_VELOCITY_SIGMA = 0.02  # m/s


class ImuUse(NamedTuple):
    """The basis of a prediction: has_gyro, the gyro measured all axes; has_samples, the IMU was not
    silent; has_rejected, some of its samples were rejected."""

    has_gyro: bool
    has_samples: bool
    has_rejected: bool


class ImuPredictor:
    """Holds the IMU samples (`buffer`), its noise model and the body's rate (3,) rad/s at the last image."""

    def __init__(self, imu: ImuNoise, config: InertialConfig) -> None:
        self.buffer = ImuBuffer()
        self.noise = scaled_noise(imu, config.imu_noise)
        self.rate = np.zeros(3)
        self._constant_velocity = ImuNoise(config.turning_noise, config.moving_noise, 0.0, 0.0, imu.rate_hz)
        self._config = config
        self._silent_ns = round(config.silent_s * 1e9)

    def samples(self, from_ns: int, to_ns: int) -> ImuBatch | None:
        """Return the samples of an interval; None if some are missing."""
        return self.buffer.between(from_ns, to_ns, self._silent_ns)

    def restart(self, state: FilterState) -> None:
        """Begin with a new state: its rate is that of the newest sample."""
        gyro = self.buffer.samples.gyro
        self.rate = gyro[-1] - state.bg if len(gyro) else np.zeros(3)

    def predict(self, s: FilterState, to_ns: int, gyro_only: bool) -> ImuUse:
        """Propagate the state to `to_ns`, IMU time.

        gyro_only: at constant velocity, for a single camera whose scale is unknown.
        """
        inflation = self.buffer.inflation(s.stamp_ns, to_ns)
        has_rejected = inflation is not None and bool(inflation.rejected_axes.any())
        if to_ns <= s.stamp_ns:
            return ImuUse(True, True, has_rejected)
        samples, gravity = self.samples(s.stamp_ns, to_ns), self._config.gravity
        if samples is None:
            substitute = constant_velocity_samples(s, self.rate, to_ns, gravity)
            filter.propagate(s, substitute, to_ns, self._constant_velocity, gravity)
            return ImuUse(False, False, has_rejected)
        if gyro_only:
            noise = noise_without_axes(self.noise, self._constant_velocity, np.arange(6) >= 3)
            self.rate = filter.propagate(
                s, gyro_only_samples(s, samples, to_ns, gravity), to_ns, noise, gravity
            )
            return ImuUse(True, True, has_rejected)
        is_clipped = self.buffer.is_clipped(samples)
        silent_axes = is_clipped if inflation is None else is_clipped | inflation.rejected_axes
        noise = noise_with_vibration(self.noise, self.buffer.latest(to_ns))
        noise = noise_without_axes(noise, self._constant_velocity, silent_axes)
        samples = fill_clipped(samples, is_clipped[:3], self.rate + s.bg)
        self.rate = filter.propagate(s, samples, to_ns, noise, gravity)
        if inflation is not None:
            filter.inflate(s, inflation.turn_rad, 0.0, inflation.speed_m_s)
        elif self._is_at_rest(s, to_ns):
            filter.zero_velocity_update(s, _ZERO_VELOCITY_SIGMA, self._config.gate)
        return ImuUse(not silent_axes[:3].any(), True, has_rejected)

    def _is_at_rest(self, s: FilterState, now_ns: int) -> bool:
        is_slow = np.linalg.norm(self.rate) < _MAX_REST_RATE and np.linalg.norm(s.v) < _MAX_REST_M_S
        return bool(is_slow) and self.buffer.is_still(now_ns)

    def pose_at(self, s: FilterState, t_ns: int, imu: ImuBatch) -> F64:
        """Return T_odom_body (4, 4) at a time after the state's, with samples that came since.

        After the last sample the body is taken to turn and accelerate as it did then. Nothing changes here.
        """
        buffer, gravity = self.buffer.extended(imu), self._config.gravity
        samples = buffer.between(s.stamp_ns, min(t_ns, buffer.last_ns), self._silent_ns)
        if samples is None:
            samples = constant_velocity_samples(s, self.rate, t_ns, gravity)
        return integrate(s.T, s.v, s.bg, s.ba, samples, s.stamp_ns, t_ns, self.noise, gravity).T
