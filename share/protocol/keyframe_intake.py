"""Keyframes on their way from an agent into the map: order, quota, plausibility, turns."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from share.checks import MAX_ID
from share.earlier_poses import EarlierPoses
from share.geometry import se3
from share.geometry.camera import Camera
from share.mapping.graph.edges import inflate_span
from share.timing import SECOND_NS, TokenBuckets
from share.types import F64, I64, Keyframe
from share.vision.keyframe_images import image_objection
from share.wire.messages import MAX_BUFFERED, Ack, Hello

MAX_ID_GAP = 1_000_000  # ids that an agent may have dropped since the last one: two days at 5 Hz
_CAPACITY = 64  # keyframes of one run that wait for a predecessor
_CAPACITY_BYTES = 1_250_000  # of their arrays: 16 of the largest, as many as an agent has in flight


class ReorderBuffer:
    """Releases each keyframe of a run once, after its predecessor; buffers a bounded number.

    Ids that the agent dropped are skipped: the predecessor of the next keyframe shows them. Of two versions
    of a buffered keyframe the one with the lower predecessor is the newer.
    """

    def __init__(self, next_keyframe: int = 0, capacity: int = _CAPACITY) -> None:
        """next_keyframe: one more than the last applied id. capacity: at most MAX_BUFFERED."""
        self.next_keyframe = next_keyframe
        self.duplicates = 0
        self.evicted = 0
        self._capacity = capacity
        self._waiting: dict[int, Keyframe] = {}

    def clear(self) -> None:
        """Drop buffered keyframes, which are not acknowledged: the agent resends them."""
        self._waiting.clear()

    def is_new(self, keyframe_id: int) -> bool:
        """Return whether no keyframe of that id has been applied or is buffered."""
        return keyframe_id >= self.next_keyframe and keyframe_id not in self._waiting

    def push(self, keyframe: Keyframe) -> list[Keyframe]:
        """Add a keyframe; return those that can be applied now, rising by id.

        Raises ValueError if its id jumps by more than MAX_ID_GAP, or no other could follow it."""
        if keyframe.id >= MAX_ID:
            raise ValueError(f"keyframe {keyframe.id}: there is no id for the next one")
        if keyframe.id > self.next_keyframe + MAX_ID_GAP:
            raise ValueError(f"keyframe {keyframe.id}: id jumps; expected about {self.next_keyframe}")
        if keyframe.id < self.next_keyframe:
            self.duplicates += 1
            return []
        waiting = self._waiting.get(keyframe.id)
        self.duplicates += waiting is not None
        if waiting is None or keyframe.predecessor < waiting.predecessor:
            self._waiting[keyframe.id] = keyframe
        ready = []
        while (applicable := self._next_applicable()) is not None:
            ready.append(applicable)
            self.next_keyframe = applicable.id + 1
            self._waiting = {k: v for k, v in self._waiting.items() if k > applicable.id}
        while len(self._waiting) > self._capacity or self._waiting_bytes() > _CAPACITY_BYTES:
            del self._waiting[max(self._waiting)]  # drop_newest: the agent resends it
            self.evicted += 1
        return ready

    def _waiting_bytes(self) -> int:
        return sum(keyframe.nbytes for keyframe in self._waiting.values())

    def ack(self, durable_below: int | None = None) -> Ack:
        """Return the answer to any keyframe, duplicates too: their acknowledgement may have been lost.

        durable_below: applied keyframes from this id on count as buffered (default: none).
        """
        durable_below = self.next_keyframe if durable_below is None else durable_below
        applied = range(durable_below, min(self.next_keyframe, durable_below + MAX_BUFFERED))
        return Ack(durable_below, (*applied, *sorted(self._waiting))[:MAX_BUFFERED])

    def _next_applicable(self) -> Keyframe | None:
        ready = (one for _, one in sorted(self._waiting.items()) if one.predecessor < self.next_keyframe)
        return next(ready, None)


# Keyframe quota: the mapper work that one agent may cause, over all its runs.
#
# The work grows with the keypoints, or with an image's pixels and surfaces; a keyframe without any costs as
# much as _BASE_COST keypoints (docs/understand/robustness.md). With the default settings an agent sends
# keyframes with an image, at most 5 a second (control.rate_max_hz), and resends up to 600 at once to a new
# edge. Twice that rate and 700 at once are accepted, of images of 848x480 px with 80 surfaces.
_BASE_COST, _IMAGE_COST, _SURFACE_COST, _PIXELS_PER_COST = 250.0, 500.0, 2.0, 3000.0
_KEYFRAMES_HZ = 10.0
_KEYFRAME_COST = _BASE_COST + _IMAGE_COST + 80 * _SURFACE_COST + 848 * 480 / _PIXELS_PER_COST
_COST_HZ = _KEYFRAMES_HZ * _KEYFRAME_COST
_COST_BURST = 700.0 * _KEYFRAME_COST
_SEGMENT_FACTOR = 28  # a keyframe that starts a segment costs this much more: the mapper never forgets one
_OVERLOAD_TEXT = (
    f"more than the work of {_KEYFRAMES_HZ:.0f} keyframes a second: further keyframes are deferred"
)
_RATE_SLACK = 1.2  # keyframes arrive unevenly
_RATE_BURST = 10.0  # keyframes


def _cost(keyframe: Keyframe, camera: Camera) -> float:
    image = keyframe.image
    cost = _BASE_COST + len(keyframe.view) + _SURFACE_COST * len(image.uv)
    if len(image.jpeg):
        cost += _IMAGE_COST + camera.width * camera.height / _PIXELS_PER_COST
    return cost * (1 if keyframe.reference >= 0 else _SEGMENT_FACTOR)


class KeyframeQuota:
    """Limits the keyframes of each agent name.

    max_rate_hz: keyframes a second that the policy grants at most; None: unlimited."""

    def __init__(self, max_rate_hz: float | None) -> None:
        self._cost_buckets = TokenBuckets(_COST_BURST, _COST_HZ)
        self._rate_buckets = TokenBuckets(
            _RATE_BURST, None if max_rate_hz is None else _RATE_SLACK * max_rate_hz
        )

    def objection(self, hello: Hello, keyframe: Keyframe, now_ns: int) -> str | None:
        """Return why this keyframe is not accepted now; None if it is, and charge its cost. hello: of its
        run."""
        cost, bucket = _cost(keyframe, hello.rig.cam0), self._cost_buckets.bucket(hello.name, now_ns)
        return None if bucket.take(now_ns, cost=cost) else _OVERLOAD_TEXT

    def is_over_rate(self, name: str, now_ns: int) -> bool:
        """Return whether this accepted keyframe exceeds the highest rate that an agent may have."""
        return not self._rate_buckets.bucket(name, now_ns).take(now_ns)


# Largest plausible motion between two keyframes, m, and what is added for each second in between.
_MAX_JUMP_M, _MAX_JUMP_M_S = 2.0, 10.0
# T_ref_body is the filter's present estimate, T_odom_body its estimate then (docs/understand/mapping.md):
# measured on correct agents they differ by up to 3 cm after 8 s and 6 m, and by 2.7 degrees while a
# headset's tilt converges.
_MAX_MISMATCH_M, _MISMATCH_PER_M = 0.3, 0.05  # and what is added for each m of motion
_MAX_MISMATCH_RAD = float(np.radians(12.0))
_MAX_DRIFT_M = 1000.0  # between the composed motions of a segment and its poses; keeps map poses finite
_MAX_VARIANCE = 100.0  # rad^2, m^2: as good as unknown; more would make the solver ill-conditioned


@dataclass(frozen=True, eq=False)
class OdometryBase:
    """The newest applied keyframe: its id, its stamp, T_odom_body (4, 4), the steps that led to it, and
    T_odom_moved (4, 4), T_odom_body by the composed motions since its segment's start; None where those are
    not known."""

    id: int
    stamp_ns: int
    T_odom_body: F64
    steps: StepChain | None = None
    T_odom_moved: F64 | None = None

    @classmethod
    def from_keyframe(cls, keyframe: Keyframe, base: OdometryBase | None = None) -> OdometryBase:
        """base: the run's keyframe before."""
        id, stamp_ns, T_odom_body = keyframe.id, keyframe.stamp_ns, keyframe.T_odom_body
        if base is None or keyframe.reference < 0:
            return cls(id, stamp_ns, T_odom_body)
        return cls(id, stamp_ns, T_odom_body, base.steps_to(keyframe), base.moved_to(keyframe))

    def moved_to(self, keyframe: Keyframe) -> F64:
        """Return T_odom_body (4, 4) of the next keyframe by the composed motions."""
        T_odom_moved = self.T_odom_body if self.T_odom_moved is None else self.T_odom_moved
        return se3.orthonormal(T_odom_moved @ keyframe.T_ref_body)

    def steps_to(self, keyframe: Keyframe) -> StepChain:
        """Return the steps up to the next keyframe."""
        steps = StepChain.start(self.id) if self.steps is None else self.steps
        return steps.extended(keyframe.id, keyframe.T_ref_body, keyframe.cov)

    def jump_m(self, keyframe: Keyframe) -> float:
        """Return the distance to the keyframe, m, if no agent can move so far in that time, else 0."""
        distance_m = float(np.linalg.norm(keyframe.T_ref_body[:3, 3]))
        elapsed_s = max(0, keyframe.stamp_ns - self.stamp_ns) / SECOND_NS
        return distance_m if distance_m > _MAX_JUMP_M + _MAX_JUMP_M_S * elapsed_s else 0.0

    def contradiction(self, keyframe: Keyframe) -> str | None:
        """Return a text on how far the keyframe's T_ref_body differs from the relative pose of the two
        T_odom_body; None if a filter's later estimate of the past can explain it."""
        T_ref_body = se3.inverse(self.T_odom_body) @ keyframe.T_odom_body
        T = se3.inverse(keyframe.T_ref_body) @ T_ref_body
        mismatch_m, mismatch_rad = float(np.linalg.norm(T[:3, 3])), float(se3.rotation_angle(T))
        step_m = float(np.linalg.norm(keyframe.T_ref_body[:3, 3]))
        if mismatch_m <= _MAX_MISMATCH_M + _MISMATCH_PER_M * step_m and mismatch_rad <= _MAX_MISMATCH_RAD:
            drift_m = float(np.linalg.norm(self.moved_to(keyframe)[:3, 3] - keyframe.T_odom_body[:3, 3]))
            said = f"the motions since its segment's start and its pose differ by {drift_m:.0f} m"
            return said if drift_m > _MAX_DRIFT_M else None
        mismatch_deg = np.degrees(mismatch_rad)
        return f"its motion and its two poses differ by {mismatch_m:.2g} m and {mismatch_deg:.2g} degrees"


