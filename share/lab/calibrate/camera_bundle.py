"""Calibration of one or two cameras from views of a flat target, by bundle adjustment.

Estimated together: fx fy cx cy and the lens coefficients of each camera, T_cam1_cam0 and the target's pose in
each view, from the corners' reprojection errors with Huber's loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.geometry.lens import RADTAN
from share.geometry.rig_check import lens_problem
from share.lab.calibrate.camera_initialisation import (
    board_pose,
    camera_from_parameters,
    has_enough_corners,
    initial_fisheye,
    initial_pinhole,
    intrinsics,
)
from share.lab.calibrate.corner_observations import (
    BoardView,
    CornerObservations,
    FrameNormals,
    corner_observations,
    intrinsic_slices,
    rig_size,
)
from share.lab.calibrate.corners import robust_sigma
from share.lab.calibrate.target import Target
from share.lab.least_squares import ArrowSystem, enclosing_covariance, jackknife, minimise
from share.types import F64

MIN_VIEWS = 4
_MAX_STEPS = 60
HUBER_SIGMAS = 2.5  # times the residuals' robust sigma
_K3_SIGMAS = 3.0  # k3 this far from 0 is significant
_CONVERGED = 1e-9  # relative decrease of the cost


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
    """The solution, with two covariances (S, S) of the rig's parameters, in the order of
    `share.lab.calibrate.corner_observations`.

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
    observations = corner_observations(views, target, initial.cameras, initial.T_cam1_cam0)
    without_k3 = _solve(observations, initial)
    return without_k3 if model != RADTAN else _with_k3(without_k3, observations)


def _with_k3(without_k3: CameraBundleSolution, observations: CornerObservations) -> CameraBundleSolution:
    """Return the solution with k3 where that is significant and valid, else `without_k3`."""
    extended = [replace(camera, distortion=(*camera.distortion, 0.0)) for camera in without_k3.state.cameras]
    try:
        with_k3 = _solve(observations, replace(without_k3.state, cameras=tuple(extended)))
    except ValueError:
        return without_k3
    is_significant = [
        abs(camera.distortion[4]) > _K3_SIGMAS * with_k3.sigmas[part.stop - 1]
        for part, camera in zip(with_k3.state.intrinsic_slices, with_k3.state.cameras, strict=True)
    ]
    is_valid = all(lens_problem(camera) is None for camera in with_k3.state.cameras)
    return with_k3 if any(is_significant) and is_valid else without_k3


def _calibrate_single(
    views: Sequence[BoardView], target: Target, size: tuple[int, int], cam: int, model: str
) -> tuple[CameraBundleState, list[int]]:
    """Calibrate one camera alone; return its state and the rows of its views."""
    corners = [(target.corners[d.ids, :2], d.px) for d in (view.detections[cam] for view in views)]
    rows = [k for k, (board, _) in enumerate(corners) if has_enough_corners(board)]
    if len(rows) < MIN_VIEWS:
        raise ValueError(f"cam{cam}: {len(rows)} views of the target; at least {MIN_VIEWS} are needed")
    boards, pixels = zip(*(corners[k] for k in rows), strict=True)
    camera = (initial_pinhole if model == RADTAN else initial_fisheye)(boards, pixels, size)
    poses = [board_pose(camera, board, px) for board, px in zip(boards, pixels, strict=True)]
    camera_views = [BoardView(views[k].name, (views[k].detections[cam],)) for k in rows]
    state = CameraBundleState((camera,), np.eye(4), np.stack(poses))
    return _solve(corner_observations(camera_views, target, (camera,)), state).state, rows


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


def _solve(observations: CornerObservations, state: CameraBundleState) -> CameraBundleSolution:
    """Minimise in three runs; each fixes the limit of Huber's loss."""
    for _ in range(3):
        residuals = np.concatenate(_seen_by(observations, state).residuals(state.T_cam0_target))
        linearise = partial(_linearise, observations, HUBER_SIGMAS * robust_sigma(residuals))
        minimum = minimise(state, linearise, _updated_state, _MAX_STEPS, _CONVERGED)
        state = minimum.state
    return _solution(observations, state, minimum.linearised)


def _seen_by(observations: CornerObservations, state: CameraBundleState) -> CornerObservations:
    return observations.with_rig(state.cameras, state.T_cam1_cam0)


def _linearise(
    observations: CornerObservations, limit: float, state: CameraBundleState
) -> tuple[FrameNormals, float]:
    normals = _seen_by(observations, state).normals(state.T_cam0_target, limit, by_rig=True)
    return normals, normals.cost


def _updated_state(
    state: CameraBundleState, normals: FrameNormals, damping: float
) -> CameraBundleState | None:
    """Return the state after a step, None where there is no step, or it leads to no valid camera."""
    H, g, S = normals.H, normals.g, rig_size(state.cameras)
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
    observations: CornerObservations, state: CameraBundleState, normals: FrameNormals
) -> CameraBundleSolution:
    H, g, S = normals.H, normals.g, rig_size(state.cameras)
    eliminated = np.linalg.solve(H[:, S:, S:], np.concatenate([H[:, S:, :S], g[:, S:, None]], axis=2))
    reduced_H = H[:, :S, :S] - H[:, :S, S:] @ eliminated[..., :S]
    reduced_g = g[:, :S] - (H[:, :S, S:] @ eliminated[..., S:])[..., 0]
    residuals = _seen_by(observations, state).residuals(state.T_cam0_target)
    sigma_px = robust_sigma(np.concatenate(residuals))
    independent = sigma_px**2 * np.linalg.inv(reduced_H.sum(axis=0))
    ends = [np.searchsorted(one.frame, np.arange(1, observations.frames)) for one in observations.corners]
    by_camera = [np.split(r, end) for r, end in zip(residuals, ends, strict=True)]
    by_view = tuple(zip(*by_camera, strict=True))
    return CameraBundleSolution(state, independent, jackknife(reduced_H, reduced_g), by_view, sigma_px)
