"""One run of one agent at the edge: reordering, status, checks of its keyframes, restoring."""

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

MAX_ID_GAP = 1_000_000  # ids that an agent may have dropped since the last one: two days at 5 Hz


class ReorderBuffer:
    """Releases each keyframe of a run once, after its predecessor; buffers a bounded number.

    Ids that the agent dropped are skipped: the predecessor of the next keyframe shows them. Of two versions
    of a buffered keyframe the one with the lower predecessor is the newer.
    """

    def __init__(self, next_keyframe: int = 0, capacity: int = 64) -> None:
        """next_keyframe: one more than the last applied id. capacity: 1 to MAX_BUFFERED."""
        if not 1 <= capacity <= MAX_BUFFERED:
            raise ValueError(f"capacity: {capacity} is outside 1 .. {MAX_BUFFERED}")
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

        Raises ValueError if its id jumps by more than MAX_ID_GAP."""
        if keyframe.id > self.next_keyframe + MAX_ID_GAP:
            raise ValueError(f"keyframe {keyframe.id}: id jumps; expected about {self.next_keyframe}")
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
            del self._waiting[max(self._waiting)]  # drop_newest: the agent resends it
            self.evicted += 1
        return ready

    def ack(self, durable_below: int | None = None) -> Ack:
        """Return the answer to any keyframe, duplicates too: their acknowledgement may have been lost.

        durable_below: applied keyframes from this id on count as buffered (default: none).
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


SILENT_S = 0.7  # agents report twice a second; after this the last report is no longer shown as the state
SILENT = "SILENT"
_NOT_RECEIVED = "no message since the map was restored"


class PeerStatus:
    """An agent's last reported state and its age by the edge's clock."""

    def __init__(self) -> None:
        self.state = TrackState.INITIALISING
        self._reason = ""
        self._age_ms: float | None = None  # of the newest pose at `_age_at_ns`
        self._age_at_ns = 0
        self._has_left = False

    def update(self, status: Status, now_ns: int) -> None:
        self.state, self._reason, self._has_left = status.state, status.reason, False
        self._age_ms, self._age_at_ns = status.pose_age_ms, now_ns

    def add_pose(self, state: TrackState, now_ns: int) -> None:
        """Record a pose message. Its pose is about as old as the newest was at the last status."""
        if state is not self.state:
            self._reason = ""
        self.state, self._has_left = state, False
        if state.has_pose:
            self._age_at_ns = now_ns

    def leave(self) -> None:
        """Record a bye: silence is expected from now on."""
        self._has_left = True

    def report(self, now_ns: int, last_received_ns: int | None) -> dict[str, Any]:
        """Return plain data. state: SILENT without a message for SILENT_S. pose_age_ms: None if never
        reported. last_received_ns: time of the last message; None: none in this session."""
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


_MAX_JUMP_M = 2.0  # largest plausible motion between keyframes,
_MAX_JUMP_M_S = 10.0  # plus this for each second in between
# T_ref_body is the filter's present estimate, T_odom_body its estimate then (docs/understand/mapping.md):
# measured on
# correct agents they differ by up to 3 cm after 8 s and 6 m, and by 2.7 degrees while a headset's tilt
# converges.
_MAX_MISMATCH_M = 0.3
_MISMATCH_PER_M = 0.05  # added for each m of motion
_MAX_MISMATCH_RAD = float(np.radians(12.0))
_MIN_REFUSALS = 10  # refused messages before a warning
_RECENT_S = 10.0  # since the newest of them, while the warning is shown
_OVERLOAD_SHOWN_S = 2.0  # how long a status shows that keyframes were deferred
_MAX_PENDING_SAVES = 256  # keyframes that may wait for the disk; an agent has 16 in flight
_MAX_VARIANCE = 100.0  # rad^2, m^2: as good as unknown; more would make the solver ill-conditioned


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
            return None
        mismatch_deg = np.degrees(mismatch_rad)
        return f"its motion and its two poses differ by {mismatch_m:.2g} m and {mismatch_deg:.2g} degrees"


@dataclass(frozen=True, eq=False)
class RestoredRun:
    """A run stored by an earlier session of the edge.

    odometry_base: its last keyframe; None without one. next_keyframe: id that the edge asks for.
    last_finding: its correction, sent with the welcome. credential: as in `SaveRun`."""

    key: str
    hello: Hello
    odometry_base: OdometryBase | None
    next_keyframe: int
    last_finding: MapEvent | None = None
    credential: str | None = ""


