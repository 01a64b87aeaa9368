"""Calibration of one or two cameras from views of a flat target, by bundle adjustment.

Estimated together: fx fy cx cy and the lens coefficients of each camera, T_cam1_cam0 and the target's pose in
each view, from the corners' reprojection errors with Huber's loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from share.lab.least_squares import ArrowSystem, enclosing_covariance, huber, jackknife, minimise
from share.types import F64

MIN_VIEWS = 4
_MAX_STEPS = 60
_HUBER_SIGMAS = 2.5  # times the residuals' robust sigma
_K3_SIGMAS = 3.0  # k3 this far from 0 is significant
_CONVERGED = 1e-9  # relative decrease of the cost


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
    """Minimise in three runs; each fixes the limit of Huber's loss."""
    for _ in range(3):
        residuals, _ = zip(*_linearise_views(state, views, target), strict=True)
        limit = _HUBER_SIGMAS * robust_sigma(np.concatenate(residuals))
        minimum = minimise(
            state, partial(_normal_equations, views, target, limit), _updated_state, _MAX_STEPS, _CONVERGED
        )
        state = minimum.state
    return _solution(views, target, state, *minimum.linearised)


def _linearise_views(
    state: CameraBundleState, views: Sequence[BoardView], target: Target
) -> list[tuple[F64, F64]]:
    return [_linearise_view(state, view, k, target) for k, view in enumerate(views)]


def _normal_equations(
    views: Sequence[BoardView], target: Target, limit: float, state: CameraBundleState
) -> tuple[tuple[F64, F64], float]:
    """Return H (V, S + 6, S + 6) and g (V, S + 6) of each view, and the cost of all."""
    H, g, cost = [], [], 0.0
    for r, J in _linearise_views(state, views, target):
        view_cost, root = huber(np.linalg.norm(r, axis=1), limit)
        A, b = (J * root[:, None, None]).reshape(-1, J.shape[2]), (r * root[:, None]).reshape(-1)
        H.append(A.T @ A)
        g.append(A.T @ b)
        cost += view_cost
    return (np.stack(H), np.stack(g)), cost


def _updated_state(
    state: CameraBundleState, normals: tuple[F64, F64], damping: float
) -> CameraBundleState | None:
    """Return the state after a step, None where there is no step, or it leads to no valid camera."""
    H, g = normals
    S = shared_size(state.cameras)
    system = ArrowSystem(
        H[:, None, S:, S:], H[:, S:, :S], H[:, :S, :S].sum(axis=0), g[:, S:], g[:, :S].sum(axis=0)
    )
    try:
        poses, shared = system.solve(damping)
        cameras = tuple(
            camera_from_parameters(intrinsics(camera) + shared[part], camera)
            for camera, part in zip(state.cameras, state.intrinsic_slices, strict=True)
        )
    except ValueError:  # LinAlgError is one
        return None
    mount = state.T_cam1_cam0 @ se3.exp(shared[-6:]) if len(cameras) == 2 else state.T_cam1_cam0
    return CameraBundleState(cameras, mount, state.T_cam0_target @ se3.exp(poses))


def _solution(
    views: Sequence[BoardView], target: Target, state: CameraBundleState, H: F64, g: F64
) -> CameraBundleSolution:
    S = shared_size(state.cameras)
    eliminated = np.linalg.solve(H[:, S:, S:], np.concatenate([H[:, S:, :S], g[:, S:, None]], axis=2))
    reduced_H = H[:, :S, :S] - H[:, :S, S:] @ eliminated[..., :S]
    reduced_g = g[:, :S] - (H[:, :S, S:] @ eliminated[..., S:])[..., 0]
    residuals = tuple(
        tuple(_linearise(state, view, k, cam, target)[0] for cam in range(len(state.cameras)))
        for k, view in enumerate(views)
    )
    sigma_px = robust_sigma(np.concatenate([r for view in residuals for r in view]))
    independent = sigma_px**2 * np.linalg.inv(reduced_H.sum(axis=0))
    return CameraBundleSolution(state, independent, jackknife(reduced_H, reduced_g), residuals, sigma_px)
