"""Keyframes of a headset's own odometry: when it wants one, what that shows to others, and the work that one
brings, in slices.

A keyframe's pose joins the filter's state at once. All else is done after the poses of this frame and the
next ones are out, one slice a frame, so that no frame waits for the whole of it: features seen from about
here before, free corners, their depth. What is new is sought from a fixed frame on, however long a slice
takes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from share.config import InertialConfig
from share.estimator.inertial.scene import Scene
from share.estimator.inertial.shown import Shown
from share.estimator.spacing import Spacing
from share.geometry.camera import Rig
from share.types import F32, F64, Frame, View
from share.vision.view import make_view

_SHOWN_GAP_NS = 400_000_000  # between keyframes that others are told of

Slice = Callable[[Scene, Frame, F64], None]  # with the frame just tracked, and its rate


class Showing(NamedTuple):
    """Of a keyframe: its view, T_last_body (4, 4) since the one shown before, and its covariance (6, 6)."""

    view: View
    T_last_body: F64
    cov: F64


class Unsettled(NamedTuple):
    """A keyframe whose candidate was made, and that others are told of unless something fails."""

    frame: Frame
    view: View


class Keyframes:
    """Those of one tracker, newest last in its scene."""

    def __init__(self, rig: Rig, config: InertialConfig, view_features: int) -> None:
        self._rig, self._view_features = rig, view_features
        c = config
        self._newest = Spacing(c.keyframe_gap_s, c.keyframe_m, c.keyframe_rad, c.keyframe_seen)
        self._shown = Shown()
        self._shown_ns = 0
        self._unsettled: Unsettled | None = None
        self._slices: deque[Slice] = deque()
        self._urgent = False

    def wanted(self, stamp_ns: int, T_odom_body: F64, seen: int) -> bool:
        """Whether a frame with so many features seen is to be one."""
        return not self._slices and self._newest.wanted(stamp_ns, T_odom_body, seen)

    def anchor(self, frame: Frame, scene: Scene, rate: F64) -> None:
        """Make the frame just tracked one, all at once: where no pose is told yet. rate (3,): rad/s."""
        self.begin(frame, scene, rate, urgent=True)
        self._work(scene, frame, rate)

    def begin(self, frame: Frame, scene: Scene, rate: F64, urgent: bool) -> None:
        """Make the frame just tracked one, if it is not: its pose; the rest is for `settle`. urgent: all of
        it at once, for there is little to go by."""
        self._urgent = urgent
        if self.is_newest(frame):
            return
        number = scene.add_keyframe(rate)
        self._newest.stamp_ns, self._newest.T = frame.stamp_ns, scene.state.T
        self._slices = deque([partial(self._recall, frame, number, scene.taken())])

    def is_newest(self, frame: Frame) -> bool:
        return frame.stamp_ns == self._newest.stamp_ns

    def may_show(self, stamp_ns: int) -> bool:
        """Whether it is time to tell others of one."""
        return stamp_ns - self._shown_ns >= _SHOWN_GAP_NS

    def show(self, frame: Frame, scene: Scene, new_stretch: bool) -> Showing:
        """Of the frame just tracked, the newest keyframe."""
        self._shown_ns = frame.stamp_ns
        view = make_view(frame, self._rig, self._view_features, scene.depths(frame))
        self._unsettled = Unsettled(frame, view)
        return Showing(view, *self._shown.motion(scene.state, new_stretch))

    def settle(self, scene: Scene, frame: Frame, rate: F64) -> Unsettled | None:
        """A slice of what is left to do, once a frame, of which `frame` is the last. The keyframe that was
        shown, if there was one."""
        done, self._unsettled = self._unsettled, None
        if done is not None:
            self._shown.told(scene.state)  # only now: before, making its candidate might have failed
        if done is None or self._urgent:  # a view is work enough for one frame
            self._work(scene, frame, rate)
        return done

    def forget(self) -> None:
        """The filter begins anew, and numbers its keyframes anew. What is left to do is void."""
        self._unsettled = None
        self._slices.clear()
        self._shown.forget()

    # ------------------------------------------------------------------ slices

    def _work(self, scene: Scene, last: Frame, rate: F64) -> None:
        while self._slices:
            self._slices.popleft()(scene, last, rate)
            if not self._urgent:
                break

    def _recall(self, frame: Frame, number: int, taken: F32, scene: Scene, last: Frame, rate: F64) -> None:
        woken = scene.wake(last, rate)
        taken = np.concatenate([taken, woken])
        self._slices.append(partial(self._corners, frame, number, taken))

    def _corners(self, frame: Frame, number: int, taken: F32, scene: Scene, last: Frame, rate: F64) -> None:
        px = scene.corners(frame, taken)
        self._slices.append(partial(self._admit, frame, number, px))

    def _admit(self, frame: Frame, number: int, px: F32, scene: Scene, last: Frame, rate: F64) -> None:
        scene.admit(frame, number, px)
        self._newest.features = len(scene.state.ids)
