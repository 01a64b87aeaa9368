"""One run of one agent, as the edge knows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from share.geometry import se3
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import StoredMap, map_poses
from share.mapping.steps import MapEvent, map_assignment
from share.timing import SECOND_NS, seconds_to_ns
from share.types import F64, Keyframe, TrackState
from share.wire.messages import MAX_BUFFERED, Ack, Hello, Status

# ---- Keyframes of one agent, from any order of arrival into the order in which they were made.

MAX_ID_GAP = 1_000_000  # ids that an agent may have dropped since the last: two days alone at 5 Hz


class ReorderBuffer:
    """Yields each keyframe once, after the one that it follows; holds a bounded number back.

    Ids that the agent dropped are skipped: the first keyframe after them says so by what it follows.
    Of two versions of a waiting keyframe the one that follows the lower id is the later.
    """

    def __init__(self, next_keyframe: int = 0, capacity: int = 64) -> None:
        """next_keyframe: one more than the last id already applied. hold: at most MAX_HELD."""
        if not 1 <= capacity <= MAX_BUFFERED:
            raise ValueError(f"hold: {capacity} is outside 1 .. {MAX_BUFFERED}")
        self.next_keyframe = next_keyframe
        self.duplicates = 0
        self.evicted = 0
        self._capacity = capacity
        self._waiting: dict[int, Keyframe] = {}

    def clear(self) -> None:
        """What is held back was not acknowledged: the agent sends it again."""
        self._waiting.clear()

    def is_new(self, keyframe_id: int) -> bool:
        """Whether no keyframe of that id has been applied, or waits."""
        return keyframe_id >= self.next_keyframe and keyframe_id not in self._waiting

    def push(self, keyframe: Keyframe) -> list[Keyframe]:
        """The keyframes, rising by id, that can be applied now that this one is here.

        Raises ValueError if its id leaps by more than MAX_STEP."""
        if keyframe.id > self.next_keyframe + MAX_ID_GAP:
            raise ValueError(f"keyframe {keyframe.id}: its id leaps; {self.next_keyframe} is expected")
        if keyframe.id < self.next_keyframe:
            self.duplicates += 1
            return []
        self._insert(keyframe)
        ready = []
        while (applicable := self._next_applicable()) is not None:
            ready.append(applicable)
            self.next_keyframe = applicable.id + 1
            self._waiting = {k: v for k, v in self._waiting.items() if k > applicable.id}
        if len(self._waiting) > self._capacity:
            del self._waiting[max(self._waiting)]  # drop_newest: the agent sends it again
            self.evicted += 1
        return ready

    def ack(self, durable_below: int | None = None) -> Ack:
        """What to answer to every keyframe, duplicates too: their acknowledgement may have been lost.

        safe: applied keyframes from this number on are only held yet (default: all are safe).
        """
        durable_below = self.next_keyframe if durable_below is None else durable_below
        applied = range(durable_below, min(self.next_keyframe, durable_below + MAX_BUFFERED))
        return Ack(durable_below, (*applied, *sorted(self._waiting))[:MAX_BUFFERED])

    def _insert(self, keyframe: Keyframe) -> None:
        waiting = self._waiting.get(keyframe.id)
        if waiting is not None:
            self.duplicates += 1
        if waiting is None or keyframe.predecessor < waiting.predecessor:
            self._waiting[keyframe.id] = keyframe

    def _next_applicable(self) -> Keyframe | None:
        ready = (k for k in sorted(self._waiting) if self._waiting[k].predecessor < self.next_keyframe)
        first = next(ready, None)
        return None if first is None else self._waiting[first]


# ---- What an agent last said of its own state, and how old that is by the edge's clock.

SILENT_S = 0.7  # an agent says something twice a second; after this what it said is not shown as its state
SILENT = "SILENT"
_NOT_RECEIVED = "no message since the map was restored"


class PeerStatus:
    """Fed with what the agent says; `report` is true of the moment that it is asked for."""

    def __init__(self) -> None:
        self.state = TrackState.INITIALISING
        self._reason = ""
        self._age_ms: float | None = None  # of the newest pose, when `_age_at_ns` was
        self._age_at_ns = 0
        self._has_left = False

    def update(self, status: Status, now_ns: int) -> None:
        self.state, self._reason, self._has_left = status.state, status.reason, False
        self._age_ms, self._age_at_ns = status.pose_age_ms, now_ns

    def add_pose(self, state: TrackState, now_ns: int) -> None:
        """A pose has come. It is about as old as the newest was when the agent last said how old that was."""
        if state is not self.state:
            self._reason = ""
        self.state, self._has_left = state, False
        if state.has_pose:
            self._age_at_ns = now_ns

    def leave(self) -> None:
        """It said bye: its silence is no news."""
        self._has_left = True

    def report(self, now_ns: int, last_received_ns: int | None) -> dict[str, Any]:
        """Plain data. state: SILENT where nothing was heard for SILENT_S. pose_age_ms: None if never told.
        heard_ns: when the agent was last heard; None: not in this life of the edge."""
        if last_received_ns is None:
            return {"state": SILENT, "reason": _NOT_RECEIVED, "pose_age_ms": None, "heard_s": None}
        silent_ns = max(0, now_ns - last_received_ns)
        since_ms = max(0, now_ns - self._age_at_ns) / 1e6
        silent = silent_ns > seconds_to_ns(SILENT_S) and not self._has_left
        reason = f"silent for {silent_ns / SECOND_NS:.1f} s; its last state was {self.state}"
        return {
            "state": SILENT if silent else str(self.state),
            "reason": reason if silent else self._reason,
            "pose_age_ms": None if self._age_ms is None else round(self._age_ms + since_ms, 1),
            "heard_s": round(silent_ns / SECOND_NS, 3),
        }


_MAX_JUMP_M, _MAX_JUMP_M_S = (
    2.0,
    10.0,
)  # further than this, and so much more a second, nobody moves between keyframes
# T_ref_body is of what the filter knows now, T_odom_body of what it knew then (docs/edge-map.md): of honest
# agents these differ by up to 3 cm after 8 s and 6 m, and by 2.7 degrees while a headset learns what is up.
_MAX_MISMATCH_M, _MISMATCH_PER_M, _MAX_MISMATCH_RAD = 0.3, 0.05, float(np.radians(12.0))
_MIN_REFUSALS, _RECENT_S = 10, 10.0  # refused messages that are worth a person's while, and for how long
_OVERLOAD_SHOWN_S = 2.0  # that it is said of an agent that its keyframes were not taken in
_MAX_PENDING_SAVES = 256  # keyframes that may wait for the disk: an agent has 16 under way
_MAX_VARIANCE = 100.0  # rad^2, m^2: says nothing; more would only upset the solver


@dataclass(frozen=True, eq=False)
class OdometryBase:
    """The newest applied keyframe: its id, its stamp, and T_odom_body (4, 4)."""

    id: int
    stamp_ns: int
    T_odom_body: F64

    @classmethod
    def from_keyframe(cls, keyframe: Keyframe) -> OdometryBase:
        return cls(keyframe.id, keyframe.stamp_ns, keyframe.T_odom_body)

    def jump_m(self, keyframe: Keyframe) -> float:
        """How far (m) the keyframe is from here, if nobody can have moved so far meanwhile, else 0."""
        distance_m = float(np.linalg.norm(keyframe.T_ref_body[:3, 3]))
        elapsed_s = max(0, keyframe.stamp_ns - self.stamp_ns) / SECOND_NS
        return distance_m if distance_m > _MAX_JUMP_M + _MAX_JUMP_M_S * elapsed_s else 0.0

    def contradiction(self, keyframe: Keyframe) -> str | None:
        """How far T_ref_body of the keyframe lies from what its T_odom_body and this one say, if that is more
        than a filter learns of the past meanwhile."""
        T_ref_body = se3.inverse(self.T_odom_body) @ keyframe.T_odom_body
        T = se3.inverse(keyframe.T_ref_body) @ T_ref_body
        mismatch_m, mismatch_rad = float(np.linalg.norm(T[:3, 3])), float(se3.rotation_angle(T))
        step_m = float(np.linalg.norm(keyframe.T_ref_body[:3, 3]))
        if mismatch_m <= _MAX_MISMATCH_M + _MISMATCH_PER_M * step_m and mismatch_rad <= _MAX_MISMATCH_RAD:
            return None
        return (
            f"its step and its two poses "
            f"differ by {mismatch_m:.2g} "
            f"m and {np.degrees(mismatch_rad):.2g} degrees"
        )


@dataclass(frozen=True, eq=False)
class RestoredRun:
    """A run that an earlier life of the edge kept. foot: its last keyframe, None without any.
    next_keyframe: the number that is asked for. finding: where it is in the map, to be told at once.
    voice: as of `KeepRun`."""

    key: str
    hello: Hello
    odometry_base: OdometryBase | None
    next_keyframe: int
    last_finding: MapEvent | None = None
    credential: str | None = ""


@dataclass
class RefusedMessages:
    """Messages of a peer that were not accepted: how many, and why and when the newest was not."""

    count: int = 0
    reason: str = ""
    last_ns: int = 0
    label: ClassVar[str] = "messages refused"

    def add(self, reason: str, now_ns: int) -> None:
        self.count, self.reason, self.last_ns = self.count + 1, reason, now_ns

    def warning_line(self, now_ns: int) -> str | None:
        """For a person, while it happens again and again."""
        if self.count < _MIN_REFUSALS or now_ns - self.last_ns > _RECENT_S * SECOND_NS:
            return None
        return f"{self.count} {self.label}, the last: {self.reason}"


class SuspectKeyframes(RefusedMessages):
    """Keyframes that were taken in, but not as they came."""

    label = "suspect keyframes"


@dataclass
class OverloadNotice:
    """Keyframes that were not taken in, since there were too many, and are sent again."""

    reason: str = ""
    last_ns: int = 0

    def record(self, reason: str, now_ns: int) -> None:
        self.reason, self.last_ns = reason, now_ns

    def annotate(self, status: dict[str, Any], now_ns: int) -> dict[str, Any]:
        """`status` with the reason, while that is news."""
        if not self.reason or now_ns - self.last_ns > _OVERLOAD_SHOWN_S * SECOND_NS:
            return status
        return {**status, "reason": "; ".join(filter(None, (status["reason"], self.reason)))}


@dataclass
class Peer:
    """safe: all its keyframes below this number will be there after a crash, and so are acknowledged.
    unsafe: how many are applied and not safe yet. voice: as of `KeepRun`."""

    hello: Hello
    key: str  # names this run: the name, and some of the run id
    last_received_ns: int
    reorder_buffer: ReorderBuffer = field(default_factory=ReorderBuffer)
    durable_below: int = 0
    odometry_base: OdometryBase | None = None
    status: PeerStatus = field(default_factory=PeerStatus)
    counts: Counter[str] = field(default_factory=Counter)
    refusals: RefusedMessages = field(default_factory=RefusedMessages)
    suspect_keyframes: SuspectKeyframes = field(default_factory=SuspectKeyframes)
    overload: OverloadNotice = field(default_factory=OverloadNotice)
    revision: int = 0
    is_gone: bool = False
    last_finding: MapEvent | None = None  # the newest correction; who has been away may not have got it
    is_welcomed: bool = True  # in this life of the edge
    has_sent: bool = True  # likewise
    pending_saves: int = 0
    credential: str | None = ""

    @property
    def is_idle(self) -> bool:
        """Whether it is gone and never sent a keyframe."""
        return self.is_gone and self.reorder_buffer.next_keyframe == 0

    def overload_reason(self) -> str | None:
        """Why no other keyframe is applied now; None if one may be."""
        return (
            f"{self.pending_saves} keyframes wait for the disk"
            if self.pending_saves >= _MAX_PENDING_SAVES
            else None
        )

    def sanitise(self, keyframe: Keyframe) -> tuple[Keyframe, str | None]:
        """The next keyframe in order as the map may have it, and what was wrong with it.

        The step of one that leaps, or whose step is not that between its two poses, is not believed: it
        begins a stretch, in the same odom. A covariance beyond all measure is bounded.
        Raises ValueError where what it refers to is not the keyframe before it.
        """
        problem = None
        if keyframe.reference >= 0:
            if self.odometry_base is None or keyframe.reference != self.odometry_base.id:
                raise ValueError(
                    f"keyframe {keyframe.id} refers to {keyframe.reference}, which is not the last"
                )
            if jump_m := self.odometry_base.jump_m(keyframe):
                problem = f"keyframe {keyframe.id} is {jump_m:.0f} m from the one before: new segment"
            elif contradiction := self.odometry_base.contradiction(keyframe):
                problem = f"keyframe {keyframe.id}: {contradiction}: new segment"
            if problem:
                keyframe = replace(keyframe, reference=-1, T_ref_body=keyframe.T_odom_body)
        self.odometry_base = OdometryBase.from_keyframe(keyframe)
        if (max_variance := float(keyframe.cov.diagonal().max())) > _MAX_VARIANCE:
            problem = (
                problem or f"keyframe {keyframe.id} has a variance of {max_variance:.0e}; taken as unknown"
            )
            keyframe = replace(keyframe, cov=keyframe.cov * (_MAX_VARIANCE / max_variance))
        return keyframe, problem

    def report(self, now_ns: int) -> dict[str, Any]:
        """edge.json's fields of one run, as far as it was heard."""
        return {
            "kind": str(self.hello.kind),
            "run": self.key,
            **self.overload.annotate(
                self.status.report(now_ns, self.last_received_ns if self.has_sent else None), now_ns
            ),
            "gone": self.is_gone,
            **{name: self.counts[name] for name in _REPORTED_COUNTS},
            "refused_messages": self.refusals.count,
            "last_refusal": self.refusals.reason or None,
            "suspect_keyframes": self.suspect_keyframes.count,
            "last_suspicion": self.suspect_keyframes.reason or None,
        }


