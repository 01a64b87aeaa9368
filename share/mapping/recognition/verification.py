"""Verification of a candidate: the relative pose of two views, or the reason why there is none.

Descriptors have to match, some of them closely; either view's 3D points have to give a pose in the other's
image (PnP), both poses have to agree, and the result must not contradict gravity. A refusal says which check
failed and by how much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.absolute_pose import RansacOptions, absolute_pose
from share.geometry.camera import rays
from share.mapping.recognition.depth_scale import DepthScale, relative_depth_scale
from share.mapping.recognition.refinement import KeypointNoise, refine_relative_pose, transfer_keypoints
from share.mapping.recognition.relative_tilt import RelativeTilt
from share.types import F64, View
from share.vision.matching import DescriptorPairs, close_pairs, hamming_matrix, mutual_best, pairs_within

_MIN_DEPTH_M, _MAX_DEPTH_M = 0.05, 1000.0  # other depths count as unknown


CLOSE_BITS = 40  # largest Hamming distance of a close match
MIN_CLOSE_MATCHES = 12  # all verified pairs had more, every second other candidate fewer
MAX_BITS = 64  # largest Hamming distance of a match, of 256
MIN_MATCHES = 20  # mutual nearest neighbours required before geometry is tried
RANSAC_PX = 6.0  # reprojection error of a RANSAC inlier
_RANSAC_ITERATIONS = 300  # at most, best matches first
_REVERSE_ITERATIONS = 900  # the same, of the reverse direction, in random order
_MIN_CONSENSUS = 8  # RANSAC inliers: 3-D points of one view in the other's image
GUIDED_BITS = 80  # largest Hamming distance of a match found near its predicted position
GUIDED_PX = 15.0  # largest distance from the predicted position of such a match
_AGREE_DEPTH_RATIO = 0.05  # poses are equal if positions differ by less than this times the depth
_AGREE_DEG = 2.5  # and their rotations by less than this
_COMPETING_SHARE = 0.5  # another pose with more than this share of the inliers: refused
SIGMA_PX = 1.5  # standard deviation of a keypoint
SIGMA_INVERSE_DEPTH = 0.01  # 1/m, of a keypoint's depth: disparity noise / (focal * baseline)
INLIER_CHI2 = 11.3  # squared Mahalanobis distance of an inlier (99 %, 3 degrees of freedom)
MIN_INLIERS = 20  # matches that agree with the relative pose; fewer: refused
MIN_DIRECTION_INLIERS = 10  # of these, with the query's depths and with the candidate's
MAX_SIGMA_DEG = 0.5  # a pose with a larger standard deviation is refused
MIN_SPREAD = 0.05  # narrow side (1 sigma) of the inliers, normalised coordinates
GRAVITY_DEG = 6.0  # largest difference of the two gravity directions, where both are known
# Added to the covariance: errors that many inliers do not average out (calibration, depth bias, rolling
# shutter).
_FLOOR_DEG = 0.1
_FLOOR_M = 0.005
MIN_RANSAC_ITERATIONS = 50  # per direction: a wrong place costs more than a millisecond
RANSAC_CONFIDENCE = 0.99  # per direction; the two seldom fail alike


@dataclass(frozen=True, eq=False)
class CameraView:
    """A view with its camera.

    focal of cam0 [px]; T_body_cam0 (4, 4); up (3,): against gravity in the body frame, zeros if unknown;
    up_sigma: of both its angles, rad.
    """

    view: View
    focal: float
    T_body_cam0: F64
    up: F64
    up_sigma: float = 0.0

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
    relative to the candidate's; None where too few points have both. is_confirmed: False where the images
    were compared and their patches do not align by this pose.
    """

    T_c_q: F64
    cov: F64
    matches: int
    inliers: int
    depth_scale: DepthScale | None = None
    is_confirmed: bool = True

    @property
    def reason(self) -> str:
        return f"{self.inliers} inliers of {self.matches} matches"


@dataclass(frozen=True)
class Refusal:
    """Why there is no pose, e.g. "17 inliers of 25 needed".

    possible_poses: T_c_q (4, 4) as in `Verification` that enough features fit, but do not determine."""

    reason: str
    possible_poses: tuple[F64, ...] = field(default=(), compare=False)


