"""Calibration of one or two cameras from views of a flat target, by bundle adjustment.

Found together: fx fy cx cy and the lens's coefficients of each camera, T_cam1_cam0 and a pose of the target
in each view. Levenberg-Marquardt on the corners' reprojection errors; the poses, each of which meets only its
own view, are eliminated by the Schur complement (Triggs et al., Bundle adjustment: a modern synthesis, 2000,
section 6.1). Huber's weights hold back corners that were found wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera
from share.geometry.lens import RADTAN
from share.geometry.rig_check import lens_objection
from share.lab.calibrate import camera_start
from share.lab.calibrate.camera_start import camera_of, intrinsics, moved, names, project
from share.lab.calibrate.corners import Detection, spread
from share.lab.calibrate.target import Target
from share.types import F64

# ---- How far parameters that many views tell together may be off, also where a view's residuals err
# together.


def jackknife(H: F64, g: F64) -> F64:
    """Covariance (S, S) of what V views tell together by H (V, S, S) and g (V, S) each, by how far it moves
    without each of them (MacKinnon, Nielsen and Webb, *Cluster-robust inference*, 2023: CV3). Of few views
    it knows few directions."""
    moved = np.linalg.solve(H.sum(axis=0) - H, g[..., None])[..., 0]
    out: F64 = (1 - 1 / len(H)) * moved.T @ moved
    return out


def larger(one: F64, other: F64) -> F64:
    """A covariance (S, S) in no direction below `one`, which is positive definite, nor below `other`: where
    `one` is a unit ball, the principal axes of `other` that are shorter than 1 are made 1."""
    root = np.linalg.cholesky(one)
    inside = np.linalg.solve(root, np.linalg.solve(root, other).T)
    squares, axes = np.linalg.eigh((inside + inside.T) / 2)
    back = root @ axes * np.sqrt(np.maximum(squares, 1))
    out: F64 = back @ back.T
    return out


LEAST_VIEWS = 4
_ROUNDS = 60
_HUBER = 2.5  # times the residuals' own spread
_SURE = 3.0  # sigmas from 0 at which a fifth coefficient is told
_STILL = 1e-9  # relative fall of the cost at which it has arrived


@dataclass(frozen=True, eq=False)
class View:
    """One look at the target: corners of each camera, in the order of the cameras; none is an empty one."""

    name: str
    seen: tuple[Detection, ...]


@dataclass(frozen=True, eq=False)
class State:
    """What is sought. T_cam0_target: (V, 4, 4)."""

    cameras: tuple[Camera, ...]
    T_cam1_cam0: F64
    T_cam0_target: F64

    @property
    def parts(self) -> tuple[slice, ...]:
        """Where each camera's intrinsics are among the shared parameters."""
        return parts(self.cameras)


@dataclass(frozen=True, eq=False)
class Solution:
    """`state`, with two covariances (S, S) of the intrinsics of each camera, see `projection.names`, and, of
    two, xi of T_cam1_cam0 Exp(xi): `independent`, if corners err so; `by_views`, as views contradict one
    another. Of each view and camera the residuals (N, 2) px, seen less predicted; sigma_px: noise of a
    coordinate."""

    state: State
    independent: F64
    by_views: F64
    residuals: tuple[tuple[F64, ...], ...]
    sigma_px: float

    @property
    def covariance(self) -> F64:
        """(S, S): in each direction the larger of both. Corners of a view err together: by a bent board, by
        blur, by what a detector makes of a slant."""
        return larger(self.independent, self.by_views)

    @property
    def sigmas(self) -> F64:
        """(S,): one sigma of each."""
        return np.sqrt(np.diag(self.covariance))


def calibrate(views: Sequence[View], target: Target, size: tuple[int, int], model: str = RADTAN) -> Solution:
    """From views each of which `start.enough` corners of one camera tell. size: (width, height) of an image.
    model: of the lenses. Radtan's k3 is taken where it is told, `_SURE` sigmas from 0 in one camera at least,
    and a tracker can use it.

    Raises ValueError where the views are too few, or do not tell what is sought.
    """
    eyes = len(views[0].seen) if views else 0
    alone = [_alone(views, target, size, eye, model) for eye in range(eyes)]
    if eyes == 0:
        raise ValueError("no view of the target")
    first = alone[0][0]
    if eyes == 2:
        first = _together([state for state, _ in alone], [at for _, at in alone], len(views))
    four = _solve(views, target, first)
    return four if model != RADTAN else _with_k3(four, views, target)


def _with_k3(four: Solution, views: Sequence[View], target: Target) -> Solution:
    """The solution with a fifth coefficient, where it tells that one; else as it is."""
    wider = [replace(camera, distortion=(*camera.distortion, 0.0)) for camera in four.state.cameras]
    try:
        five = _solve(views, target, replace(four.state, cameras=tuple(wider)))
    except (ValueError, np.linalg.LinAlgError):
        return four
    told = [
        abs(camera.distortion[4]) > _SURE * five.sigmas[part.stop - 1]
        for part, camera in zip(five.state.parts, five.state.cameras, strict=True)
    ]
    sound = all(lens_objection(camera) is None for camera in five.state.cameras)
    return five if any(told) and sound else four


