"""The agent's book of keyframes: what was sent, what has been acknowledged, what is due again."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from share.config import AgentConfig, LinkConfig
from share.geometry.se3 import compose_cov, orthonormal
from share.timing import seconds_to_ns
from share.types import F64, Keyframe, KeyframeCandidate
from share.wire.messages import Ack, Welcome


@dataclass(eq=False, slots=True)
class LedgerEntry:
    """A keyframe, its frame, and how far it has come."""

    keyframe: Keyframe
    frame_index: int
    arrived_ns: int
    attempts: int = 0  # in this life of the edge
    send_count: int = 0  # that the link took, in any life
    due_ns: int | None = None  # None: now
    sent_ns: int = 0
    is_replayed: bool = False  # an earlier life of the edge had acknowledged it
    is_corrected: bool = False  # a correction based on it came back


class KeyframeLedger:
    """Keyframes in order of their ids: first those acknowledged, then those open.

    Only the first `window` open ones are in flight. A full ledger drops the oldest acknowledged one
    (policy drop_oldest_acknowledged); where none is, the oldest open one (drop_oldest), and the next
    keyframe is then made relative to what that one was relative to. `counts` has both, by name.
    """

    def __init__(self, agent: AgentConfig, link: LinkConfig) -> None:
        self.counts: Counter[str] = Counter()
        self._capacity = agent.keep_keyframes
        self._link = link
        self._acknowledged: dict[int, LedgerEntry] = {}
        self._pending: dict[int, LedgerEntry] = {}
        self._buffered_at_edge: frozenset[int] = (
            frozenset()
        )  # arrived, but waiting at the edge for a gap to close
        self._max_sent_id = -1  # highest id put on the wire in this life of the edge
        self._max_ever_sent_id = -1  # in any life

    def __len__(self) -> int:
        return len(self._acknowledged) + len(self._pending)

    @property
    def pending(self) -> int:
        """How many keyframes are not acknowledged."""
        return len(self._pending)

    @property
    def unacknowledged(self) -> int:
        """How many keyframes are not known to be safe at the edge, those included that were dropped."""
        return len(self._pending) + self.counts["drop_oldest"]

    @property
    def buffered_at_edge(self) -> int:
        """How many of them the edge has, but has not made safe."""
        return sum(keyframe in self._pending for keyframe in self._buffered_at_edge)

    @property
    def last_acknowledged(self) -> LedgerEntry | None:
        return next(reversed(self._acknowledged.values()), None)

    @property
    def next_unsent_id(self) -> int:
        """No edge can know of a keyframe from here on."""
        return self._max_ever_sent_id + 1

    def find(self, keyframe: int) -> LedgerEntry | None:
        return self._acknowledged.get(keyframe) or self._pending.get(keyframe)

    def record_correction(self, keyframe: int, now_ns: int) -> tuple[LedgerEntry | None, float | None]:
        """A correction came of this keyframe. Its entry, if it is remembered; and ms since its frame arrived,
        for the first correction only, and not where a restarted edge was given it again."""
        entry = self.find(keyframe)
        if entry is None or entry.is_corrected or entry.is_replayed:
            return entry, None
        entry.is_corrected = True
        return entry, (now_ns - entry.arrived_ns) / 1e6

    def add(self, entry: LedgerEntry) -> None:
        """Appends the newest keyframe; drops one where that is one too many."""
        self._pending[entry.keyframe.id] = entry
        if len(self) > self._capacity:
            self._drop_oldest()

    def take_due(self, now_ns: int) -> list[LedgerEntry]:
        """What to send now, in order; taken as sent, unless `record_send_failure` says otherwise."""
        window = list(self._pending.values())[: self._link.window]
        due = [entry for entry in window if self._is_due(entry, now_ns)]
        for entry in due:
            self._count_sends(entry, 1)
            backoff = self._link.resend_s * 2.0 ** min(entry.attempts, 30)
            entry.due_ns = now_ns + seconds_to_ns(min(backoff, self._link.resend_max_s))
            entry.attempts += 1
            entry.sent_ns = now_ns
            self._max_sent_id = max(self._max_sent_id, entry.keyframe.id)
        self._max_ever_sent_id = max(self._max_ever_sent_id, self._max_sent_id)
        return due

    def record_send_failure(self, keyframe: int) -> None:
        """The link had no room for one that was due, or nobody to take it to. It is due again in its time."""
        if (entry := self.find(keyframe)) is not None and entry.send_count:
            self._count_sends(entry, -1)

    def _count_sends(self, entry: LedgerEntry, change: int) -> None:
        """One sending more or less. sent: keyframes; resent: what was sent of them once more."""
        first = max(entry.send_count, entry.send_count + change) == 1
        self.counts["sent" if first else "resent"] += change
        entry.send_count += change

    def acknowledge(self, ack: Ack) -> bool:
        """Takes note of what has arrived; gaps below what is held are due again after `gap_s`.

        Returns whether it is believed: what says more than was sent in this life of the edge is of an
        earlier one, or a lie.
        """
        if (
            ack.next_keyframe > self._max_sent_id + 1
            or max(ack.buffered, default=-1) > self._max_ever_sent_id
        ):
            self.counts["bad_acks"] += 1
            return False
        while self._pending and (first := next(iter(self._pending))) < ack.next_keyframe:
            self._acknowledged[first] = self._pending.pop(first)
            self.counts["acknowledged"] += 1
        self._buffered_at_edge = frozenset(ack.buffered)
        max_buffered = max(self._buffered_at_edge, default=-1)
        if max_buffered in self._pending:  # it was under way when this life of the edge began
            self._max_sent_id = max(self._max_sent_id, max_buffered)
        for entry in list(self._pending.values())[: self._link.window]:
            if entry.attempts and entry.keyframe.id < max_buffered:
                entry.due_ns = min(entry.due_ns or 0, entry.sent_ns + seconds_to_ns(self._link.gap_s))
        return True

    def resume(self, welcome: Welcome) -> None:
        """The edge was silent and is back: what was on its way is taken as lost, and due."""
        self.acknowledge(Ack(welcome.next_keyframe))
        self._make_all_due()

    def begin_session(self, welcome: Welcome) -> int:
        """A new life of the edge: everything held from `next_keyframe` on is due. Returns how many.

        The first one stands on its own if this life of the edge does not have what it refers to.
        """
        entries = self._acknowledged | self._pending
        for entry in self._acknowledged.values():
            entry.is_replayed = True
        self._acknowledged = {k: v for k, v in entries.items() if k < welcome.next_keyframe}
        self._pending = {k: v for k, v in entries.items() if k >= welcome.next_keyframe}
        self._max_sent_id = welcome.next_keyframe - 1
        first = next(iter(self._pending.values()), None)
        if first and first.keyframe.predecessor >= welcome.next_keyframe:
            first.keyframe = _detach(first)
        for entry in self._pending.values():
            entry.attempts = 0
        self._make_all_due()
        return self.pending

    def _is_due(self, entry: LedgerEntry, now_ns: int) -> bool:
        if entry.keyframe.id in self._buffered_at_edge and entry.keyframe.id != next(iter(self._pending)):
            return False  # the oldest open one is never safe there: what it waits for may be dropped here
        return entry.due_ns is None or entry.due_ns <= now_ns

    def _make_all_due(self) -> None:
        self._buffered_at_edge = frozenset()
        for entry in self._pending.values():
            entry.due_ns = None

    def _drop_oldest(self) -> None:
        if self._acknowledged:
            del self._acknowledged[next(iter(self._acknowledged))]
            self.counts["drop_oldest_acknowledged"] += 1
            return
        dropped = self._pending.pop(next(iter(self._pending))).keyframe
        self.counts["drop_oldest"] += 1
        successor = next(iter(self._pending.values()), None)
        if successor:
            successor.keyframe = _rebase(successor.keyframe, dropped)
            successor.due_ns = None


def _rebase(keyframe: Keyframe, dropped: Keyframe) -> Keyframe:
    """`make_keyframe` relative to what the dropped one, its predecessor, was relative to."""
    if keyframe.reference != dropped.id:  # a stretch of its own
        return replace(keyframe, predecessor=dropped.predecessor)
    return replace(
        keyframe,
        reference=dropped.reference,
        predecessor=dropped.predecessor,
        T_ref_body=dropped.T_ref_body @ keyframe.T_ref_body,
        cov=compose_cov(keyframe.T_ref_body, dropped.cov, keyframe.cov),
    )


def _detach(entry: LedgerEntry) -> Keyframe:
    """The keyframe at the beginning of a stretch, for an edge that has nothing before it."""
    return replace(entry.keyframe, reference=-1, predecessor=-1, T_ref_body=entry.keyframe.T_odom_body)


# ---- From candidates to keyframes: numbers, relative poses, and the covariance of what is left out.


class KeyframeChain:
    """Every keyframe is relative to the one before it, across the candidates that were not sent."""

    _T_keyframe_candidate: F64
    _cov: F64  # of it

    def __init__(self) -> None:
        self.next_id = 0
        self.first_of_segment = 0  # lowest id that the present stretch of odometry has or will have
        self._has_reference = False  # else the next keyframe begins a stretch
        self._reset_motion()

    def begin_segment(self) -> None:
        """Odometry broke: what comes now is of another stretch."""
        self.first_of_segment = self.next_id
        self._has_reference = False
        self._reset_motion()

    def extend(self, candidate: KeyframeCandidate) -> None:
        """Takes note of a candidate's motion, whether or not it will be sent."""
        if candidate.new_segment:
            self.begin_segment()
        T = candidate.T_previous_body
        self._T_keyframe_candidate = orthonormal(self._T_keyframe_candidate @ T)
        self._cov = compose_cov(T, self._cov, candidate.cov)

    def make_keyframe(self, candidate: KeyframeCandidate, stamp_ns: int) -> Keyframe:
        """The last extended candidate as the next keyframe."""
        keyframe = Keyframe(
            id=self.next_id,
            reference=self.next_id - 1 if self._has_reference else -1,
            stamp_ns=stamp_ns,
            T_ref_body=self._T_keyframe_candidate if self._has_reference else candidate.T_odom_body,
            cov=self._cov,
            T_odom_body=candidate.T_odom_body,
            up=candidate.up,
            up_sigma=candidate.up_sigma,
            view=candidate.view,
            predecessor=self.next_id - 1,
        )
        self.next_id += 1
        self._has_reference = True
        self._reset_motion()
        return keyframe

    def _reset_motion(self) -> None:
        """What is summed up from here on is since the last keyframe, or since the stretch began."""
        self._T_keyframe_candidate, self._cov = np.eye(4), np.zeros((6, 6))
