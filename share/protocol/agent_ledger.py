"""The agent's book of keyframes: what was sent, what has been acknowledged, what is due again."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from share.config import AgentConfig, LinkConfig
from share.geometry.se3 import compose_cov, orthonormal
from share.rates import seconds
from share.types import F64, Candidate, Keyframe
from share.wire.messages import Ack, Welcome


@dataclass(eq=False, slots=True)
class Entry:
    """A keyframe, its frame, and how far it has come."""

    keyframe: Keyframe
    frame: int
    arrived_ns: int
    attempts: int = 0  # in this life of the edge
    sendings: int = 0  # that the link took, in any life
    due_ns: int | None = None  # None: now
    sent_ns: int = 0
    replayed: bool = False  # an earlier life of the edge had acknowledged it
    answered: bool = False  # a correction based on it came back


class Ledger:
    """Keyframes in order of their ids: first those acknowledged, then those open.

    Only the first `window` open ones are in flight. A full ledger drops the oldest acknowledged one
    (policy drop_oldest_acknowledged); where none is, the oldest open one (drop_oldest), and the next
    keyframe is then made relative to what that one was relative to. `counts` has both, by name.
    """

    def __init__(self, agent: AgentConfig, link: LinkConfig) -> None:
        self.counts: Counter[str] = Counter()
        self._keep = agent.keep_keyframes
        self._link = link
        self._acknowledged: dict[int, Entry] = {}
        self._open: dict[int, Entry] = {}
        self._held: frozenset[int] = frozenset()  # arrived, but waiting at the edge for a gap to close
        self._sent_to = -1  # highest id put on the wire in this life of the edge
        self._ever_sent_to = -1  # in any life

    def __len__(self) -> int:
        return len(self._acknowledged) + len(self._open)

    @property
    def open(self) -> int:
        """How many keyframes are not acknowledged."""
        return len(self._open)

    @property
    def unacknowledged(self) -> int:
        """How many keyframes are not known to be safe at the edge, those included that were dropped."""
        return len(self._open) + self.counts["drop_oldest"]

    @property
    def held(self) -> int:
        """How many of them the edge has, but has not made safe."""
        return sum(keyframe in self._open for keyframe in self._held)

    @property
    def last_acknowledged(self) -> Entry | None:
        return next(reversed(self._acknowledged.values()), None)

    @property
    def next_unsent(self) -> int:
        """No edge can know of a keyframe from here on."""
        return self._ever_sent_to + 1

    def find(self, keyframe: int) -> Entry | None:
        return self._acknowledged.get(keyframe) or self._open.get(keyframe)

    def answered(self, keyframe: int, now_ns: int) -> tuple[Entry | None, float | None]:
        """A correction came of this keyframe. Its entry, if it is remembered; and ms since its frame arrived,
        for the first correction only, and not where a restarted edge was given it again."""
        entry = self.find(keyframe)
        if entry is None or entry.answered or entry.replayed:
            return entry, None
        entry.answered = True
        return entry, (now_ns - entry.arrived_ns) / 1e6

    def add(self, entry: Entry) -> None:
        """Appends the newest keyframe; drops one where that is one too many."""
        self._open[entry.keyframe.id] = entry
        if len(self) > self._keep:
            self._drop()

    def due(self, now_ns: int) -> list[Entry]:
        """What to send now, in order; taken as sent, unless `not_taken` says otherwise."""
        window = list(self._open.values())[: self._link.window]
        chosen = [entry for entry in window if self._is_due(entry, now_ns)]
        for entry in chosen:
            self._count(entry, 1)
            backoff = self._link.resend_s * 2.0 ** min(entry.attempts, 30)
            entry.due_ns = now_ns + seconds(min(backoff, self._link.resend_max_s))
            entry.attempts += 1
            entry.sent_ns = now_ns
            self._sent_to = max(self._sent_to, entry.keyframe.id)
        self._ever_sent_to = max(self._ever_sent_to, self._sent_to)
        return chosen

    def not_taken(self, keyframe: int) -> None:
        """The link had no room for one that was due, or nobody to take it to. It is due again in its time."""
        if (entry := self.find(keyframe)) is not None and entry.sendings:
            self._count(entry, -1)

    def _count(self, entry: Entry, change: int) -> None:
        """One sending more or less. sent: keyframes; resent: what was sent of them once more."""
        first = max(entry.sendings, entry.sendings + change) == 1
        self.counts["sent" if first else "resent"] += change
        entry.sendings += change

    def acknowledge(self, ack: Ack) -> bool:
        """Takes note of what has arrived; gaps below what is held are due again after `gap_s`.

        Returns whether it is believed: what says more than was sent in this life of the edge is of an
        earlier one, or a lie.
        """
        if ack.next_keyframe > self._sent_to + 1 or max(ack.held, default=-1) > self._ever_sent_to:
            self.counts["bad_acks"] += 1
            return False
        while self._open and (first := next(iter(self._open))) < ack.next_keyframe:
            self._acknowledged[first] = self._open.pop(first)
            self.counts["acknowledged"] += 1
        self._held = frozenset(ack.held)
        top = max(self._held, default=-1)
        if top in self._open:  # it was under way when this life of the edge began
            self._sent_to = max(self._sent_to, top)
        for entry in list(self._open.values())[: self._link.window]:
            if entry.attempts and entry.keyframe.id < top:
                entry.due_ns = min(entry.due_ns or 0, entry.sent_ns + seconds(self._link.gap_s))
        return True

    def resume(self, welcome: Welcome) -> None:
        """The edge was silent and is back: what was on its way is taken as lost, and due."""
        self.acknowledge(Ack(welcome.next_keyframe))
        self._retry()

    def begin(self, welcome: Welcome) -> int:
        """A new life of the edge: everything held from `next_keyframe` on is due. Returns how many.

        The first one stands on its own if this life of the edge does not have what it refers to.
        """
        everything = self._acknowledged | self._open
        for entry in self._acknowledged.values():
            entry.replayed = True
        self._acknowledged = {k: v for k, v in everything.items() if k < welcome.next_keyframe}
        self._open = {k: v for k, v in everything.items() if k >= welcome.next_keyframe}
        self._sent_to = welcome.next_keyframe - 1
        first = next(iter(self._open.values()), None)
        if first and first.keyframe.follows >= welcome.next_keyframe:
            first.keyframe = _cut_loose(first)
        for entry in self._open.values():
            entry.attempts = 0
        self._retry()
        return self.open

    def _is_due(self, entry: Entry, now_ns: int) -> bool:
        if entry.keyframe.id in self._held and entry.keyframe.id != next(iter(self._open)):
            return False  # the oldest open one is never safe there: what it waits for may be dropped here
        return entry.due_ns is None or entry.due_ns <= now_ns

    def _retry(self) -> None:
        self._held = frozenset()
        for entry in self._open.values():
            entry.due_ns = None

    def _drop(self) -> None:
        if self._acknowledged:
            del self._acknowledged[next(iter(self._acknowledged))]
            self.counts["drop_oldest_acknowledged"] += 1
            return
        dropped = self._open.pop(next(iter(self._open))).keyframe
        self.counts["drop_oldest"] += 1
        heir = next(iter(self._open.values()), None)
        if heir:
            heir.keyframe = _inherit(heir.keyframe, dropped)
            heir.due_ns = None


def _inherit(keyframe: Keyframe, dropped: Keyframe) -> Keyframe:
    """`keyframe` relative to what the dropped one, its predecessor, was relative to."""
    if keyframe.reference != dropped.id:  # a stretch of its own
        return replace(keyframe, follows=dropped.follows)
    return replace(
        keyframe,
        reference=dropped.reference,
        follows=dropped.follows,
        T_ref_body=dropped.T_ref_body @ keyframe.T_ref_body,
        cov=compose_cov(keyframe.T_ref_body, dropped.cov, keyframe.cov),
    )


def _cut_loose(entry: Entry) -> Keyframe:
    """The keyframe at the beginning of a stretch, for an edge that has nothing before it."""
    return replace(entry.keyframe, reference=-1, follows=-1, T_ref_body=entry.keyframe.T_odom_body)


# ---- From candidates to keyframes: numbers, relative poses, and the covariance of what is left out.


class Chain:
    """Every keyframe is relative to the one before it, across the candidates that were not sent."""

    _T_keyframe_candidate: F64
    _cov: F64  # of it

    def __init__(self) -> None:
        self.next_id = 0
        self.first_of_stretch = 0  # lowest id that the present stretch of odometry has or will have
        self._begun = False  # else the next keyframe begins a stretch
        self._forget_motion()

    def break_off(self) -> None:
        """Odometry broke: what comes now is of another stretch."""
        self.first_of_stretch = self.next_id
        self._begun = False
        self._forget_motion()

    def extend(self, candidate: Candidate) -> None:
        """Takes note of a candidate's motion, whether or not it will be sent."""
        if candidate.new_stretch:
            self.break_off()
        T = candidate.T_last_body
        self._T_keyframe_candidate = orthonormal(self._T_keyframe_candidate @ T)
        self._cov = compose_cov(T, self._cov, candidate.cov)

    def keyframe(self, candidate: Candidate, stamp_ns: int) -> Keyframe:
        """The last extended candidate as the next keyframe."""
        keyframe = Keyframe(
            id=self.next_id,
            reference=self.next_id - 1 if self._begun else -1,
            stamp_ns=stamp_ns,
            T_ref_body=self._T_keyframe_candidate if self._begun else candidate.T_odom_body,
            cov=self._cov,
            T_odom_body=candidate.T_odom_body,
            up=candidate.up,
            up_sigma=candidate.up_sigma,
            view=candidate.view,
            follows=self.next_id - 1,
        )
        self.next_id += 1
        self._begun = True
        self._forget_motion()
        return keyframe

    def _forget_motion(self) -> None:
        """What is summed up from here on is since the last keyframe, or since the stretch began."""
        self._T_keyframe_candidate, self._cov = np.eye(4), np.zeros((6, 6))
