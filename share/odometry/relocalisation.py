"""An agent's local map of keyframes and points, and relocalisation in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.absolute_pose import RansacOptions, absolute_pose
from share.geometry.camera import Camera, Rig
from share.types import F32, F64, I64, U8, Frame, KeyframeImage, View
from share.vision.corners import UNIFORM_FIELD_DEG, field_mask
from share.vision.matching import match_descriptors
from share.vision.orb import detect_orb, image_view

# Pose of a camera from known points: RANSAC, then weighted least squares

RANSAC_PX = 3.0  # reprojection error of a RANSAC inlier
NOISE_PX = 1.0  # standard deviation of a point's position in an image
GATE_SIGMA = 3.0  # a measurement further off is an outlier
MIN_INLIERS = 15  # points that agree with a pose; with fewer there is none
_MAX_ITERATIONS = 8  # of a refinement
POSE_COV = np.diag(np.repeat([0.01**2, 0.03**2], 3))  # rad^2, m^2: of a pose by ORB features


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """T_cam_world (4, 4), its covariance (6, 6) perturbed on the right, and the inliers (N,) bool."""

    T: F64
    cov: F64
    inliers: NDArray[np.bool_]


def ransac_pose(
    points: F64, uv: F64, focal: float, threshold_px: float, seed: int = 0
) -> PoseEstimate | None:
    """Return the pose of `absolute_pose` by points (N, 3) m, world, seen at uv (N, 2), with a unit
    covariance; None without a model."""
    if len(points) < 4:
        return None
    T, inliers = absolute_pose(points, uv, focal, RansacOptions(threshold_px, seed))
    return PoseEstimate(T, np.eye(6), inliers) if inliers.sum() >= 4 else None


def refine_absolute_pose(
    T: F64, points: F64, uv: F64, focal: float, sigma_px: F64, gate_px: float
) -> PoseEstimate:
    """Refine T_cam_world by Gauss-Newton on reprojection errors with Cauchy weights.

    sigma_px (N,): standard deviation of each observation. Points beyond `gate_px` sigmas are outliers. The
    covariance is scaled up by the inliers' residuals, never down.
    """
    scale = focal / sigma_px
    for _ in range(_MAX_ITERATIONS):
        r, J = reprojection_residuals(T, points, uv, scale)
        weight = 1 / (1 + (r * r).sum(axis=1) / 4.0)  # Cauchy, 2 sigma
        H, g = _normal_equations(r, J, weight)
        step: F64 = np.asarray(-np.linalg.solve(H, g), np.float64)
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-6:
            break
    r, J = reprojection_residuals(T, points, uv, scale)
    squared = (r * r).sum(axis=1)
    inliers = squared < gate_px**2
    H, _ = _normal_equations(r, J, inliers.astype(np.float64))
    excess = squared[inliers].mean() / 2 if inliers.any() else 1.0
    return PoseEstimate(T, np.linalg.inv(H) * max(1.0, excess), inliers)


def _normal_equations(r: F64, J: F64, w: F64) -> tuple[F64, F64]:
    """Return sum w J'J (6, 6), regularised, and sum w J'r (6,)."""
    flat = J.reshape(-1, 6)
    weighted = flat * np.repeat(w, 2)[:, None]
    return weighted.T @ flat + 1e-9 * np.eye(6), weighted.T @ r.ravel()


def reprojection_residuals(T: F64, points: F64, uv: F64, scale: F64) -> tuple[F64, F64]:
    """Return residuals (N, 2) = scale (projection - uv), and their derivatives (N, 2, 6) by xi of T Exp(xi).

    With p_c = R p + t, T Exp(xi) moves it by R (rho - p x phi). So a row d of D R, where D is the derivative
    of the projection, becomes [p x d | d].
    """
    R = T[:3, :3]
    p = points @ R.T + T[:3, 3]
    iz = 1 / np.where(p[:, 2] > 1e-3, p[:, 2], 1e-3)
    projected = p[:, :2] * iz[:, None]
    d = (R[None, :2] - projected[:, :, None] * R[2]) * (iz * scale)[:, None, None]
    J = np.empty((len(p), 2, 6))
    J[:, :, 3:] = d
    x, y, z = points.T[:, :, None]
    J[:, :, 0] = y * d[:, :, 2] - z * d[:, :, 1]
    J[:, :, 1] = z * d[:, :, 0] - x * d[:, :, 2]
    J[:, :, 2] = x * d[:, :, 1] - y * d[:, :, 0]
    return (projected - uv) * scale[:, None], J


# The local map

_BORDER_PX = 12.0  # of an image, in which no point is expected to be found
MAX_KEYFRAMES = 60  # of the local map; a full one drops the older keyframe of its closest pair


@dataclass(eq=False)
class LocalKeyframe:
    """A keyframe of the local map: its image, in which patches of points are found, its pose T_odom_cam (4,
    4), and the surfaces in it, for relocalisation; None until they are known."""

    image: U8
    T_odom_cam: F64
    surfaces: KeyframeImage | None = None
    _view: View | None = None

    def view(self, camera: Camera) -> View:
        """Return its ORB view; made when first needed, since an agent is seldom LOST."""
        if self._view is None and self.surfaces is not None:
            self._view = image_view(self.image, camera, self.surfaces, VIEW_FEATURES)
        return View.empty() if self._view is None else self._view


class LocalMap:
    """Points in odom, each anchored in the keyframe that saw it first. Memory is bounded.

    Points have stable ids; a point is dropped with its anchor. The tracker with IMU uses only the keyframes.
    """

    def __init__(self) -> None:
        self.keyframes: dict[int, LocalKeyframe] = {}
        self._next_keyframe = 0
        self._next_id = 0
        self.ids: I64 = np.zeros(0, np.int64)  # ascending
        self.points: F64 = np.zeros((0, 3))
        self.anchors: I64 = np.zeros(0, np.int64)
        self.anchor_px: F32 = np.zeros((0, 2), np.float32)

    def add_keyframe(self, image: U8, T_odom_cam: F64) -> int:
        """Add a keyframe and return its number. If the map is full, the most redundant keyframe is
        dropped."""
        if len(self.keyframes) >= MAX_KEYFRAMES:
            self._drop_keyframe(self._most_redundant())
        keyframe_id = self._next_keyframe
        self._next_keyframe += 1
        self.keyframes[keyframe_id] = LocalKeyframe(image, T_odom_cam)
        return keyframe_id

    def set_surfaces(self, surfaces: KeyframeImage) -> None:
        """Set the surfaces in the newest keyframe."""
        self.keyframes[self._next_keyframe - 1].surfaces = surfaces

    def add_points(self, anchor: int, points: F64, px: F32) -> I64:
        """Add points (N, 3) m in odom, seen at px (N, 2) in keyframe `anchor`. Return their ids (N,)."""
        ids = np.arange(self._next_id, self._next_id + len(points))
        self._next_id += len(points)
        self.ids = np.concatenate([self.ids, ids])
        self.points = np.concatenate([self.points, points])
        self.anchors = np.concatenate([self.anchors, np.full(len(points), anchor)])
        self.anchor_px = np.concatenate([self.anchor_px, px.astype(np.float32)])
        return ids

    def turn(self, T_new_old: F64) -> None:
        """Give all in another odom."""
        self.points = self.points @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        for keyframe in self.keyframes.values():
            keyframe.T_odom_cam = T_new_old @ keyframe.T_odom_cam

    def row_indices(self, ids: I64) -> I64:
        """Return the row of each point, -1 where it was dropped."""
        row = np.searchsorted(self.ids, ids)
        row = np.minimum(row, max(len(self.ids) - 1, 0))
        is_known = self.ids[row] == ids if len(self.ids) else np.zeros(len(ids), bool)
        return np.where(is_known, row, -1)

    def visible_points(self, T_cam_odom: F64, camera: Camera, anchors: list[int]) -> tuple[I64, F32]:
        """Return rows and predicted px of the points of `anchors` in the camera's view."""
        rows = np.flatnonzero(np.isin(self.anchors, anchors))
        px = camera.project(se3.transform(T_cam_odom, self.points[rows]))
        inside = camera.is_inside(np.nan_to_num(px, nan=-1e6), _BORDER_PX)
        return rows[inside], px[inside].astype(np.float32)

    def keyframes_near(self, T_odom_cam: F64, max_m: float, max_rad: float) -> list[int]:
        """Return keyframes within `max_m` and `max_rad`, nearest first; one metre counts as one radian."""
        numbers = np.array(sorted(self.keyframes), np.int64)
        if len(numbers) == 0:
            return []
        (distance,), (angle,) = se3.pairwise_distances(T_odom_cam[None], self._poses(numbers))
        near = (distance < max_m) & (angle < max_rad)
        cost = distance + angle
        return [int(n) for n in numbers[near][np.argsort(cost[near], kind="stable")]]

    def _poses(self, numbers: I64) -> F64:
        return np.stack([self.keyframes[int(n)].T_odom_cam for n in numbers])

    def _most_redundant(self) -> int:
        """Return the older keyframe of the closest pair."""
        numbers = np.array(sorted(self.keyframes), np.int64)
        poses = self._poses(numbers)
        distance, angle = se3.pairwise_distances(poses[:-1], poses)  # the newest is never dropped
        cost = distance + angle
        cost[np.tril_indices_from(cost)] = np.inf
        return int(numbers[np.argmin(cost.min(axis=1))])

    def _drop_keyframe(self, number: int) -> None:
        del self.keyframes[number]
        keep: NDArray[np.bool_] = self.anchors != number
        self.ids, self.points = self.ids[keep], self.points[keep]
        self.anchors, self.anchor_px = self.anchors[keep], self.anchor_px[keep]


