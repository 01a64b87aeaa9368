"""Keyframes of a headset's own odometry: when it wants one, what that shows to others, and what can wait.

Others are told as soon as its pose has joined the filter's state. Half the work is for the tracker itself,
and is done once what others are told is on its way: features of its free corners, and a place to find
oneself by.
"""

from __future__ import annotations

from typing import NamedTuple

from share.config import InertialConfig
from share.estimator.inertial.scene import Scene
from share.estimator.inertial.shown import Shown
from share.estimator.spacing import Spacing
from share.geometry.camera import Rig
from share.types import F64, Frame, View
from share.vision.view import make_view


class Showing(NamedTuple):
    """Of a keyframe: its view, T_last_body (4, 4) since the one shown before, and its covariance (6, 6)."""

    view: View
    T_last_body: F64
    cov: F64


class Unsettled(NamedTuple):
    """A keyframe whose candidate was made, and that others are told of unless something fails."""

    frame: Frame
    view: View
    fresh: bool  # its pose joined the state with it, and it has no features yet


class Keyframes:
    """Those of one tracker, newest last in its scene."""

    def __init__(self, rig: Rig, config: InertialConfig, view_features: int) -> None:
        self._rig, self._view_features = rig, view_features
        c = config
        self._newest = Spacing(c.keyframe_gap_s, c.keyframe_m, c.keyframe_rad, c.keyframe_seen)
        self._shown = Shown()
        self._unsettled: Unsettled | None = None

    def wanted(self, stamp_ns: int, T_odom_body: F64, seen: int) -> bool:
        """Whether a frame with so many features seen is to be one."""
        return self._newest.wanted(stamp_ns, T_odom_body, seen)

    def anchor(self, frame: Frame, scene: Scene, rate: F64) -> None:
        """Make the frame just tracked one, all at once: where nobody else is told yet. rate (3,): rad/s."""
        self._add_pose(frame, scene, rate)
        self._add_features(frame, scene, rate)

    def show(self, frame: Frame, scene: Scene, rate: F64, new_stretch: bool) -> Showing:
        """Make the frame just tracked one, if it is not; the rest waits for `settle`."""
        fresh = frame.stamp_ns != self._newest.stamp_ns
        if fresh:
            self._add_pose(frame, scene, rate)
        view = make_view(frame, self._rig, self._view_features, scene.depths(frame))
        self._unsettled = Unsettled(frame, view, fresh)
        return Showing(view, *self._shown.motion(scene.state, new_stretch))

    def settle(self, scene: Scene, rate: F64) -> Unsettled | None:
        """What `show` left to do. The keyframe that it was done for, if there was any."""
        todo, self._unsettled = self._unsettled, None
        if todo is None:
            return None
        self._shown.told(scene.state)  # only now: before, making its candidate might have failed
        if todo.fresh:
            self._add_features(todo.frame, scene, rate)
        return todo

    def forget(self) -> None:
        """The filter begins anew, and numbers its keyframes anew. What `show` left to do is void."""
        self._unsettled = None
        self._shown.forget()

    def _add_pose(self, frame: Frame, scene: Scene, rate: F64) -> None:
        scene.add_keyframe(rate)
        self._newest.stamp_ns, self._newest.T = frame.stamp_ns, scene.state.T

    def _add_features(self, frame: Frame, scene: Scene, rate: F64) -> None:
        scene.replenish(frame, rate)
        self._newest.features = len(scene.state.ids)
