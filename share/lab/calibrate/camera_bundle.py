"""Calibration of one or two cameras from views of a flat target, by bundle adjustment.

Estimated together: fx fy cx cy and the lens coefficients of each camera, T_cam1_cam0 and the target's pose in
each view. Levenberg-Marquardt on the corners' reprojection errors with Huber weights; the poses, each coupled
to its own view only, are eliminated by the Schur complement (Triggs et al., Bundle adjustment: a modern
synthesis, 2000, section 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.geometry.lens import RADTAN
from share.geometry.rig_check import lens_problem
from share.lab.calibrate import camera_initialisation
from share.lab.calibrate.camera_initialisation import (
    camera_from_parameters,
    intrinsics,
    parameter_names,
    project_with_jacobians,
    transform_with_jacobian,
)
from share.lab.calibrate.corners import Detection, robust_sigma
from share.lab.calibrate.target import Target
from share.types import F64


def jackknife(H: F64, g: F64) -> F64:
    """Return the covariance (S, S) of parameters that V views determine together by H (V, S, S) and g (V, S)
    each, from how far the solution moves without each view (MacKinnon, Nielsen and Webb, *Cluster-robust
    inference*, 2023: CV3).

    With few views it has low rank.
    """
    moved = np.linalg.solve(H.sum(axis=0) - H, g[..., None])[..., 0]
    out: F64 = (1 - 1 / len(H)) * moved.T @ moved
    return out


def enclosing_covariance(one: F64, other: F64) -> F64:
    """Return a covariance (S, S) that is in no direction below `one`, which is positive definite, nor below
    `other`.

    Where `one` is the unit ball, principal axes of `other` shorter than 1 become 1.
    """
    root = np.linalg.cholesky(one)
    whitened = np.linalg.solve(root, np.linalg.solve(root, other).T)
    squares, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    axes_back = root @ axes * np.sqrt(np.maximum(squares, 1))
    out: F64 = axes_back @ axes_back.T
    return out


MIN_VIEWS = 4
_MAX_ITERATIONS = 60
_HUBER_SIGMAS = 2.5  # times the residuals' robust sigma
_K3_SIGMAS = 3.0  # k3 this far from 0 is significant
_MIN_RELATIVE_DECREASE = 1e-9  # of the cost: converged below


@dataclass(frozen=True, eq=False)
class BoardView:
    """One view of the target: the corners of each camera, in the order of the cameras, empty where it sees
    none."""

    name: str
    detections: tuple[Detection, ...]


@dataclass(frozen=True, eq=False)
class CameraBundleState:
    """The estimated state. T_cam0_target: (V, 4, 4)."""

    cameras: tuple[Camera, ...]
    T_cam1_cam0: F64
    T_cam0_target: F64

    @property
    def intrinsic_slices(self) -> tuple[slice, ...]:
        """Where each camera's intrinsics are among the shared parameters."""
        return intrinsic_slices(self.cameras)


@dataclass(frozen=True, eq=False)
class CameraBundleSolution:
    """The solution, with two covariances (S, S) of the shared parameters: each camera's intrinsics
    (`camera_initialisation.parameter_names`) and, with two cameras, xi of T_cam1_cam0 Exp(xi).

    `independent`: for independent corner errors. `by_views`: from how views contradict each other.
    `residuals`: of each view and camera (N, 2) px, measured minus predicted. `sigma_px`: noise of a
    coordinate.
    """

    state: CameraBundleState
    independent: F64
    by_views: F64
    residuals: tuple[tuple[F64, ...], ...]
    sigma_px: float

    @property
    def covariance(self) -> F64:
        """(S, S): in each direction the larger of both.

        Corner errors within a view are correlated: by a bent board, by blur, by the detector's bias on
        slanted boards.
        """
        return enclosing_covariance(self.independent, self.by_views)

    @property
    def sigmas(self) -> F64:
        """(S,): standard deviations."""
        return np.sqrt(np.diag(self.covariance))