def sanitise(
    keyframe: Keyframe,
    base: OdometryBase | None,
    camera: Camera,
    forgotten_below: int = 0,
    is_entering: bool = False,
) -> tuple[Keyframe, str | None]:
    """Return the next keyframe of a run as the map accepts it, and what was wrong with it, None if nothing.

    base: the run's keyframe before; camera: its cam0. is_entering: the keyframe before is in another room. A
    keyframe with an implausible jump, or with a motion that contradicts its two poses, starts a segment in
    the same odom, as does one that enters, or whose reference is forgotten: after `base`, below
    `forgotten_below`. Poses relative to earlier keyframes that contradict its steps are dropped, as is an
    image that cannot be this camera's. An excessive covariance is bounded. Raises ValueError if its reference
    is neither `base` nor forgotten.
    """
    problems = []
    if (0 if base is None else base.id + 1) <= keyframe.reference < forgotten_below:
        keyframe = _starting_segment(keyframe)
    if objection := image_objection(keyframe.image, camera):
        problems.append(f"keyframe {keyframe.id}: {objection}: without it")
        keyframe = replace(keyframe, image=keyframe.image.without_jpeg())
    if keyframe.reference >= 0:
        if base is None or keyframe.reference != base.id:
            raise ValueError(f"keyframe {keyframe.id} refers to {keyframe.reference}, not to the last one")
        reason = _segment_reason(keyframe, base)
        if reason is not None:
            problems.append(f"{reason}: new segment")
        if reason is not None or is_entering:
            keyframe = _starting_segment(keyframe)
        else:
            earlier, problem = base.steps_to(keyframe).agreeing(keyframe.earlier)
            problems += [] if problem is None else [f"keyframe {keyframe.id}: {problem}"]
            keyframe = keyframe if earlier is keyframe.earlier else replace(keyframe, earlier=earlier)
    if (variance := float(keyframe.cov.diagonal().max())) > _MAX_VARIANCE:
        problems.append(f"keyframe {keyframe.id} has a variance of {variance:.0e}; treated as unknown")
        keyframe = replace(keyframe, cov=keyframe.cov * (_MAX_VARIANCE / variance))
    return keyframe, "; ".join(problems) or None


