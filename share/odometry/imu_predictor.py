"""The last seconds of IMU samples, and the prediction of the state at the time of an image: by the samples,
at constant velocity where some are missing."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.odometry import filter
from share.odometry.imu_outliers import ImuOutlierDetector
from share.odometry.imu_propagation import integrate, noise_with_vibration, noise_without_axes, scaled_noise
from share.odometry.state import FilterState
from share.types import F64, ImuBatch

_MAX_SAMPLES = 600
_REST_S = 0.5  # window in which rest is detected
_MIN_REST_SAMPLES = 20
_MAX_REST_ACCEL_STD = 0.12  # m/s^2, about twice a D435i's noise
_MAX_REST_GYRO_STD = 0.02  # rad/s
_VIBRATION_WINDOW_S = 0.2  # window in which vibration is measured
_MIN_CLIPPED = 4  # samples at the end of the scale
_MIN_FULL_SCALE = np.repeat([0.5, 11.0], 3)  # rad/s and m/s^2; every scale ends above


class ImuBuffer:
    """IMU samples of the last few seconds in order of time, without those that `outliers` has rejected."""

    def __init__(self) -> None:
        self.samples = ImuBatch.empty()
        self.max_abs = np.zeros(6)  # of each axis, over all time
        self.outliers = ImuOutlierDetector()

    def add(self, imu: ImuBatch) -> None:
        """Add samples; those not later than the newest are dropped."""
        start = int(np.searchsorted(imu.stamps_ns, self.outliers.newest_ns, side="right"))
        imu = imu.take(slice(start, None)) if start else imu
        values = np.hstack([imu.gyro, imu.accel])
        accepted = self.outliers.accepted_mask(imu.stamps_ns, values)
        if accepted is not None:
            imu, values = imu.take(accepted), values[accepted]
        if self.outliers.retracted_ns:
            self._remove(self.outliers.retracted_ns)
        self.max_abs = np.abs(values).max(axis=0, initial=0.0).clip(self.max_abs)
        self.samples = self.samples.take(slice(-_MAX_SAMPLES, None)).concatenate(imu)

    def extended(self, imu: ImuBatch) -> ImuBuffer:
        """Return a buffer with later samples added; this one does not change."""
        out = ImuBuffer()
        out.samples, out.max_abs, out.outliers = self.samples, self.max_abs, self.outliers.copy()
        out.add(imu)
        return out

    def _remove(self, stamps_ns: list[int]) -> None:
        self.samples = self.samples.take(~np.isin(self.samples.stamps_ns, stamps_ns))
        self.max_abs = np.abs(np.hstack([self.samples.gyro, self.samples.accel])).max(axis=0, initial=0.0)

    @property
    def last_ns(self) -> int:
        """The stamp of the newest sample; 0 without samples."""
        return int(self.samples.stamps_ns[-1]) if len(self.samples) else 0

    def between(self, from_ns: int, to_ns: int, silent_ns: int) -> ImuBatch | None:
        """Return the samples in an interval and one beyond each end, if there is one; None with a gap
        longer than `silent_ns`."""
        stamps = self.samples.stamps_ns
        first = max(int(np.searchsorted(stamps, from_ns, side="right")) - 1, 0)
        last = int(np.searchsorted(stamps, to_ns)) + 1
        part = self.samples.take(slice(first, last))
        stamps_inside = part.stamps_ns
        if (
            len(stamps_inside) == 0
            or np.diff(np.r_[stamps_inside, max(to_ns, int(stamps_inside[-1]))]).max() > silent_ns
        ):
            return None
        return part

    def latest(self, to_ns: int) -> ImuBatch:
        """Return the samples of the last `_VIBRATION_WINDOW_S` before `to_ns`."""
        stamps = self.samples.stamps_ns
        first, last = np.searchsorted(stamps, [to_ns - round(_VIBRATION_WINDOW_S * 1e9), to_ns], side="right")
        return self.samples.take(slice(int(first), int(last) + 1))

    def is_still(self, now_ns: int) -> bool:
        """Return whether the IMU was at rest for `_REST_S` before `now_ns`, with no motor running."""
        last = self.samples.stamps_ns > now_ns - round(_REST_S * 1e9)
        if last.sum() < _MIN_REST_SAMPLES:
            return False
        accel_std, gyro_std = self.samples.accel[last].std(axis=0), self.samples.gyro[last].std(axis=0)
        return bool(
            np.linalg.norm(accel_std) < _MAX_REST_ACCEL_STD and np.linalg.norm(gyro_std) < _MAX_REST_GYRO_STD
        )

    def is_clipped(self, imu: ImuBatch) -> NDArray[np.bool_]:
        """Return which axes (6,), gyro then accelerometer, are at the end of their scale: several samples
        equal the largest value ever, and it is large. Noise does not repeat exactly."""
        magnitude = np.abs(np.hstack([imu.gyro, imu.accel]))
        out: NDArray[np.bool_] = ((magnitude == self.max_abs) & (magnitude > _MIN_FULL_SCALE)).sum(
            axis=0
        ) >= _MIN_CLIPPED
        return out


def fill_clipped(imu: ImuBatch, axes: NDArray[np.bool_], rate: F64) -> ImuBatch:
    """Return the samples with clipped gyro axes (3,) replaced by `rate` (3,) rad/s, biased as a gyro's,
    where that is faster."""
    if not axes.any():
        return imu
    is_faster = axes & (np.abs(rate) > np.abs(imu.gyro)) & (rate * imu.gyro > 0)
    return replace(imu, gyro=np.where(is_faster, rate, imu.gyro))


def constant_velocity_samples(state: FilterState, rate: F64, to_ns: int, gravity: float) -> ImuBatch:
    """Return the samples that an IMU would measure of a body that keeps its velocity and turns by rate
    (3,) rad/s."""
    half_turn = se3.so3_exp(rate * (to_ns - state.stamp_ns) * 0.5e-9)
    force = (state.T[:3, :3] @ half_turn).T @ np.array([0.0, 0.0, gravity])
    stamps = np.array([state.stamp_ns, to_ns])
    return ImuBatch(stamps, np.tile(rate + state.bg, (2, 1)), np.tile(force + state.ba, (2, 1)))


def mean_angular_rate(before: F64, after: F64, dt_ns: int) -> F64:
    """Return the mean rate (3,) rad/s, in the body, between two poses (4, 4)."""
    out: F64 = se3.so3_log(before[:3, :3].T @ after[:3, :3]) / max(dt_ns * 1e-9, 1e-3)
    return out


_MAX_REST_RATE = 0.03  # rad/s
_SILENT_NS = 100_000_000  # time without a sample after which the IMU counts as silent
# Process noise of a prediction at constant velocity: of the angular rate and of the velocity.
_TURNING_NOISE = 0.5  # rad/s/sqrt(Hz)
_MOVING_NOISE = 1.0  # m/s^2/sqrt(Hz)


class ImuStatus(NamedTuple):
    """What the IMU gave for a prediction.

    has_samples: it was not silent. has_gyro: its gyroscope measured all axes. has_rejected: some samples were
    rejected. is_still: it measured what it does at rest, or at constant velocity.
    """

    has_gyro: bool
    has_samples: bool
    has_rejected: bool
    is_still: bool = False


class ImuPredictor:
    """Holds the IMU samples (`buffer`), its noise model and the body's rate (3,) rad/s at the last image."""

    def __init__(self, imu: ImuNoise, config: InertialConfig) -> None:
        self.buffer = ImuBuffer()
        self.noise = scaled_noise(imu, config.imu_noise)
        self.rate = np.zeros(3)
        self._constant_velocity = ImuNoise(_TURNING_NOISE, _MOVING_NOISE, 0.0, 0.0, imu.rate_hz)
        self._gravity = config.gravity

    def samples(self, from_ns: int, to_ns: int) -> ImuBatch | None:
        """Return the samples of an interval; None if some are missing."""
        return self.buffer.between(from_ns, to_ns, _SILENT_NS)

    def restart(self, state: FilterState) -> None:
        """Begin with a new state: its rate is that of the newest sample, unless the IMU is silent."""
        gyro = self.buffer.samples.gyro
        is_known = len(gyro) > 0 and not self.has_fallen_silent(state.stamp_ns)
        self.rate = gyro[-1] - state.bg if is_known else np.zeros(3)

    def has_fallen_silent(self, now_ns: int) -> bool:
        """Return whether samples came, but none of late."""
        return len(self.buffer.samples) > 0 and self.buffer.last_ns < now_ns - _SILENT_NS

    def predict(self, s: FilterState, to_ns: int, gyro_only: bool) -> ImuStatus:
        """Propagate the state to `to_ns`, IMU time.

        gyro_only: at constant velocity, for a single camera whose scale is unknown.
        """
        inflation = self.buffer.outliers.inflation(s.stamp_ns, to_ns)
        has_rejected = inflation is not None and bool(inflation.rejected_axes.any())
        if to_ns <= s.stamp_ns:
            return ImuStatus(True, True, has_rejected)
        samples, gravity = self.samples(s.stamp_ns, to_ns), self._gravity
        if samples is None:
            substitute = constant_velocity_samples(s, self.rate, to_ns, gravity)
            filter.propagate(s, substitute, to_ns, self._constant_velocity, gravity)
            return ImuStatus(False, False, has_rejected)
        if gyro_only:
            noise = noise_without_axes(self.noise, self._constant_velocity, np.arange(6) >= 3)
            mean_rate = samples.gyro.mean(axis=0) - s.bg
            substitute = constant_velocity_samples(s, mean_rate, to_ns, gravity)
            self.rate = filter.propagate(s, substitute, to_ns, noise, gravity)
            return ImuStatus(True, True, has_rejected)
        is_clipped = self.buffer.is_clipped(samples)
        silent_axes = is_clipped if inflation is None else is_clipped | inflation.rejected_axes
        noise = noise_with_vibration(self.noise, self.buffer.latest(to_ns))
        noise = noise_without_axes(noise, self._constant_velocity, silent_axes)
        samples = fill_clipped(samples, is_clipped[:3], self.rate + s.bg)
        self.rate = filter.propagate(s, samples, to_ns, noise, gravity)
        if inflation is not None:
            filter.inflate(s, inflation.turn_rad, 0.0, inflation.speed_m_s)
        is_still = inflation is None and self._is_still(to_ns)
        return ImuStatus(not silent_axes[:3].any(), True, has_rejected, is_still)

    def _is_still(self, now_ns: int) -> bool:
        return bool(np.linalg.norm(self.rate) < _MAX_REST_RATE) and self.buffer.is_still(now_ns)

    def pose_at(self, s: FilterState, t_ns: int, imu: ImuBatch) -> F64:
        """Return T_odom_body (4, 4) at a time after the state's, with samples that came since.

        After the last sample the body is taken to turn and accelerate as it did then. Nothing changes here.
        """
        buffer, gravity = self.buffer.extended(imu), self._gravity
        samples = buffer.between(s.stamp_ns, min(t_ns, buffer.last_ns), _SILENT_NS)
        if samples is None:
            samples = constant_velocity_samples(s, self.rate, t_ns, gravity)
        return integrate(s.T, s.v, s.bg, s.ba, samples, s.stamp_ns, t_ns, self.noise, gravity).T