class _RefusedError(Exception):
    """A failed check; the text is the reason. unsure: fits that enough features support."""

    def __init__(self, reason: str, unsure: Sequence[_PoseFit] = ()) -> None:
        super().__init__(reason)
        self.unsure = [fit for fit in unsure if fit.inliers >= MIN_INLIERS]


def verify(query: CameraView, candidate: CameraView, seed: int = 0) -> Verification | Refusal:
    """Return the pose of the query's body in the candidate's body frame, or why there is none.

    Deterministic for a given seed. Does not raise for any two valid views.
    """
    try:
        return _verify_or_raise(query, candidate, seed)
    except _RefusedError as failed:
        T_body_cam_q, T_body_cam_c = query.T_body_cam0, candidate.T_body_cam0
        unsure = [T_body_cam_c @ fit.T @ se3.inverse(T_body_cam_q) for fit in failed.unsure]
        return Refusal(str(failed), tuple(unsure))
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


def _verify_or_raise(query: CameraView, candidate: CameraView, seed: int) -> Verification:
    close = close_pairs(query.view.descriptors, candidate.view.descriptors, CLOSE_BITS)
    _require_count(len(mutual_best(close).rows), MIN_CLOSE_MATCHES, "close matches")
    y_q, y_c = query.keypoints, candidate.keypoints
    candidate_pairs = pairs_within(
        hamming_matrix(query.view.descriptors, candidate.view.descriptors), GUIDED_BITS
    )
    pairs = mutual_best(candidate_pairs.keep(candidate_pairs.bits <= MAX_BITS))
    _require_count(len(pairs.rows), MIN_MATCHES, "matches")
    initial_poses = _two_way_poses(y_q[pairs.rows], y_c[pairs.cols], query.focal, candidate.focal, seed)
    noises = _keypoint_noise(query), _keypoint_noise(candidate)
    has_gravity = bool(query.up.any() and candidate.up.any())
    if not has_gravity and len(initial_poses) > 1:
        raise _RefusedError("the two directions give different poses, and gravity is unknown")
    tilt = RelativeTilt.between(query, candidate)
    fit = _best_fit(_refine_relative_poses(initial_poses, candidate_pairs, y_q, y_c, noises, tilt))
    _require_count(fit.inliers, MIN_INLIERS, "inliers")
    for y, side in ((fit.inliers_q, "query"), (fit.inliers_c, "candidate")):
        known = int(np.isfinite(y[:, 2]).sum())
        _require_count(known, MIN_DIRECTION_INLIERS, f"inliers with the {side}'s depth")
        _check_spread(y, side)
    _check_uncertainty(fit)
    T, cov = _between_bodies(fit.T, fit.cov, query.T_body_cam0, candidate.T_body_cam0)
    _require_upright(T, query, candidate)
    cov = cov + np.diag([np.radians(_FLOOR_DEG) ** 2] * 3 + [_FLOOR_M**2] * 3)
    depth_scale = _depth_scale(fit, noises, candidate.T_body_cam0)
    return Verification(T, cov, fit.matches, fit.inliers, depth_scale)


def _depth_scale(
    fit: _PoseFit, noises: tuple[KeypointNoise, KeypointNoise], T_body_cam_c: F64
) -> DepthScale | None:
    """Depth scale, or None where the matches do not determine it."""
    try:
        depth_scale = relative_depth_scale(fit.T, *fit.guided_matches, *noises, INLIER_CHI2)
    except np.linalg.LinAlgError:
        return None
    if depth_scale is None or depth_scale.pose_sensitivity is None:
        return depth_scale
    return depth_scale._replace(pose_sensitivity=se3.adjoint(T_body_cam_c) @ depth_scale.pose_sensitivity)


def _keypoint_noise(camera_view: CameraView) -> KeypointNoise:
    return KeypointNoise(SIGMA_PX / camera_view.focal, SIGMA_INVERSE_DEPTH)


