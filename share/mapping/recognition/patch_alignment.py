"""Loops as exact as odometry: the patches of both keyframes aligned in each other's images.

The pose of a verified candidate rests on descriptors matched to a pixel. Here each feature of one keyframe is
warped into the other's image by that pose and by the plane of its surface, and its patch is aligned there to
a tenth of a pixel; the same the other way. The pose that explains all aligned positions is found by robust
Gauss-Newton. A pose by descriptors is first improved in a small image; that of a map is good enough to begin
with the whole one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera, project, rays
from share.mapping.recognition.depth_scale import DepthScale
from share.mapping.recognition.verification import Refusal, Verification
from share.types import F32, F64, I64, U8, KeyframeImage, View
from share.vision import patches
from share.vision.keyframe_images import decompress
from share.vision.orb import image_view

ORB_FEATURES = 800  # found in a keyframe's image
_COARSE_TO_FINE = (2, 0)  # levels of the pyramid; each has half the size of the one before
_FINE = (0,)
_BORDER_PX = 6.0  # a patch's centre is at least so far inside the other image
_REACH_PX = 5.0  # largest distance from the predicted position, px of the level
_MIN_CORRELATION = 0.8
_CONVERGED_PX = 0.3  # last step of a converged alignment
_MAX_MAGNIFICATION = 3.0  # of a warped patch, or the inverse
_MAX_STEPS = 8
_SIGMA_PX = 0.2  # of an aligned position
_INLIER_CHI2 = 9.2  # 99 %, 2 degrees of freedom
_CAUCHY = 2.0  # Mahalanobis distance at which a measurement has half its weight
_MIN_INLIERS, _MIN_INLIER_SHARE = 25, 0.7  # of the aligned patches
_MIN_FOUND_SHARE = 0.35  # aligned patches, of those in both views, where only the map gave the pose
_ITERATIONS = 6
_CONVERGED_STEP = 3e-4  # rad and m, at full size
_MIN_SHARED_DEPTH, _MAX_SHARED_DEPTH = 1e-3, 1.0  # relative; no baseline is known better
_MIN_RHO = 1e-6  # 1/m
_NOT_VISIBLE = 1e3  # whitened residual of what the pose puts behind the camera
_RIDGE = 1e-6
# Added to the covariance: errors that many patches do not average out (calibration, shutter, the JPEG).
_FLOOR_DEG, _FLOOR_M = 0.02, 0.001
# Surfaces are no planes, which shows from elsewhere: without this factor on the variance 90 % of the NEES (6
# degrees of freedom) are below 6 at 0.3 m, 15 at 1.2 m, 25 at 2 m, 75 at 3 m (three emulated sessions).
_WIDE_VARIANCE_PER_M2 = 0.5
_UNALIGNED_VARIANCE = 10.0  # factor on that of a pair whose patches do not align: NEES of 17 to 116 measured
_MAX_SIGMA_DEG = 1.0  # of a pose that features leave uncertain; vaguer ones are worse than none
_SAME_CHI2 = 22.5  # 99.9 %, 6 degrees of freedom
_SHARED_ERROR = 2.0  # factor on sigma in the graph: the loops of a keyframe share its depths' errors


@dataclass(frozen=True, eq=False)
class ImageView:
    """The image of a keyframe with its camera, decoded when needed. T_body_cam0 (4, 4)."""

    source: KeyframeImage
    camera: Camera
    T_body_cam0: F64

    @cached_property
    def pixels(self) -> U8 | None:
        """The image (H, W); None if it is damaged."""
        return decompress(self.source, self.camera)

    @property
    def is_intact(self) -> bool:
        return self.pixels is not None

    @cached_property
    def pyramid(self) -> tuple[U8, ...]:
        """The image at full, half and a quarter of its size; empty if it is damaged."""
        if self.pixels is None:
            return ()
        half = np.asarray(cv2.pyrDown(self.pixels), np.uint8)
        return self.pixels, half, np.asarray(cv2.pyrDown(half), np.uint8)

    def kernels(self, level: int) -> F32:
        """Kernels (N, 3, S) of the features' patches, from this image of `pyramid`."""
        if level not in self._kernels:
            px = self.px / np.float32(2**level)
            self._kernels[level] = patches.extract_kernels(self.pyramid[level], px)
        return self._kernels[level]

    @cached_property
    def _kernels(self) -> dict[int, F32]:
        return {}

    @cached_property
    def uv(self) -> F64:
        """Normalised coordinates (N, 2) of the features."""
        return self.source.uv.astype(np.float64)

    @cached_property
    def px(self) -> F32:
        return self.camera.distort(self.uv).astype(np.float32)

    @cached_property
    def plane(self) -> F64:
        return self.source.plane.astype(np.float64)

    @cached_property
    def rho_sigma(self) -> F64:
        return self.source.rho_sigma.astype(np.float64)

    @cached_property
    def shared_depth_sigma(self) -> float:
        """Bound on the relative error that all depths have in common, such as the scale of a camera without a
        baseline: no more than the surest of them has."""
        rho = (rays(self.uv) * self.plane).sum(axis=1)
        surest = (self.rho_sigma / np.maximum(rho, _MIN_RHO)).min(initial=_MAX_SHARED_DEPTH)
        return max(_MIN_SHARED_DEPTH, float(surest))

    @cached_property
    def uv_per_px(self) -> F64:
        """Derivative (N, 2, 2) of `uv` by px."""
        return np.asarray(np.linalg.inv(self.camera.jacobian(self.uv)))

    def describe(self) -> View:
        """Return the ORB features of the image; an empty view if it is damaged."""
        if self.pixels is None:
            return View.empty()
        return image_view(self.pixels, self.camera, self.source, ORB_FEATURES)


