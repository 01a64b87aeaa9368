"""The agent's own small map: keyframes it has been at, and the points it first saw from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.config import TrackerConfig
from share.geometry import se3
from share.geometry.absolute_pose import Terms, absolute_pose
from share.geometry.camera import Camera, Rig
from share.types import F32, F64, I64, U8, Frame, View
from share.vision.mask import EVEN_DEG, within
from share.vision.matching import match
from share.vision.orb import orb

# ---- Pose of a camera from points whose place is known: consensus, then weighted least squares.


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """T_cam_world (4, 4), its covariance (6, 6) perturbed on the right, and the inliers (N,) bool."""

    T: F64
    cov: F64
    inliers: NDArray[np.bool_]


def consensus(points: F64, uv: F64, focal: float, threshold_px: float, seed: int) -> PoseEstimate | None:
    """`absolute_pose` of points (N, 3) m, world, seen at uv (N, 2); None without a model."""
    if len(points) < 4:
        return None
    T, inliers = absolute_pose(points, uv, focal, Terms(threshold_px, seed))
    return PoseEstimate(T, np.eye(6), inliers) if inliers.sum() >= 4 else None


def refine(
    T: F64, points: F64, uv: F64, focal: float, sigma_px: F64, gate_px: float, iterations: int = 8
) -> PoseEstimate:
    """Gauss-Newton on reprojection errors with Cauchy weights, from T_cam_world.

    sigma_px (N,): standard deviation of each observation. Points that end further than `gate_px`
    sigmas away are no inliers. The covariance is scaled by the inliers' own residuals, never
    below what `sigma_px` promises.
    """
    scale = focal / sigma_px
    for _ in range(iterations):
        r, J = reprojection(T, points, uv, scale)
        w = 1 / (1 + (r * r).sum(axis=1) / 4.0)  # Cauchy, 2 sigma
        H, g = _normal_equations(r, J, w)
        step: F64 = np.asarray(-np.linalg.solve(H, g), np.float64)
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-6:
            break
    r, J = reprojection(T, points, uv, scale)
    squared = (r * r).sum(axis=1)
    inliers = squared < gate_px**2
    H, _ = _normal_equations(r, J, inliers.astype(np.float64))
    excess = squared[inliers].mean() / 2 if inliers.any() else 1.0
    return PoseEstimate(T, np.linalg.inv(H) * max(1.0, excess), inliers)


def _normal_equations(r: F64, J: F64, w: F64) -> tuple[F64, F64]:
    """sum w J'J (6, 6), never quite singular, and sum w J'r (6,)."""
    flat = J.reshape(-1, 6)
    weighted = flat * np.repeat(w, 2)[:, None]
    return weighted.T @ flat + 1e-9 * np.eye(6), weighted.T @ r.ravel()


def reprojection(T: F64, points: F64, uv: F64, scale: F64) -> tuple[F64, F64]:
    """Residuals (N, 2) = scale (projection - uv), and d/d(xi) (N, 2, 6) for T Exp(xi).

    With p_c = R p + t, T Exp(xi) moves it by R (rho - p x phi). So a row d of D R, where D is the
    derivative of the projection, becomes [p x d | d].
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


@dataclass(frozen=True, eq=False)
class LocalKeyframe:
    """An image the local map holds on to: its patches are what a point looks like.

    view: its ORB features, for relocalisation; None until they are made.
    """

    image: U8
    T_odom_cam: F64
    view: View | None = None