def _refine_relative_poses(
    initial_poses: list[F64],
    candidate_pairs: DescriptorPairs,
    y_q: F64,
    y_c: F64,
    noises: tuple[KeypointNoise, KeypointNoise],
    tilt: RelativeTilt,
) -> list[_PoseFit]:
    """Refine the initial poses, except those with too few matches to compete."""
    radius = noises[0].uv / SIGMA_PX * GUIDED_PX
    matched = [
        (mutual_best(guided_pairs(candidate_pairs, initial_pose, y_q, y_c, radius)), initial_pose)
        for initial_pose in initial_poses
    ]
    matched.sort(key=lambda found: -len(found[0].rows))
    _require_count(len(matched[0][0].rows), MIN_INLIERS, "matches near the projected points")
    fits: list[_PoseFit] = []
    for pairs, initial_pose in matched:
        if not fits or len(pairs.rows) > _COMPETING_SHARE * max(fit.inliers for fit in fits):
            fits.append(_refine_matches(initial_pose, y_q[pairs.rows], y_c[pairs.cols], noises, tilt))
    return fits


def _refine_matches(
    initial_pose: F64,
    y_q: F64,
    y_c: F64,
    noises: tuple[KeypointNoise, KeypointNoise],
    tilt: RelativeTilt,
) -> _PoseFit:
    """Refine the pose by matched keypoints, and select the inliers."""
    refined = refine_relative_pose(initial_pose, y_q, y_c, *noises, INLIER_CHI2, tilt)
    is_inlier = refined.d2 < INLIER_CHI2
    return _PoseFit(refined.T, refined.cov, (y_q, y_c), y_q[is_inlier], y_c[is_inlier])


def _best_fit(fits: list[_PoseFit]) -> _PoseFit:
    """Return the fit with most inliers. Raises if a different pose has nearly as many."""
    best, *others = sorted(fits, key=lambda fit: -fit.inliers)
    for other in others:
        if other.inliers > _COMPETING_SHARE * best.inliers and _poses_differ(
            best.T, other.T, _median_depth(best.inliers_q, best.inliers_c)
        ):
            raise _RefusedError(f"two poses fit: {best.inliers} and {other.inliers} inliers", [best, other])
    return best


def _require_count(count: int, needed: int, what: str) -> None:
    if count < needed:
        raise _RefusedError(f"{count} {what} of {needed} needed")


def _two_way_poses(y_q: F64, y_c: F64, focal_q: float, focal_c: float, seed: int) -> list[F64]:
    """T_c_q by the query's points in the candidate's image and by the reverse; one pose if both agree.

    For a flat scene two poses look nearly alike (Schweighofer and Pinz, PAMI 2006). The two directions seldom
    choose the same wrong one if only one of them uses the order of the matches.
    """
    forward = _absolute_pose(y_q, y_c, focal_c, "query's", seed, _RANSAC_ITERATIONS, True)
    backward = _absolute_pose(y_c, y_q, focal_q, "candidate's", seed, _REVERSE_ITERATIONS, False)
    backward = se3.inverse(backward)
    depth = _median_depth(y_q, y_c)
    return [forward, backward] if _poses_differ(forward, backward, depth) else [forward]