def calibrate_cameras(
    views: Sequence[BoardView], target: Target, size: tuple[int, int], model: str = RADTAN
) -> CameraBundleSolution:
    """Calibrate cameras from views each with enough corners for one camera (`has_enough_corners`).

    size: (width, height) of an image. model: of the lenses. Radtan's k3 is kept where it is significant,
    `_K3_SIGMAS` sigmas from 0 in at least one camera, and the lens stays valid for tracking.

    Raises ValueError where there are too few views, or they do not determine the parameters.
    """
    cams = len(views[0].detections) if views else 0
    single_solutions = [_calibrate_single(views, target, size, cam, model) for cam in range(cams)]
    if cams == 0:
        raise ValueError("no view shows the target")
    initial = single_solutions[0][0]
    if cams == 2:
        initial = _initial_stereo(
            [state for state, _ in single_solutions], [at for _, at in single_solutions], len(views)
        )
    without_k3 = _solve(views, target, initial)
    return without_k3 if model != RADTAN else _with_k3(without_k3, views, target)


def _with_k3(
    without_k3: CameraBundleSolution, views: Sequence[BoardView], target: Target
) -> CameraBundleSolution:
    """Return the solution with k3 where that is significant and valid, else `without_k3`."""
    extended = [replace(camera, distortion=(*camera.distortion, 0.0)) for camera in without_k3.state.cameras]
    try:
        with_k3 = _solve(views, target, replace(without_k3.state, cameras=tuple(extended)))
    except (ValueError, np.linalg.LinAlgError):
        return without_k3
    is_significant = [
        abs(camera.distortion[4]) > _K3_SIGMAS * with_k3.sigmas[part.stop - 1]
        for part, camera in zip(with_k3.state.intrinsic_slices, with_k3.state.cameras, strict=True)
    ]
    is_valid = all(lens_problem(camera) is None for camera in with_k3.state.cameras)
    return with_k3 if any(is_significant) and is_valid else without_k3


def reprojection_residuals(
    state: CameraBundleState, views: Sequence[BoardView], target: Target
) -> tuple[tuple[F64, ...], ...]:
    """Return residuals (N, 2) px of each view and camera, measured minus predicted."""
    return tuple(
        tuple(_linearise(state, view, k, cam, target)[0] for cam in range(len(state.cameras)))
        for k, view in enumerate(views)
    )


def _board_points(view: BoardView, cam: int, target: Target) -> F64:
    """Return the corners (N, 2) m on the target that a camera sees."""
    return target.corners[view.detections[cam].ids, :2]


def _calibrate_single(
    views: Sequence[BoardView], target: Target, size: tuple[int, int], cam: int, model: str
) -> tuple[CameraBundleState, list[int]]:
    """Calibrate one camera alone; return its state and the rows of its views."""
    view_rows = [
        k
        for k, view in enumerate(views)
        if camera_initialisation.has_enough_corners(_board_points(view, cam, target))
    ]
    if len(view_rows) < MIN_VIEWS:
        raise ValueError(f"cam{cam}: {len(view_rows)} views of the target; at least {MIN_VIEWS} are needed")
    camera_views = [BoardView(views[k].name, (views[k].detections[cam],)) for k in view_rows]
    boards = [_board_points(view, 0, target) for view in camera_views]
    initial_camera = (
        camera_initialisation.initial_pinhole if model == RADTAN else camera_initialisation.initial_fisheye
    )
    camera = initial_camera(boards, [view.detections[0].px for view in camera_views], size)
    poses = [
        camera_initialisation.board_pose(camera, xy, view.detections[0].px)
        for xy, view in zip(boards, camera_views, strict=True)
    ]
    return _solve(
        camera_views, target, CameraBundleState((camera,), np.eye(4), np.stack(poses))
    ).state, view_rows


