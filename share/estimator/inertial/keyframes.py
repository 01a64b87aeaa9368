"""Keyframes of a headset's own odometry: when it wants one, what that shows to others, and the work that one
brings, in slices.

A keyframe's pose joins the filter's state at once. All else is done after the poses of this frame and the
next ones are out, one slice a frame (more where frames are rare), so that no frame waits for the whole of
it: the view that others are shown, if they are told of it, features seen from about here before, free
corners, and their depth. A view is told at a fixed frame, and what is new is sought from a fixed frame on,
however long a slice takes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from share.config import InertialConfig
from share.estimator.inertial import ekf
from share.estimator.inertial.readiness import tilt
from share.estimator.inertial.scene import Scene
from share.estimator.inertial.shown import Shown
from share.estimator.spacing import Spacing
from share.geometry.camera import Rig
from share.types import F32, F64, Frame, View
from share.vision.view import ViewInSteps

_SHOWN_GAP_NS = 400_000_000  # between keyframes that others are told of
_SLICE_NS = 30_000_000  # of the time between frames: two slices a frame at 15 Hz, one at 20 and at 30


class Showing(NamedTuple):
    """Of a keyframe: its view, its pose T (4, 4) and the sigma of what is up there, rad, as the filter knows
    them now; T_last_body (4, 4) since the one shown before, and its covariance (6, 6). frames_ago: how many
    frames have been tracked since its own."""

    view: View
    T: F64
    tilt: float
    T_last_body: F64
    cov: F64
    frames_ago: int


class Unsettled(NamedTuple):
    """A keyframe, by id, whose candidate was made, and that others are told of unless something fails."""

    frame: Frame
    keyframe: int
    view: View


@dataclass(eq=False)
class _Making:
    """Of the keyframe with id `number`, whose frame this is: px (N, 2) near which nothing new is sought, and
    of new corners; `ago` frames have been settled since. view: if others are to be told of it."""

    frame: Frame
    number: int
    taken: F32
    corners: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    ago: int = 0
    view: ViewInSteps | None = None
    is_due: bool = False  # what it shows is for the next who asks


Step = Callable[[_Making, Scene, Frame, F64], None]  # with the frame just tracked, and its rate
Slice = list[tuple[Step, _Making]]


class Keyframes:
    """Those of one tracker, newest last in its scene."""

    def __init__(self, rig: Rig, config: InertialConfig, view_features: int) -> None:
        self._rig, self._view_features = rig, view_features
        c = config
        self._newest = Spacing(c.keyframe_gap_s, c.keyframe_m, c.keyframe_rad, c.keyframe_seen)
        self._shown = Shown()
        self._shown_ns = self._settled_ns = 0
        self._unsettled: Unsettled | None = None
        self._newest_made: _Making | None = None
        self._showing: _Making | None = None  # of which others are told next
        self._slices: deque[Slice] = deque()

    def wanted(self, stamp_ns: int, T_odom_body: F64, seen: int) -> bool:
        """Whether a frame with so many features seen is to be one."""
        steps = (step for part in self._slices for step, _ in part)
        return self._admit not in steps and self._newest.wanted(stamp_ns, T_odom_body, seen)

    def anchor(self, frame: Frame, scene: Scene, rate: F64) -> None:
        """Make the frame just tracked one, all at once: where no pose is told yet. rate (3,): rad/s."""
        self.begin(frame, scene, rate, urgent=True)
        self._work(scene, frame, rate)

    def begin(self, frame: Frame, scene: Scene, rate: F64, urgent: bool, to_show: bool = False) -> None:
        """Make the frame just tracked one, if it is not: its pose; the rest is for `settle`, after what an
        earlier one still takes. to_show: others are to be told of it, when its view is made, which is what
        comes first. urgent: all new features with the next slice, for there is little to go by."""
        if frame.stamp_ns == self._newest.stamp_ns:
            return
        number = scene.add_keyframe(rate)
        self._newest.stamp_ns, self._newest.T = frame.stamp_ns, scene.state.T
        made = self._newest_made = _Making(frame, number, scene.taken())
        features: Slice = [(step, made) for step in (self._recall, self._corners, self._admit)]
        view: Slice = [(step, made) for step in (self._detect, self._describe)] if to_show else []
        if to_show:
            self._offer(scene)
        if not urgent:
            self._slices.extend([step] for step in [*view, *features])
            return
        if self._slices:
            self._slices[0][:0] = features
        else:
            self._slices.append(features)
        self._slices.extend([step] for step in view)

    def show_at_once(self, scene: Scene) -> None:
        """Others are to be told of the newest, which is the frame just tracked, now."""
        self._offer(scene).is_due = True

    def _offer(self, scene: Scene) -> _Making:
        made = self._showing = self._newest_made
        assert made is not None
        self._shown_ns = made.frame.stamp_ns
        made.view = ViewInSteps(made.frame, self._rig, self._view_features, scene.depths(made.frame))
        return made

    def may_show(self, stamp_ns: int) -> bool:
        """Whether it is time to tell others of one."""
        return self._showing is None and stamp_ns - self._shown_ns >= _SHOWN_GAP_NS

    @property
    def is_due(self) -> bool:
        """Whether there is one that others are to be told of now."""
        return self._showing is not None and self._showing.is_due

    def show(self, scene: Scene, new_stretch: bool) -> Showing:
        """The one that is due. Raises ValueError where none is."""
        made, s = self._showing, scene.state
        if made is None or made.view is None or not made.is_due:
            raise ValueError("no keyframe is due")
        view = made.view.finish()
        self._unsettled = Unsettled(made.frame, made.number, view)
        k = ekf.number_of(s, made.number)
        T_last_body, cov = self._shown.motion(s, k, new_stretch)
        return Showing(view, s.poses[k], tilt(s, s.keyframe(k)), T_last_body, cov, made.ago)

    def settle(self, scene: Scene, frame: Frame, rate: F64) -> Unsettled | None:
        """A slice of what is left to do, or as many as there is time for between frames, once a frame, of
        which `frame` is the last. The keyframe that was shown, if there was one."""
        done, self._unsettled = self._unsettled, None
        if done is not None:
            self._shown.told(scene.state, done.keyframe)  # not before: making its candidate might have failed
        if self._showing is not None:
            self._showing.ago += 1
            if self._showing.is_due:  # others have it, or nobody asked
                self._showing = None
        since_ns, self._settled_ns = frame.stamp_ns - self._settled_ns, frame.stamp_ns
        for _ in range(max(1, since_ns // _SLICE_NS)):
            if not self._slices:
                break
            self._work(scene, frame, rate)
        return done

    def forget(self) -> None:
        """The filter begins anew, and numbers its keyframes anew. What is left to do is void."""
        self._unsettled = self._newest_made = self._showing = None
        self._slices.clear()
        self._shown.forget()

    # ------------------------------------------------------------------ slices

    def _work(self, scene: Scene, last: Frame, rate: F64) -> None:
        for step, made in self._slices.popleft():
            step(made, scene, last, rate)

    def _recall(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        woken = scene.wake(last, rate)
        made.taken = np.concatenate([made.taken, woken])

    def _corners(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        made.corners = scene.corners(made.frame, made.taken)

    def _admit(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        held = self._shown.keyframe, -1 if self._showing is None else self._showing.number
        scene.admit(made.frame, made.number, made.corners, held)
        self._newest.features = len(scene.state.ids)

    def _detect(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        if made.view is not None:
            made.view.detect()

    def _describe(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        if made.view is not None:
            made.view.describe()
            made.is_due = True
