"""Match the state's features in the images of a frame: predict their positions, then align their patches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.geometry import se3
from share.geometry.camera import Camera, Rig, project, rays
from share.odometry.feature_appearance import Appearance, is_stereo_due
from share.odometry.state import FilterState
from share.types import F32, F64, I64, U8, Frame
from share.vision import optical_flow, patches

_BORDER_PX = 6.0
_MIN_CORRELATION = 0.85  # with the first patch, of a match
_MAX_LAST_STEP_PX = 0.3  # of an alignment that has converged
_MAX_REACH_PX = 4.0  # of an alignment, from the predicted position
_MAX_FLOW_ERROR_PX = 1.5  # between the position by optical flow and by alignment of the patch
_MAX_MISSING_SHARE = 0.15  # of the features in view; if more are missing, they are tracked by optical flow


@dataclass(frozen=True, eq=False)
class StereoMatches:
    """Indices (M,) of the features found in cam1, and their normalised coordinates uv (M, 2)."""

    feature: I64
    uv: F64


@dataclass(frozen=True, eq=False)
class FeatureMatches:
    """Matches of all N features in cam0.

    px, uv (N, 2): measured position, in pixels and normalised; uv is NaN where is_found (N,) is False.
    is_dynamic (N,): set later, by `visual_update.mark_dynamic` and `LandmarkMap.record_frame`. predicted_px,
    predicted_uv (N, 2): predicted position, NaN behind the camera. warp (N, 2, 2): d px / d px of the first
    image. px_per_rho (N, 2): derivative of the position in the first image by inverse depth. samples (N, S):
    see `patches.AlignedPatches`. cam1: matches in cam1.
    """

    px: F32
    uv: F64
    is_found: NDArray[np.bool_]
    is_dynamic: NDArray[np.bool_]
    predicted_px: F64
    predicted_uv: F64
    warp: F64
    px_per_rho: F64
    samples: F32
    cam1: StereoMatches | None = None

    def in_view_count(self, camera: Camera) -> int:
        """Return the number of features predicted in view."""
        return int(camera.is_inside(self.predicted_px, 0.0).sum())


def match_features(
    frame: Frame, rig: Rig, state: FilterState, appearance: Appearance, cam0_only: bool = False
) -> FeatureMatches:
    """Match the features in the images of a frame, both in one pass; in cam1 only those that are due. The
    covariance is not used."""
    n = len(state.feature_ids)
    images: tuple[U8, ...] = (frame.image0,)
    indices, cameras = np.arange(n), [rig.cam0]
    if frame.image1 is not None and rig.cam1 is not None and not cam0_only:
        images, cameras = (frame.image0, frame.image1), [rig.cam0, rig.cam1]
        indices = np.concatenate([indices, np.flatnonzero(is_stereo_due(appearance))])
    is_in_cam1 = np.arange(len(indices)) >= n
    T = rig.T_cam1_cam0 if len(cameras) > 1 else None
    patch = predict_patches(
        state, indices, appearance.ray_per_px[indices], appearance.slant[indices], T, is_in_cam1
    )

    def of_each(evaluate: Callable[[Camera, slice], F64]) -> F64:
        parts = (slice(n), slice(n, None))
        return np.concatenate([evaluate(*one) for one in zip(cameras, parts, strict=False)])

    expected = of_each(lambda camera, part: camera.distort(patch.uv[part]))
    jacobian = of_each(lambda camera, part: camera.jacobian(patch.uv[part]))
    inside = of_each(lambda camera, part: camera.is_inside(expected[part], _BORDER_PX))
    to_align, warp = np.flatnonzero(inside), jacobian @ patch.warp
    out = _no_matches(expected[:n], patch.take(np.arange(n)), warp[:n])
    if len(to_align) == 0:
        return out
    cam0_to_align = int(np.searchsorted(to_align, n))
    px = expected[to_align]
    aligned = patches.align(
        images, cam0_to_align, appearance.patch.kernels[indices[to_align]], px, warp[to_align]
    )
    accepted = _is_match(aligned, px, _MAX_REACH_PX)
    uv = patch.uv[to_align] + _solve_2x2(jacobian[to_align], aligned.px - px)
    in_cam0, in_cam1 = slice(0, cam0_to_align), slice(cam0_to_align, None)
    for camera, part in zip(cameras, (in_cam0, in_cam1), strict=False):
        rows = to_align[part]
        uv[part] = _undistorted(camera, aligned.px[part], uv[part], patch.uv[rows], jacobian[rows])
        if camera.is_bounded:  # the aligned position may have no normalised coordinates
            accepted[part] &= camera.has_normalised(aligned.px[part].astype(np.float64))
    _store_matches(out, indices[to_align[in_cam0]], aligned, uv[in_cam0], accepted[in_cam0], in_cam0)
    if len(cameras) == 1:
        return out
    number = indices[to_align[in_cam1]]
    cam1_accepted = np.flatnonzero(accepted[in_cam1] & out.is_found[number])
    return replace(out, cam1=StereoMatches(number[cam1_accepted], uv[in_cam1][cam1_accepted]))


def _undistorted(camera: Camera, px: F32, uv: F64, predicted_uv: F64, jacobian: F64) -> F64:
    """Return the normalised positions (N, 2) of aligned ones, px. uv: to first order, from `predicted_uv`;
    jacobian: d px / d uv there."""
    if camera.is_fisheye:  # the Jacobian changes within a few px
        return camera.normalise(px.astype(np.float64), predicted_uv)
    if camera.distortion:
        return np.asarray(uv + _solve_2x2(jacobian, px - camera.distort(uv)))
    return uv


def match_by_flow(
    previous: U8,
    image: U8,
    camera: Camera,
    appearance: Appearance,
    matches: FeatureMatches,
) -> None:
    """Track the missing features from the previous image by optical flow, if many are missing in cam0.

    Updates `matches` in place.
    """
    inside = camera.is_inside(matches.predicted_px, _BORDER_PX)
    missing = np.flatnonzero(~matches.is_found & inside)
    if len(missing) <= _MAX_MISSING_SHARE * inside.sum():
        return
    guess = matches.predicted_px[missing].astype(np.float32)
    px, ok = optical_flow.track_points(
        previous, image, appearance.last_px[missing], guess, window=15, levels=2, back_check_px=1.0
    )
    missing, flow_px = missing[ok], px[ok].astype(np.float64)
    if len(missing) == 0:
        return
    aligned = patches.align(
        (image,), len(missing), appearance.patch.kernels[missing], flow_px, matches.warp[missing]
    )
    uv = camera.normalise(aligned.px.astype(np.float64))
    accepted = _is_match(aligned, flow_px, _MAX_FLOW_ERROR_PX) & np.isfinite(uv).all(axis=1)
    _store_matches(matches, missing, aligned, uv, accepted, slice(None))


def _no_matches(predicted_px: F64, patch: PatchPrediction, warp: F64) -> FeatureMatches:
    """Return matches of the predicted features (N,), none found yet."""
    n = len(predicted_px)
    none, samples = np.zeros(n, bool), np.zeros((n, len(patches.OFFSETS)), np.float32)
    px = np.where(np.isnan(predicted_px), -1e6, predicted_px).astype(np.float32)
    uv = np.full((n, 2), np.nan)
    return FeatureMatches(
        px, uv, none, none.copy(), predicted_px, patch.uv, warp, _px_per_rho(patch), samples
    )


def _solve_2x2(J: F64, b: F64) -> F64:
    """Return x (N, 2) with J x = b for J (N, 2, 2), b (N, 2); not finite where J is singular."""
    p, q, r, s = J[:, 0, 0], J[:, 0, 1], J[:, 1, 0], J[:, 1, 1]
    x, y = b[:, 0], b[:, 1]
    out = np.empty((len(J), 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = p * s - q * r
        np.divide(s * x - q * y, determinant, out=out[:, 0])
        np.divide(p * y - r * x, determinant, out=out[:, 1])
    return out


def _px_per_rho(patch: PatchPrediction) -> F64:
    """Return the derivative (N, 2) px of the position in the first image by inverse depth; 0 where it is not
    finite."""
    out = _solve_2x2(patch.warp, patch.J_rho)
    return np.where(np.isfinite(out), out, 0.0)


def _is_match(aligned: patches.AlignedPatches, px: F64, reach_px: float) -> NDArray[np.bool_]:
    """Return which alignments (N,) converged within `reach_px` of px (N, 2) with enough correlation."""
    distance = np.hypot(*(aligned.px - px).T)
    converged = (aligned.last_step < _MAX_LAST_STEP_PX) & (distance < reach_px)
    out: NDArray[np.bool_] = converged & (aligned.correlation > _MIN_CORRELATION)
    return out


def _store_matches(
    out: FeatureMatches,
    indices: I64,
    aligned: patches.AlignedPatches,
    uv: F64,
    accepted: NDArray[np.bool_],
    part: slice,
) -> None:
    out.px[indices] = aligned.px[part]
    out.is_found[indices] = accepted
    out.samples[indices] = aligned.samples[part]
    out.uv[indices[accepted]] = uv[accepted]


# Predicted positions of features, and their derivatives by the state.
#
# A feature at inverse depth rho on the ray f of its anchor is q = f + rho p in the homogeneous coordinates of
# any frame: nothing here divides by rho, so a feature may be infinitely far away (Civera et al. 2008).


@dataclass(frozen=True, eq=False)
class Prediction(ArrayTable):
    """Predicted positions of N features and their derivatives.

    uv (N, 2): normalised coordinates, NaN behind the camera. Derivatives by the body's pose (N, 2, 6), the
    extrinsic (N, 2, 6), the inverse depth (N, 2). The derivative by the anchor's pose is the negative of that
    by the body's: only their difference is observable.
    """

    uv: F64
    H_pose: F64
    H_extrinsic: F64
    H_rho: F64


def predict(
    state: FilterState, indices: I64, T_cam1_cam0: F64 | None = None, in_cam1: NDArray[np.bool_] | None = None
) -> Prediction:
    """Predict features `indices` (N,) in cam0.

    With T_cam1_cam0 (4, 4): in cam1, or in cam1 only where in_cam1 (N,) is True.
    """
    f, rho, anchor = rays(state.ray[indices]), state.rho[indices], state.anchor[indices]
    T_odom_anchor = state.keyframe_poses @ state.T_body_cam
    T_cam_odom = se3.inverse(state.T @ state.T_body_cam)
    R_odom_anchor, t_odom_anchor = T_odom_anchor[anchor, :3, :3], T_odom_anchor[anchor, :3, 3]
    R, t = T_cam_odom[:3, :3], T_cam_odom[:3, 3]
    q_odom = (R_odom_anchor @ f[:, :, None])[:, :, 0] + rho[:, None] * t_odom_anchor
    q = q_odom @ R.T + rho[:, None] * t
    H_rho = t_odom_anchor @ R.T + t
    uv, D, H_rho = _project_with_jacobians(q, rho, H_rho, T_cam1_cam0, in_cam1)
    DR = D @ R
    H_extrinsic = se3.point_jacobian(DR @ R_odom_anchor, f, rho) - se3.point_jacobian(D, q, rho)
    return Prediction(uv, -se3.point_jacobian(DR, q_odom, rho), H_extrinsic, H_rho)


def in_image_plane(predicted: Prediction, camera: Camera, mask: NDArray[np.bool_]) -> Prediction:
    """Return the prediction with the features in `mask` (N,) in the image plane of `camera`, a fisheye: see
    `Camera.to_image_plane`."""
    uv, H_pose, H_extrinsic, H_rho = (
        part.copy() for part in (predicted.uv, predicted.H_pose, predicted.H_extrinsic, predicted.H_rho)
    )
    J = camera.jacobian(uv[mask]) / np.array([[camera.fx], [camera.fy]])
    uv[mask] = camera.to_image_plane(uv[mask])
    H_pose[mask], H_extrinsic[mask] = J @ H_pose[mask], J @ H_extrinsic[mask]
    H_rho[mask] = (J @ H_rho[mask, :, None])[:, :, 0]
    return Prediction(uv, H_pose, H_extrinsic, H_rho)


@dataclass(frozen=True, eq=False)
class PatchPrediction(ArrayTable):
    """Predicted position and shape of N patches.

    uv (N, 2): normalised coordinates, NaN behind the camera. warp (N, 2, 2): d uv / d px of the anchor's
    image. J_rho (N, 2): d uv / d inverse depth.
    """

    uv: F64
    warp: F64
    J_rho: F64


def predict_patches(
    state: FilterState,
    indices: I64,
    ray_per_px: F64,
    slant: F64,
    T_cam1_cam0: F64 | None = None,
    in_cam1: NDArray[np.bool_] | None = None,
) -> PatchPrediction:
    """Predict the patches of features `indices` (N,); T_cam1_cam0 and in_cam1 as in `predict`.

    ray_per_px (N, 2, 2): d ray / d px in the anchor's image. slant (N, 2): d rho / d px of the surface.
    """
    rho, T = state.rho[indices], anchors_in_camera(state, indices)
    R, t = T[:, :3, :3], T[:, :3, 3]
    q = (R @ rays(state.ray[indices])[:, :, None])[:, :, 0] + rho[:, None] * t
    uv, D, J_rho = _project_with_jacobians(q, rho, t, T_cam1_cam0, in_cam1)
    return PatchPrediction(uv, (D @ R)[:, :, :2] @ ray_per_px + J_rho[:, :, None] * slant[:, None, :], J_rho)


def _project_with_jacobians(
    q: F64, rho: F64, q_by_rho: F64, T_cam1_cam0: F64 | None, in_cam1: NDArray[np.bool_] | None
) -> tuple[F64, F64, F64]:
    """Project points q (N, 3) in cam0, with derivative q_by_rho (N, 3) by inverse depth.

    Return uv (N, 2), d uv / d q (N, 2, 3) and d uv / d inverse depth (N, 2).
    """
    if T_cam1_cam0 is None:
        uv, D = project(q)
        return uv, D, (D @ q_by_rho[:, :, None])[:, :, 0]
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    if in_cam1 is None:
        uv, D = project(q @ R.T + rho[:, None] * t)
        D_q = D @ R
        return uv, D_q, (D_q @ q_by_rho[:, :, None])[:, :, 0] + D @ t
    q_cam = q.copy()
    q_cam[in_cam1] = q[in_cam1] @ R.T + rho[in_cam1, None] * t
    uv, D = project(q_cam)
    shift_term = D[in_cam1] @ t
    D[in_cam1] = D[in_cam1] @ R
    J_rho = (D @ q_by_rho[:, :, None])[:, :, 0]
    J_rho[in_cam1] += shift_term
    return uv, D, J_rho


def is_in_view(state: FilterState, camera: Camera, anchor: I64, ray: F64, rho: F64) -> NDArray[np.bool_]:
    """Return which points (N,) on rays (N, 2) of the keyframes with indices `anchor` (N,), at inverse depths
    (N,), are in cam0's view."""
    T = _keyframes_in_camera(state)[anchor]
    uv, _ = project((T[:, :3, :3] @ rays(ray)[:, :, None])[:, :, 0] + rho[:, None] * T[:, :3, 3])
    return np.asarray(camera.is_inside(np.nan_to_num(camera.distort(uv), nan=-1e6)), bool)


def anchors_in_camera(state: FilterState, indices: I64 | slice = slice(None)) -> F64:
    """Return T_cam_anchor (N, 4, 4): from cam0 of the anchor of each feature in `indices` to cam0 now."""
    out: F64 = _keyframes_in_camera(state)[state.anchor[indices]]
    return out


def _keyframes_in_camera(state: FilterState) -> F64:
    """Return T_cam_keyframe (K, 4, 4): from cam0 of each keyframe to cam0 now."""
    out: F64 = se3.inverse(state.T @ state.T_body_cam) @ state.keyframe_poses @ state.T_body_cam
    return out