def _initial_stereo(
    singles: list[CameraBundleState], view_rows: list[list[int]], count: int
) -> CameraBundleState:
    """Return initial values of both cameras from their single calibrations."""
    first, second = (
        dict(zip(k, s.T_cam0_target, strict=True)) for s, k in zip(singles, view_rows, strict=True)
    )
    common = sorted(first.keys() & second.keys())
    if len(common) < MIN_VIEWS:
        raise ValueError(f"both cameras see the target in {len(common)} views; {MIN_VIEWS} are needed")
    pairs = np.stack([second[k] @ se3.inverse(first[k]) for k in common])
    median_mount = pairs[
        np.argmin([np.linalg.norm(se3.log(se3.inverse(T) @ pairs), axis=1).sum() for T in pairs])
    ]
    poses = [first[k] if k in first else se3.inverse(median_mount) @ second[k] for k in range(count)]
    return CameraBundleState((singles[0].cameras[0], singles[1].cameras[0]), median_mount, np.stack(poses))


def _linearise(
    state: CameraBundleState, view: BoardView, k: int, cam: int, target: Target
) -> tuple[F64, F64, F64, F64]:
    """Return residuals (N, 2) and derivatives of the prediction by intrinsics (N, 2, I), by xi of
    T_cam1_cam0 and by xi of T_cam0_target (N, 2, 6)."""
    detection = view.detections[cam]
    points, jacobian_pose = transform_with_jacobian(state.T_cam0_target[k], target.corners[detection.ids])
    jacobian_mount = np.zeros((len(detection), 3, 6))
    if cam == 1:
        points, jacobian_mount = transform_with_jacobian(state.T_cam1_cam0, points)
        jacobian_pose = state.T_cam1_cam0[:3, :3] @ jacobian_pose
    px, jacobian_intrinsics, jacobian_points = project_with_jacobians(state.cameras[cam], points)
    return (
        detection.px - px,
        jacobian_intrinsics,
        jacobian_points @ jacobian_mount,
        jacobian_points @ jacobian_pose,
    )


def _linearise_view(state: CameraBundleState, view: BoardView, k: int, target: Target) -> tuple[F64, F64]:
    """Return residuals (M, 2) of a view and derivatives (M, 2, S + 6) by shared parameters, then by its
    pose."""
    cams = len(state.cameras)
    size = shared_size(state.cameras)
    rs, Js = [], []
    for cam in range(cams):
        r, by_intrinsics, by_mount, by_pose = _linearise(state, view, k, cam, target)
        J = np.zeros((len(r), 2, size + 6))
        J[:, :, state.intrinsic_slices[cam]] = by_intrinsics
        J[:, :, size:] = by_pose
        if cams == 2:
            J[:, :, size - 6 : size] = by_mount
        rs.append(r)
        Js.append(J)
    return np.concatenate(rs), np.concatenate(Js)


def intrinsic_slices(cameras: Sequence[Camera]) -> tuple[slice, ...]:
    """Return where each camera's intrinsics are among the shared parameters."""
    ends = np.cumsum([0, *(len(parameter_names(camera)) for camera in cameras)]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))


def shared_size(cameras: Sequence[Camera]) -> int:
    """Return the number of shared parameters: intrinsics of each camera, and xi of T_cam1_cam0."""
    return int(intrinsic_slices(cameras)[-1].stop) + 6 * (len(cameras) - 1)


def _solve(views: Sequence[BoardView], target: Target, state: CameraBundleState) -> CameraBundleSolution:
    """Levenberg-Marquardt in three runs; each fixes the scale of Huber's weights."""
    for _ in range(3):
        blocks = [_linearise_view(state, view, k, target) for k, view in enumerate(views)]
        limit = _HUBER_SIGMAS * robust_sigma(np.concatenate([r for r, _ in blocks]))
        state = _levenberg_marquardt(views, target, state, limit)
    return _solution(views, target, state, limit)


def _levenberg_marquardt(
    views: Sequence[BoardView], target: Target, state: CameraBundleState, limit: float
) -> CameraBundleState:
    damping, blocks = 1e-4, [_linearise_view(state, view, k, target) for k, view in enumerate(views)]
    cost = _cost(blocks, limit)
    for _ in range(_MAX_ITERATIONS):
        trial = _updated_state(state, *_solve_step(blocks, limit, damping))
        trial_blocks = (
            [_linearise_view(trial, v, k, target) for k, v in enumerate(views)] if trial else blocks
        )
        decrease = cost - _cost(trial_blocks, limit) if trial else -1.0
        if trial is None or not decrease > 0:
            damping *= 8
            if damping > 1e8:
                break
            continue
        state, blocks, cost, damping = trial, trial_blocks, cost - decrease, damping / 5
        if decrease < _MIN_RELATIVE_DECREASE * cost:
            break
    return state