@dataclass(frozen=True, eq=False)
class AlignedLoop:
    """T_c_q (4, 4) of the bodies and its covariance (6, 6).

    predicted: features in both views; found: those that were aligned; inliers: those that agree with the
    pose. depth_scale: as in `Verification`."""

    T_c_q: F64
    cov: F64
    predicted: int
    found: int
    inliers: int
    depth_scale: DepthScale | None


def align_verified(verified: Verification, query: ImageView, candidate: ImageView) -> Verification:
    """Return the verification with the pose of the aligned images; with its own pose, which is trusted less,
    where too few patches can be compared or agree: surfaces seen from elsewhere."""
    if not query.pyramid or not candidate.pyramid:
        return verified  # damaged: nothing to compare
    aligned = align_images(verified.T_c_q, query, candidate)
    refined = None if aligned is None else _verification(aligned)
    if isinstance(refined, Verification):
        return refined
    scale = verified.depth_scale
    if scale is not None:
        scale = scale._replace(shared_sigma=_shared_sigma(query, candidate))
    return replace(verified, cov=_UNALIGNED_VARIANCE * verified.cov, depth_scale=scale, is_confirmed=False)


def align_undetermined(refused: Refusal, query: ImageView, candidate: ImageView) -> Verification | Refusal:
    """Return the pose of a pair whose features do not determine one, by aligning the images from each pose
    that they allow; the refusal where that fails, gives two poses, or one that is uncertain too."""
    found: list[Verification] = []
    for T_c_q in refused.possible_poses:
        aligned = _align_from_map(T_c_q, query, candidate, _COARSE_TO_FINE)
        if isinstance(aligned, Verification):
            found.append(aligned)
    if not found or any(_differ(found[0], other) for other in found[1:]):
        return refused
    is_sure = np.degrees(se3.rotation_sigma(found[0].cov)) <= _MAX_SIGMA_DEG
    return found[0] if is_sure else refused