@dataclass
class UnjoinedPeers:
    """Peers that have not joined, all as one."""

    counts: Counter[str] = field(default_factory=Counter)
    refusals: RefusedMessages = field(default_factory=RefusedMessages)


_REPORTED_COUNTS = (
    "keyframes",
    "poses",
    "evaluations",
    "corrections",
    "bytes_up",
    "bytes_down",
    "bad_messages",
    "unexpected",
)


def refusal_warnings(peers: Iterable[Peer], unjoined: UnjoinedPeers, now_ns: int) -> list[str]:
    """Who sends again and again what is refused or doubted: a line each."""
    by_sender: dict[str, list[RefusedMessages]] = {}
    for peer in peers:
        by_sender.setdefault(f"agent '{peer.hello.name}'", []).extend((peer.refusals, peer.suspect_keyframes))
    by_sender["peers that have not joined"] = [unjoined.refusals]
    lines = (
        (sender, refusals.warning_line(now_ns))
        for sender, sender_refusals in by_sender.items()
        for refusals in sender_refusals
    )
    return [f"{sender}: {line}" for sender, line in lines if line]


def restored_runs(stored: StoredMap, position_sigma_m: float) -> list[RestoredRun]:
    """Of all earlier lives. What comes after a run's last keyframe that is there is asked for. known_m: how
    surely such a run's place in another's map is known until that is solved anew, 1 sigma.

    Who was in a map that loops have joined to another since poses were kept is told once that is solved.
    """
    cov = np.diag([0.0, 0.0, 0.0, *[position_sigma_m**2 / 3] * 3])
    last = {keyframe.run_key: keyframe.keyframe for keyframe in stored.keyframes}
    placements = map_poses(stored)
    merged_maps = _merged_maps(stored.loops, {key: map_id for key, (map_id, _) in placements.items()})
    out = []
    for run in stored.runs:
        if (keyframe := last.get(run.run_key)) is None:
            out.append(RestoredRun(run.run_key, run.hello, None, 0, credential=run.credential))
            continue
        map_id, T_map_body = placements[KeyframeKey(run.run_key, keyframe.id)]
        if map_id in merged_maps:
            out.append(
                RestoredRun(
                    run.run_key,
                    run.hello,
                    OdometryBase.from_keyframe(keyframe),
                    keyframe.id + 1,
                    credential=run.credential,
                )
            )
            continue
        T_map_odom = se3.orthonormal(T_map_body @ se3.inverse(keyframe.T_odom_body))
        cov_body = None if map_id.startswith(f"{run.run_key}/") else cov
        cov_odom = None if cov_body is None else se3.inverse_cov(keyframe.T_odom_body, cov_body)
        finding = map_assignment(run.run_key, map_id, T_map_odom, keyframe.id, cov_odom)
        out.append(
            RestoredRun(
                run.run_key,
                run.hello,
                OdometryBase.from_keyframe(keyframe),
                keyframe.id + 1,
                finding,
                run.credential,
            )
        )
    return out


def _merged_maps(loops: Iterable[Loop], map_of: Mapping[KeyframeKey, str]) -> set[str]:
    """Maps that loops tie to others."""
    ends = ({map_of[key] for key in (loop.a, loop.b) if key in map_of} for loop in loops)
    return set[str]().union(*(maps for maps in ends if len(maps) > 1))