def _cost(blocks: list[tuple[F64, F64]], limit: float) -> float:
    d = np.linalg.norm(np.concatenate([r for r, _ in blocks]), axis=1)
    if np.isnan(d).any():  # a corner behind the camera
        return np.inf
    return float(np.where(d <= limit, d * d / 2, limit * (d - limit / 2)).sum())


def _normal_equations(block: tuple[F64, F64], limit: float) -> tuple[F64, F64]:
    """Return H (S + 6, S + 6) and g (S + 6,) of one view, with Huber weights."""
    r, J = block
    root = np.sqrt(np.minimum(1, limit / np.maximum(np.linalg.norm(r, axis=1), 1e-12)))[:, None]
    A, b = (J * root[..., None]).reshape(-1, J.shape[2]), (r * root).reshape(-1)
    return A.T @ A, A.T @ b


def _solve_step(blocks: list[tuple[F64, F64]], limit: float, damping: float) -> tuple[F64, F64]:
    """Return the step of the shared parameters (S,) and of the poses (V, 6)."""
    H, g = _view_normal_equations(blocks, limit)
    S = H.shape[1] - 6
    reduced, back_substitution = _schur_complement(H, g, damping)
    total = reduced.sum(axis=0)
    damped = damping * np.diag(np.diag(H[:, :S, :S].sum(axis=0)))
    shared = np.linalg.solve(total[:, :S] + damped, total[:, S])
    return shared, back_substitution[..., -1] - back_substitution[..., :S] @ shared


def _view_normal_equations(blocks: list[tuple[F64, F64]], limit: float) -> tuple[F64, F64]:
    """Return `_normal_equations` of all views: H (V, S + 6, S + 6) and g (V, S + 6)."""
    H, g = zip(*(_normal_equations(block, limit) for block in blocks), strict=True)
    return np.stack(H), np.stack(g)


def _schur_complement(H: F64, g: F64, damping: float) -> tuple[F64, F64]:
    """Eliminate each view's pose: return H and g of the shared parameters side by side, (V, S, S + 1), and
    the back substitution of the pose by them, with its own step last, (V, 6, S + 1)."""
    S = H.shape[1] - 6
    Hpp = H[:, S:, S:] * (1 + damping * np.eye(6))
    back_substitution = np.linalg.solve(Hpp, np.concatenate([H[:, S:, :S], g[:, S:, None]], axis=2))
    return np.concatenate([H[:, :S, :S], g[:, :S, None]], axis=2) - H[
        :, :S, S:
    ] @ back_substitution, back_substitution


def _updated_state(state: CameraBundleState, shared: F64, poses: F64) -> CameraBundleState | None:
    """Return the state after a step, None where that is no valid camera."""
    try:
        cameras = tuple(
            camera_from_parameters(intrinsics(camera) + shared[part], camera)
            for camera, part in zip(state.cameras, state.intrinsic_slices, strict=True)
        )
    except ValueError:
        return None
    mount = state.T_cam1_cam0 @ se3.exp(shared[-6:]) if len(cameras) == 2 else state.T_cam1_cam0
    return CameraBundleState(cameras, mount, state.T_cam0_target @ se3.exp(poses))


def _solution(
    views: Sequence[BoardView], target: Target, state: CameraBundleState, limit: float
) -> CameraBundleSolution:
    blocks = [_linearise_view(state, view, k, target) for k, view in enumerate(views)]
    reduced, _ = _schur_complement(*_view_normal_equations(blocks, limit), damping=0.0)
    sigma_px = robust_sigma(np.concatenate([r for r, _ in blocks]))
    H, g = reduced[..., :-1], reduced[..., -1]
    independent = sigma_px**2 * np.linalg.inv(H.sum(axis=0))
    return CameraBundleSolution(
        state, independent, jackknife(H, g), reprojection_residuals(state, views, target), sigma_px
    )
