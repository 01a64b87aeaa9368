"""One run of one agent, as the edge knows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from share.geometry import se3
from share.mapping.changes import Kept, placed
from share.mapping.loops import Key, Loop
from share.mapping.steps import Finding, in_map
from share.rates import SECOND_NS, seconds
from share.types import F64, Keyframe, TrackState
from share.wire.messages import MAX_HELD, Ack, Hello, Status

# ---- Keyframes of one agent, from any order of arrival into the order in which they were made.

MAX_STEP = 1_000_000  # ids that an agent may have dropped since the last: two days alone at 5 Hz


class InOrder:
    """Yields each keyframe once, after the one that it follows; holds a bounded number back.

    Ids that the agent dropped are skipped: the first keyframe after them says so by what it follows.
    Of two versions of a waiting keyframe the one that follows the lower id is the later.
    """

    def __init__(self, next_keyframe: int = 0, hold: int = 64) -> None:
        """next_keyframe: one more than the last id already applied. hold: at most MAX_HELD."""
        if not 1 <= hold <= MAX_HELD:
            raise ValueError(f"hold: {hold} is outside 1 .. {MAX_HELD}")
        self.next_keyframe = next_keyframe
        self.duplicates = 0
        self.evicted = 0
        self._hold = hold
        self._waiting: dict[int, Keyframe] = {}

    def drop_waiting(self) -> None:
        """What is held back was not acknowledged: the agent sends it again."""
        self._waiting.clear()

    def is_new(self, number: int) -> bool:
        """Whether no keyframe of that id has been applied, or waits."""
        return number >= self.next_keyframe and number not in self._waiting

    def push(self, keyframe: Keyframe) -> list[Keyframe]:
        """The keyframes, rising by id, that can be applied now that this one is here.

        Raises ValueError if its id leaps by more than MAX_STEP."""
        if keyframe.id > self.next_keyframe + MAX_STEP:
            raise ValueError(f"keyframe {keyframe.id}: its id leaps; {self.next_keyframe} is expected")
        if keyframe.id < self.next_keyframe:
            self.duplicates += 1
            return []
        self._keep(keyframe)
        ready = []
        while (found := self._applicable()) is not None:
            ready.append(found)
            self.next_keyframe = found.id + 1
            self._waiting = {k: v for k, v in self._waiting.items() if k > found.id}
        if len(self._waiting) > self._hold:
            del self._waiting[max(self._waiting)]  # drop_newest: the agent sends it again
            self.evicted += 1
        return ready

    def ack(self, safe: int | None = None) -> Ack:
        """What to answer to every keyframe, duplicates too: their acknowledgement may have been lost.

        safe: applied keyframes from this number on are only held yet (default: all are safe).
        """
        safe = self.next_keyframe if safe is None else safe
        applied = range(safe, min(self.next_keyframe, safe + MAX_HELD))
        return Ack(safe, (*applied, *sorted(self._waiting))[:MAX_HELD])

    def _keep(self, keyframe: Keyframe) -> None:
        known = self._waiting.get(keyframe.id)
        if known is not None:
            self.duplicates += 1
        if known is None or keyframe.follows < known.follows:
            self._waiting[keyframe.id] = keyframe

    def _applicable(self) -> Keyframe | None:
        ready = (k for k in sorted(self._waiting) if self._waiting[k].follows < self.next_keyframe)
        first = next(ready, None)
        return None if first is None else self._waiting[first]


# ---- What an agent last said of its own state, and how old that is by the edge's clock.

SILENT_S = 0.7  # an agent says something twice a second; after this what it said is not shown as its state
SILENT = "SILENT"
_UNHEARD = "not heard since the map was taken up again"


class PeerStatus:
    """Fed with what the agent says; `report` is true of the moment that it is asked for."""

    def __init__(self) -> None:
        self.state = TrackState.INITIALISING
        self._reason = ""
        self._age_ms: float | None = None  # of the newest pose, when `_at_ns` was
        self._at_ns = 0
        self._has_left = False

    def told(self, status: Status, now_ns: int) -> None:
        self.state, self._reason, self._has_left = status.state, status.reason, False
        self._age_ms, self._at_ns = status.pose_age_ms, now_ns

    def posed(self, state: TrackState, now_ns: int) -> None:
        """A pose has come. It is about as old as the newest was when the agent last said how old that was."""
        if state is not self.state:
            self._reason = ""
        self.state, self._has_left = state, False
        if state.has_pose:
            self._at_ns = now_ns

    def left(self) -> None:
        """It said bye: its silence is no news."""
        self._has_left = True

    def report(self, now_ns: int, heard_ns: int | None) -> dict[str, Any]:
        """Plain data. state: SILENT where nothing was heard for SILENT_S. pose_age_ms: None if never told.
        heard_ns: when the agent was last heard; None: not in this life of the edge."""
        if heard_ns is None:
            return {"state": SILENT, "reason": _UNHEARD, "pose_age_ms": None, "heard_s": None}
        silent_ns = max(0, now_ns - heard_ns)
        since_ms = max(0, now_ns - self._at_ns) / 1e6
        silent = silent_ns > seconds(SILENT_S) and not self._has_left
        reason = f"silent for {silent_ns / SECOND_NS:.1f} s; its last state was {self.state}"
        return {
            "state": SILENT if silent else str(self.state),
            "reason": reason if silent else self._reason,
            "pose_age_ms": None if self._age_ms is None else round(self._age_ms + since_ms, 1),
            "heard_s": round(silent_ns / SECOND_NS, 3),
        }


_LEAP_M, _LEAP_M_S = 2.0, 10.0  # further than this, and so much more a second, nobody moves between keyframes
# T_ref_body is of what the filter knows now, T_odom_body of what it knew then (docs/edge-map.md): of honest
# agents these differ by up to 3 cm after 8 s and 6 m, and by 2.7 degrees while a headset learns what is up.
_OFF_M, _OFF_A_METRE, _OFF_RAD = 0.3, 0.05, float(np.radians(12.0))
_AGAIN, _RECENT_S = 10, 10.0  # refused messages that are worth a person's while, and for how long
_HELD_S = 2.0  # that it is said of an agent that its keyframes were not taken in
_MAX_UNSAFE = 256  # keyframes that may wait for the disk: an agent has 16 under way
_MOST_VARIANCE = 100.0  # rad^2, m^2: says nothing; more would only upset the solver


@dataclass(frozen=True, eq=False)
class Foot:
    """The newest applied keyframe: its id, its stamp, and T_odom_body (4, 4)."""

    id: int
    stamp_ns: int
    T_odom_body: F64

    @classmethod
    def of(cls, keyframe: Keyframe) -> Foot:
        return cls(keyframe.id, keyframe.stamp_ns, keyframe.T_odom_body)

    def leaps(self, keyframe: Keyframe) -> float:
        """How far (m) the keyframe is from here, if nobody can have moved so far meanwhile, else 0."""
        away = float(np.linalg.norm(keyframe.T_ref_body[:3, 3]))
        passed_s = max(0, keyframe.stamp_ns - self.stamp_ns) / SECOND_NS
        return away if away > _LEAP_M + _LEAP_M_S * passed_s else 0.0

    def contradicts(self, keyframe: Keyframe) -> str | None:
        """How far T_ref_body of the keyframe lies from what its T_odom_body and this one say, if that is more
        than a filter learns of the past meanwhile."""
        T_ref_body = se3.inverse(self.T_odom_body) @ keyframe.T_odom_body
        T = se3.inverse(keyframe.T_ref_body) @ T_ref_body
        off_m, off_rad = float(np.linalg.norm(T[:3, 3])), float(se3.angle(T))
        way_m = float(np.linalg.norm(keyframe.T_ref_body[:3, 3]))
        if off_m <= _OFF_M + _OFF_A_METRE * way_m and off_rad <= _OFF_RAD:
            return None
        return f"its step and its two poses differ by {off_m:.2g} m and {np.degrees(off_rad):.2g} degrees"


@dataclass(frozen=True, eq=False)
class Known:
    """A run that an earlier life of the edge kept. foot: its last keyframe, None without any.
    next_keyframe: the number that is asked for. finding: where it is in the map, to be told at once.
    voice: as of `KeepRun`."""

    key: str
    hello: Hello
    foot: Foot | None
    next_keyframe: int
    finding: Finding | None = None
    voice: str | None = ""


@dataclass
class Refusals:
    """Messages of a peer that were not accepted: how many, and why and when the newest was not."""

    n: int = 0
    reason: str = ""
    at_ns: int = 0
    what: ClassVar[str] = "messages refused"

    def add(self, reason: str, now_ns: int) -> None:
        self.n, self.reason, self.at_ns = self.n + 1, reason, now_ns

    def line(self, now_ns: int) -> str | None:
        """For a person, while it happens again and again."""
        if self.n < _AGAIN or now_ns - self.at_ns > _RECENT_S * SECOND_NS:
            return None
        return f"{self.n} {self.what}, the last: {self.reason}"


class Doubts(Refusals):
    """Keyframes that were taken in, but not as they came."""

    what = "keyframes doubted"


@dataclass
class HeldBack:
    """Keyframes that were not taken in, since there were too many, and are sent again."""

    reason: str = ""
    at_ns: int = 0

    def note(self, reason: str, now_ns: int) -> None:
        self.reason, self.at_ns = reason, now_ns

    def said(self, status: dict[str, Any], now_ns: int) -> dict[str, Any]:
        """`status` with the reason, while that is news."""
        if not self.reason or now_ns - self.at_ns > _HELD_S * SECOND_NS:
            return status
        return {**status, "reason": "; ".join(filter(None, (status["reason"], self.reason)))}


@dataclass
class Peer:
    """safe: all its keyframes below this number will be there after a crash, and so are acknowledged.
    unsafe: how many are applied and not safe yet. voice: as of `KeepRun`."""

    hello: Hello
    key: str  # names this run: the name, and some of the run id
    heard_ns: int
    inorder: InOrder = field(default_factory=InOrder)
    safe: int = 0
    foot: Foot | None = None
    status: PeerStatus = field(default_factory=PeerStatus)
    counts: Counter[str] = field(default_factory=Counter)
    refusals: Refusals = field(default_factory=Refusals)
    doubts: Doubts = field(default_factory=Doubts)
    held_back: HeldBack = field(default_factory=HeldBack)
    revision: int = 0
    gone: bool = False
    newest: Finding | None = None  # the newest correction; who has been away may not have got it
    greeted: bool = True  # in this life of the edge
    was_heard: bool = True  # likewise
    unsafe: int = 0
    voice: str | None = ""

    @property
    def is_idle(self) -> bool:
        """Whether it is gone and never sent a keyframe."""
        return self.gone and self.inorder.next_keyframe == 0

    def too_many(self) -> str | None:
        """Why no other keyframe is applied now; None if one may be."""
        return f"{self.unsafe} keyframes wait for the disk" if self.unsafe >= _MAX_UNSAFE else None

    def place(self, keyframe: Keyframe) -> tuple[Keyframe, str | None]:
        """The next keyframe in order as the map may have it, and what was wrong with it.

        The step of one that leaps, or whose step is not that between its two poses, is not believed: it
        begins a stretch, in the same odom. A covariance beyond all measure is bounded.
        Raises ValueError where what it refers to is not the keyframe before it.
        """
        complaint = None
        if keyframe.reference >= 0:
            if self.foot is None or keyframe.reference != self.foot.id:
                raise ValueError(
                    f"keyframe {keyframe.id} refers to {keyframe.reference}, which is not the last"
                )
            if leap_m := self.foot.leaps(keyframe):
                complaint = f"keyframe {keyframe.id} is {leap_m:.0f} m from the one before: a new stretch"
            elif why := self.foot.contradicts(keyframe):
                complaint = f"keyframe {keyframe.id}: {why}: a new stretch"
            if complaint:
                keyframe = replace(keyframe, reference=-1, T_ref_body=keyframe.T_odom_body)
        self.foot = Foot.of(keyframe)
        if (most := float(keyframe.cov.diagonal().max())) > _MOST_VARIANCE:
            complaint = complaint or f"keyframe {keyframe.id} has a variance of {most:.0e}; taken as unknown"
            keyframe = replace(keyframe, cov=keyframe.cov * (_MOST_VARIANCE / most))
        return keyframe, complaint

    def report(self, now_ns: int) -> dict[str, Any]:
        """edge.json's fields of one run, as far as it was heard."""
        return {
            "kind": str(self.hello.kind),
            "run": self.key,
            **self.held_back.said(
                self.status.report(now_ns, self.heard_ns if self.was_heard else None), now_ns
            ),
            "gone": self.gone,
            **{name: self.counts[name] for name in _COUNTS},
            "refused_messages": self.refusals.n,
            "last_refusal": self.refusals.reason or None,
            "doubted_keyframes": self.doubts.n,
            "last_doubt": self.doubts.reason or None,
        }


