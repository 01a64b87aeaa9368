"""Verification of a candidate: the relative pose of two views, or the reason why there is none.

Descriptors have to match, either view's 3D points have to give a pose in the other's image (PnP), both poses
have to agree, and the result must not contradict gravity. A refusal says which check failed and by how much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.config import PlaceConfig
from share.geometry import se3
from share.geometry.absolute_pose import RansacOptions, absolute_pose
from share.geometry.camera import rays
from share.mapping.recognition.depth_scale import DepthScale, relative_depth_scale
from share.mapping.recognition.guided import guided_pairs
from share.mapping.recognition.refinement import KeypointNoise, refine_pose
from share.types import F64, View
from share.vision.matching import DescriptorPairs, hamming_matrix, mutual_best, pairs_within

_MIN_DEPTH_M, _MAX_DEPTH_M = 0.05, 1000.0  # other depths count as unknown


MIN_RANSAC_ITERATIONS = 50  # per direction: a wrong place costs more than a millisecond
RANSAC_CONFIDENCE = 0.99  # per direction; the two seldom fail alike


@dataclass(frozen=True, eq=False)
class CameraView:
    """A view with its camera.

    focal of cam0 [px]; T_body_cam0 (4, 4); up (3,): against gravity in the body frame, zeros if unknown.
    """

    view: View
    focal: float
    T_body_cam0: F64
    up: F64

    @property
    def keypoints(self) -> F64:
        """Keypoints (N, 3): u, v and inverse depth [1/m], NaN where depth is unknown or out of range."""
        uv, z = self.view.uv.astype(np.float64), self.view.points[:, 2].astype(np.float64)
        z[~((z > _MIN_DEPTH_M) & (z < _MAX_DEPTH_M))] = np.nan
        return np.column_stack([uv, 1 / z])


@dataclass(frozen=True, eq=False)
class Verification:
    """T_c_q (4, 4): body of the query in the body frame of the candidate; cov (6, 6): its covariance.

    matches: descriptor pairs; inliers: those that agree with the pose. depth_scale: of the query's depths
    relative to the candidate's; None where too few points have both.
    """

    T_c_q: F64
    cov: F64
    matches: int
    inliers: int
    depth_scale: DepthScale | None = None

    @property
    def reason(self) -> str:
        return f"{self.inliers} inliers of {self.matches} matches"


@dataclass(frozen=True)
class Refusal:
    """Why there is no pose, e.g. "17 inliers of 25 needed"."""

    reason: str


class _RefusedError(Exception):
    """A failed check; the text is the reason."""


def verify(
    query: CameraView, candidate: CameraView, config: PlaceConfig, seed: int = 0
) -> Verification | Refusal:
    """Return the pose of the query's body in the candidate's body frame, or why there is none.

    Deterministic for a given seed. Does not raise for any two valid views.
    """
    try:
        return _verify_or_raise(query, candidate, config, seed)
    except _RefusedError as failed:
        return Refusal(str(failed))
    except np.linalg.LinAlgError:
        return Refusal("degenerate geometry: the matches do not determine a pose")


@dataclass(frozen=True, eq=False)
class _PoseFit:
    """A refined pose T_c_q of the cameras with its covariance.

    guided_matches: keypoint pairs near the projection, (M, 3) each; inliers_q, inliers_c (N, 3).
    """

    T: F64
    cov: F64
    guided_matches: tuple[F64, F64]
    inliers_q: F64
    inliers_c: F64

    @property
    def matches(self) -> int:
        return len(self.guided_matches[0])

    @property
    def inliers(self) -> int:
        return len(self.inliers_q)


def _verify_or_raise(
    query: CameraView, candidate: CameraView, config: PlaceConfig, seed: int
) -> Verification:
    y_q, y_c = query.keypoints, candidate.keypoints
    candidate_pairs = pairs_within(
        hamming_matrix(query.view.descriptors, candidate.view.descriptors), config.guided_bits
    )
    pairs = mutual_best(candidate_pairs.keep(candidate_pairs.bits <= config.max_distance_bits))
    _require_count(len(pairs.rows), config.min_matches, "matches")
    initial_poses = _two_way_poses(
        y_q[pairs.rows], y_c[pairs.cols], query.focal, candidate.focal, config, seed
    )
    noises = _keypoint_noise(query, config), _keypoint_noise(candidate, config)
    has_gravity = bool(query.up.any() and candidate.up.any())
    if not has_gravity and len(initial_poses) > 1:
        raise _RefusedError("the two directions give different poses, and gravity is unknown")
    fit = _best_fit(_refine_poses(initial_poses, candidate_pairs, y_q, y_c, noises, config), config)
    _require_count(fit.inliers, config.min_inliers, "inliers")
    for y, side in ((fit.inliers_q, "query"), (fit.inliers_c, "candidate")):
        known = int(np.isfinite(y[:, 2]).sum())
        _require_count(known, config.min_direction_inliers, f"inliers with the {side}'s depth")
        _check_spread(y, side, config)
    _check_uncertainty(fit.cov, config.max_sigma_deg)
    if has_gravity:
        _check_gravity(fit.T, query, candidate, config)
    T, cov = _between_bodies(fit.T, fit.cov, query.T_body_cam0, candidate.T_body_cam0)
    depth_scale = _depth_scale(fit, noises, config, candidate.T_body_cam0)
    return Verification(T, cov + _covariance_floor(config), fit.matches, fit.inliers, depth_scale)


def _depth_scale(
    fit: _PoseFit, noises: tuple[KeypointNoise, KeypointNoise], config: PlaceConfig, T_body_cam_c: F64
) -> DepthScale | None:
    """Depth scale, or None where the matches do not determine it."""
    try:
        depth_scale = relative_depth_scale(fit.T, *fit.guided_matches, *noises, config.inlier_chi2)
    except np.linalg.LinAlgError:
        return None
    if depth_scale is None or depth_scale.pose_sensitivity is None:
        return depth_scale
    return depth_scale._replace(pose_sensitivity=se3.adjoint(T_body_cam_c) @ depth_scale.pose_sensitivity)


def _keypoint_noise(camera_view: CameraView, config: PlaceConfig) -> KeypointNoise:
    return KeypointNoise(config.sigma_px / camera_view.focal, config.sigma_inverse_depth)


def _refine_poses(
    initial_poses: list[F64],
    candidate_pairs: DescriptorPairs,
    y_q: F64,
    y_c: F64,
    noises: tuple[KeypointNoise, KeypointNoise],
    config: PlaceConfig,
) -> list[_PoseFit]:
    """Refine the initial poses, except those with too few matches to compete."""
    radius = noises[0].uv / config.sigma_px * config.guided_px
    matched = [
        (mutual_best(guided_pairs(candidate_pairs, initial_pose, y_q, y_c, radius)), initial_pose)
        for initial_pose in initial_poses
    ]
    matched.sort(key=lambda found: -len(found[0].rows))
    _require_count(len(matched[0][0].rows), config.min_inliers, "matches near the projected points")
    fits: list[_PoseFit] = []
    for pairs, initial_pose in matched:
        if not fits or len(pairs.rows) > config.rival_share * max(fit.inliers for fit in fits):
            fits.append(_refine_matches(initial_pose, y_q[pairs.rows], y_c[pairs.cols], noises, config))
    return fits


def _refine_matches(
    initial_pose: F64, y_q: F64, y_c: F64, noises: tuple[KeypointNoise, KeypointNoise], config: PlaceConfig
) -> _PoseFit:
    """Refine the pose by matched keypoints, and select the inliers."""
    refined = refine_pose(initial_pose, y_q, y_c, *noises, config.inlier_chi2)
    is_inlier = refined.d2 < config.inlier_chi2
    return _PoseFit(refined.T, refined.cov, (y_q, y_c), y_q[is_inlier], y_c[is_inlier])


def _best_fit(fits: list[_PoseFit], config: PlaceConfig) -> _PoseFit:
    """Return the fit with most inliers. Raises if a different pose has nearly as many."""
    best, *others = sorted(fits, key=lambda fit: -fit.inliers)
    for other in others:
        if other.inliers > config.rival_share * best.inliers and _poses_differ(
            best.T, other.T, _median_depth(best.inliers_q, best.inliers_c), config
        ):
            raise _RefusedError(f"two poses fit: {best.inliers} and {other.inliers} inliers")
    return best


def _require_count(count: int, needed: int, what: str) -> None:
    if count < needed:
        raise _RefusedError(f"{count} {what} of {needed} needed")


def _two_way_poses(
    y_q: F64, y_c: F64, focal_q: float, focal_c: float, config: PlaceConfig, seed: int
) -> list[F64]:
    """T_c_q by the query's points in the candidate's image and by the reverse; one pose if both agree.

    For a flat scene two poses look nearly alike (Schweighofer and Pinz, PAMI 2006). The two directions seldom
    choose the same wrong one if only one of them uses the order of the matches.
    """
    forward = _absolute_pose(y_q, y_c, focal_c, "query's", config, seed, config.ransac_iterations, True)
    iterations = config.reverse_iterations
    backward = _absolute_pose(y_c, y_q, focal_q, "candidate's", config, seed, iterations, False)
    backward = se3.inverse(backward)
    depth = _median_depth(y_q, y_c)
    return [forward, backward] if _poses_differ(forward, backward, depth, config) else [forward]


def _median_depth(y_q: F64, y_c: F64) -> float:
    """Median depth, m."""
    rho = np.concatenate([y_q[:, 2], y_c[:, 2]])
    rho = rho[np.isfinite(rho)]
    return float(1 / np.partition(rho, len(rho) // 2)[len(rho) // 2])  # a quarter of np.nanmedian's time


def _poses_differ(a: F64, b: F64, depth: float, config: PlaceConfig) -> bool:
    difference = se3.inverse(a) @ b
    metres = float(np.linalg.norm(difference[:3, 3]))
    degrees = float(np.degrees(se3.rotation_angle(difference)))
    return metres > config.agree_depth_ratio * depth or degrees > config.agree_deg


def _absolute_pose(
    source: F64,
    target: F64,
    focal: float,
    side: str,
    config: PlaceConfig,
    seed: int,
    iterations: int,
    best_first: bool,
) -> F64:
    """T_target_source from 3D points of the source and their projections in the target."""
    known = np.isfinite(source[:, 2])
    _require_count(int(known.sum()), config.min_consensus, f"matches with the {side} depth")
    y = source[known]
    points, observed = rays(y[:, :2]) / y[:, 2:], target[known, :2]
    options = RansacOptions(
        config.ransac_px, seed, MIN_RANSAC_ITERATIONS, iterations, best_first, RANSAC_CONFIDENCE
    )
    T, inliers = absolute_pose(points, observed, focal, options)
    _require_count(int(inliers.sum()), config.min_consensus, f"inliers of the {side} points")
    if not np.isfinite(T).all():
        raise _RefusedError(f"no pose from the {side} points")
    return T


def _check_spread(y: F64, side: str, config: PlaceConfig) -> None:
    """Refuse inliers in one corner or on one line: they do not determine a pose."""
    centred = y[:, :2] - y[:, :2].mean(0)
    narrow_sigma = float(np.linalg.svd(centred, compute_uv=False)[-1] / np.sqrt(len(y) - 1))
    if narrow_sigma < config.min_spread:
        raise _RefusedError(
            f"inliers crowd in the {side} image: spread {narrow_sigma:.3f} of {config.min_spread} needed"
        )


def _check_uncertainty(cov: F64, max_deg: float) -> None:
    """Refuse an uncertain pose; most wrong poses that pass the other checks fail here."""
    degrees = float(np.degrees(np.sqrt(np.trace(cov[:3, :3]))))
    if degrees > max_deg:
        raise _RefusedError(f"pose uncertain by {degrees:.2f}°, {max_deg:.2f}° allowed")


def _check_gravity(T_c_q: F64, query: CameraView, candidate: CameraView, config: PlaceConfig) -> None:
    up_q, up_c = (view.T_body_cam0[:3, :3].T @ view.up for view in (query, candidate))
    cosine = float((T_c_q[:3, :3] @ up_q) @ up_c / (np.linalg.norm(up_q) * np.linalg.norm(up_c)))
    degrees = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if degrees > config.gravity_deg:
        raise _RefusedError(f"gravity differs by {degrees:.1f}°, {config.gravity_deg:.1f}° allowed")


def _between_bodies(T_c_q: F64, cov: F64, T_body_cam_q: F64, T_body_cam_c: F64) -> tuple[F64, F64]:
    """From cameras to bodies: X_c T Exp(xi) X_q^-1 = (X_c T X_q^-1) Exp(Ad(X_q) xi)."""
    Ad = se3.adjoint(T_body_cam_q)
    return T_body_cam_c @ T_c_q @ se3.inverse(T_body_cam_q), Ad @ cov @ Ad.T


def _covariance_floor(config: PlaceConfig) -> Any:
    """Errors that many inliers do not average out: calibration, depth bias, rolling shutter."""
    return np.diag([np.radians(config.floor_deg) ** 2] * 3 + [config.floor_m**2] * 3)