def _differ(a: Verification, b: Verification) -> bool:
    xi = se3.log(se3.inverse(a.T_c_q) @ b.T_c_q)
    return bool(xi @ np.linalg.solve(a.cov + b.cov, xi) > _SAME_CHI2)


def align_from_map(T_c_q: F64, query: ImageView, candidate: ImageView) -> Verification | Refusal:
    """Return the pose of the query's body in the candidate's by their images, from the pose T_c_q (4, 4) that
    the map has; or why there is none.

    Coarse images are used only where the map's pose is too far off without: they take twice the time."""
    fine = _align_from_map(T_c_q, query, candidate, _FINE)
    is_found = isinstance(fine, Verification)
    return fine if is_found else _align_from_map(T_c_q, query, candidate, _COARSE_TO_FINE)


def _align_from_map(
    T_c_q: F64, query: ImageView, candidate: ImageView, levels: tuple[int, ...]
) -> Verification | Refusal:
    aligned = align_images(T_c_q, query, candidate, levels)
    if aligned is None:
        return Refusal("too few patches align from the map's pose")
    if aligned.found < _MIN_FOUND_SHARE * aligned.predicted:
        return Refusal(f"{aligned.found} of {aligned.predicted} patches align from the map's pose")
    return _verification(aligned)


def _verification(aligned: AlignedLoop) -> Verification | Refusal:
    if aligned.inliers < max(_MIN_INLIERS, _MIN_INLIER_SHARE * aligned.found):
        return Refusal(f"{aligned.inliers} of {aligned.found} aligned patches agree with one pose")
    floor = np.diag([np.radians(_FLOOR_DEG) ** 2] * 3 + [_FLOOR_M**2] * 3)
    distance_m = float(np.linalg.norm(aligned.T_c_q[:3, 3]))
    cov = _SHARED_ERROR**2 * (1 + _WIDE_VARIANCE_PER_M2 * distance_m**2) * (aligned.cov + floor)
    return Verification(aligned.T_c_q, cov, aligned.found, aligned.inliers, aligned.depth_scale)


class _AlignedFeatures(NamedTuple):
    """Features of one view that were aligned in the other: feature (M,), their indices; px (M, 2), their
    positions there. predicted: number of features that the other view should show."""

    feature: I64
    px: F64
    predicted: int


def align_images(
    T_c_q: F64, query: ImageView, candidate: ImageView, levels: tuple[int, ...] = _COARSE_TO_FINE
) -> AlignedLoop | None:
    """Refine the pose T_c_q (4, 4) of the query's body in the candidate's by aligning their patches, at each
    of these levels in turn; None where too few can be aligned."""
    if not query.pyramid or not candidate.pyramid:
        return None
    T = se3.inverse(candidate.T_body_cam0) @ T_c_q @ query.T_body_cam0
    for level in levels:
        forward = _align(T, query, candidate, level)
        backward = _align(se3.inverse(T), candidate, query, level)
        found = len(forward.feature) + len(backward.feature)
        if found < _MIN_INLIERS:
            return None
        try:
            fit = _fit_pose(T, query, candidate, forward, backward, 2.0**level)
        except np.linalg.LinAlgError:
            return None
        T = fit.T
    left_to_right = se3.adjoint(se3.inverse(T))  # cov of Exp(xi) T -> of T Exp(xi), of the cameras
    cov = left_to_right @ fit.cov @ left_to_right.T
    to_body = se3.adjoint(query.T_body_cam0)
    T_bodies = se3.orthonormal(candidate.T_body_cam0 @ T @ se3.inverse(query.T_body_cam0))
    scale = fit.depth_scale
    if scale is not None and scale.pose_sensitivity is not None:
        scale = scale._replace(pose_sensitivity=se3.adjoint(candidate.T_body_cam0) @ scale.pose_sensitivity)
    predicted = forward.predicted + backward.predicted
    return AlignedLoop(T_bodies, to_body @ cov @ to_body.T, predicted, found, fit.inliers, scale)