# Relocalisation in the keyframes of the local map

NEW_SEGMENT_S = 3.0  # LOST for this long: odometry starts a new segment
VIEW_FEATURES = 500  # ORB features of a frame or keyframe
MAX_HAMMING_BITS = 64  # of 256
_BATCH_SIZE = 8  # keyframes that a LOST frame is matched with
MATCH_RATIO = 0.8  # of the best distance to the second best (Lowe 2004)


class RoundRobin:
    """Takes turns among keyframes, `batch_size` a frame: matching all of them would delay a live camera's
    frames."""

    def __init__(self, batch_size: int = _BATCH_SIZE) -> None:
        self._batch_size, self._offset = batch_size, 0

    def reset(self) -> None:
        """Start again from the first."""
        self._offset = 0

    def next_batch(self, numbers: Sequence[int]) -> Sequence[int]:
        """Return the next batch of `numbers`, which are sorted by likelihood."""
        first = self._offset % max(len(numbers), 1)
        self._offset += self._batch_size
        return numbers[first : first + self._batch_size]


def relocalise(keyframes: Sequence[LocalKeyframe], frame: Frame, rig: Rig) -> F64 | None:
    """Return T_odom_cam (4, 4) of the frame by its ORB features and the keyframe with the most inliers; None
    without enough.

    It takes twice as many inliers as tracking, because nothing else confirms the pose.
    """
    px, descriptors = detect_orb(frame.image0, VIEW_FEATURES, mask=field_mask(rig.cam0, UNIFORM_FIELD_DEG))
    uv = rig.cam0.normalise(px.astype(np.float64))
    views = [keyframe.view(rig.cam0) for keyframe in keyframes]
    estimates = [
        _match_view(view, keyframe.T_odom_cam, uv, descriptors, rig.cam0.focal)
        for view, keyframe in zip(views, keyframes, strict=True)
    ]
    best = max(
        (estimate for estimate in estimates if estimate is not None),
        key=lambda f: f.inliers.sum(),
        default=None,
    )
    if best is None or best.inliers.sum() < 2 * MIN_INLIERS:
        return None
    return se3.inverse(best.T)


def _match_view(view: View, T_odom_cam: F64, uv: F64, descriptors: U8, focal: float) -> PoseEstimate | None:
    with_depth = np.flatnonzero(~np.isnan(view.points[:, 0]))
    pairs = match_descriptors(descriptors, view.descriptors[with_depth], MAX_HAMMING_BITS, MATCH_RATIO)
    points = view.points[with_depth[pairs[:, 1]]].astype(np.float64)
    points, matched_uv = se3.transform(T_odom_cam, points), uv[pairs[:, 0]]
    initial = ransac_pose(points, matched_uv, focal, RANSAC_PX)
    if initial is None:
        return None
    return refine_absolute_pose(
        initial.T, points, matched_uv, focal, np.full(len(points), NOISE_PX), GATE_SIGMA
    )