def errors(state: State, views: Sequence[View], target: Target) -> tuple[tuple[F64, ...], ...]:
    """Of each view and camera the residuals (N, 2) px, seen less predicted."""
    return tuple(
        tuple(_linear(state, view, k, eye, target)[0] for eye in range(len(state.cameras)))
        for k, view in enumerate(views)
    )


def refit(state: State, views: Sequence[View], target: Target) -> State:
    """Poses of other views by cameras that are known: intrinsics and T_cam1_cam0 stay."""
    poses = np.stack([_first_pose(state, view, target) for view in views])
    return _solve(views, target, replace(state, T_cam0_target=poses), cameras_fixed=True).state


def _board(view: View, eye: int, target: Target) -> F64:
    """Corners (N, 2) m on the target that a camera sees."""
    return target.corners[view.seen[eye].ids, :2]


def _alone(
    views: Sequence[View], target: Target, size: tuple[int, int], eye: int, model: str
) -> tuple[State, list[int]]:
    """One camera by itself, and which views it has."""
    at = [k for k, view in enumerate(views) if camera_start.enough(_board(view, eye, target))]
    if len(at) < LEAST_VIEWS:
        raise ValueError(f"cam{eye}: {len(at)} views of the target; {LEAST_VIEWS} are needed at least")
    mine = [View(views[k].name, (views[k].seen[eye],)) for k in at]
    boards = [_board(view, 0, target) for view in mine]
    begin = camera_start.first_camera if model == RADTAN else camera_start.first_fisheye
    camera = begin(boards, [view.seen[0].px for view in mine], size)
    poses = [camera_start.pose(camera, xy, view.seen[0].px) for xy, view in zip(boards, mine, strict=True)]
    return _solve(mine, target, State((camera,), np.eye(4), np.stack(poses))).state, at


def _together(alone: list[State], at: list[list[int]], count: int) -> State:
    """Both cameras, where each begins where it ended alone."""
    first, second = (dict(zip(k, s.T_cam0_target, strict=True)) for s, k in zip(alone, at, strict=True))
    both = sorted(first.keys() & second.keys())
    if len(both) < LEAST_VIEWS:
        raise ValueError(f"both cameras see the target in {len(both)} views; {LEAST_VIEWS} are needed")
    pairs = np.stack([second[k] @ se3.inverse(first[k]) for k in both])
    middle = pairs[np.argmin([np.linalg.norm(se3.log(se3.inverse(T) @ pairs), axis=1).sum() for T in pairs])]
    poses = [first[k] if k in first else se3.inverse(middle) @ second[k] for k in range(count)]
    return State((alone[0].cameras[0], alone[1].cameras[0]), middle, np.stack(poses))


def _first_pose(state: State, view: View, target: Target) -> F64:
    eye = int(np.argmax([len(seen) for seen in view.seen]))
    seen = view.seen[eye]
    T = camera_start.pose(state.cameras[eye], target.corners[seen.ids, :2], seen.px)
    return T if eye == 0 else se3.inverse(state.T_cam1_cam0) @ T


def _linear(state: State, view: View, k: int, eye: int, target: Target) -> tuple[F64, F64, F64, F64]:
    """Residuals (N, 2) and the derivatives of what is predicted, by intrinsics (N, 2, I), by xi of
    T_cam1_cam0 and by xi of T_cam0_target (N, 2, 6)."""
    seen = view.seen[eye]
    points, by_pose = moved(state.T_cam0_target[k], target.corners[seen.ids])
    by_mount = np.zeros((len(seen), 3, 6))
    if eye == 1:
        points, by_mount = moved(state.T_cam1_cam0, points)
        by_pose = state.T_cam1_cam0[:3, :3] @ by_pose
    px, by_intrinsics, by_points = project(state.cameras[eye], points)
    return seen.px - px, by_intrinsics, by_points @ by_mount, by_points @ by_pose


def _block(state: State, view: View, k: int, target: Target) -> tuple[F64, F64]:
    """Residuals (M, 2) of one view and derivatives (M, 2, S + 6): shared parameters, then its pose."""
    eyes = len(state.cameras)
    size = shared(state.cameras)
    rs, Js = [], []
    for eye in range(eyes):
        r, by_intrinsics, by_mount, by_pose = _linear(state, view, k, eye, target)
        J = np.zeros((len(r), 2, size + 6))
        J[:, :, state.parts[eye]] = by_intrinsics
        J[:, :, size:] = by_pose
        if eyes == 2:
            J[:, :, size - 6 : size] = by_mount
        rs.append(r)
        Js.append(J)
    return np.concatenate(rs), np.concatenate(Js)


def parts(cameras: Sequence[Camera]) -> tuple[slice, ...]:
    """Where each camera's intrinsics are among the parameters that the views share."""
    ends = np.cumsum([0, *(len(names(camera)) for camera in cameras)]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))