def _transfer(
    T: F64, source: ImageView, index: I64 | slice, log_scale: float = 0.0
) -> tuple[F64, F64, F64, F64]:
    """Project the source's features by T (4, 4), target from source, with depths shorter by exp(log_scale).

    Return uv (N, 2) in the target, NaN behind it; the derivative D (N, 2, 3) of uv by the homogeneous point
    q (N, 3) = R ray + rho t; q; and rho (N,)."""
    ray, plane = rays(source.uv[index]), source.plane[index]
    rho = np.exp(log_scale) * (ray * plane).sum(axis=1)
    q = ray @ T[:3, :3].T + rho[:, None] * T[:3, 3]
    return *project(q), q, rho


def _align(T: F64, source: ImageView, target: ImageView, level: int) -> _AlignedFeatures:
    """Align the source's patches in the target's image of a level, from where T (4, 4) puts them."""
    uv, D, _, _ = _transfer(T, source, slice(None))
    by_ray = T[:3, :3] + T[:3, 3, None] * source.plane[:, None, :]  # d q / d ray, along the plane
    warp = target.camera.jacobian(uv) @ D @ by_ray[:, :, :2] @ source.uv_per_px
    px = target.camera.distort(uv)
    magnification = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(warp))))
    inside = target.camera.is_inside(np.nan_to_num(px, nan=-1e6), _BORDER_PX)
    index = np.flatnonzero(
        inside & (magnification < _MAX_MAGNIFICATION) & (magnification > 1 / _MAX_MAGNIFICATION)
    )
    if len(index) == 0:
        return _AlignedFeatures(index, np.zeros((0, 2)), 0)
    size = 2.0**level
    kernels = source.kernels(level)[index]
    images = (target.pyramid[level],)
    aligned = patches.align(images, len(index), kernels, px[index] / size, warp[index], _MAX_STEPS)
    distance_px = np.hypot(*(aligned.px - px[index] / size).T)
    good = (
        (aligned.correlation > _MIN_CORRELATION)
        & (aligned.last_step < _CONVERGED_PX)
        & (distance_px < _REACH_PX)
    )
    return _AlignedFeatures(index[good], size * aligned.px[good].astype(np.float64), len(index))


class _FittedPose(NamedTuple):
    """T (4, 4) of the cameras, covariance (6, 6) of its left perturbation, inliers, and relative depth
    scale."""

    T: F64
    cov: F64
    inliers: int
    depth_scale: DepthScale | None


def _shared_sigma(query: ImageView, candidate: ImageView) -> float:
    """Return the sigma of the relative scale of both views' depths that many features do not average out."""
    return float(np.hypot(query.shared_depth_sigma, candidate.shared_depth_sigma))


def _fit_pose(
    T: F64,
    query: ImageView,
    candidate: ImageView,
    forward: _AlignedFeatures,
    backward: _AlignedFeatures,
    size: float,
) -> _FittedPose:
    """Fit the pose, and the scale of either view's depths, to all aligned positions. size: px of the image
    per px of the level. Raises LinAlgError where they do not determine it."""
    scale_sigma = np.array([query.shared_depth_sigma, candidate.shared_depth_sigma])
    prior = np.diag(np.concatenate([np.full(6, _RIDGE), scale_sigma**-2]))
    log_scales = np.zeros(2)  # of the query's depths and the candidate's
    for _ in range(_ITERATIONS):
        at_candidate = _residuals(T, query, candidate, forward, size, log_scales[0])
        at_query = _residuals(se3.inverse(T), candidate, query, backward, size, log_scales[1])
        r = np.concatenate([at_candidate.r, at_query.r])
        J, split = np.zeros((len(r), 2, 8)), len(at_candidate.r)
        J[:, :, :6] = np.concatenate([at_candidate.J_pose, at_query.J_pose @ -se3.adjoint(se3.inverse(T))])
        J[:split, :, 6], J[split:, :, 7] = at_candidate.J_scale, at_query.J_scale
        chi2 = (r * r).sum(axis=1)
        root_weight = 1 / np.sqrt(1 + chi2 / _CAUCHY**2)
        A = (J * root_weight[:, None, None]).reshape(-1, 8)
        information = A.T @ A + prior
        gradient = A.T @ (r * root_weight[:, None]).ravel()
        gradient[6:] -= log_scales / scale_sigma**2
        step = np.linalg.solve(information, gradient)
        T, log_scales = se3.exp(step[:6]) @ T, log_scales + step[6:]
        if np.abs(step).max() < _CONVERGED_STEP * size:
            break
    inlier, cov = chi2 < _INLIER_CHI2, np.linalg.inv(information)
    depth_scale = _depth_scale(J[inlier], r[inlier], log_scales)
    if depth_scale is not None:
        pose_sensitivity = cov[:6, 6] / scale_sigma[0] ** 2
        depth_scale = DepthScale(*depth_scale[:2], pose_sensitivity, _shared_sigma(query, candidate))
    return _FittedPose(T, cov[:6, :6], int(inlier.sum()), depth_scale)


