"""Normal equations of corners and IMU, segment by segment of the curve, and the system of all; L =
LOCAL_COLUMNS."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from share.geometry import se3
from share.lab.calibrate.camera_imu.spline import ORDER, Curve
from share.lab.calibrate.camera_imu.state import (
    GRAVITY,
    KNOTS,
    LOCAL_COLUMNS,
    MOUNT,
    SHARED,
    SHIFT,
    CameraImuState,
    body_twist,
)
from share.lab.calibrate.corner_observations import CornerObservations, rig_size
from share.lab.least_squares import ArrowSystem
from share.types import F64, I64, ImuBatch

_SHARED = slice(KNOTS, KNOTS + SHARED)


@dataclass(frozen=True)
class Sigmas:
    """Sigmas of a corner coordinate, px, and of IMU samples, rad/s and m/s^2. huber: threshold of corners,
    in sigmas."""

    px: float
    gyro: float
    accel: float
    huber: float = 2.5


@dataclass(frozen=True, eq=False)
class SegmentNormals:
    """Normal equations of S segments, H (S, L, L) and g (S, L) by local columns, and the total cost."""

    H: F64
    g: F64
    cost: float


def segment_normals(
    state: CameraImuState, stamps_ns: I64, observations: CornerObservations, imu: ImuBatch, sigmas: Sigmas
) -> SegmentNormals:
    """Return the normal equations at a state, with corners in frames at stamps_ns (F,).

    The cost is infinite where a corner would lie behind its camera.
    """
    H = np.zeros((state.curve.segments, LOCAL_COLUMNS, LOCAL_COLUMNS))
    g = np.zeros((state.curve.segments, LOCAL_COLUMNS))

    T, J, segment = pose_derivatives(state, stamps_ns)
    frames = observations.normals(T, sigmas.huber, sigmas.px)
    np.add.at(H, segment, J.swapaxes(1, 2) @ frames.H @ J)
    np.add.at(g, segment, (J.swapaxes(1, 2) @ frames.g[..., None])[..., 0])

    r, J, segment = inertial_residuals(state, imu)
    sigma = np.repeat([sigmas.gyro, sigmas.accel], 3)
    r, J = r / sigma, J / sigma[:, None]
    ends = np.searchsorted(segment, np.arange(state.curve.segments + 1))
    for k, (first, last) in enumerate(pairwise(ends)):
        A = J[first:last].reshape(-1, LOCAL_COLUMNS)
        H[k] += A.T @ A
        g[k] += A.T @ r[first:last].reshape(-1)
    return SegmentNormals(H, g, frames.cost + float((r**2).sum() / 2))


def camera_poses(state: CameraImuState, stamps_ns: I64) -> F64:
    """Return T_target_cam0 (F, 4, 4) at stamps (F,) of the camera's clock."""
    spans = state.curve.locate(stamps_ns, state.shift_s)
    return se3.from_rt(state.curve.rotation(spans).R, state.curve.position(spans)[0]) @ state.T_imu_cam0


def pose_derivatives(state: CameraImuState, stamps_ns: I64) -> tuple[F64, F64, I64]:
    """Return T_cam0_target (F, 4, 4), derivatives (F, 6, L) by local columns of xi in T_cam0_target Exp(xi),
    and the segments (F,)."""
    curve, spans = state.curve, state.curve.locate(stamps_ns, state.shift_s)
    rotation, (p, weight) = curve.rotation(spans), curve.position(spans)
    J = np.zeros((len(spans.u), 6, LOCAL_COLUMNS))  # of the body's pose, perturbed on the right
    knots = J[..., :KNOTS].reshape(len(spans.u), 6, ORDER, 6)  # a view
    knots[:, :3, :, :3] = rotation.by_knots.transpose(0, 2, 1, 3)
    knots[:, 3:, :, 3:] = rotation.R.swapaxes(1, 2)[:, :, None] * weight[:, None, :, None]
    J[:, :, KNOTS + SHIFT] = body_twist(rotation.R, rotation.rate, curve.position(spans, 1)[0])
    J[:, :, _SHARED][:, :, MOUNT] = se3.adjoint(state.T_imu_cam0)
    T_target_imu = se3.from_rt(rotation.R, p)
    T_cam0_target = se3.inverse(T_target_imu @ state.T_imu_cam0)
    return T_cam0_target, -se3.adjoint(T_target_imu) @ J, spans.segment


