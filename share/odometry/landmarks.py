"""The features of the filter: match statistics, dynamic features, new and dormant features, in step with
the state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Rig, rays
from share.odometry import (
    dormant_features,
    feature_appearance,
    feature_matching,
    filter,
    initial_depth,
    state,
)
from share.odometry.dormant_features import DormantFeatures, DormantTable
from share.odometry.feature_appearance import Appearance
from share.odometry.feature_matching import FeatureMatches, Prediction
from share.odometry.state import GYRO_BIAS, FilterState
from share.types import F32, F64, I64, U8, FeatureStatistics, Frame
from share.vision import corners
from share.vision.corners import CornerPeaks, field_mask
from share.vision.depth import MIN_RHO, measures_depth
from share.vision.keyframe_images import Surfaces

CORRELATED_SIGMA_PX = 0.3  # error of a feature that lasts: edges, patches seen from elsewhere
_SPACING_PX = 18.0  # least distance between new features
_GRAY_NOISE = 3.0  # gray levels of an image
_MAX_PATCH_SIGMA_PX = 0.5  # error of a patch's position by image noise; with more it is no feature
_AVOID_FRAMES = 30  # for which no feature is searched where a dynamic feature was
_MIN_DYNAMIC = 5  # dynamic features in a frame that begin a time of caution
_CAUTION_FRAMES = 60  # length of that time, after the last such frame
_PROBATION_S = 0.34  # after which a static feature is proven
_SUSPECT_NOISE_SCALE = 5.0  # of the sigma of a feature that may move
_UNKNOWN_BIAS_SIGMA = 2e-3  # rad/s, of the gyroscope; with more, rotation may pass for translation
_NEAR_RATIO = 2.0  # of a near feature's inverse depth to the median
_MAX_NEAR_SHARE = 0.25  # of the features; if more are near, they are a part of the room
_SLANT_PERIOD = 4  # frames between updates of a feature's slant
_MIN_DEPTH_M = 0.2
_UNKNOWN_RHO_SIGMA = 0.05  # 1/m; half a pixel a frame at walking speed
_KNOWN_DEPTH_RATIO = 0.1  # relative sigma of a known inverse depth
_MIN_PLANE_OFFSET = 0.05  # share of the distance to a surface's plane that is left: nearer is seen edge on
_ACTIVE_FEATURES_COST = 100.0  # added to the distance of a keyframe that anchors features in view


class LandmarkMap:
    """Keyframes, features and their appearance, in step with `state`."""

    def __init__(self, s: FilterState, rig: Rig, config: InertialConfig) -> None:
        self.state, self._rig, self._config = s, rig, config
        self.sigma_px = config.sigma_px  # noise of a feature's position, independent in each image
        self.appearance: Appearance = feature_appearance.empty_appearance()
        self._dormant = DormantFeatures()
        self._avoided_px: list[F32] = []
        self._probation_frames = 0  # `_PROBATION_S` at the present frame rate
        self._caution_frames = 0  # left
        self._next_feature = self._next_keyframe = 0
        # Of the last frame: matches, inliers, ids of the inliers.
        self._last_matches: tuple[FeatureMatches, NDArray[np.bool_], I64] | None = None

    def add_keyframe(self, rate: F64) -> int:
        """Add the pose of the frame just tracked as a keyframe. Return its id."""
        state.add_keyframe(self.state, self._next_keyframe, rate)
        self._next_keyframe += 1
        return self._next_keyframe - 1

    def match_features(self, frame: Frame, last_image: U8, interval_s: float) -> FeatureMatches:
        """Return the matches of the features in a frame, `interval_s` after the one with `last_image`."""
        self._probation_frames = int(_PROBATION_S / max(interval_s, 1e-3))
        matches = feature_matching.match_features(frame, self._rig, self.state, self.appearance)
        feature_matching.match_by_flow(last_image, frame.image0, self._rig.cam0, self.appearance, matches)
        return matches

    def record_frame(self, matches: FeatureMatches, inliers: NDArray[np.bool_]) -> None:
        """Keep the inliers (N,) of a frame; features that were not found become dormant, the others are
        dropped.

        Marks slow movers among the inliers as dynamic, in place, and updates appearance.
        """
        self.appearance.last_px[matches.is_found] = matches.px[matches.is_found]
        self.appearance.age[inliers] += 1
        indices = np.flatnonzero(inliers & ~self._has_unknown_depth())
        drifting = indices[
            feature_appearance.drifting_features(
                self.appearance, indices, matches.px[indices] - matches.predicted_px[indices]
            )
        ]
        inliers[drifting] = False
        matches.is_dynamic[drifting] = True
        self._avoid(matches.px[matches.is_dynamic])
        self._caution_frames = (
            _CAUTION_FRAMES if matches.is_dynamic.sum() >= _MIN_DYNAMIC else max(self._caution_frames - 1, 0)
        )
        slant_due = np.flatnonzero(
            inliers & (feature_appearance.staggered_age(self.appearance) % _SLANT_PERIOD == 0)
        )
        feature_appearance.update_slant(
            self.appearance, slant_due, matches.samples[slant_due], matches.px_per_rho[slant_due]
        )
        self._dormant.deactivate(self.state, self.appearance, np.flatnonzero(~matches.is_found))
        self.keep_features(inliers)
        self._last_matches = matches, inliers, self.state.feature_ids

    def surfaces(self, frame: Frame) -> Surfaces:
        """Return the surfaces of the features in `frame`, the one just tracked; where it measures no depth,
        of those with a well-known one."""
        s, appearance = self.state, self.appearance
        T_cam_anchor = feature_matching.anchors_in_camera(s)
        T_anchor_cam = se3.inverse(T_cam_anchor)
        slope = (np.linalg.inv(appearance.ray_per_px).swapaxes(1, 2) @ appearance.slant[:, :, None])[:, :, 0]
        plane = np.column_stack([slope, s.rho - (slope * s.ray).sum(axis=1)])  # in the anchor: plane X = 1
        offset = 1 - (plane * T_anchor_cam[:, :3, 3]).sum(axis=1)
        plane = (T_anchor_cam[:, :3, :3].swapaxes(1, 2) @ plane[:, :, None])[:, :, 0] / offset[:, None]
        ray_z = (T_cam_anchor[:, 2, :3] * rays(s.ray)).sum(axis=1)
        rho_scale = ray_z / (ray_z + s.rho * T_cam_anchor[:, 2, 3]) ** 2  # d rho here / d rho in the anchor
        uv = self._rig.cam0.normalise(appearance.last_px.astype(np.float64))
        found = Surfaces(uv, plane, np.sqrt(s.rho_variance) * np.abs(rho_scale))
        is_measured = ~self._has_unknown_depth() & measures_depth(frame, self._rig)
        is_known = self._has_known_depth() | is_measured
        return found.take(is_known & (offset > _MIN_PLANE_OFFSET) & found.is_valid())

    def feature_statistics(self) -> FeatureStatistics:
        """Return the statistics of the last frame, empty for the first one."""
        known = self._has_known_depth()
        if self._last_matches is None:
            return FeatureStatistics(
                np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0), 0, int(known.sum())
            )
        matches, inliers, ids = self._last_matches
        depth = np.full(len(inliers), np.nan)
        # The frame may have become a keyframe meanwhile, with new features.
        _, old_rows, new_rows = np.intersect1d(ids, self.state.feature_ids, return_indices=True)
        depth[np.flatnonzero(inliers)[old_rows]] = np.where(known, self._depths(), np.nan)[new_rows]
        is_found = matches.is_found | inliers
        return FeatureStatistics(
            matches.px[is_found],
            inliers[is_found],
            depth[is_found],
            matches.in_view_count(self._rig.cam0),
            int(known.sum()),
        )

    def _depths(self) -> F64:
        """Return the depths (N,) m of the features in cam0."""
        s = self.state
        T = feature_matching.anchors_in_camera(s)
        z = (T[:, 2, :3] * rays(s.ray)).sum(axis=1) / np.maximum(s.rho, MIN_RHO) + T[:, 2, 3]
        out: F64 = np.maximum(z, _MIN_DEPTH_M)
        return out

    def _has_known_depth(self) -> NDArray[np.bool_]:
        """Return which features (N,) have a well-known depth."""
        out: NDArray[np.bool_] = self.state.rho_variance < (_KNOWN_DEPTH_RATIO * self.state.rho) ** 2
        return out

    def _avoid(self, px: F32) -> None:
        """Search no new features near px (N, 2) for a while."""
        self._avoided_px = [*self._avoided_px[-_AVOID_FRAMES:], px]

    def cam0_measurements(self, uv: F64, indices: I64, rate: F64) -> filter.FeatureMeasurements:
        """Return measurements of features `indices` (M,) at uv (N, 2) of all in cam0."""
        return self._measurements(self.state, indices, uv[indices], None, rate)

    def frame_measurements(self, matches: FeatureMatches, rate: F64) -> filter.FeatureMeasurements:
        """Return measurements of all static matches of a frame, in both cameras, sorted by anchor, by the
        present state."""
        used = matches.is_found & ~matches.is_dynamic
        indices, in_cam1 = np.flatnonzero(used), None
        measured_uv = matches.uv[indices]
        if (stereo := matches.cam1) is not None:
            used_in_cam1 = used[stereo.feature]
            cam1_indices = stereo.feature[used_in_cam1]
            in_cam1 = np.arange(len(indices) + len(cam1_indices)) >= len(indices)
            indices = np.concatenate([indices, cam1_indices])
            measured_uv = np.concatenate([measured_uv, stereo.uv[used_in_cam1]])
        order = np.argsort(self.state.anchor[indices], kind="stable")
        in_cam1 = None if in_cam1 is None else in_cam1[order]
        return self._with_inflated_noise(
            self._measurements(self.state, indices[order], measured_uv[order], in_cam1, rate)
        )

    def _measurements(
        self, s: FilterState, indices: I64, uv: F64, in_cam1: NDArray[np.bool_] | None, rate: F64
    ) -> filter.FeatureMeasurements:
        """Return measurements of features `indices` (M,) of a state at uv (M, 2), in cam1 where in_cam1 (M,)
        is True."""
        T = None if in_cam1 is None else self._rig.T_cam1_cam0
        focal = np.full(len(indices), self._rig.cam0.focal)
        if in_cam1 is not None and self._rig.cam1 is not None:
            focal[in_cam1] = self._rig.cam1.focal
        predicted = feature_matching.predict(s, indices, T, in_cam1)
        if self._rig.cam0.is_fisheye:
            predicted, uv = self._in_image_plane(
                predicted, uv, np.zeros(len(indices), bool) if in_cam1 is None else in_cam1
            )
        sigma, correlated_sigma = self.sigma_px / focal, CORRELATED_SIGMA_PX / focal
        return filter.feature_measurements(s, indices, predicted, uv, sigma, correlated_sigma, rate)

    def _in_image_plane(
        self, predicted: Prediction, uv: F64, in_cam1: NDArray[np.bool_]
    ) -> tuple[Prediction, F64]:
        """Return prediction and uv in the image planes of fisheye lenses, where a pixel has the same size
        everywhere."""
        uv = uv.copy()
        for camera, mask in ((self._rig.cam0, ~in_cam1), (self._rig.cam1, in_cam1)):
            if camera is not None and mask.any():
                uv[mask] = camera.to_image_plane(uv[mask])
                predicted = feature_matching.in_image_plane(predicted, camera, mask)
        return predicted, uv

    def _with_inflated_noise(self, rows: filter.FeatureMeasurements) -> filter.FeatureMeasurements:
        """Return measurements with more noise for features that may move: unproven ones in a time of caution,
        and a near few while rotation may pass for translation."""
        suspect = np.zeros(len(self.state.feature_ids), bool)
        if self._caution_frames > 0:
            suspect |= self.appearance.age < self._probation_frames
        if self.state.cov.diagonal()[GYRO_BIAS].max() > _UNKNOWN_BIAS_SIGMA**2:
            suspect |= _near_few(initial_depth.current_rho(self.state))
        if not suspect.any():
            return rows
        noise_scale = np.where(suspect[rows.feature], _SUSPECT_NOISE_SCALE, 1.0)
        return replace(
            rows, sigma=noise_scale * rows.sigma, correlated_sigma=noise_scale * rows.correlated_sigma
        )

    def is_proven(self, indices: I64) -> NDArray[np.bool_]:
        """Return which of features `indices` (M,) have long been static."""
        out: NDArray[np.bool_] = self.appearance.age[indices] >= self._probation_frames
        return out

    def is_static(self, min_features: int) -> bool:
        """Return False while something moves in the view and fewer than `min_features` features are
        proven."""
        return (
            self._caution_frames == 0
            or int(self.is_proven(np.arange(len(self.state.feature_ids))).sum()) >= min_features
        )

    def _has_unknown_depth(self) -> NDArray[np.bool_]:
        """Return which features (N,) have hardly any known depth, and so no accurate prediction."""
        out: NDArray[np.bool_] = self.state.rho_variance > _UNKNOWN_RHO_SIGMA**2
        return out

    def occupied_px(self) -> F32:
        """Return px (M, 2) in the frame just tracked, near which no new feature is searched."""
        return np.concatenate([self.appearance.last_px, *self._avoided_px])

    def find_corners(self, frame: Frame, occupied_px: F32, peaks: CornerPeaks | None = None) -> F32:
        """Return px (N, 2) of corners for new features of a keyframe, away from occupied_px (M, 2), best
        first; peaks: of its image, if some are known."""
        max_count = self._config.features if self.free_slots() else 0
        mask = field_mask(self._rig.cam0)
        return corners.detect(frame.image0, occupied_px, max_count, _SPACING_PX, mask, peaks)

    def free_slots(self) -> int:
        """Return the number of features that may be added."""
        return max(self._config.features - len(self.state.feature_ids), 0)

    def admit_features(self, frame: Frame, keyframe_id: int, px: F32) -> None:
        """Add features at px (N, 2) of `frame`, the keyframe with this id; the last frame may be a later
        one."""
        camera, s, px = self._rig.cam0, self.state, px[: self.free_slots()]
        anchor = filter.keyframe_index(s, keyframe_id)
        ray = camera.normalise(px.astype(np.float64))
        prior = initial_depth.initial_depths(frame, self._rig, s, px, ray, self.appearance.last_px)
        appearance = feature_appearance.extract_appearance(
            frame.image0, camera, px, ray, np.nan_to_num(prior.rho)
        )
        is_usable = ~np.isnan(prior.rho) & (_GRAY_NOISE * appearance.patch.sigma_px < _MAX_PATCH_SIGMA_PX)
        ids = np.arange(self._next_feature, self._next_feature + int(is_usable.sum()))
        self._next_feature += len(ids)
        prior = prior.take(is_usable)
        old_count = len(s.feature_ids)
        state.add_features(
            s,
            ids,
            np.full(len(ids), anchor),
            ray[is_usable],
            prior.rho,
            prior.sigma,
            prior.J_existing,
            prior.common_sigma,
        )
        self.appearance = self.appearance.concatenate(appearance.take(is_usable))
        px_now = camera.distort(feature_matching.predict(s, np.arange(old_count, old_count + len(ids))).uv)
        self.appearance.last_px[old_count:] = np.where(np.isnan(px_now), px[is_usable], px_now)

    def reactivate(self, frame: Frame, rate: F64) -> F32:
        """Reactivate dormant features where the frame just tracked shows them within the gate. Return
        their px (M, 2)."""
        s = self.state
        dormant = self._dormant.nearby(s, self._rig.cam0)
        if dormant is None:
            return np.zeros((0, 2), np.float32)
        known = self._recognised(dormant, frame, rate)
        state.add_features(s, known.ids, known.anchor, known.ray, known.rho, known.sigma)
        self.appearance = self.appearance.concatenate(known.appearance)
        self._dormant.reactivate(known.ids)
        return known.appearance.last_px

    def _recognised(self, dormant: DormantTable, frame: Frame, rate: F64) -> DormantTable:
        """Return the dormant features that are found within the gate, with their place in the frame."""
        means = replace(
            self.state, feature_ids=dormant.ids, anchor=dormant.anchor, ray=dormant.ray, rho=dormant.rho
        )
        matches = feature_matching.match_features(frame, self._rig, means, dormant.appearance, cam0_only=True)
        found = np.flatnonzero(matches.is_found)
        rows = self._measurements(means, found, matches.uv[found], None, rate)
        recognised = found[dormant_features.nis(self.state, rows, dormant.sigma[found]) < filter.GATE]
        dormant.appearance.last_px[recognised] = matches.px[recognised]
        return dormant.take(recognised)

    def keep_features(self, keep: NDArray[np.bool_]) -> None:
        """Drop the features where keep (N,) is False."""
        if not keep.all():
            state.keep_features(self.state, keep)
            self.appearance = self.appearance.take(keep)

    def drop_dormant(self) -> None:
        """Forget all dormant features."""
        self._dormant = DormantFeatures()

    def drop_keyframes(self, held_ids: tuple[int, ...] = ()) -> None:
        """Drop keyframes without features, and the most redundant ones where there are too many.

        Never the newest two, nor those in `held_ids`, between which motions are published.
        """
        s = self.state
        is_active = np.bincount(s.anchor, minlength=len(s.keyframe_ids)) > 0
        dropped = ~is_active & ~self._dormant.has_features(s.keyframe_ids)
        is_held = np.isin(s.keyframe_ids, held_ids)
        is_held[-2:] = True
        dropped &= ~is_held
        while len(s.keyframe_ids) - dropped.sum() > self._config.max_keyframes:
            kept = np.flatnonzero(~dropped)
            distance, angle = se3.pairwise_distances(s.keyframe_poses[kept], s.keyframe_poses[kept])
            cost = distance + angle
            cost[np.diag_indices(len(kept))] = np.inf
            nearest = cost.min(axis=1) + _ACTIVE_FEATURES_COST * is_active[kept]
            nearest[is_held[kept]] = np.inf
            if not np.isfinite(nearest).any():
                break
            dropped[kept[np.argmin(nearest)]] = True
        if not dropped.any():
            return
        self._dormant.drop_keyframes(s.keyframe_ids[dropped])
        if (is_active & dropped).any():
            self.appearance = self.appearance.take(~dropped[s.anchor])
        state.drop_keyframes(s, s.keyframe_ids[dropped])


def _near_few(rho: F64) -> NDArray[np.bool_]:
    """Return which features (N,) with inverse depths rho are much nearer than most; none if they are many.

    Near features say the most about translation: a person who sways before the camera outweighs the room.
    """
    if not len(rho):
        return np.zeros(0, bool)
    near: NDArray[np.bool_] = rho > _NEAR_RATIO * np.median(rho)
    return near if near.mean() < _MAX_NEAR_SHARE else np.zeros(len(rho), bool)