def _median_depth(y_q: F64, y_c: F64) -> float:
    rho = np.concatenate([y_q[:, 2], y_c[:, 2]])
    rho = rho[np.isfinite(rho)]
    return float(1 / np.partition(rho, len(rho) // 2)[len(rho) // 2])  # a quarter of np.nanmedian's time


def _poses_differ(a: F64, b: F64, depth: float) -> bool:
    difference = se3.inverse(a) @ b
    metres = float(np.linalg.norm(difference[:3, 3]))
    degrees = float(np.degrees(se3.rotation_angle(difference)))
    return metres > _AGREE_DEPTH_RATIO * depth or degrees > _AGREE_DEG


def _absolute_pose(
    source: F64,
    target: F64,
    focal: float,
    side: str,
    seed: int,
    iterations: int,
    best_first: bool,
) -> F64:
    """T_target_source from 3D points of the source and their projections in the target."""
    known = np.isfinite(source[:, 2])
    _require_count(int(known.sum()), _MIN_CONSENSUS, f"matches with the {side} depth")
    y = source[known]
    points, observed = rays(y[:, :2]) / y[:, 2:], target[known, :2]
    options = RansacOptions(RANSAC_PX, seed, MIN_RANSAC_ITERATIONS, iterations, best_first, RANSAC_CONFIDENCE)
    T, inliers = absolute_pose(points, observed, focal, options)
    _require_count(int(inliers.sum()), _MIN_CONSENSUS, f"inliers of the {side} points")
    if not np.isfinite(T).all():
        raise _RefusedError(f"no pose from the {side} points")
    return T


def _check_spread(y: F64, side: str) -> None:
    """Refuse inliers in one corner or on one line: they do not determine a pose."""
    centred = y[:, :2] - y[:, :2].mean(0)
    narrow_sigma = float(np.linalg.svd(centred, compute_uv=False)[-1] / np.sqrt(len(y) - 1))
    if narrow_sigma < MIN_SPREAD:
        raise _RefusedError(
            f"inliers crowd in the {side} image: spread {narrow_sigma:.3f} of {MIN_SPREAD} needed"
        )


def _check_uncertainty(fit: _PoseFit) -> None:
    """Refuse an uncertain pose; most wrong poses that pass the other checks fail here."""
    degrees = float(np.degrees(se3.rotation_sigma(fit.cov)))
    if degrees > MAX_SIGMA_DEG:
        raise _RefusedError(f"pose uncertain by {degrees:.2f}°, {MAX_SIGMA_DEG:.2f}° allowed", [fit])


def _require_upright(T_c_q: F64, query: CameraView, candidate: CameraView) -> None:
    """Refuse a pose of the bodies that contradicts gravity, where both directions are known."""
    degrees = gravity_difference_deg(T_c_q, query, candidate)
    if degrees > GRAVITY_DEG:
        raise _RefusedError(f"gravity differs by {degrees:.1f}°, {GRAVITY_DEG:.1f}° allowed")


def gravity_difference_deg(T_c_q: F64, query: CameraView, candidate: CameraView) -> float:
    """Return the angle between the two gravity directions if the bodies stand so; 0 where one is unknown."""
    lengths = float(np.linalg.norm(query.up) * np.linalg.norm(candidate.up))
    if lengths == 0:
        return 0.0
    cosine = float((T_c_q[:3, :3] @ query.up) @ candidate.up) / lengths
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _between_bodies(T_c_q: F64, cov: F64, T_body_cam_q: F64, T_body_cam_c: F64) -> tuple[F64, F64]:
    """From cameras to bodies: X_c T Exp(xi) X_q^-1 = (X_c T X_q^-1) Exp(Ad(X_q) xi)."""
    Ad = se3.adjoint(T_body_cam_q)
    return T_body_cam_c @ T_c_q @ se3.inverse(T_body_cam_q), Ad @ cov @ Ad.T


# Guided matching: without a prediction a descriptor must be very similar to count as a match; near the
# position that an initial pose predicts much less similarity is enough. Source: Hartley and Zisserman (2004),
# section 4.7.1 and algorithm 11.4.


def guided_pairs(pairs: DescriptorPairs, T_c_q: F64, y_q: F64, y_c: F64, radius: float) -> DescriptorPairs:
    """Keep the pairs within `radius` (normalised coordinates) of where T_c_q (4, 4) projects them.

    y_q (N, 3), y_c (K, 3): keypoints with inverse depth, NaN if unknown. Each keypoint with a depth is
    projected; pairs without any depth are dropped.
    """
    query_in_candidate, candidate_in_query = _transfer(T_c_q, y_q), _transfer(se3.inverse(T_c_q), y_c)
    for axis in (0, 1):  # one coordinate after the other: each leaves few pairs for the next
        pairs = pairs.keep(_is_near(query_in_candidate[axis][pairs.rows], y_c[:, axis][pairs.cols], radius))
        pairs = pairs.keep(_is_near(candidate_in_query[axis][pairs.cols], y_q[:, axis][pairs.rows], radius))
    return pairs.keep(np.isfinite(y_q[pairs.rows, 2]) | np.isfinite(y_c[pairs.cols, 2]))


def _transfer(T: F64, y: F64) -> F64:
    """Projected keypoints (3, N): NaN where the depth is unknown, infinite behind the camera."""
    out = transfer_keypoints(T, y.T)
    out[:, np.isnan(out[2]) & np.isfinite(y[:, 2])] = np.inf
    return out


def _is_near(a: F64, b: F64, radius: float) -> NDArray[np.bool_]:
    """Mask of values within `radius`; unknown ones (NaN) pass."""
    return np.asarray(~(np.abs(a - b) > radius))