def _starting_segment(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, reference=-1, T_ref_body=keyframe.T_odom_body, earlier=EarlierPoses.empty())


def _segment_reason(keyframe: Keyframe, base: OdometryBase) -> str | None:
    """Return why the keyframe has to start a segment; None if it does not."""
    if jump_m := base.jump_m(keyframe):
        return f"keyframe {keyframe.id} is {jump_m:.0f} m from the previous one"
    if contradiction := base.contradiction(keyframe):
        return f"keyframe {keyframe.id}: {contradiction}"
    return None


T = TypeVar("T")

_MAX_ADD_MS = 10.0  # spent on adding keyframes before one is queried


class FairQueue(Generic[T]):
    """Keyframes that wait to be added to the map: names take turns, each in order of arrival, so that an
    agent that sends many delays only itself."""

    def __init__(self) -> None:
        self._queues: dict[str, deque[T]] = {}  # by name, next in turn first

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def add(self, name: str, item: T) -> None:
        self._queues.setdefault(name, deque()).append(item)

    def take_next(self, spent_ms: float = 0.0) -> T | None:
        """Return the next item; None if there is none, or if `spent_ms` (on items since the last query)
        calls for a query."""
        if not self._queues or spent_ms >= _MAX_ADD_MS:
            return None
        name = next(iter(self._queues))
        queue = self._queues.pop(name)
        item = queue.popleft()
        if queue:
            self._queues[name] = queue
        return item


