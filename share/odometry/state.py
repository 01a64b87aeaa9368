"""The state of the filter: means, and one covariance of all errors.

Errors of poses and velocity are on the left, in odom (the right-invariant error of Barrau & Bonnabel 2017): R
= Exp(phi) R_mean, p = Exp(phi) p_mean + rho, v = Exp(phi) v_mean + nu. The unobservable directions, a
rotation of everything about the vertical and a translation of everything, then do not depend on the means, so
no linearisation point makes the filter gain false information about them.

Columns of the covariance: body pose 6 | velocity 3 | gyro bias 3 | accel bias 3 | T_body_cam 6 (on the right)
| time offset 1 | origin 6 | keyframe poses 6 each | inverse depths 1 each. The origin is the body's pose
where the filter began: its heading and position define odom, its tilt is learnt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.types import F64, I64

POSE = slice(0, 6)
VELOCITY = slice(6, 9)
GYRO_BIAS = slice(9, 12)
ACCEL_BIAS = slice(12, 15)
IMU_STATE_SIZE = 15  # columns that IMU propagation changes
EXTRINSIC = slice(15, 21)
TIMESHIFT = 21
CORE_SIZE = 22
ORIGIN = slice(22, 28)
KEYFRAMES_START = 28

Float = TypeVar("Float", bound=np.floating[Any])


@dataclass(eq=False)
class FilterState:
    """Means and covariance.

    stamp_ns: IMU time. T (4, 4) T_odom_body; v (3,) m/s in odom; bg rad/s, ba m/s^2 (3,) in the body;
    T_body_cam (4, 4); timeshift_s: IMU time minus camera time; T_origin (4, 4): T_odom_body where the filter
    began.

    keyframe_ids (K,), keyframe_poses (K, 4, 4) T_odom_body. feature_ids (N,); anchor (N,): index of the
    keyframe; ray (N, 2): normalised coordinates in the anchor's cam0, exact by definition; rho (N,): inverse
    depth along the anchor's axis, 1/m. cov (28 + 6 K + N, same).
    """

    stamp_ns: int
    T: F64
    v: F64
    bg: F64
    ba: F64
    T_body_cam: F64
    timeshift_s: float
    T_origin: F64
    cov: F64
    keyframe_ids: I64
    keyframe_poses: F64
    feature_ids: I64
    anchor: I64
    ray: F64
    rho: F64

    @property
    def size(self) -> int:
        return self.features_start + len(self.feature_ids)

    @property
    def features_start(self) -> int:
        """The column of the first feature's inverse depth."""
        return KEYFRAMES_START + 6 * len(self.keyframe_ids)

    @property
    def rho_variance(self) -> F64:
        """Variances (N,) 1/m^2 of the inverse depths."""
        return np.diag(self.cov)[self.features_start :]

    def means(self) -> tuple[Any, ...]:
        """Return the means, without the covariance, for `restore`."""
        calibration = self.bg, self.ba, self.T_body_cam, self.timeshift_s
        return self.T, self.v, *calibration, self.T_origin, self.keyframe_poses, self.rho

    def restore(self, means: tuple[Any, ...]) -> None:
        """Restore what `means` returned. Filter steps replace arrays and never write into them."""
        self.T, self.v, self.bg, self.ba, self.T_body_cam, self.timeshift_s = means[:6]
        self.T_origin, self.keyframe_poses, self.rho = means[6:]

    def keyframe_columns(self, k: int) -> slice:
        """Return the columns of the pose of keyframe k."""
        return slice(KEYFRAMES_START + 6 * k, KEYFRAMES_START + 6 * k + 6)


def initial_state(
    stamp_ns: int, T: F64, v: F64, bg: F64, ba: F64, T_body_cam: F64, sigma: F64
) -> FilterState:
    """Return a state without keyframes that begins here. sigma (22,): standard deviations of the core,
    uncorrelated."""
    none = np.zeros(0, np.int64)
    state = FilterState(
        stamp_ns,
        T.copy(),
        v.copy(),
        bg.copy(),
        ba.copy(),
        T_body_cam.copy(),
        0.0,
        T.copy(),
        np.diag(np.r_[sigma**2, np.zeros(6)]),
        none,
        np.zeros((0, 4, 4)),
        none,
        none,
        np.zeros((0, 2)),
        np.zeros(0),
    )
    set_origin(state)
    return state


def set_origin(state: FilterState) -> None:
    """Make the body's pose the origin."""
    state.T_origin = state.T.copy()
    state.cov[ORIGIN] = state.cov[POSE]
    state.cov[:, ORIGIN] = state.cov[:, POSE]


def move(state: FilterState, T: F64) -> None:
    """Move the body of a state without keyframes to T (4, 4), T_odom_body, and begin there: all errors move
    along, for they are of the body and not of odom."""
    T_new_old = T @ se3.inverse(state.T)
    J = np.eye(len(state.cov))
    J[POSE, POSE], J[VELOCITY, VELOCITY] = se3.adjoint(T_new_old), T_new_old[:3, :3]
    state.T, state.v, state.cov = T.copy(), T_new_old[:3, :3] @ state.v, J @ state.cov @ J.T
    set_origin(state)


