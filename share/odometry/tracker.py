"""Odometry by cameras and IMU: a headset's own.

A frame's way: IMU -> propagate -> where features should be -> find them by their patches -> gate ->
update. After its pose is out, a keyframe (`keyframes`).
Without the IMU the body is taken to go on as it does, without sight the IMU carries it for a while.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig, TrackerConfig
from share.geometry import se3
from share.geometry.camera import ImuBias, ImuNoise, Rig
from share.odometry import filter, measurement, outliers, relocalisation
from share.odometry.features import Looks
from share.odometry.imu_buffer import Samples, coasting, mean_rate, unclipped
from share.odometry.imu_outliers import Doubt
from share.odometry.imu_propagation import integrate, louder, shaken, without
from share.odometry.initialisation import (
    converged,
    first_state,
    learnt_bias,
    state_by_camera,
    unknown_bias,
    waits_for,
    worth_telling,
)
from share.odometry.keyframes import Keyframes
from share.odometry.landmarks import Scene
from share.odometry.mono_initialisation import Window, window_for, without_force
from share.odometry.outliers import Agreement, Straying, trusted
from share.odometry.pivot import Pivot
from share.odometry.relocalisation import LocalMap
from share.odometry.result import TrackResult, median, typical
from share.odometry.state import State
from share.types import F64, Candidate, Footing, Frame, ImuBatch, TrackState, Wait
from share.vision import corners
from share.vision.orb import measures_depth

_FAR_OFF_PX = 1.0  # median residual, from which derivatives are taken anew
_MINORITY, _MAJORITY = 0.3, 0.7  # of what is found: believed by the filter; agreeing among itself
_GAP_NS = 250_000_000  # between frames: more than an IMU of this sort is modelled for,
_DOUBT = 0.02, 0.1, 0.3  # rad, m, m/s: how wrong the filter may be after it that believes nobody
_REST_RATE, _REST_M_S = 0.03, 0.02  # rad/s of a body at rest; m/s of its velocity
_SLOW_M_S = 0.3  # a smooth ride looks like rest to an IMU, but not to a filter that knows it moves
_PATIENCE = 10  # frames without a sample of the IMU, after which we begin without
_LEVEL_RAD = np.radians(3.0)  # sigma of tilt up to which others are told what is up


class InertialTracker:
    """Feed frames in order to `track`. Deterministic: the same frames give the same poses."""

    def __init__(
        self,
        rig: Rig,
        config: InertialConfig,
        places: TrackerConfig,
        seed: int = 0,
        bias: ImuBias | None = None,
    ) -> None:
        """bias: of the IMU, where a run before has learnt it."""
        if rig.imu is None:
            raise ValueError("without an IMU there is VisualTracker")
        self._rig, self._config = rig, config
        self._bias = unknown_bias(config) if bias is None else bias
        self._noise = louder(rig.imu, config.imu_noise)
        self._coasting = ImuNoise(config.turning_noise, config.moving_noise, 0.0, 0.0, rig.imu.rate_hz)
        self._common = np.diag(np.repeat([config.common_rad**2, config.common_m**2], 3))
        self._samples = Samples()
        self._scene: Scene | None = None
        self._window: Window | None = None  # of a single camera, until its scale is known
        self._last: Frame | None = None
        self._stamp_ns = 0
        self._settled = True  # what there was to do after the last frame
        self._rate = np.zeros(3)
        self._straying = Straying(config.weak, config.blind)
        self._agreement, self._surprise = Agreement(), np.zeros(0)  # of the frame
        self._waited = 0  # frames, for the IMU
        self._begun_ns, self._begun_at = 0, np.zeros(3)
        self._ready = False
        self._knows_up = False  # the IMU said so
        self._new_stretch = False  # the next keyframe begins one
        self._keyframes, self._pivot = Keyframes(rig, config, places.view_features), Pivot()
        self._places = LocalMap(places.max_keyframes)  # where to look for oneself when LOST
        self._places_config, self._seed = places, seed
        self._turns = relocalisation.Turns(places.relocalise_hosts)
        self._lost_ns: int | None = None

    @property
    def state(self) -> State | None:
        """The filter's; for those who look into it."""
        return self._scene.state if self._scene else None

    @property
    def bias(self) -> ImuBias | None:
        """Of the IMU, as the filter knows it now; None where that is not worth remembering."""
        if self._scene is None or not (self._ready and self._knows_up and self._agreement.sound):
            return None
        return learnt_bias(self._scene.state, self._config)

    @property
    def looks(self) -> Looks | None:
        """Of the state's features."""
        return self._scene.looks if self._scene else None

    def track(self, frame: Frame) -> TrackResult:
        """The pose of this frame, causal. Frames must come with rising stamps."""
        self.settle()
        self._samples.add(frame.imu)
        result = self._begin(frame) if self._scene is None else self._follow(frame, self._scene)
        self._last, self._stamp_ns, self._settled = frame, frame.stamp_ns, False
        return result

    def keyframe(self, frame: Frame) -> Candidate:
        """What there is to show to others; call it where `track` said so of this frame. It is of this frame,
        or of one shortly before, whose view was made meanwhile."""
        assert self._scene is not None
        new_stretch, self._new_stretch = self._new_stretch, False
        view, T, unsure, T_last_body, cov, ago = self._keyframes.show(self._scene, new_stretch)
        up = T[2, :3] if self._knows_up and unsure < _LEVEL_RAD else np.zeros(3)
        sigma = unsure / np.sqrt(2)
        return Candidate(self._pivot.told(T), T_last_body, cov, up, sigma, view, new_stretch, ago)

    def settle(self) -> None:
        """A slice of what keyframes leave to do, and nobody waits for: new features, and places to find
        oneself by. For when the pose, and the candidate if there is one, are on their way; else the next
        `track` does it first."""
        if self._scene is None or self._last is None or self._settled:
            return
        self._settled = True
        s, done = self._scene.state, self._keyframes.settle(self._scene, self._last, self._rate)
        if done is not None and not self._straying.suspected:
            T_odom_body = s.poses[filter.number_of(s, done.keyframe)]
            self._places.add_keyframe(done.frame.image0, T_odom_body @ s.T_body_cam)
            self._places.set_view(done.view)

    def footing(self) -> Footing:
        """Of the own frame of the keyframe that is due; where none is, of the frame just tracked, one with a
        pose."""
        assert self._scene is not None
        return self._keyframes.footing or self._scene.footing()

    def give_up(self, frame: Frame) -> None:
        """Something failed in or after `frame`, the last: the filter may be in any state."""
        self._window = None
        self._lose(frame)
        self._last, self._stamp_ns = frame, frame.stamp_ns

    @property
    def doubted(self) -> int:
        """How many samples of the IMU were not believed."""
        return self._samples.doubted

    def predict(self, t_ns: int, imu: ImuBatch | None = None) -> F64 | None:
        """T_odom_body (4, 4) at a time after the last frame's, IMU time: for renderers, between frames.

        imu: samples that came since that frame, if there are any. From the last one on the body is taken to
        turn and to accelerate as it did then. None where there is no pose to go on from.
        """
        if self._scene is None or not self._ready:
            return None
        s, known = self._scene.state, self._samples.with_more(imu or ImuBatch.empty())
        silent_ns, gravity = round(self._config.silent_s * 1e9), self._config.gravity
        heard = known.between(s.stamp_ns, min(t_ns, known.last_ns), silent_ns)
        going_on = coasting(s, self._rate, t_ns, gravity) if heard is None else heard
        then = integrate(s.T, s.v, s.bg, s.ba, going_on, s.stamp_ns, t_ns, self._noise, gravity)
        return self._pivot.told(then.T)

    # ------------------------------------------------------------------ the usual frame

    def _follow(self, frame: Frame, scene: Scene) -> TrackResult:
        before, imu = scene.state.T, self._heard(frame, scene.state)
        doubt = self._samples.doubt(scene.state.stamp_ns, self._taken_ns(frame, scene.state))
        doubted = doubt is not None and bool(doubt.axes.any())
        since_s = (frame.stamp_ns - self._stamp_ns) * 1e-9
        measured = self._propagate(frame, scene.state, imu, doubt)
        scene.step(since_s)
        left, seen = self._look(frame, scene)
        heard = imu is not None and not (doubted and self._ready)
        if measured and self._window is None:
            self._agreement.add(self._surprise, since_s)
        scene.seen(left, seen)
        if not measured:
            self._rate = mean_rate(before, scene.state.T, frame.stamp_ns - self._stamp_ns)
        count = int(seen.sum())
        textured = count >= self._config.blind or corners.count(frame.image0) >= self._config.weak
        self._straying.add(textured, left.due(self._rig.cam0), int(left.found.sum()), count, since_s)
        state = self._judge(scene.state, count, heard)
        if not trusted(scene.state, self._config) or self._straying.certain:
            return self._lose(frame)
        if state is TrackState.LOST:
            return TrackResult(state, None)
        wanted = textured and self._keyframes.wanted(frame.stamp_ns, scene.state.T, count)
        if state is TrackState.INITIALISING:
            if wanted:
                self._keyframes.anchor(frame, scene, self._rate)
            if not self._solved(frame, scene, wanted):
                return self._initialising(scene.state)
            state, wanted = TrackState.OK, True
        told = self._told(frame, scene, state, wanted, count)
        return replace(told, found=int((left.found | seen).sum()), surprise=typical(self._surprise))

    def _solved(self, frame: Frame, scene: Scene, anchored: bool) -> bool:
        """Whether what a single camera saw since the beginning has told it the scale, and all that poses
        need."""
        window, s = self._window, scene.state
        if window is None or not (anchored or window.wants(s.stamp_ns)):
            return False
        imu = self._samples.between(window.last_ns, s.stamp_ns, round(self._config.silent_s * 1e9))
        if imu is None or window.full or measures_depth(frame, self._rig):
            self._scene = self._window = None  # begin anew
            return False
        return window.solved(scene, imu, anchored) and converged(s)

    def _told(self, frame: Frame, scene: Scene, state: TrackState, wanted: bool, count: int) -> TrackResult:
        s = scene.state
        first, self._ready, self._window = not self._ready, True, None
        new_stretch = first and self._new_stretch
        if first:
            self._pivot.begin(s, self._begun_at, new_stretch)
        else:
            self._pivot.after(s)
        pose, cov = self._pose(s), filter.pose_cov(s)
        if wanted or first:
            to_show = not first and self._keyframes.may_show(frame.stamp_ns)
            self._keyframes.begin(frame, scene, self._rate, count < self._config.weak, to_show)
            if first:
                self._keyframes.show_at_once(scene)
        is_due = self._keyframes.is_due
        return TrackResult(state, pose, is_due, count, new_stretch, cov, self._agreement.sound)

    def _look(self, frame: Frame, scene: Scene) -> tuple[measurement.Sought, NDArray[np.bool_]]:
        """Where cam0 shows the features, and which (N,) were seen and believed."""
        sought = measurement.seek(frame, self._rig, scene.state, scene.looks, self._config)
        if self._last is not None:
            measurement.rescue(
                self._last.image0, frame.image0, self._rig.cam0, scene.looks, sought, self._config
            )
        scene.mark_movers(sought, self._rate)
        return sought, self._update(frame, scene, sought)

    def _heard(self, frame: Frame, s: State) -> ImuBatch | None:
        """What the IMU said until the image was taken; None if it was silent."""
        to_ns = self._taken_ns(frame, s)
        if to_ns <= s.stamp_ns:
            return ImuBatch.empty()
        return self._samples.between(s.stamp_ns, to_ns, round(self._config.silent_s * 1e9))

    def _propagate(self, frame: Frame, s: State, imu: ImuBatch | None, doubt: Doubt | None) -> bool:
        """To when the image was taken; without an IMU, as the body went before. Whether the IMU measured how
        it turns. doubt: of these samples."""
        to_ns, gravity = self._taken_ns(frame, s), self._config.gravity
        if to_ns <= s.stamp_ns:
            return True
        if imu is None:
            filter.propagate(s, coasting(s, self._rate, to_ns, gravity), to_ns, self._coasting, gravity)
            return False
        if self._window is not None:
            noise = without(self._noise, self._coasting, np.arange(6) >= 3)
            self._rate = filter.propagate(s, without_force(s, imu, to_ns, gravity), to_ns, noise, gravity)
            return True
        clipped = self._samples.clipped(imu)
        silent = clipped if doubt is None else clipped | doubt.axes
        noise = shaken(self._noise, self._samples.latest(to_ns))
        noise = without(noise, self._coasting, silent)
        imu = unclipped(imu, clipped[:3], self._rate + s.bg)
        self._rate = filter.propagate(s, imu, to_ns, noise, gravity)
        if doubt is not None:
            filter.doubt(s, doubt.turn, 0.0, doubt.speed)
            return not silent[:3].any()
        slow = np.linalg.norm(self._rate) < _REST_RATE and np.linalg.norm(s.v) < _SLOW_M_S
        if slow and self._samples.still(to_ns):
            filter.rest(s, _REST_M_S, self._config.gate)
        return not silent[:3].any()

    def _taken_ns(self, frame: Frame, s: State) -> int:
        """When the image was taken, IMU time."""
        return frame.stamp_ns + round(s.offset_s * 1e9)

    def _update(self, frame: Frame, scene: Scene, sought: measurement.Sought) -> NDArray[np.bool_]:
        """Which features (N,) were seen and believed."""
        s = scene.state

        def rows_now() -> filter.Sight:
            return scene.heard(sought, self._rate)

        seen, self._surprise = sought.found & ~sought.astray, np.zeros(0)
        rows = rows_now()
        if len(rows.which) == 0:
            return seen
        rows, good, HP, S = self._judged(s, rows, rows_now)
        gap = frame.stamp_ns - self._stamp_ns > _GAP_NS
        if (
            (gap and good.mean() < _MINORITY) or (self._samples.odd(s.stamp_ns) and good.mean() < _MAJORITY)
        ) and self._agreed(s, sought):
            filter.doubt(s, *_DOUBT)
            rows, good, HP, S = self._judged(s, rows, rows_now)
        if good.all():
            filter.update(s, rows, HP, S)
        elif good.any():
            twice = np.flatnonzero(np.repeat(good, 2))
            filter.update(s, rows.take(good), HP.take(twice, axis=0), filter.square(S, twice))
        seen[rows.which[~good]] = False
        return seen

    def _judged(
        self, s: State, rows: filter.Sight, rows_now: Callable[[], filter.Sight]
    ) -> tuple[filter.Sight, NDArray[np.bool_], filter.Gain, filter.Gain]:
        """Rows at the best linearisation, which of them the filter believes, and its `ekf.gains`."""
        if median(np.abs(rows.residual).ravel()) * self._rig.cam0.focal > _FAR_OFF_PX:
            rows = filter.relinearised(s, rows_now, self._common)
        HP, S = filter.gains(s, rows, self._common)
        self._surprise = filter.surprise(rows, S)
        believed = np.ones(len(s.ids), bool)
        believed[rows.which[self._surprise >= self._config.gate]] = False  # one camera's doubt is enough
        return rows, believed[rows.which], HP, S

    def _agreed(self, s: State, left: measurement.Sought) -> bool:
        """Whether nearly all that cam0 shows agrees among itself."""
        which = np.flatnonzero(left.found & ~left.astray)
        if len(which) < self._config.weak:
            return False
        return bool(outliers.by_votes(s, which, left.px[which], self._rig.cam0).mean() > _MAJORITY)

    def _judge(self, s: State, count: int, heard: bool) -> TrackState:
        config = self._config
        if self._window is not None or (heard and not self._ready and not self._is_ready(s)):
            return TrackState.INITIALISING
        if count < config.blind:
            return TrackState.INERTIAL_ONLY if heard else TrackState.LOST
        if not heard:
            return TrackState.VISION_ONLY
        return TrackState.OK if count >= config.weak else TrackState.WEAK

    def _is_ready(self, s: State) -> bool:
        """For a first pose. What moves in the view must not be all that the velocity is known by."""
        waited_s = (s.stamp_ns - self._begun_ns) * 1e-9
        return self._is_static() and worth_telling(s, waited_s, self._new_stretch)

    def _is_static(self) -> bool:
        return self._scene is None or self._scene.is_static(self._config.weak // 2)

    def _initialising(self, s: State) -> TrackResult:
        waits = Wait.SCALE if self._window is not None else waits_for(s) if self._is_static() else Wait.VIEW
        return TrackResult(TrackState.INITIALISING, None, waits=waits)

    def _pose(self, s: State) -> F64:
        """At the frame's stamp, IMU time: the state is where the image was taken."""
        if s.offset_s == 0:
            return self._pivot.told(s.T)
        return self._pivot.told(se3.exp(-filter.twist(s, self._rate) * s.offset_s) @ s.T)

    # ------------------------------------------------------------------ beginnings and losses

    def _begin(self, frame: Frame) -> TrackResult:
        """At odom's origin, z up. After a loss, where the map says; at last anew."""
        found = self._find_place(frame)
        waiting = TrackState.INITIALISING if self._lost_ns is None else TrackState.LOST
        lost_ns = 0 if self._lost_ns is None else frame.stamp_ns - self._lost_ns
        if found is None and 0 < lost_ns < self._places_config.new_stretch_s * 1e9:
            return TrackResult(waiting, None)
        state = first_state(frame.stamp_ns, self._samples.all, self._rig, self._config, self._bias)
        self._waited += state is None
        self._knows_up = state is not None
        if state is None and self._waited >= _PATIENCE:
            state = state_by_camera(frame.stamp_ns, self._rig, self._config, self._bias)
        if state is None:
            return TrackResult(waiting, None, waits=Wait.IMU)
        if found is not None:
            state.T = found @ se3.inverse(self._rig.T_body_cam0)
        scene = Scene(state, self._rig, self._config)
        self._rate = self._samples.all.gyro[-1] - state.bg if len(self._samples.all) else np.zeros(3)
        self._keyframes.anchor(frame, scene, self._rate)
        if len(state.ids) < self._config.weak:
            return TrackResult(waiting, None, waits=Wait.VIEW)
        self._scene, self._ready = scene, False
        self._begun_ns, self._begun_at = state.stamp_ns, state.T[:3, 3].copy()  # by the IMU's clock
        self._window = window_for(state, self._rig.cam0, self._noise, self._config, self._common)
        self._new_stretch = found is None
        if found is None:
            self._places = LocalMap(self._places_config.max_keyframes)
        self._lost_ns = None
        if self._window is not None or not self._is_ready(state):
            return self._initialising(state)
        return self._told(frame, scene, TrackState.OK, True, len(state.ids))

    def _lose(self, frame: Frame) -> TrackResult:
        """What is left of the filter is worth nothing."""
        self._scene, self._straying = None, Straying(self._config.weak, self._config.blind)
        self._keyframes.forget()
        if self._window is not None:  # there was nothing to lose
            return TrackResult(TrackState.INITIALISING, None, waits=Wait.SCALE)
        self._ready, self._lost_ns = False, frame.stamp_ns
        return TrackResult(TrackState.LOST, None)

    def _find_place(self, frame: Frame) -> F64 | None:
        """T_odom_cam (4, 4) of a LOST frame by its ORB features."""
        if self._lost_ns is None or not self._places.keyframes:
            return None
        turn = self._turns.next(sorted(self._places.keyframes, reverse=True))
        chosen = [self._places.keyframes[n] for n in turn]
        return relocalisation.find(chosen, frame, self._rig, self._places_config, self._seed)