# ---- Chains of steps. Agents are compared by their steps; poses relative to earlier keyframes that
# contradict these, or are much more certain, would bend the map unnoticed. Measured on 19 emulated paths
# (docs/lab/attack-figures.md): 99 % of the squared differences of correct agents are below 2.3 of the steps'
# variance; with lengths 3 % off they are 14 to 72 in the mean. And of n steps no pose has less than some 1/n
# of their variance, since the error of a keyframe occurs once in it and n times in the steps.

_REACH = 64  # keyframes; SHARE's agents reach 13 back
_MAX_CHI2 = 9.0  # of translation and rotation, 2 expected at most; beyond, the robust kernel discounts it too
_MIN_VARIANCE_SHARE = 0.5  # of the mean variance of the steps in between


@dataclass(frozen=True, eq=False)
class StepChain:
    """The newest keyframes of a segment: ids (M,); T_first_body (M, 4, 4), composed of their steps; and
    variance (M, 2), of rotation and of translation, summed over the steps."""

    ids: I64
    T_first_body: F64
    variance: F64

    @classmethod
    def start(cls, keyframe_id: int) -> StepChain:
        return cls(np.array([keyframe_id], np.int64), np.eye(4)[None], np.zeros((1, 2)))

    def extended(self, keyframe_id: int, T_last_body: F64, cov: F64) -> StepChain:
        """Return the chain with one more keyframe, a step T_last_body (4, 4), cov (6, 6), after the last."""
        T = se3.orthonormal(self.T_first_body[-1] @ T_last_body)
        poses = np.concatenate([self.T_first_body, T[None]])[-_REACH:]
        variance = np.concatenate([self.variance, self.variance[-1:] + _variance(cov[None])])[-_REACH:]
        return StepChain(np.append(self.ids, keyframe_id)[-_REACH:], poses, variance - variance[0])

    def agreeing(self, earlier: EarlierPoses) -> tuple[EarlierPoses, str | None]:
        """Return the last keyframe's poses relative to earlier ones that agree with its steps since then, no
        surer than these allow, and what is wrong with the others; None if nothing.

        Poses relative to keyframes that the chain no longer has cannot be checked, and are left out."""
        rows = np.array([self._row(one) for one in earlier.ids.tolist()], np.int64)
        claimed = earlier.T_earlier_body.astype(np.float64)
        T = se3.inverse(claimed) @ se3.inverse(self.T_first_body[rows]) @ self.T_first_body[-1]
        distance_m, angle_rad = np.linalg.norm(T[:, :3, 3], axis=1), se3.rotation_angle(T)
        variance = self._variance_since(rows, claimed)
        chi2 = angle_rad**2 / variance[:, 0] + distance_m**2 / variance[:, 1]
        is_false = (rows >= 0) & ~(chi2 <= _MAX_CHI2)
        is_agreed = (rows >= 0) & ~is_false
        agreed = self._bounded(_select_rows(earlier, is_agreed), rows[is_agreed])
        if not is_false.any():
            return agreed, None
        worst = int(np.where(is_false, distance_m, -1.0).argmax())
        away = f"{distance_m[worst]:.2g} m and {np.degrees(angle_rad[worst]):.2g} degrees"
        what = f"its pose relative to keyframe {earlier.ids[worst]}"
        return agreed, f"{what} is {away} off its steps: without it"

    def _variance_since(self, rows: I64, T_earlier_body: F64) -> F64:
        """Variance (N, 2), of rotation and of translation, of poses (N, 4, 4) composed of the steps since
        these rows, with the floor that the graph adds to steps."""
        count = len(self.ids) - 1 - rows
        floors = [inflate_span(T, np.zeros((6, 6)), n) for T, n in zip(T_earlier_body, count, strict=True)]
        variance = self.variance[-1] - self.variance[rows] + _variance(np.array(floors).reshape(-1, 6, 6))
        length_m = np.linalg.norm(T_earlier_body[:, :3, 3], axis=1)
        variance[:, 1] += length_m**2 * variance[:, 0] / 3  # by the rotations on the way
        return np.asarray(variance)

    def _bounded(self, earlier: EarlierPoses, rows: I64) -> EarlierPoses:
        """Return poses relative to keyframes in these rows, with the least variance that the steps allow."""
        count = len(self.ids) - 1 - rows
        least = _MIN_VARIANCE_SHARE * (self.variance[-1] - self.variance[rows]) / count[:, None]
        missing = np.maximum(0.0, least - _variance(earlier.cov))
        if not missing.any():
            return earlier
        added = np.repeat(missing / 3, 3, axis=1)[:, :, None] * np.eye(6)
        return replace(earlier, cov=(earlier.cov + added).astype(np.float32))

    def _row(self, keyframe_id: int) -> int:
        """Row of a keyframe before the last; -1 if the chain does not have it."""
        row = int(np.searchsorted(self.ids, keyframe_id))
        return row if row < len(self.ids) - 1 and self.ids[row] == keyframe_id else -1


def _variance(covs: NDArray[np.floating]) -> F64:
    """Sums (N, 2) of the variances of rotation and of translation in covariances (N, 6, 6)."""
    diagonal = covs.diagonal(axis1=1, axis2=2).astype(np.float64)
    return np.asarray(diagonal.reshape(-1, 2, 3).sum(axis=2))


def _select_rows(earlier: EarlierPoses, is_kept: NDArray[np.bool_]) -> EarlierPoses:
    rows = np.flatnonzero(is_kept).tolist()
    return earlier if len(rows) == len(earlier) else earlier.take(rows, earlier.ids[rows].tolist())