def shared(cameras: Sequence[Camera]) -> int:
    """How many parameters the views share: intrinsics of each camera, and xi of T_cam1_cam0."""
    return int(parts(cameras)[-1].stop) + 6 * (len(cameras) - 1)


def _solve(views: Sequence[View], target: Target, state: State, cameras_fixed: bool = False) -> Solution:
    """Levenberg-Marquardt; the spread that Huber's weights go by is fixed in each of three runs."""
    for _ in range(3):
        blocks = [_block(state, view, k, target) for k, view in enumerate(views)]
        limit = _HUBER * spread(np.concatenate([r for r, _ in blocks]))
        state = _descend(views, target, state, limit, cameras_fixed)
    return _solution(views, target, state, limit)


def _descend(views: Sequence[View], target: Target, state: State, limit: float, fixed: bool) -> State:
    damping, blocks = 1e-4, [_block(state, view, k, target) for k, view in enumerate(views)]
    cost = _cost(blocks, limit)
    for _ in range(_ROUNDS):
        trial = _moved(state, *_step(blocks, limit, damping, fixed))
        after = [_block(trial, v, k, target) for k, v in enumerate(views)] if trial else blocks
        fallen = cost - _cost(after, limit) if trial else -1.0
        if trial is None or not fallen > 0:
            damping *= 8
            if damping > 1e8:
                break
            continue
        state, blocks, cost, damping = trial, after, cost - fallen, damping / 5
        if fallen < _STILL * cost:
            break
    return state


def _cost(blocks: list[tuple[F64, F64]], limit: float) -> float:
    d = np.linalg.norm(np.concatenate([r for r, _ in blocks]), axis=1)
    if np.isnan(d).any():  # a corner behind the camera
        return np.inf
    return float(np.where(d <= limit, d * d / 2, limit * (d - limit / 2)).sum())


def _normal(block: tuple[F64, F64], limit: float) -> tuple[F64, F64]:
    """H (S + 6, S + 6) and g (S + 6,) of one view, weighted by Huber."""
    r, J = block
    root = np.sqrt(np.minimum(1, limit / np.maximum(np.linalg.norm(r, axis=1), 1e-12)))[:, None]
    A, b = (J * root[..., None]).reshape(-1, J.shape[2]), (r * root).reshape(-1)
    return A.T @ A, A.T @ b


def _step(blocks: list[tuple[F64, F64]], limit: float, damping: float, fixed: bool) -> tuple[F64, F64]:
    """Of the shared parameters (S,) and of the poses (V, 6)."""
    H, g = _normals(blocks, limit)
    S = H.shape[1] - 6
    told, back = _eliminated(H, g, damping)
    if fixed:
        return np.zeros(S), back[..., -1]
    whole = told.sum(axis=0)
    held = damping * np.diag(np.diag(H[:, :S, :S].sum(axis=0)))
    shared = np.linalg.solve(whole[:, :S] + held, whole[:, S])
    return shared, back[..., -1] - back[..., :S] @ shared


def _normals(blocks: list[tuple[F64, F64]], limit: float) -> tuple[F64, F64]:
    """`_normal` of each view: H (V, S + 6, S + 6) and g (V, S + 6)."""
    H, g = zip(*(_normal(block, limit) for block in blocks), strict=True)
    return np.stack(H), np.stack(g)


def _eliminated(H: F64, g: F64, damping: float) -> tuple[F64, F64]:
    """What each view tells of the shared parameters, its pose left free: H and g beside it, (V, S, S + 1);
    and by how much its pose follows them, with where it goes by itself, (V, 6, S + 1)."""
    S = H.shape[1] - 6
    Hpp = H[:, S:, S:] * (1 + damping * np.eye(6))
    back = np.linalg.solve(Hpp, np.concatenate([H[:, S:, :S], g[:, S:, None]], axis=2))
    return np.concatenate([H[:, :S, :S], g[:, :S, None]], axis=2) - H[:, :S, S:] @ back, back


def _moved(state: State, shared: F64, poses: F64) -> State | None:
    """None where a step leads to no camera."""
    try:
        cameras = tuple(
            camera_of(intrinsics(camera) + shared[part], camera)
            for camera, part in zip(state.cameras, state.parts, strict=True)
        )
    except ValueError:
        return None
    mount = state.T_cam1_cam0 @ se3.exp(shared[-6:]) if len(cameras) == 2 else state.T_cam1_cam0
    return State(cameras, mount, state.T_cam0_target @ se3.exp(poses))


def _solution(views: Sequence[View], target: Target, state: State, limit: float) -> Solution:
    blocks = [_block(state, view, k, target) for k, view in enumerate(views)]
    told, _ = _eliminated(*_normals(blocks, limit), damping=0.0)
    sigma_px = spread(np.concatenate([r for r, _ in blocks]))
    H, g = told[..., :-1], told[..., -1]
    independent = sigma_px**2 * np.linalg.inv(H.sum(axis=0))
    return Solution(state, independent, jackknife(H, g), errors(state, views, target), sigma_px)
