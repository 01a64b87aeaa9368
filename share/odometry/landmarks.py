"""The filter's state with what its features look like: what is added, forgotten, remembered, woken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Rig, rays
from share.odometry import feature_appearance, feature_matching, filter, outliers, state_augmentation
from share.odometry.depth_prior import DepthPrior, prior_from_neighbours
from share.odometry.dormant_features import DormantFeatures
from share.odometry.feature_appearance import Appearance
from share.odometry.feature_matching import FeatureMatches, Prediction
from share.odometry.state import FilterState
from share.types import F32, F64, I64, U8, FeatureStatistics, Frame
from share.vision import corners, epipolar
from share.vision.depth import disparity_per_rho, from_depth_camera, from_stereo
from share.vision.mask import field_mask
from share.vision.orb import measures_depth

_DEPTH_SIGMA_PX, _DEPTH_BASELINE_M = 0.3, 0.05  # of the stereo pair inside a depth camera, m
_GRAY_NOISE = 3.0  # gray levels of an image
_MAX_PATCH_SIGMA_PX = 0.5  # error by noise alone, beyond which a patch is no feature
_MAX_DISPARITY_ERROR_PX = 2.0  # of disparity
_AVOID_FRAMES = 30  # for which nothing new is sought where something moved by itself
_MIN_DYNAMIC, _CAUTION_FRAMES = 5, 60  # features at a time that went astray: somebody moves in the view
_PROBATION_S, _UNPROVEN_NOISE_SCALE = (
    0.34,
    5.0,
)  # in which a feature proves itself, and times its sigma until then
_SLANT_PERIOD = 4  # frames in which a feature's slant is learnt
_MIN_RHO, _MIN_DEPTH_M = 0.03, 0.2  # 1/m; m
_UNKNOWN_RHO_SIGMA = 0.05  # 1/m, sigma; half a pixel a frame of somebody who walks
_KNOWN_DEPTH_RATIO = 0.1  # relative sigma of an inverse depth that others are told
_ACTIVE_FEATURES_COST = 100.0  # redundancy that features in view are worth


class LandmarkMap:
    """Keyframes, features and their looks, always in step with `state`."""

    def __init__(self, state: FilterState, rig: Rig, config: InertialConfig) -> None:
        self.state, self._rig, self._config = state, rig, config
        self.appearance: Appearance = feature_appearance.empty_appearance()
        self._dormant = DormantFeatures()
        self._avoided_px: list[F32] = []
        self._probation_frames = 0  # frames that _PROBATION_S are
        self._caution_frames = 0  # frames for which new features have to prove themselves
        self._next_feature = self._next_keyframe = 0
        self._last_matches: tuple[FeatureMatches, NDArray[np.bool_], I64] | None = (
            None  # frame: sought, believed, their ids
        )

    def add_keyframe(self, rate: F64) -> int:
        """The frame just tracked: its pose. Its id."""
        state_augmentation.add_keyframe(self.state, self._next_keyframe, rate)
        self._next_keyframe += 1
        return self._next_keyframe - 1

    def begin_frame(self, interval_s: float) -> None:
        """Since the frame before."""
        self._probation_frames = int(_PROBATION_S / max(interval_s, 1e-3))

    def record_frame(self, matches: FeatureMatches, inliers: NDArray[np.bool_]) -> None:
        """Which features (N,) a frame showed. The others are gone, or asleep where they were not found."""
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

    def known_depths(self, frame: Frame) -> tuple[F32, F64]:
        """px (N, 2) and depth (N,) m of the features in `frame`, the last one; only of those whose depth is
        known well, where nothing else in the frame tells."""
        known = self._has_known_depth() | measures_depth(frame, self._rig)
        return self.appearance.last_px[known], self._depths()[known]

    def feature_statistics(self) -> FeatureStatistics:
        """Of the last frame; nothing for the first one, whose pose rests on nothing it shows."""
        known = self._has_known_depth()
        if self._last_matches is None:
            return FeatureStatistics(
                np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0), 0, int(known.sum())
            )
        matches, inliers, ids = self._last_matches
        depth = np.full(len(inliers), np.nan)
        _, old_rows, new_rows = np.intersect1d(
            ids, self.state.feature_ids, return_indices=True
        )  # it may be a keyframe by now
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
        """z (N,) m in cam0 of the features."""
        s = self.state
        T = feature_matching.anchors_in_camera(s)
        z = (T[:, 2, :3] * rays(s.ray)).sum(axis=1) / np.maximum(s.rho, _MIN_RHO) + T[:, 2, 3]
        out: F64 = np.maximum(z, _MIN_DEPTH_M)
        return out

    def _has_known_depth(self) -> NDArray[np.bool_]:
        """Which features' depth (N,) is known well."""
        out: NDArray[np.bool_] = self.state.rho_variance < (_KNOWN_DEPTH_RATIO * self.state.rho) ** 2
        return out

    def _avoid(self, px: F32) -> None:
        """No new feature near px (N, 2) for a while: there goes somebody."""
        self._avoided_px = [*self._avoided_px[-_AVOID_FRAMES:], px]

    def mark_dynamic(self, matches: FeatureMatches, rate: F64) -> None:
        """What moves by itself is astray; looked for only where the IMU alone does not explain the image."""
        indices = np.flatnonzero(matches.is_found)
        camera, config = self._rig.cam0, self._config
        residual = camera.to_image_plane(matches.at[indices]) - camera.to_image_plane(
            matches.predicted_uv[indices]
        )
        if len(indices) == 0 or outliers.matches_imu(
            residual * camera.focal, config.sigma_px, config.lasting_px
        ):
            return
        rows = self.cam0_measurements(matches.at, indices, rate)
        static = outliers.static_inliers(
            self.state, rows, matches.px[indices], self.is_proven(indices), camera
        )
        matches.is_dynamic[indices[~static]] = True

    def cam0_measurements(self, uv: F64, indices: I64, rate: F64) -> filter.FeatureMeasurements:
        """Rows for the filter of features `which` (M,) of those at uv (N, 2) in cam0."""
        return self._measurements(indices, uv[indices], None, rate)

    def frame_measurements(self, matches: FeatureMatches, rate: F64) -> filter.FeatureMeasurements:
        """Rows of all that was seen in a frame's images, sorted by host; as the state is now."""
        used = matches.is_found & ~matches.is_dynamic
        indices, in_cam1 = np.flatnonzero(used), None
        measured_uv = matches.at[indices]
        if (stereo := matches.cam1) is not None:
            used_in_cam1 = used[stereo.feature]
            cam1_indices = stereo.feature[used_in_cam1]
            in_cam1 = np.arange(len(indices) + len(cam1_indices)) >= len(indices)
            indices, measured_uv = (
                np.concatenate([indices, cam1_indices]),
                np.concatenate([measured_uv, stereo.at[used_in_cam1]]),
            )
        order = np.argsort(self.state.anchor[indices], kind="stable")
        in_cam1 = None if in_cam1 is None else in_cam1[order]
        return self._with_inflated_noise(
            self._measurements(indices[order], measured_uv[order], in_cam1, rate)
        )

    def _measurements(
        self, indices: I64, uv: F64, in_cam1: NDArray[np.bool_] | None, rate: F64
    ) -> filter.FeatureMeasurements:
        """Of features `which` (M,) seen at uv (M, 2), in cam1 where `right` (M,) says so."""
        T = None if in_cam1 is None else self._rig.T_cam1_cam0
        focal = np.full(len(indices), self._rig.cam0.focal)
        if in_cam1 is not None and self._rig.cam1 is not None:
            focal[in_cam1] = self._rig.cam1.focal
        predicted = feature_matching.predict(self.state, indices, T, in_cam1)
        if self._rig.cam0.is_fisheye:
            predicted, uv = self._in_image_plane(
                predicted, uv, np.zeros(len(indices), bool) if in_cam1 is None else in_cam1
            )
        sigma, correlated_sigma = self._config.sigma_px / focal, self._config.lasting_px / focal
        return filter.feature_measurements(self.state, indices, predicted, uv, sigma, correlated_sigma, rate)

    def _in_image_plane(
        self, predicted: Prediction, uv: F64, in_cam1: NDArray[np.bool_]
    ) -> tuple[Prediction, F64]:
        """Both in the image planes of fisheye lenses, where a pixel is as much everywhere."""
        uv = uv.copy()
        for camera, mask in ((self._rig.cam0, ~in_cam1), (self._rig.cam1, in_cam1)):
            if camera is not None and mask.any():
                uv[mask] = camera.to_image_plane(uv[mask])
                predicted = feature_matching.in_image_plane(predicted, camera, mask)
        return predicted, uv

    def _with_inflated_noise(self, rows: filter.FeatureMeasurements) -> filter.FeatureMeasurements:
        """While somebody moves in the view, what is new in it counts little."""
        if self._caution_frames == 0:
            return rows
        unproven = ~self.is_proven(rows.feature)
        noise_scale = np.where(unproven, _UNPROVEN_NOISE_SCALE, 1.0)
        return replace(
            rows, sigma=noise_scale * rows.sigma, correlated_sigma=noise_scale * rows.correlated_sigma
        )

    def is_proven(self, indices: I64) -> NDArray[np.bool_]:
        """Which of features `which` (M,) have long done as they should."""
        out: NDArray[np.bool_] = self.appearance.age[indices] >= self._probation_frames
        return out

    def is_static(self, min_features: int) -> bool:
        """False while something moves in the view and fewer than `min_features` features have proven not
        to."""
        return (
            self._caution_frames == 0
            or int(self.is_proven(np.arange(len(self.state.feature_ids))).sum()) >= min_features
        )

    def _has_unknown_depth(self) -> NDArray[np.bool_]:
        """Which features' depth (N,) is hardly known, nor therefore where they should be."""
        out: NDArray[np.bool_] = self.state.rho_variance > _UNKNOWN_RHO_SIGMA**2
        return out

    def occupied_px(self) -> F32:
        """px (M, 2) of the frame just tracked, near which nothing new is sought."""
        return np.concatenate([self.appearance.last_px, *self._avoided_px])

    def find_corners(self, frame: Frame, occupied_px: F32) -> F32:
        """px (N, 2) of what may become features of a keyframe, away from those `occupied_px` (M, 2), the most
        wanted first."""
        max_count = self._config.features if self._free_slots() else 0
        return corners.detect(
            frame.image0, occupied_px, max_count, self._config.spacing_px, field_mask(self._rig.cam0)
        )

    def admit_features(self, frame: Frame, keyframe_id: int, px: F32) -> None:
        """New features at px (N, 2) of the frame that is the keyframe with that id; the last frame may be a
        later one."""
        anchor, free_slots = filter.keyframe_index(self.state, keyframe_id), self._free_slots()
        self._add_features(frame, anchor, px[:free_slots])

    def _free_slots(self) -> int:
        """For so many features more."""
        return max(self._config.features - len(self.state.feature_ids), 0)

    def _add_features(self, frame: Frame, anchor: int, px: F32) -> None:
        camera, s = self._rig.cam0, self.state
        ray = camera.normalise(px.astype(np.float64))
        prior = self._initial_depths(frame, px, ray)
        appearance = feature_appearance.extract_appearance(
            frame.image0, camera, px, ray, np.nan_to_num(prior.rho)
        )
        is_usable = ~np.isnan(prior.rho) & (_GRAY_NOISE * appearance.patch.sigma_px < _MAX_PATCH_SIGMA_PX)
        ids = np.arange(self._next_feature, self._next_feature + int(is_usable.sum()))
        self._next_feature += len(ids)
        prior = prior.take(is_usable)
        old_count = len(s.feature_ids)
        state_augmentation.add_features(
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
        self.appearance.last_px[old_count:] = np.where(
            np.isnan(px_now), px[is_usable], px_now
        )  # in the last frame

    def _initial_depths(self, frame: Frame, px: F32, ray: F64) -> DepthPrior:
        """Of new features, NaN unknown: measured, or else guessed."""
        if not measures_depth(frame, self._rig):
            return prior_from_neighbours(self.state, px, self.appearance.last_px)
        focal, n = self._rig.cam0.focal, len(px)
        if frame.image1 is not None and self._rig.cam1 is not None:
            z = self._stereo_depth(frame.image0, frame.image1, px, ray)
            sigma = np.full(n, self._config.stereo_px / focal / self._rig.baseline)
            if self._rig.cam1.is_fisheye:
                sigma = self._config.stereo_px / disparity_per_rho(self._rig, ray, 1 / z)
        else:
            assert frame.depth is not None
            z = from_depth_camera(frame.depth, self._rig, ray)
            sigma = np.full(n, _DEPTH_SIGMA_PX / focal / _DEPTH_BASELINE_M)
        return DepthPrior(1 / z, sigma, np.zeros((n, 0)), np.zeros(n))

    def _stereo_depth(self, image0: U8, image1: U8, px: F32, ray: F64) -> F64:
        """m (N,), NaN where the pair does not agree on one: the clearest place on each line, then to a
        fraction of a pixel."""
        coarse = epipolar.search_depth(image0, image1, self._rig, px, ray)
        out, found = np.full(len(px), np.nan), np.flatnonzero(~np.isnan(coarse))
        z = from_stereo(image0, image1, self._rig, px[found], ray[found], coarse[found])
        error_px = np.abs(1 / z - 1 / coarse[found]) * self._rig.cam0.focal * self._rig.baseline
        if self._rig.cam0.is_fisheye:
            error_px = np.abs(1 / z - 1 / coarse[found]) * disparity_per_rho(
                self._rig, ray[found], 1 / coarse[found]
            )
        out[found] = np.where(error_px < _MAX_DISPARITY_ERROR_PX, z, np.nan)
        return out

    def reactivate(self, frame: Frame, rate: F64) -> F32:
        """Features seen from about here before, where the frame just tracked shows them as near as the filter
        knows: px (M, 2)."""
        s, config, old_count = self.state, self._config, len(self.state.feature_ids)
        dormant = self._dormant.nearby(s, self._rig.cam0, config.recall_m, config.recall_rad, config.recall)
        if dormant is None:
            return np.zeros((0, 2), np.float32)
        state_augmentation.add_features(
            s, dormant.ids, dormant.anchor, dormant.ray, dormant.rho, dormant.sigma
        )
        self.appearance = self.appearance.concatenate(dormant.appearance)
        recognised = self._is_recognised(frame, rate, old_count)
        self._dormant.reactivate(s.feature_ids[recognised][old_count:])
        self.keep_features(recognised)
        return self.appearance.last_px[old_count:]

    def _is_recognised(self, frame: Frame, rate: F64, start: int) -> NDArray[np.bool_]:
        """Of features from number `fresh` on, those that are found where they should be; all others."""
        matches = feature_matching.match_features(
            frame, self._rig, self.state, self.appearance, self._config, start
        )
        self.appearance.last_px[matches.is_found] = matches.px[matches.is_found]
        rows = self.cam0_measurements(matches.at, np.flatnonzero(matches.is_found), rate)
        recognised = np.arange(len(self.state.feature_ids)) < start
        if len(rows.feature):
            _, S = filter.innovation_covariance(self.state, rows)
            recognised[rows.feature[filter.nis(rows, S) < self._config.gate]] = True
        return recognised

    def keep_features(self, keep: NDArray[np.bool_]) -> None:
        """The other features (N,) are forgotten."""
        if not keep.all():
            state_augmentation.keep_features(self.state, keep)
            self.appearance = self.appearance.take(keep)

    def drop_dormant(self) -> None:
        """What is out of sight was remembered for nothing."""
        self._dormant = DormantFeatures()

    def forget(self, held: tuple[int, ...] = ()) -> None:
        """Keyframes whose features are all gone, and, where there are too many, the most redundant ones.
        Never the newest two, nor those with ids in `held`: others are told of the motion between them."""
        s = self.state
        busy = np.isin(np.arange(len(s.keyframe_ids)), s.anchor)
        leave = ~busy & ~self._dormant.has_features(s.keyframe_ids)
        stay = np.isin(s.keyframe_ids, held)
        stay[-2:] = True
        leave &= ~stay
        while len(s.keyframe_ids) - leave.sum() > self._config.max_keyframes:
            left = np.flatnonzero(~leave)
            distance, angle = se3.pairwise_distances(s.keyframe_poses[left], s.keyframe_poses[left])
            cost = distance + angle
            cost[np.diag_indices(len(left))] = np.inf
            nearest = cost.min(axis=1) + _ACTIVE_FEATURES_COST * busy[left]
            nearest[stay[left]] = np.inf
            if not np.isfinite(nearest).any():
                break
            leave[left[np.argmin(nearest)]] = True
        if not leave.any():
            return
        self._dormant.drop_keyframes(s.keyframe_ids[leave])
        self.appearance = self.appearance.take(~leave[s.anchor])
        state_augmentation.drop_keyframes(s, s.keyframe_ids[leave])
