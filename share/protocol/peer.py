"""One run of one agent at the edge: its state, its faults, and runs restored from a stored map."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from share.geometry import se3
from share.mapping.corrections import MapEvent, map_assignment
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import StoredMap, map_poses
from share.protocol.agent_health import MISSED_S, SILENT, PoseAges, agent_troubles
from share.protocol.correction_delay import ComputationDelay
from share.protocol.keyframe_intake import OdometryBase, ReorderBuffer
from share.scheduling.room_budget import RateGrant
from share.timing import SECOND_NS, seconds_to_ns
from share.types import TrackState
from share.wire.messages import Hello, PoseUpdate, Status, peer_id

SILENT_S = 0.7  # agents report twice a second; after this the last report is no longer shown as the state


class PeerStatus:
    """An agent's last reported state and its age by the edge's clock."""

    def __init__(self) -> None:
        self.state = TrackState.INITIALISING
        self._reason = ""
        self._age_ms: float | None = None  # of the newest pose at `_age_at_ns`
        self._age_at_ns = 0
        self._has_left = False
        self._pose_ages = PoseAges()
        self._unacknowledged_ms = 0.0
        self._clock_error_ms: float | None = None

    def update(self, status: Status, now_ns: int) -> None:
        self.state, self._reason, self._has_left = status.state, status.reason, False
        self._age_ms, self._age_at_ns = status.pose_age_ms, now_ns
        self._unacknowledged_ms, self._clock_error_ms = status.unacknowledged_ms, status.clock_error_ms

    def add_pose(self, state: TrackState, now_ns: int, age_ms: float | None = None) -> None:
        """Record a pose message. age_ms: of its pose; None: about that of the newest at the last status."""
        if state is not self.state:
            self._reason = ""
        self.state, self._has_left = state, False
        if state.has_pose:
            self._age_at_ns = now_ns
            if age_ms is not None:
                self._age_ms = age_ms
                self._pose_ages.add(age_ms, now_ns)

    def leave(self) -> None:
        """Record a bye: silence is expected from now on."""
        self._has_left = True

    def is_missed(self, now_ns: int, last_received_ns: int) -> bool:
        """Return whether an agent that is gone went without a bye, not long ago."""
        return not self._has_left and now_ns - last_received_ns <= seconds_to_ns(MISSED_S)

    def report(self, now_ns: int, last_received_ns: int | None, is_gone: bool = False) -> dict[str, Any]:
        """Return plain data. state: SILENT without a message for SILENT_S. pose_age_ms: None if never
        reported. last_received_ns: time of the last message; None: none in this session."""
        if last_received_ns is None:
            reason = "no message since the map was restored"
            unknown = {"state": SILENT, "reason": reason, "pose_age_ms": None, "last_received_s": None}
            return unknown | self._link_report(now_ns)
        silent_ns = max(0, now_ns - last_received_ns)
        since_ms = max(0, now_ns - self._age_at_ns) / 1e6
        silent = silent_ns > seconds_to_ns(SILENT_S) and not self._has_left
        is_missed = not is_gone or self.is_missed(now_ns, last_received_ns)
        how_long = f"silent for {silent_ns / SECOND_NS:.1f} s" if is_missed else "gone without a word"
        reason = f"{how_long}; its last state was {self.state}"
        return {
            "state": SILENT if silent else str(self.state),
            "reason": reason if silent else self._reason,
            "pose_age_ms": None if self._age_ms is None else round(self._age_ms + since_ms, 1),
            "last_received_s": round(silent_ns / SECOND_NS, 3),
            **self._link_report(now_ns),
        }

    def _link_report(self, now_ns: int) -> dict[str, Any]:
        return {
            **self._pose_ages.report(now_ns),
            "unacknowledged_ms": round(self._unacknowledged_ms, 1),
            "clock_error_ms": None if self._clock_error_ms is None else round(self._clock_error_ms, 3),
        }


_MIN_FAULTS = 10  # faults before a warning
_RECENT_S = 10.0  # since the newest of them, while the warning is shown
_OVERLOAD_SHOWN_S = 2.0  # how long a status shows that keyframes were deferred
_MAX_PENDING_SAVES = 256  # keyframes that may wait for the disk; an agent has 16 in flight
_REPORTED_COUNTS = (
    *("keyframes", "poses", "evaluations", "corrections", "bytes_up", "bytes_down"),
    *("bad_messages", "unexpected"),
)


@dataclass
class Faults:
    """Count of one kind of faults of a peer, with reason and time of the newest."""

    count: int = 0
    reason: str = ""
    last_ns: int = 0

    def add(self, reason: str, now_ns: int) -> None:
        self.count, self.reason, self.last_ns = self.count + 1, reason, now_ns

    def is_recent(self, now_ns: int, within_s: float) -> bool:
        return self.count > 0 and now_ns - self.last_ns <= within_s * SECOND_NS


@dataclass(kw_only=True)
class Sender:
    """Counts of the messages of a peer, or of all peers that have not joined together."""

    counts: Counter[str] = field(default_factory=Counter)
    refusals: Faults = field(default_factory=Faults)  # refused messages

    def count(self, kind: str, reason: str, now_ns: int) -> int:
        """Count a refused message of this kind; return their number."""
        self.counts[kind] += 1
        self.refusals.add(reason, now_ns)
        return self.counts[kind]


@dataclass
class RoomEntry:
    """What is left to do for a run that has come from another room. is_entering: none of its keyframes is in
    this room's map yet. Until `until_ns` it is shown where it was found in a map of this room; withheld: the
    newest correction into a map of its own."""

    until_ns: int
    is_entering: bool = True
    withheld: MapEvent | None = None

    def withholds(self, key: str, map_event: MapEvent) -> bool:
        """Return whether this event of run `key` is not for its agent yet, and keep it."""
        if map_event.correction is None:
            return False
        is_own = map_event.correction.map_id.startswith(f"{key}/")
        self.withheld = map_event if is_own else None
        return is_own


@dataclass(eq=False)
class Peer(Sender):
    """A run of an agent. id: of the transport. session: the number that its agent knows this edge by.
    durable_below: keyframes below this id are stored, and so acknowledged. pending_saves: number of keyframes
    applied but not stored yet. odometry_base: the newest applied keyframe. forgotten_below: no keyframe after
    that and below this id is known here any more. credential: as in `SaveRun`."""

    id: bytes
    hello: Hello
    key: str  # `new_run_key`
    last_received_ns: int
    session: int
    reorder_buffer: ReorderBuffer = field(default_factory=ReorderBuffer)
    durable_below: int = 0
    odometry_base: OdometryBase | None = None
    forgotten_below: int = 0
    status: PeerStatus = field(default_factory=PeerStatus)
    suspect_keyframes: Faults = field(default_factory=Faults)  # accepted only after a change
    overload: Faults = field(default_factory=Faults)  # keyframes that were deferred; the agent resends them
    revision: int = 0
    is_gone: bool = False
    last_correction_event: MapEvent | None = None  # newest correction, repeated with a welcome
    is_welcomed: bool = True  # in this session of the edge
    has_sent: bool = True  # a message in this session
    joined_ns: int | None = None  # first message in this session
    latest_pose: PoseUpdate | None = None
    rtt_ms: float | None = None  # that it reports
    pending_saves: int = 0
    grant: RateGrant | None = None  # the last that was sent
    computation: ComputationDelay = field(default_factory=ComputationDelay)
    credential: str | None = ""
    entry: RoomEntry | None = None  # of a run that has come from another room
    since_last_ns: int = 0  # from the message before the newest until that; 0: there was none
    arrival_ms: float = 0.0  # `since_last_ns` of its newest keyframe: how long that took to arrive, at most

    @property
    def map_id(self) -> str | None:
        """Map of its newest correction."""
        correction = None if self.last_correction_event is None else self.last_correction_event.correction
        return None if correction is None else correction.map_id

    @property
    def name(self) -> str:
        return self.hello.name

    @property
    def is_idle(self) -> bool:
        """Whether it left without a keyframe since it joined."""
        return self.is_gone and self.odometry_base is None and not self.pending_saves

    @property
    def overload_reason(self) -> str | None:
        """Why no further keyframe is accepted now; None if one is."""
        is_full = self.pending_saves >= _MAX_PENDING_SAVES
        return f"{self.pending_saves} keyframes wait for the disk" if is_full else None

    def mark_received(self, now_ns: int) -> None:
        """Record that it has sent a message."""
        self.since_last_ns = now_ns - self.last_received_ns if self.has_sent else 0
        self.last_received_ns, self.has_sent = now_ns, True
        if self.joined_ns is None:
            self.joined_ns = now_ns

    def add_pose(self, pose: PoseUpdate, now_ns: int) -> None:
        self.counts["poses"] += 1
        self.status.add_pose(pose.state, now_ns, pose.age_ms)
        self.latest_pose = pose

    def report(self, now_ns: int, rating: Mapping[str, Any], is_latest: bool = True) -> dict[str, Any]:
        """Return the fields of edge.json that come from the run's messages. rating: of `RateScheduler`.
        is_latest: of its name; no other run is missed."""
        status = self.status.report(now_ns, self.last_received_ns if self.has_sent else None, self.is_gone)
        if self.overload.is_recent(now_ns, _OVERLOAD_SHOWN_S):
            status["reason"] = "; ".join(filter(None, (status["reason"], self.overload.reason)))
        report = {
            "kind": str(self.hello.kind),
            "run": self.key,
            **status,
            "gone": self.is_gone,
            "rtt_ms": None if self.rtt_ms is None else round(self.rtt_ms, 3),
            **{name: self.counts[name] for name in _REPORTED_COUNTS},
            "refused_messages": self.refusals.count,
            "last_refusal": self.refusals.reason or None,
            "suspect_keyframes": self.suspect_keyframes.count,
            "last_suspicion": self.suspect_keyframes.reason or None,
            **rating,
        }
        if not self.is_gone:
            joined_s = 0.0 if self.joined_ns is None else (now_ns - self.joined_ns) * 1e-9
            return report | {"trouble": agent_troubles(self.hello.kind, report, joined_s)}
        is_trouble = is_latest and self.is_missed(now_ns)
        return report | {"trouble": [f"{SILENT}: {report['reason']}"] if is_trouble else []}

    def is_missed(self, now_ns: int) -> bool:
        """Return whether it has gone without a bye, not long ago."""
        return self.is_gone and self.has_sent and self.status.is_missed(now_ns, self.last_received_ns)


def fault_warnings(peers: Iterable[Peer], unjoined: Sender, now_ns: int) -> list[str]:
    """Return a warning line for each sender with repeatedly refused messages or suspect keyframes."""
    kinds = list[tuple[str, str, Faults]]()
    for peer in peers:
        kinds.append((f"agent '{peer.name}'", "messages refused", peer.refusals))
        kinds.append((f"agent '{peer.name}'", "suspect keyframes", peer.suspect_keyframes))
    return [*stranger_lines(unjoined, now_ns), *fault_lines(kinds, now_ns)]


def stranger_lines(unjoined: Sender, now_ns: int) -> list[str]:
    """Return a warning line if messages of peers that have not joined are many and recent."""
    return fault_lines([("peers that have not joined", "messages refused", unjoined.refusals)], now_ns)


def fault_lines(kinds: Iterable[tuple[str, str, Faults]], now_ns: int) -> list[str]:
    """Return a warning line for each sender, kind and faults that are many and recent."""
    return [
        f"{sender}: {faults.count} {kind}, the last: {faults.reason}"
        for sender, kind, faults in kinds
        if faults.count >= _MIN_FAULTS and faults.is_recent(now_ns, _RECENT_S)
    ]


@dataclass(frozen=True, eq=False)
class RestoredRun:
    """A run stored by an earlier session of the edge.

    odometry_base: its last keyframe; None without one. last_correction_event: sent with the
    welcome. credential: as in `SaveRun`. next_id: above the ids of all keyframes that it ever had here, also
    those that were removed."""

    key: str
    hello: Hello
    odometry_base: OdometryBase | None
    last_correction_event: MapEvent | None = None
    credential: str | None = ""
    next_id: int = 0

    @property
    def next_keyframe(self) -> int:
        """Id of the keyframe that the edge asks for."""
        return max(self.next_id, 0 if self.odometry_base is None else self.odometry_base.id + 1)

    @classmethod
    def from_peer(cls, peer: Peer) -> RestoredRun:
        """Return a run as it is now: its keyframes are all stored."""
        return cls(
            key=peer.key,
            hello=peer.hello,
            odometry_base=peer.odometry_base,
            last_correction_event=peer.last_correction_event,
            credential=peer.credential,
            next_id=peer.durable_below,
        )

    def peer(self, session: int) -> Peer:
        """Return the absent run, which may resume where it was. session: of the edge."""
        return Peer(
            id=peer_id(self.hello.run_id),
            hello=self.hello,
            key=self.key,
            last_received_ns=0,
            session=session,
            reorder_buffer=ReorderBuffer(self.next_keyframe),
            durable_below=self.next_keyframe,
            odometry_base=self.odometry_base,
            forgotten_below=self.next_keyframe,
            is_gone=True,
            last_correction_event=self.last_correction_event,
            is_welcomed=False,
            has_sent=False,
            credential=self.credential,
        )


def restored_runs(stored: StoredMap, position_sigma_m: float) -> list[RestoredRun]:
    """Return the runs of all earlier sessions; each continues after the last keyframe that it ever had here.

    position_sigma_m: standard deviation of a run's position in another agent's map until that is solved
    again. Runs in maps that loops have merged since the poses were stored get their correction from that
    solution.
    """
    cov_body = np.diag([0.0, 0.0, 0.0, *[position_sigma_m**2 / 3] * 3])
    last = {keyframe.run_key: keyframe.keyframe for keyframe in stored.keyframes}
    poses = map_poses(stored)
    loops = ({poses[key][0] for key in (loop.a, loop.b) if key in poses} for loop in stored.loops)
    merged_maps = set[str]().union(*(maps for maps in loops if len(maps) > 1))
    out = []
    for run in stored.runs:
        base = map_event = None
        if (keyframe := last.get(run.run_key)) is not None:
            base = OdometryBase.from_keyframe(keyframe)
            map_id, T_map_body = poses[KeyframeKey(run.run_key, keyframe.id)]
            if map_id not in merged_maps:
                T_map_odom = se3.orthonormal(T_map_body @ se3.inverse(keyframe.T_odom_body))
                is_own_map = map_id.startswith(f"{run.run_key}/")
                cov = None if is_own_map else se3.inverse_cov(keyframe.T_odom_body, cov_body)
                with contextlib.suppress(ValueError):  # beyond all measure: this run waits for a solution
                    map_event = map_assignment(run.run_key, map_id, T_map_odom, keyframe.id, cov)
        next_id = stored.next_ids.get(run.run_key, 0)
        out.append(RestoredRun(run.run_key, run.hello, base, map_event, run.credential, next_id))
    return out
