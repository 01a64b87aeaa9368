"""The state of the filter: means, and one covariance of all errors.

Errors of poses and velocity are on the left, in odom (the right-invariant error of Barrau & Bonnabel 2017): R
= Exp(phi) R_mean, p = Exp(phi) p_mean + rho, v = Exp(phi) v_mean + nu. The unobservable directions, a
rotation of everything about the vertical and a translation of everything, then do not depend on the means, so
no linearisation point makes the filter gain false information about them.

Columns of the covariance: body pose 6 | velocity 3 | gyro bias 3 | accel bias 3 | T_body_cam 6 (on the right)
| time offset 1 | keyframe poses 6 each | inverse depths 1 each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.types import F64, I64

POSE = slice(0, 6)
VELOCITY = slice(6, 9)
GYRO_BIAS = slice(9, 12)
ACCEL_BIAS = slice(12, 15)
IMU_STATE_SIZE = 15  # columns that IMU propagation changes
EXTRINSIC = slice(15, 21)
TIMESHIFT = 21
CORE_SIZE = 22


@dataclass(eq=False)
class FilterState:
    """Means and covariance.

    stamp_ns: IMU time. T (4, 4) T_odom_body; v (3,) m/s in odom; bg rad/s, ba m/s^2 (3,) in the body;
    T_body_cam (4, 4); timeshift_s: IMU time minus camera time.

    keyframe_ids (K,), keyframe_poses (K, 4, 4) T_odom_body. feature_ids (N,); anchor (N,): index of the
    keyframe; ray (N, 2): normalised coordinates in the anchor's cam0, exact by definition; rho (N,): inverse
    depth along the anchor's axis, 1/m. cov (22 + 6 K + N, same).
    """

    stamp_ns: int
    T: F64
    v: F64
    bg: F64
    ba: F64
    T_body_cam: F64
    timeshift_s: float
    cov: F64
    keyframe_ids: I64
    keyframe_poses: F64
    feature_ids: I64
    anchor: I64
    ray: F64
    rho: F64

    @property
    def size(self) -> int:
        return CORE_SIZE + 6 * len(self.keyframe_ids) + len(self.feature_ids)

    @property
    def features_start(self) -> int:
        """The column of the first feature's inverse depth."""
        return CORE_SIZE + 6 * len(self.keyframe_ids)

    @property
    def rho_variance(self) -> F64:
        """Variances (N,) 1/m^2 of the inverse depths."""
        return np.diag(self.cov)[self.features_start :]

    def means(self) -> tuple[Any, ...]:
        """Return the means, without the covariance, for `restore`."""
        calibration = self.bg, self.ba, self.T_body_cam, self.timeshift_s
        return self.T, self.v, *calibration, self.keyframe_poses, self.rho

    def restore(self, means: tuple[Any, ...]) -> None:
        """Restore what `means` returned. Filter steps replace arrays and never write into them."""
        self.T, self.v, self.bg, self.ba, self.T_body_cam, self.timeshift_s = means[:6]
        self.keyframe_poses, self.rho = means[6:]

    def keyframe_columns(self, k: int) -> slice:
        """Return the columns of the pose of keyframe k."""
        return slice(CORE_SIZE + 6 * k, CORE_SIZE + 6 * k + 6)


def initial_state(
    stamp_ns: int, T: F64, v: F64, bg: F64, ba: F64, T_body_cam: F64, sigma: F64
) -> FilterState:
    """Return a state without keyframes. sigma (22,): standard deviations of the core, uncorrelated."""
    none = np.zeros(0, np.int64)
    return FilterState(
        stamp_ns,
        T.copy(),
        v.copy(),
        bg.copy(),
        ba.copy(),
        T_body_cam.copy(),
        0.0,
        np.diag(sigma**2),
        none,
        np.zeros((0, 4, 4)),
        none,
        none,
        np.zeros((0, 2)),
        np.zeros(0),
    )
