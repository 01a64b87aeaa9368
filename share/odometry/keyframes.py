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
from share.geometry import se3
from share.geometry.camera import Rig
from share.odometry import filter
from share.odometry.initialisation import tilt
from share.odometry.landmarks import Scene
from share.odometry.state import State
from share.types import F32, F64, Footing, Frame, View
from share.vision.orb import ViewInSteps

# ---- When a frame is far enough from the newest keyframe to be the next one.


class Spacing:
    """From the newest keyframe of one tracker, by poses (4, 4) of its body or of its camera.

    gap_s: s, sooner there is none; m, rad: after so much motion; left: or with less than this part in view
    of the features that the newest had.
    """

    def __init__(self, gap_s: float, m: float, rad: float, left: float) -> None:
        self._gap_ns, self._m, self._left = gap_s * 1e9, m, left
        self._least_cosine = np.cos(min(rad, np.pi))
        self.stamp_ns = self.features = 0  # of the newest
        self.T = np.eye(4)

    def wanted(self, stamp_ns: int, T: F64, seen: int) -> bool:
        """Whether a frame with so many features seen is to be one: moved, turned, or little left in view."""
        if stamp_ns - self.stamp_ns < self._gap_ns:
            return False
        cosine = ((self.T[:3, :3] * T[:3, :3]).sum() - 1) / 2  # of the angle between the two
        return bool(
            np.linalg.norm(T[:3, 3] - self.T[:3, 3]) > self._m
            or cosine < self._least_cosine
            or seen < self._left * self.features
        )


# ---- How far the body has moved since the keyframe that others were told of last, as it is known by now.
#
# What was told of that keyframe has been corrected since: at first mostly its tilt, by degrees. The
# difference of what was told would have that as a turn of the body.

_FOUND_COV = np.diag(np.repeat([0.01**2, 0.03**2], 3))  # rad, m: of a place found again by its ORB features


class Shown:
    """The keyframe that others were told of last: its id; -1 where the filter has none."""

    def __init__(self) -> None:
        self.keyframe, self._T_odom_body = -1, np.eye(4)

    def forget(self) -> None:
        """The filter's keyframes are numbered anew."""
        self.keyframe = -1

    def told(self, s: State, keyframe: int) -> None:
        """The one with this id is the last one from now on: others have it."""
        self.keyframe, self._T_odom_body = keyframe, s.poses[filter.number_of(s, keyframe)]

    def motion(self, s: State, k: int, new_stretch: bool) -> tuple[F64, F64]:
        """T_last_body (4, 4) of keyframe number k and its covariance (6, 6): as the state knows both now.
        Where it has the last one no longer, after a loss, as they were told, and as unsure as the place where
        the body was found again."""
        known = np.flatnonzero(s.keyframes[:k] == self.keyframe)
        if new_stretch:
            return s.poses[k], filter.keyframe_cov(s, k)
        if len(known):
            return filter.motion(s, int(known[0]), k), filter.motion_cov(s, int(known[0]), k)
        return se3.inverse(self._T_odom_body) @ s.poses[k], filter.keyframe_cov(s, k) + _FOUND_COV


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
    of new corners; `ago` frames have been settled since. view, and what its pose rested on: if others are to
    be told of it."""

    frame: Frame
    number: int
    taken: F32
    corners: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    ago: int = 0
    view: ViewInSteps | None = None
    footing: Footing | None = None
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
        if view and self._at_a_time(frame) == 1:
            view[-1] = (self._describe_more, made)
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
        self._shown_ns, made.footing = made.frame.stamp_ns, scene.footing()
        made.view = ViewInSteps(made.frame, self._rig, self._view_features, scene.depths(made.frame))
        return made

    def may_show(self, stamp_ns: int) -> bool:
        """Whether it is time to tell others of one."""
        return self._showing is None and stamp_ns - self._shown_ns >= _SHOWN_GAP_NS

    @property
    def is_due(self) -> bool:
        """Whether there is one that others are to be told of now."""
        return self._showing is not None and self._showing.is_due

    @property
    def footing(self) -> Footing | None:
        """What the pose of the one that is due rested on; None where none is."""
        return self._showing.footing if self._showing is not None and self._showing.is_due else None

    def show(self, scene: Scene, new_stretch: bool) -> Showing:
        """The one that is due. Raises ValueError where none is."""
        made, s = self._showing, scene.state
        if made is None or made.view is None or not made.is_due:
            raise ValueError("no keyframe is due")
        view = made.view.finish()
        self._unsettled = Unsettled(made.frame, made.number, view)
        k = filter.number_of(s, made.number)
        T_last_body, cov = self._shown.motion(s, k, new_stretch)
        return Showing(view, s.poses[k], tilt(s, s.keyframe(k)), T_last_body, cov, made.ago)

    def settle(self, scene: Scene, frame: Frame, rate: F64) -> Unsettled | None:
        """A slice of what is left to do, or as many as there is time for between frames, once a frame, of
        which `frame` is the last. The keyframe that was shown, if there was one."""
        done, self._unsettled = self._unsettled, None
        if done is not None:
            self._shown.told(scene.state, done.keyframe)  # not before: making its candidate might have failed
        slices = self._at_a_time(frame)
        if self._showing is not None:
            self._showing.ago += 1
            if self._showing.is_due:  # others have it, or nobody asked
                self._showing = None
                slices -= 1  # to show it was one
        self._settled_ns = frame.stamp_ns
        for _ in range(max(1, slices)):
            if not self._slices:
                break
            self._work(scene, frame, rate)
        return done

    def _at_a_time(self, frame: Frame) -> int:
        """How many slices there is time for after the frame just tracked."""
        return int(max(1, (frame.stamp_ns - self._settled_ns) // _SLICE_NS))

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
        scene.forget((self._shown.keyframe, -1 if self._showing is None else self._showing.number))

    def _corners(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        made.corners = scene.corners(made.frame, made.taken)

    def _admit(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        scene.admit(made.frame, made.number, made.corners)
        self._newest.features = len(scene.state.ids)

    def _detect(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        if made.view is not None:
            made.view.detect()

    def _describe(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        if made.view is not None:
            made.view.describe()
            made.is_due = True

    def _describe_more(self, made: _Making, scene: Scene, last: Frame, rate: F64) -> None:
        self._describe(made, scene, last, rate)
        if made.view is not None:
            made.view.measure_half()