def rig_gradients(
    state: CameraImuState, stamps_ns: I64, observations: CornerObservations, sigmas: Sigmas
) -> F64:
    """Return by how much each segment's gradient (S, L) falls per unit of the rig's parameters, which are
    fixed, (S, L, P)."""
    T, J, segment = pose_derivatives(state, stamps_ns)
    P = rig_size(observations.cameras)
    cross_terms = observations.normals(T, sigmas.huber, sigmas.px, by_rig=True).H[:, P:, :P]
    out: F64 = np.zeros((state.curve.segments, LOCAL_COLUMNS, P))
    np.add.at(out, segment, J.swapaxes(1, 2) @ cross_terms)
    return out


def inertial_residuals(state: CameraImuState, imu: ImuBatch) -> tuple[F64, F64, I64]:
    """Return residuals (N, 6) of gyro and accel, measured minus predicted, the derivatives (N, 6, L)
    of the prediction, and the segments (N,)."""
    curve, spans = state.curve, state.curve.locate(imu.stamps_ns)
    rotation, (a, weight) = curve.rotation(spans), curve.position(spans, 2)
    bias, share_after = state.bias(spans.segment, spans.u)
    R_world_body_T = rotation.R.swapaxes(1, 2)
    force = (R_world_body_T @ (a - state.gravity)[..., None])[..., 0]
    J = np.zeros((len(spans.u), 6, LOCAL_COLUMNS))
    knots = J[..., :KNOTS].reshape(len(spans.u), 6, ORDER, 6)
    knots[:, :3, :, :3] = rotation.rate_by_knots.transpose(0, 2, 1, 3)
    knots[:, 3:, :, :3] = (se3.hat(force)[:, None] @ rotation.by_knots).transpose(0, 2, 1, 3)
    knots[:, 3:, :, 3:] = R_world_body_T[:, :, None] * weight[:, None, :, None]
    J[:, 3:, _SHARED][:, :, GRAVITY] = -R_world_body_T
    J[:, :, -12:-6] = np.eye(6) * (1 - share_after)[:, None, None]
    J[:, :, -6:] = np.eye(6) * share_after[:, None, None]
    predicted = np.concatenate([rotation.rate, force], axis=1) + bias
    return np.concatenate([imu.gyro, imu.accel], axis=1) - predicted, J, spans.segment


def arrow_system(segments: SegmentNormals, state: CameraImuState) -> ArrowSystem:
    """Assemble all segments: K knots, each coupled to the five after it, and a border of SHARED + 6 M
    columns."""
    S, K, border = state.curve.segments, len(state.curve.p), SHARED + state.biases.size
    blocks, edge = np.zeros((K, ORDER, 6, 6)), np.zeros((K, 6, border))
    corner = np.zeros((border, border))
    spans = _bias_intervals(state)
    for a in range(ORDER):
        rows = slice(6 * a, 6 * a + 6)
        for b in range(a, ORDER):
            blocks[a : a + S, b - a] += segments.H[:, rows, 6 * b : 6 * b + 6]
        for part, columns in spans:
            edge[a : a + S][part][:, :, columns] += segments.H[part, rows, KNOTS:LOCAL_COLUMNS]
    for part, columns in spans:
        corner[np.ix_(columns, columns)] += segments.H[part, KNOTS:, KNOTS:].sum(axis=0)
    return ArrowSystem(blocks, edge, corner, *gather_gradient(segments.g, state))


def gather_gradient(g: F64, state: CameraImuState) -> tuple[F64, F64]:
    """Sum gradients by local columns, (S, L, ...), into those of the knots (K, 6, ...) and of the border (B,
    ...)."""
    S, K, more = state.curve.segments, len(state.curve.p), g.shape[2:]
    knots, border = np.zeros((K, 6, *more)), np.zeros((SHARED + state.biases.size, *more))
    for a in range(ORDER):
        knots[a : a + S] += g[:, 6 * a : 6 * a + 6]
    for part, columns in _bias_intervals(state):
        border[columns] += g[part, KNOTS:].sum(axis=0)
    return knots, border


def _bias_intervals(state: CameraImuState) -> list[tuple[slice, np.ndarray]]:
    """Return the segments of each bias interval, and the border's columns that they involve."""
    starts = range(0, state.curve.segments, state.per_node)
    shared, own = np.arange(SHARED), SHARED + np.arange(12)
    return [
        (
            slice(start, min(start + state.per_node, state.curve.segments)),
            np.concatenate([shared, own + 6 * k]),
        )
        for k, start in enumerate(starts)
    ]


def on_curve_mask(curve: Curve, stamps_ns: I64, shift_s: float, margin_s: float) -> np.ndarray:
    """Return which stamps (N,), shifted, lie on the curve with a margin to its ends."""
    t = (stamps_ns - curve.start_ns) * 1e-9 + shift_s
    return np.asarray((t >= margin_s) & (t <= curve.end_s - margin_s))
