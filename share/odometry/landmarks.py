"""The filter's state with what its features look like: what is added, forgotten, remembered, woken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Rig, rays
from share.odometry import features, filter, measurement, outliers
from share.odometry.depth_prior import Guess, guess
from share.odometry.dormant_features import Memory
from share.odometry.features import Looks
from share.odometry.measurement import Prediction, Sought
from share.odometry.state import State
from share.types import F32, F64, I64, U8, Footing, Frame
from share.vision import corners, epipolar
from share.vision.depth import disparity_px, from_depth_camera, from_stereo
from share.vision.mask import within
from share.vision.orb import measures_depth

_DEPTH_SIGMA_PX, _DEPTH_BASELINE = 0.3, 0.05  # of the stereo pair inside a depth camera, m
_NOISE = 3.0  # gray levels of an image
_SHARPEST_PX = 0.5  # error by noise alone, beyond which a patch is no feature
_SAME_PLACE_PX = 2.0  # of disparity
_SHUN_FRAMES = 30  # for which nothing new is sought where something moved by itself
_CROWD, _WARY_FRAMES = 5, 60  # features at a time that went astray: somebody moves in the view
_PROBATION_S, _UNPROVEN = 0.34, 5.0  # in which a feature proves itself, and times its sigma until then
_SLANT_EVERY = 4  # frames in which a feature's slant is learnt
_FARTHEST, _NEAREST_M = 0.03, 0.2  # 1/m; m
_VAGUE = 0.05  # 1/m, sigma; half a pixel a frame of somebody who walks
_SURE = 0.1  # relative sigma of an inverse depth that others are told
_FAR = 100.0  # redundancy that features in view are worth


class Scene:
    """Keyframes, features and their looks, always in step with `state`."""

    def __init__(self, state: State, rig: Rig, config: InertialConfig) -> None:
        self.state, self._rig, self._config = state, rig, config
        self.looks: Looks = features.none()
        self._memory = Memory()
        self._shunned: list[F32] = []
        self._probation = 0  # frames that _PROBATION_S are
        self._wary = 0  # frames for which new features have to prove themselves
        self._next_feature = self._next_keyframe = 0
        self._last: tuple[Sought, NDArray[np.bool_], I64] | None = None  # frame: sought, believed, their ids

    def add_keyframe(self, rate: F64) -> int:
        """The frame just tracked: its pose. Its id."""
        filter.add_keyframe(self.state, self._next_keyframe, rate)
        self._next_keyframe += 1
        return self._next_keyframe - 1

    def step(self, seconds: float) -> None:
        """Since the frame before."""
        self._probation = int(_PROBATION_S / max(seconds, 1e-3))

    def seen(self, left: Sought, seen: NDArray[np.bool_]) -> None:
        """Which features (N,) a frame showed. The others are gone, or asleep where they were not found."""
        self.looks.px[left.found] = left.px[left.found]
        self.looks.age[seen] += 1
        which = np.flatnonzero(seen & ~self._vague())
        away = which[features.runaways(self.looks, which, left.px[which] - left.expected[which])]
        seen[away] = False
        left.astray[away] = True
        self._shun(left.px[left.astray])
        self._wary = _WARY_FRAMES if left.astray.sum() >= _CROWD else max(self._wary - 1, 0)
        now = np.flatnonzero(seen & (features.turn(self.looks) % _SLANT_EVERY == 0))
        features.learn_slant(self.looks, now, left.samples[now], left.along[now])
        self._memory.sleep(self.state, self.looks, np.flatnonzero(~left.found))
        self.keep(seen)
        self._last = left, seen, self.state.ids

    def depths(self, frame: Frame) -> tuple[F32, F64]:
        """px (N, 2) and depth (N,) m of the features in `frame`, the last one; only of those whose depth is
        known well, where nothing else in the frame tells."""
        sure = self._is_sure() | measures_depth(frame, self._rig)
        return self.looks.px[sure], self._distance()[sure]

    def footing(self) -> Footing:
        """Of the last frame; nothing for the first one, whose pose rests on nothing it shows."""
        sure = self._is_sure()
        if self._last is None:
            return Footing(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0), 0, int(sure.sum()))
        left, seen, ids = self._last
        depth = np.full(len(seen), np.nan)
        _, was, now = np.intersect1d(ids, self.state.ids, return_indices=True)  # it may be a keyframe by now
        depth[np.flatnonzero(seen)[was]] = np.where(sure, self._distance(), np.nan)[now]
        found = left.found | seen
        return Footing(left.px[found], seen[found], depth[found], left.due(self._rig.cam0), int(sure.sum()))

    def _distance(self) -> F64:
        """z (N,) m in cam0 of the features."""
        s = self.state
        T = measurement.hosts_in_camera(s)
        z = (T[:, 2, :3] * rays(s.ray)).sum(axis=1) / np.maximum(s.rho, _FARTHEST) + T[:, 2, 3]
        out: F64 = np.maximum(z, _NEAREST_M)
        return out

    def _is_sure(self) -> NDArray[np.bool_]:
        """Which features' depth (N,) is known well."""
        out: NDArray[np.bool_] = self.state.rho_variance < (_SURE * self.state.rho) ** 2
        return out

    def _shun(self, px: F32) -> None:
        """No new feature near px (N, 2) for a while: there goes somebody."""
        self._shunned = [*self._shunned[-_SHUN_FRAMES:], px]

    def mark_movers(self, sought: Sought, rate: F64) -> None:
        """What moves by itself is astray; looked for only where the IMU alone does not explain the image."""
        which = np.flatnonzero(sought.found)
        camera, config = self._rig.cam0, self._config
        residual = camera.evened(sought.at[which]) - camera.evened(sought.uv[which])
        if len(which) == 0 or outliers.as_expected(
            residual * camera.focal, config.sigma_px, config.lasting_px
        ):
            return
        rows = self.sight(sought.at, which, rate)
        fixed = outliers.of_the_room(self.state, rows, sought.px[which], self.proven(which), camera)
        sought.astray[which[~fixed]] = True

    def sight(self, uv: F64, which: I64, rate: F64) -> filter.Sight:
        """Rows for the filter of features `which` (M,) of those at uv (N, 2) in cam0."""
        return self._rows(which, uv[which], None, rate)

    def heard(self, sought: Sought, rate: F64) -> filter.Sight:
        """Rows of all that was seen in a frame's images, sorted by host; as the state is now."""
        heard = sought.found & ~sought.astray
        which, right = np.flatnonzero(heard), None
        at = sought.at[which]
        if (there := sought.right) is not None:
            both = heard[there.which]
            more = there.which[both]
            right = np.arange(len(which) + len(more)) >= len(which)
            which, at = np.concatenate([which, more]), np.concatenate([at, there.at[both]])
        order = np.argsort(self.state.host[which], kind="stable")
        right = None if right is None else right[order]
        return self._with_doubt(self._rows(which[order], at[order], right, rate))

    def _rows(self, which: I64, uv: F64, right: NDArray[np.bool_] | None, rate: F64) -> filter.Sight:
        """Of features `which` (M,) seen at uv (M, 2), in cam1 where `right` (M,) says so."""
        T = None if right is None else self._rig.T_cam1_cam0
        focal = np.full(len(which), self._rig.cam0.focal)
        if right is not None and self._rig.cam1 is not None:
            focal[right] = self._rig.cam1.focal
        seen = measurement.predict(self.state, which, T, right)
        if self._rig.cam0.fisheye:
            seen, uv = self._evened(seen, uv, np.zeros(len(which), bool) if right is None else right)
        sigma, lasting = self._config.sigma_px / focal, self._config.lasting_px / focal
        return filter.sight(self.state, which, seen, uv, sigma, lasting, rate)

    def _evened(self, seen: Prediction, uv: F64, right: NDArray[np.bool_]) -> tuple[Prediction, F64]:
        """Both in the image planes of fisheye lenses, where a pixel is as much everywhere."""
        uv = uv.copy()
        for camera, mine in ((self._rig.cam0, ~right), (self._rig.cam1, right)):
            if camera is not None and mine.any():
                uv[mine] = camera.evened(uv[mine])
                seen = measurement.evened(seen, camera, mine)
        return seen, uv

    def _with_doubt(self, rows: filter.Sight) -> filter.Sight:
        """While somebody moves in the view, what is new in it counts little."""
        if self._wary == 0:
            return rows
        unproven = ~self.proven(rows.which)
        times = np.where(unproven, _UNPROVEN, 1.0)
        return replace(rows, sigma=times * rows.sigma, lasting=times * rows.lasting)

    def proven(self, which: I64) -> NDArray[np.bool_]:
        """Which of features `which` (M,) have long done as they should."""
        out: NDArray[np.bool_] = self.looks.age[which] >= self._probation
        return out

    def is_static(self, fewest: int) -> bool:
        """False while something moves in the view and fewer than `fewest` features have proven not to."""
        return self._wary == 0 or int(self.proven(np.arange(len(self.state.ids))).sum()) >= fewest

    def _vague(self) -> NDArray[np.bool_]:
        """Which features' depth (N,) is hardly known, nor therefore where they should be."""
        out: NDArray[np.bool_] = self.state.rho_variance > _VAGUE**2
        return out

    def taken(self) -> F32:
        """px (M, 2) of the frame just tracked, near which nothing new is sought."""
        return np.concatenate([self.looks.px, *self._shunned])

    def corners(self, frame: Frame, taken: F32) -> F32:
        """px (N, 2) of what may become features of a keyframe, away from those `taken` (M, 2), the most
        wanted first."""
        more = self._config.features if self._room() else 0
        return corners.detect(frame.image0, taken, more, self._config.spacing_px, within(self._rig.cam0))

    def admit(self, frame: Frame, keyframe: int, px: F32) -> None:
        """New features at px (N, 2) of the frame that is the keyframe with that id; the last frame may be a
        later one."""
        host, room = filter.number_of(self.state, keyframe), self._room()
        self._add_features(frame, host, px[:room])

    def _room(self) -> int:
        """For so many features more."""
        return max(self._config.features - len(self.state.ids), 0)

    def _add_features(self, frame: Frame, host: int, px: F32) -> None:
        camera, s = self._rig.cam0, self.state
        ray = camera.normalise(px.astype(np.float64))
        far = self._inverse_depths(frame, px, ray)
        looks = features.looks(frame.image0, camera, px, ray, np.nan_to_num(far.rho))
        good = ~np.isnan(far.rho) & (_NOISE * looks.patch.sigma_px < _SHARPEST_PX)
        ids = np.arange(self._next_feature, self._next_feature + int(good.sum()))
        self._next_feature += len(ids)
        far = far.take(good)
        before = len(s.ids)
        filter.add_features(
            s, ids, np.full(len(ids), host), ray[good], far.rho, far.sigma, far.like, far.common
        )
        self.looks = self.looks.join(looks.take(good))
        here = camera.distort(measurement.predict(s, np.arange(before, before + len(ids))).uv)
        self.looks.px[before:] = np.where(np.isnan(here), px[good], here)  # in the last frame

    def _inverse_depths(self, frame: Frame, px: F32, ray: F64) -> Guess:
        """Of new features, NaN unknown: measured, or else guessed."""
        if not measures_depth(frame, self._rig):
            return guess(self.state, px, self.looks.px)
        focal, n = self._rig.cam0.focal, len(px)
        if frame.image1 is not None and self._rig.cam1 is not None:
            z = self._stereo_depth(frame.image0, frame.image1, px, ray)
            sigma = np.full(n, self._config.stereo_px / focal / self._rig.baseline)
            if self._rig.cam1.fisheye:
                sigma = self._config.stereo_px / disparity_px(self._rig, ray, 1 / z)
        else:
            assert frame.depth is not None
            z = from_depth_camera(frame.depth, self._rig, ray)
            sigma = np.full(n, _DEPTH_SIGMA_PX / focal / _DEPTH_BASELINE)
        return Guess(1 / z, sigma, np.zeros((n, 0)), np.zeros(n))

    def _stereo_depth(self, image0: U8, image1: U8, px: F32, ray: F64) -> F64:
        """m (N,), NaN where the pair does not agree on one: the clearest place on each line, then to a
        fraction of a pixel."""
        about = epipolar.search(image0, image1, self._rig, px, ray)
        out, clear = np.full(len(px), np.nan), np.flatnonzero(~np.isnan(about))
        z = from_stereo(image0, image1, self._rig, px[clear], ray[clear], about[clear])
        off_px = np.abs(1 / z - 1 / about[clear]) * self._rig.cam0.focal * self._rig.baseline
        if self._rig.cam0.fisheye:
            off_px = np.abs(1 / z - 1 / about[clear]) * disparity_px(self._rig, ray[clear], 1 / about[clear])
        out[clear] = np.where(off_px < _SAME_PLACE_PX, z, np.nan)
        return out

    def wake(self, frame: Frame, rate: F64) -> F32:
        """Features seen from about here before, where the frame just tracked shows them as near as the filter
        knows: px (M, 2)."""
        s, config, fresh = self.state, self._config, len(self.state.ids)
        asleep = self._memory.near(s, self._rig.cam0, config.recall_m, config.recall_rad, config.recall)
        if asleep is None:
            return np.zeros((0, 2), np.float32)
        filter.add_features(s, asleep.ids, asleep.host, asleep.ray, asleep.rho, asleep.sigma)
        self.looks = self.looks.join(asleep.looks)
        good = self._recognised(frame, rate, fresh)
        self._memory.wake(s.ids[good][fresh:])
        self.keep(good)
        return self.looks.px[fresh:]

    def _recognised(self, frame: Frame, rate: F64, fresh: int) -> NDArray[np.bool_]:
        """Of features from number `fresh` on, those that are found where they should be; all others."""
        sought = measurement.seek(frame, self._rig, self.state, self.looks, self._config, fresh)
        self.looks.px[sought.found] = sought.px[sought.found]
        rows = self.sight(sought.at, np.flatnonzero(sought.found), rate)
        good = np.arange(len(self.state.ids)) < fresh
        if len(rows.which):
            _, S = filter.gains(self.state, rows)
            good[rows.which[filter.surprise(rows, S) < self._config.gate]] = True
        return good

    def keep(self, keep: NDArray[np.bool_]) -> None:
        """The other features (N,) are forgotten."""
        if not keep.all():
            filter.keep_features(self.state, keep)
            self.looks = self.looks.take(keep)

    def forget_asleep(self) -> None:
        """What is out of sight was remembered for nothing."""
        self._memory = Memory()

    def forget(self, held: tuple[int, ...] = ()) -> None:
        """Keyframes whose features are all gone, and, where there are too many, the most redundant ones.
        Never the newest two, nor those with ids in `held`: others are told of the motion between them."""
        s = self.state
        busy = np.isin(np.arange(len(s.keyframes)), s.host)
        leave = ~busy & ~self._memory.has(s.keyframes)
        stay = np.isin(s.keyframes, held)
        stay[-2:] = True
        leave &= ~stay
        while len(s.keyframes) - leave.sum() > self._config.max_keyframes:
            left = np.flatnonzero(~leave)
            distance, angle = se3.apart(s.poses[left], s.poses[left])
            cost = distance + angle
            cost[np.diag_indices(len(left))] = np.inf
            nearest = cost.min(axis=1) + _FAR * busy[left]
            nearest[stay[left]] = np.inf
            if not np.isfinite(nearest).any():
                break
            leave[left[np.argmin(nearest)]] = True
        if not leave.any():
            return
        self._memory.forget(s.keyframes[leave])
        self.looks = self.looks.take(~leave[s.host])
        filter.drop_keyframes(s, s.keyframes[leave])