def twist(state: FilterState, rate: F64) -> F64:
    """Return the derivative (6,) of the body's pose by time: T(t + dt) = Exp(twist dt) T(t). rate (3,):
    rad/s, body."""
    turning = state.T[:3, :3] @ rate
    (a, b, c), (x, y, z) = turning.tolist(), state.T[:3, 3].tolist()
    return np.concatenate([turning, state.v - (b * z - c * y, c * x - a * z, a * y - b * x)])


def pose_at_stamp(state: FilterState, rate: F64) -> F64:
    """Return T_odom_body (4, 4) at the frame's stamp, IMU time; the state is at the time of the image. rate
    (3,): rad/s, body."""
    if state.timeshift_s == 0:
        return state.T
    out: F64 = se3.exp(-twist(state, rate) * state.timeshift_s) @ state.T
    return out


# Add keyframes and features to the state, and marginalise them. Each function changes the state in place.
# Source: stochastic cloning with an unknown time offset, Li & Mourikis (2014).


def add_keyframe(state: FilterState, keyframe_id: int, rate: F64) -> int:
    """Clone the body's pose at the time of the image, which depends on the time offset. Return its index.

    rate (3,): rad/s of the body.
    """
    n, start = state.size, state.features_start
    J = np.zeros((6, n))
    J[:, POSE] = np.eye(6)
    J[:, TIMESHIFT] = twist(state, rate)
    rows = J @ state.cov
    grown = _insert_zeros(state.cov, start, 6)
    for old, new in ((slice(0, start), slice(0, start)), (slice(start, n), slice(start + 6, n + 6))):
        grown[start : start + 6, new], grown[new, start : start + 6] = rows[:, old], rows[:, old].T
    grown[start : start + 6, start : start + 6] = rows @ J.T
    state.cov = grown
    state.keyframe_ids = np.append(state.keyframe_ids, keyframe_id)
    state.keyframe_poses = np.concatenate([state.keyframe_poses, state.T[None]])
    return len(state.keyframe_ids) - 1


def add_features(
    state: FilterState,
    ids: I64,
    anchor: I64,
    ray: F64,
    rho: F64,
    sigma: F64,
    J_existing: F64 | None = None,
    common_sigma: F64 | None = None,
) -> None:
    """Add features (N,) on rays (N, 2) of the keyframes with indices `anchor` (N,), with inverse depths rho
    (N,) 1/m.

    sigma (N,): independent error of each. J_existing (N, M): derivative by the M inverse depths of the state.
    common_sigma (N,): sigma of an error that the new ones share.
    """
    n, count = state.size, len(ids)
    grown = _insert_zeros(state.cov, n, count)
    new = slice(n, n + count)
    if J_existing is not None and J_existing.shape[1]:
        rows = J_existing @ state.cov[state.features_start :]
        grown[new, :n], grown[:n, new] = rows, rows.T
        grown[new, new] = rows[:, state.features_start :] @ J_existing.T
    diagonal = np.arange(n, n + count)
    grown[diagonal, diagonal] += sigma**2
    if common_sigma is not None and common_sigma.any():
        grown[new, new] += np.outer(common_sigma, common_sigma)
    state.cov = grown
    state.feature_ids = np.concatenate([state.feature_ids, ids])
    state.anchor = np.concatenate([state.anchor, anchor])
    state.ray = np.concatenate([state.ray, ray])
    state.rho = np.concatenate([state.rho, rho])


def keep_features(state: FilterState, keep: NDArray[np.bool_]) -> None:
    """Marginalise the features where `keep` (N,) is False."""
    if keep.all():
        return
    _keep_columns(state, np.concatenate([np.ones(state.features_start, bool), keep]))
    state.feature_ids, state.anchor = state.feature_ids[keep], state.anchor[keep]
    state.ray, state.rho = state.ray[keep], state.rho[keep]


def drop_keyframes(state: FilterState, keyframe_ids: I64) -> None:
    """Marginalise the keyframes with these ids, and the features anchored in them."""
    dropped = np.isin(state.keyframe_ids, keyframe_ids)
    if not dropped.any():
        return
    keep = ~dropped[state.anchor]
    _keep_columns(state, np.concatenate([np.ones(KEYFRAMES_START, bool), np.repeat(~dropped, 6), keep]))
    state.feature_ids, state.ray, state.rho = state.feature_ids[keep], state.ray[keep], state.rho[keep]
    state.anchor = (np.cumsum(~dropped) - 1)[state.anchor[keep]]
    state.keyframe_ids, state.keyframe_poses = state.keyframe_ids[~dropped], state.keyframe_poses[~dropped]


def _keep_columns(state: FilterState, keep: NDArray[np.bool_]) -> None:
    state.cov = submatrix(state.cov, np.flatnonzero(keep))


def submatrix(matrix: NDArray[Float], indices: I64) -> NDArray[Float]:
    """Return the rows and columns `indices` of a square matrix; faster than with `np.ix_`."""
    return matrix.take(indices, axis=0).take(indices, axis=1)


def _insert_zeros(cov: F64, start: int, count: int) -> F64:
    """Return the covariance with `count` rows and columns of zeros inserted before column `start`."""
    n = len(cov)
    out = np.zeros((n + count, n + count))
    out[:start, :start], out[:start, start + count :] = cov[:start, :start], cov[:start, start:]
    out[start + count :, :start] = cov[start:, :start]
    out[start + count :, start + count :] = cov[start:, start:]
    return out