class LocalMap:
    """Points in odom, each hosted by the keyframe that saw it first. Memory is bounded.

    Points have stable ids; a point is gone when its host is dropped.
    """

    def __init__(self, max_keyframes: int) -> None:
        self._max_keyframes = max_keyframes
        self.keyframes: dict[int, LocalKeyframe] = {}
        self._next_keyframe = 0
        self._next_id = 0
        self.ids: I64 = np.zeros(0, np.int64)  # ascending
        self.points: F64 = np.zeros((0, 3))
        self.hosts: I64 = np.zeros(0, np.int64)
        self.host_px: F32 = np.zeros((0, 2), np.float32)

    def add_keyframe(self, image: U8, T_odom_cam: F64) -> int:
        """Its number. Where the map is full, the keyframe nearest to another one makes room."""
        if len(self.keyframes) >= self._max_keyframes:
            self._drop(self._most_redundant())
        number = self._next_keyframe
        self._next_keyframe += 1
        self.keyframes[number] = LocalKeyframe(image, T_odom_cam)
        return number

    def set_view(self, view: View) -> None:
        """The features of the newest keyframe."""
        newest = self._next_keyframe - 1
        self.keyframes[newest] = replace(self.keyframes[newest], view=view)

    def add_points(self, host: int, points: F64, px: F32) -> I64:
        """Ids (N,) of new points (N, 3) m in odom, seen at px (N, 2) in keyframe `host`."""
        ids = np.arange(self._next_id, self._next_id + len(points))
        self._next_id += len(points)
        self.ids = np.concatenate([self.ids, ids])
        self.points = np.concatenate([self.points, points])
        self.hosts = np.concatenate([self.hosts, np.full(len(points), host)])
        self.host_px = np.concatenate([self.host_px, px.astype(np.float32)])
        return ids

    def rows(self, ids: I64) -> I64:
        """Row of each point, -1 where it is gone."""
        row = np.searchsorted(self.ids, ids)
        row = np.minimum(row, max(len(self.ids) - 1, 0))
        known = self.ids[row] == ids if len(self.ids) else np.zeros(len(ids), bool)
        return np.where(known, row, -1)

    def visible(
        self, T_cam_odom: F64, camera: Camera, hosts: list[int], border: float = 12.0
    ) -> tuple[I64, F32]:
        """Rows and predicted px of the points of `hosts` that the camera should see."""
        rows = np.flatnonzero(np.isin(self.hosts, hosts))
        px = camera.project(se3.transform(T_cam_odom, self.points[rows]))
        inside = camera.inside(np.nan_to_num(px, nan=-1e6), border)
        return rows[inside], px[inside].astype(np.float32)

    def hosts_near(self, T_odom_cam: F64, max_m: float, max_rad: float) -> list[int]:
        """Keyframes seen from about here, nearest first; one metre weighs as much as one radian."""
        numbers = np.array(sorted(self.keyframes), np.int64)
        if len(numbers) == 0:
            return []
        (distance,), (angle,) = se3.apart(T_odom_cam[None], self._poses(numbers))
        near = (distance < max_m) & (angle < max_rad)
        cost = distance + angle
        return [int(n) for n in numbers[near][np.argsort(cost[near], kind="stable")]]

    def _poses(self, numbers: I64) -> F64:
        return np.stack([self.keyframes[int(n)].T_odom_cam for n in numbers])

    def _most_redundant(self) -> int:
        """The older keyframe of the closest pair."""
        numbers = np.array(sorted(self.keyframes), np.int64)
        poses = self._poses(numbers)
        distance, angle = se3.apart(poses[:-1], poses)  # the newest is never dropped
        cost = distance + angle
        cost[np.tril_indices_from(cost)] = np.inf
        return int(numbers[np.argmin(cost.min(axis=1))])

    def _drop(self, number: int) -> None:
        del self.keyframes[number]
        keep: NDArray[np.bool_] = self.hosts != number
        self.ids, self.points = self.ids[keep], self.points[keep]
        self.hosts, self.host_px = self.hosts[keep], self.host_px[keep]


# ---- Finding oneself again among keyframes one has been at.

MAX_HAMMING = 64  # of 256 bits
RATIO = 0.8  # the best match must be so much nearer than the second (Lowe 2004)


class Turns:
    """Some of the keyframes at a frame, others at the next: looking at all of them would make a live
    camera's frames late. count: at a time."""

    def __init__(self, count: int) -> None:
        self._count, self._tried = count, 0

    def begin(self) -> None:
        """Lost anew."""
        self._tried = 0

    def next(self, numbers: Sequence[int]) -> Sequence[int]:
        """Of `numbers`, the likeliest first, those whose turn it is."""
        first = self._tried % max(len(numbers), 1)
        self._tried += self._count
        return numbers[first : first + self._count]


def find(
    keyframes: Sequence[LocalKeyframe], frame: Frame, rig: Rig, config: TrackerConfig, seed: int
) -> F64 | None:
    """T_odom_cam (4, 4) of the frame by its ORB features, from the keyframe that most of them agree with.

    Twice as many inliers are asked for as tracking needs: nothing else vouches for the answer.
    """
    px, descriptors = orb(frame.image0, config.view_features, within=within(rig.cam0, EVEN_DEG))
    uv = rig.cam0.normalise(px.astype(np.float64))
    found = (_against(keyframe, uv, descriptors, rig.cam0.focal, config, seed) for keyframe in keyframes)
    best = max((f for f in found if f is not None), key=lambda f: f.inliers.sum(), default=None)
    if best is None or best.inliers.sum() < 2 * config.min_inliers:
        return None
    return se3.inverse(best.T)


def _against(
    keyframe: LocalKeyframe, uv: F64, descriptors: U8, focal: float, config: TrackerConfig, seed: int
) -> PoseEstimate | None:
    if keyframe.view is None:
        return None
    known = np.flatnonzero(~np.isnan(keyframe.view.points[:, 0]))
    pairs = match(descriptors, keyframe.view.descriptors[known], MAX_HAMMING, RATIO)
    points = keyframe.view.points[known[pairs[:, 1]]].astype(np.float64)
    points, seen = se3.transform(keyframe.T_odom_cam, points), uv[pairs[:, 0]]
    first = consensus(points, seen, focal, config.ransac_px, seed)
    if first is None:
        return None
    return refine(first.T, points, seen, focal, np.full(len(points), config.noise_px), config.gate_sigma)