@dataclass
class Strangers:
    """Peers that have not joined, all as one."""

    counts: Counter[str] = field(default_factory=Counter)
    refusals: Refusals = field(default_factory=Refusals)


_COUNTS = (
    "keyframes",
    "poses",
    "evaluations",
    "corrections",
    "bytes_up",
    "bytes_down",
    "bad_messages",
    "unexpected",
)


def refused_lines(peers: Iterable[Peer], strangers: Strangers, now_ns: int) -> list[str]:
    """Who sends again and again what is refused or doubted: a line each."""
    found: dict[str, list[Refusals]] = {}
    for peer in peers:
        found.setdefault(f"agent '{peer.hello.name}'", []).extend((peer.refusals, peer.doubts))
    found["peers that have not joined"] = [strangers.refusals]
    lines = ((who, one.line(now_ns)) for who, several in found.items() for one in several)
    return [f"{who}: {line}" for who, line in lines if line]


def known_runs(kept: Kept, known_m: float) -> list[Known]:
    """Of all earlier lives. What comes after a run's last keyframe that is there is asked for. known_m: how
    surely such a run's place in another's map is known until that is solved anew, 1 sigma.

    Who was in a map that loops have joined to another since poses were kept is told once that is solved.
    """
    cov = np.diag([0.0, 0.0, 0.0, *[known_m**2 / 3] * 3])
    last = {found.key: found.keyframe for found in kept.keyframes}
    there = placed(kept)
    joined = _joined_since(kept.loops, {key: map_id for key, (map_id, _) in there.items()})
    out = []
    for run in kept.runs:
        if (found := last.get(run.key)) is None:
            out.append(Known(run.key, run.hello, None, 0, voice=run.voice))
            continue
        map_id, T_map_body = there[Key(run.key, found.id)]
        if map_id in joined:
            out.append(Known(run.key, run.hello, Foot.of(found), found.id + 1, voice=run.voice))
            continue
        T_map_odom = se3.orthonormal(T_map_body @ se3.inverse(found.T_odom_body))
        at_body = None if map_id.startswith(f"{run.key}/") else cov
        at_odom = None if at_body is None else se3.inverse_cov(found.T_odom_body, at_body)
        finding = in_map(run.key, map_id, T_map_odom, found.id, at_odom)
        out.append(Known(run.key, run.hello, Foot.of(found), found.id + 1, finding, run.voice))
    return out


def _joined_since(loops: Iterable[Loop], map_of: Mapping[Key, str]) -> set[str]:
    """Maps that loops tie to others."""
    ends = ({map_of[key] for key in (loop.a, loop.b) if key in map_of} for loop in loops)
    return set[str]().union(*(maps for maps in ends if len(maps) > 1))