@dataclass
class RefusedMessages:
    """Count of a peer's refused messages, with reason and time of the newest."""

    count: int = 0
    reason: str = ""
    last_ns: int = 0
    label: ClassVar[str] = "messages refused"

    def add(self, reason: str, now_ns: int) -> None:
        self.count, self.reason, self.last_ns = self.count + 1, reason, now_ns

    def warning_line(self, now_ns: int) -> str | None:
        """Return a warning for a person while refusals recur, else None."""
        if self.count < _MIN_REFUSALS or now_ns - self.last_ns > _RECENT_S * SECOND_NS:
            return None
        return f"{self.count} {self.label}, the last: {self.reason}"


class SuspectKeyframes(RefusedMessages):
    """Count of keyframes that were accepted only after a change."""

    label = "suspect keyframes"


@dataclass
class OverloadNotice:
    """Notice that keyframes were deferred for overload; the agent resends them."""

    reason: str = ""
    last_ns: int = 0

    def record(self, reason: str, now_ns: int) -> None:
        self.reason, self.last_ns = reason, now_ns

    def annotate(self, status: dict[str, Any], now_ns: int) -> dict[str, Any]:
        """Return `status` with the reason added while it is recent."""
        if not self.reason or now_ns - self.last_ns > _OVERLOAD_SHOWN_S * SECOND_NS:
            return status
        return {**status, "reason": "; ".join(filter(None, (status["reason"], self.reason)))}


@dataclass
class Peer:
    """A run of an agent. durable_below: keyframes below this id are stored, and so acknowledged.
    pending_saves: number of keyframes applied but not stored yet. credential: as in `SaveRun`."""

    hello: Hello
    key: str  # `new_run_key`
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
    last_finding: MapEvent | None = None  # newest correction, repeated with a welcome
    is_welcomed: bool = True  # in this session of the edge
    has_sent: bool = True  # a message in this session
    pending_saves: int = 0
    credential: str | None = ""

    @property
    def is_idle(self) -> bool:
        """Whether it left without ever sending a keyframe."""
        return self.is_gone and self.reorder_buffer.next_keyframe == 0

    def overload_reason(self) -> str | None:
        """Return why no further keyframe is accepted now; None if one is."""
        return (
            f"{self.pending_saves} keyframes wait for the disk"
            if self.pending_saves >= _MAX_PENDING_SAVES
            else None
        )

    def sanitise(self, keyframe: Keyframe) -> tuple[Keyframe, str | None]:
        """Return the next keyframe as the map accepts it, and what was wrong with it, None if nothing.

        One with an implausible jump, or with a motion that contradicts its two poses, starts a segment in the
        same odom. An excessive covariance is bounded. Raises ValueError if its reference is not the last
        keyframe.
        """
        problem = None
        if keyframe.reference >= 0:
            if self.odometry_base is None or keyframe.reference != self.odometry_base.id:
                raise ValueError(
                    f"keyframe {keyframe.id} refers to {keyframe.reference}, not to the last one"
                )
            if jump_m := self.odometry_base.jump_m(keyframe):
                problem = f"keyframe {keyframe.id} is {jump_m:.0f} m from the previous one: new segment"
            elif contradiction := self.odometry_base.contradiction(keyframe):
                problem = f"keyframe {keyframe.id}: {contradiction}: new segment"
            if problem:
                keyframe = replace(keyframe, reference=-1, T_ref_body=keyframe.T_odom_body)
        self.odometry_base = OdometryBase.from_keyframe(keyframe)
        if (max_variance := float(keyframe.cov.diagonal().max())) > _MAX_VARIANCE:
            problem = (
                problem or f"keyframe {keyframe.id} has a variance of {max_variance:.0e}; treated as unknown"
            )
            keyframe = replace(keyframe, cov=keyframe.cov * (_MAX_VARIANCE / max_variance))
        return keyframe, problem

    def report(self, now_ns: int) -> dict[str, Any]:
        """Return the fields of edge.json that come from the run's messages."""
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
    """Counts of all peers that have not joined, together."""

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
    """Return a warning line for each sender whose messages or keyframes keep being refused or suspect."""
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
    """Return the runs of all earlier sessions; each continues after its last stored keyframe.

    position_sigma_m: standard deviation of a run's position in another agent's map until that is solved
    again. Runs in maps that loops have merged since the poses were stored get their correction from that
    solution.
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
    """Return the maps that loops connect to others."""
    ends = ({map_of[key] for key in (loop.a, loop.b) if key in map_of} for loop in loops)
    return set[str]().union(*(maps for maps in ends if len(maps) > 1))