def _depth_scale(J: F64, r: F64, log_scales: F64) -> DepthScale | None:
    """Return the scale of the query's depths over the candidate's by residuals r (M, 2) at the fit, with
    nothing known of it before. J (M, 2, 8) and log_scales (2,): of the fit."""
    if len(r) < _MIN_INLIERS:
        return None
    A = J[:, :, :7].reshape(-1, 7)
    normal = A.T @ A + _RIDGE * np.eye(7)
    log_scale = float(log_scales[0] - log_scales[1] + np.linalg.solve(normal, A.T @ r.ravel())[6])
    variance = max(1.0, float((r * r).sum()) / max(1, 2 * len(r) - 7))
    sigma = float(np.sqrt(np.linalg.inv(normal)[6, 6] * variance))
    return DepthScale(log_scale, sigma)


class _Residuals(NamedTuple):
    """Whitened: r (M, 2), measured minus predicted; its derivatives J_pose (M, 2, 6) of the prediction by the
    left perturbation of T, and J_scale (M, 2) by the log of the source's depths."""

    r: F64
    J_pose: F64
    J_scale: F64


def _residuals(
    T: F64, source: ImageView, target: ImageView, alignment: _AlignedFeatures, size: float, log_scale: float
) -> _Residuals:
    index = alignment.feature
    uv, D, q, rho = _transfer(T, source, index, log_scale)
    J_px = target.camera.jacobian(uv) @ D
    by_rho = J_px @ T[:3, 3]  # px per 1/m
    J = np.empty((len(index), 2, 8))  # by the pose, by the log of the depth, and the residual
    J[:, :, :6] = se3.point_jacobian(J_px, q, rho)
    J[:, :, 6] = by_rho * rho[:, None]
    J[:, :, 7] = alignment.px - target.camera.distort(uv)
    is_visible = np.isfinite(uv).all(axis=1)
    J = _whitened(J, size * _SIGMA_PX, by_rho * source.rho_sigma[index, None])
    J[~is_visible] = 0.0
    J[~is_visible, :, 7] = _NOT_VISIBLE
    return _Residuals(J[:, :, 7], J[:, :, :6], J[:, :, 6])


def _whitened(J: F64, sigma: float, common: F64) -> F64:
    """Return S^-1/2 J for rows J (M, 2, K) with covariance S = sigma^2 1 + common common' (M, 2, 2)."""
    length = np.sqrt((common * common).sum(axis=1))
    along = common / np.maximum(length, 1e-12)[:, None]
    reduction = 1 - sigma / np.sqrt(sigma**2 + length**2)
    part = (along[:, None, :] @ J) * reduction[:, None, None]  # (M, 1, K)
    out: F64 = (J - along[:, :, None] * part) / sigma
    return out
