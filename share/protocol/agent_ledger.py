"""The agent's keyframes: the choice under a rate limit, the chain that numbers them, and the ledger of those
sent, acknowledged and due for a resend."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from share.earlier_poses import MAX_EARLIER, EarlierPoses
from share.geometry.se3 import compose_cov, orthonormal
from share.timing import seconds_to_ns
from share.types import F64, Keyframe, OdometryKeyframe
from share.wire.messages import Ack, Welcome

WINDOW = 16  # keyframes in flight
RESEND_S = 1.0  # first wait for an acknowledgement, at least; doubles with each resend
RESEND_MAX_S = 8.0  # longest wait
GAP_RESEND_S = 0.1  # first wait for a keyframe that later ones have overtaken


@dataclass(eq=False, slots=True)
class LedgerEntry:
    """A keyframe, its frame, and its state of transmission."""

    keyframe: Keyframe
    frame_index: int
    arrived_ns: int
    attempts: int = 0  # in this session of the edge
    send_count: int = 0  # sends that the link took, in all sessions
    due_ns: int | None = None  # None: now
    sent_ns: int = 0
    is_refused: bool = False  # by the link, when it was sent last
    is_replayed: bool = False  # an earlier session of the edge had acknowledged it
    is_corrected: bool = False  # a correction has answered it


class KeyframeLedger:
    """Keyframes in order of their ids: first those acknowledged, then those pending.

    Only the first `window` pending ones are in flight. One is resent only after the edge has answered a later
    message: a link keeps the order, so until then the keyframe is under way, and a copy would only fill a
    slow link (J. Nagle, *Congestion Control in IP/TCP Internetworks*, RFC 896).

    A full ledger drops the oldest acknowledged one (policy drop_oldest_acknowledged); without one, the oldest
    pending one (drop_oldest), and rebases the next keyframe onto the dropped one's reference.
    `counts` has both, by name.
    """

    def __init__(self, capacity: int, window: int = WINDOW) -> None:
        self.counts: Counter[str] = Counter()
        self._capacity, self._window = capacity, window
        self._acknowledged: dict[int, LedgerEntry] = {}
        self._pending: dict[int, LedgerEntry] = {}
        # ids that wait at the edge for a gap to close, or for its disk
        self._buffered_at_edge = frozenset[int]()
        self._max_sent_id = -1  # highest id sent in this session of the edge
        self._max_ever_sent_id = -1  # in any session
        self._heard_before_ns = -1  # what was sent before, the edge has, or it was lost

    def __len__(self) -> int:
        return len(self._acknowledged) + len(self._pending)

    @property
    def pending(self) -> list[LedgerEntry]:
        """Keyframes that are not acknowledged, in order."""
        return list(self._pending.values())

    @property
    def unacknowledged(self) -> int:
        """Number of keyframes that the edge never acknowledged, dropped ones included."""
        return len(self._pending) + self.counts["drop_oldest"]

    def unacknowledged_for_ns(self, now_ns: int) -> int:
        """Return the time since the oldest pending keyframe's frame arrived; 0 without one."""
        oldest = next(iter(self._pending.values()), None)
        return 0 if oldest is None else max(0, now_ns - oldest.arrived_ns)

    @property
    def buffered_at_edge(self) -> int:
        """Number of pending keyframes that have arrived at the edge."""
        return sum(keyframe in self._pending for keyframe in self._buffered_at_edge)

    @property
    def last_acknowledged(self) -> LedgerEntry | None:
        return next(reversed(self._acknowledged.values()), None)

    @property
    def next_unsent_id(self) -> int:
        """Lowest id that no edge can have seen."""
        return self._max_ever_sent_id + 1

    def find(self, keyframe: int) -> LedgerEntry | None:
        return self._acknowledged.get(keyframe) or self._pending.get(keyframe)

    def record_correction(self, keyframe: int, now_ns: int) -> tuple[LedgerEntry | None, float | None]:
        """Record a correction that answers this keyframe. Return its entry, None if not remembered, and the
        ms since its frame arrived, None but for the first correction of a keyframe that was not resent to a
        restarted edge."""
        entry = self.find(keyframe)
        if entry is None or entry.is_corrected or entry.is_replayed:
            return entry, None
        entry.is_corrected = True
        return entry, (now_ns - entry.arrived_ns) / 1e6

    def add(self, entry: LedgerEntry) -> None:
        """Append the newest keyframe; drop one if the ledger is full."""
        self._pending[entry.keyframe.id] = entry
        if len(self) > self._capacity:
            self._drop_oldest()

    def take_due(self, now_ns: int, window: int | None = None) -> list[LedgerEntry]:
        """Return what to send now, in order. It counts as sent unless `record_send_failure` follows.

        window: keyframes in flight, if fewer than the ledger's."""
        window = self._window if window is None else min(window, self._window)
        due = [entry for entry in self.pending[:window] if self._is_due(entry, now_ns)]
        for entry in due:
            self._count_sends(entry, 1)
            backoff = RESEND_S * 2.0 ** min(entry.attempts, 30)
            entry.due_ns = now_ns + seconds_to_ns(min(backoff, RESEND_MAX_S))
            entry.attempts += 1
            entry.sent_ns, entry.is_refused = now_ns, False
            self._max_sent_id = max(self._max_sent_id, entry.keyframe.id)
        self._max_ever_sent_id = max(self._max_ever_sent_id, self._max_sent_id)
        return due

    def record_answer(self, sent_ns: int) -> None:
        """Record that the edge has answered a message, such as a ping, sent at `sent_ns`."""
        self._heard_before_ns = max(self._heard_before_ns, sent_ns)

    def record_send_failure(self, keyframe: int) -> None:
        """Record that the link did not take this keyframe. It is due again after its backoff."""
        if (entry := self.find(keyframe)) is not None and entry.send_count:
            self._count_sends(entry, -1)
            entry.is_refused = True

    def _count_sends(self, entry: LedgerEntry, change: int) -> None:
        """Count `change` sends of an entry: the first as `sent`, others as `resent`."""
        first = max(entry.send_count, entry.send_count + change) == 1
        self.counts["sent" if first else "resent"] += change
        entry.send_count += change

    def acknowledge(self, ack: Ack) -> bool:
        """Apply an acknowledgement. Keyframes that later ones overtook are due again after GAP_RESEND_S.

        Return False, and ignore it, if it covers keyframes not sent in this session of the edge: it is of an
        earlier session, or false.
        """
        max_buffered = max(ack.buffered, default=-1)
        if ack.next_keyframe > self._max_sent_id + 1 or max_buffered > self._max_ever_sent_id:
            self.counts["invalid_acks"] += 1
            return False
        while self._pending and (first := next(iter(self._pending))) < ack.next_keyframe:
            self._acknowledged[first] = self._pending.pop(first)
            self.counts["acknowledged"] += 1
        self._buffered_at_edge = frozenset(ack.buffered)
        if max_buffered in self._pending:  # it was in flight when this session began
            self._max_sent_id = max(self._max_sent_id, max_buffered)
        self._bring_resends_forward()
        return True

    def _bring_resends_forward(self) -> None:
        """Make each gap due soon: a keyframe that has not arrived though a later one, sent after it, has.

        Once for each time that it is sent: an acknowledgement that is repeated says nothing new."""
        arrived_ns: int | None = None  # when the newest of the later ones that have arrived was sent
        for entry in reversed(self.pending[: self._window]):
            if entry.keyframe.id in self._buffered_at_edge:
                arrived_ns = max(entry.sent_ns, arrived_ns or entry.sent_ns)
                self.record_answer(entry.sent_ns + 1)  # keyframes of one moment are sent in order
            elif entry.attempts and arrived_ns is not None and arrived_ns >= entry.sent_ns:
                entry.due_ns = min(entry.due_ns or 0, entry.sent_ns + seconds_to_ns(GAP_RESEND_S))

    def resume(self, welcome: Welcome) -> None:
        """Resume after the edge was silent: keyframes in flight count as lost and are due."""
        self.acknowledge(Ack(welcome.next_keyframe))
        self._make_all_due()

    def begin_session(self, welcome: Welcome) -> int:
        """Start a new session of the edge: all entries from `next_keyframe` on are due. Return their number.

        The first starts a segment if this session does not have its predecessor.
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
        return len(self._pending)

    def _is_due(self, entry: LedgerEntry, now_ns: int) -> bool:
        if entry.keyframe.id in self._buffered_at_edge and entry.keyframe.id != next(iter(self._pending)):
            return False  # not for the oldest: the edge may wait for a keyframe that was dropped here
        is_on_its_way = not entry.is_refused and entry.sent_ns >= self._heard_before_ns
        return entry.due_ns is None or (entry.due_ns <= now_ns and not is_on_its_way)

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
    """Return `keyframe` relative to the reference of the dropped one, its predecessor."""
    if keyframe.reference != dropped.id:  # it starts a segment
        return replace(keyframe, predecessor=dropped.predecessor)
    return replace(
        keyframe,
        reference=dropped.reference,
        predecessor=dropped.predecessor,
        T_ref_body=dropped.T_ref_body @ keyframe.T_ref_body,
        cov=compose_cov(keyframe.T_ref_body, dropped.cov, keyframe.cov),
    )


def _detach(entry: LedgerEntry) -> Keyframe:
    """Return the keyframe as the start of a segment, for an edge that has nothing before it."""
    return replace(
        entry.keyframe,
        reference=-1,
        predecessor=-1,
        T_ref_body=entry.keyframe.T_odom_body,
        earlier=EarlierPoses.empty(),
    )


class KeyframeChain:
    """Makes keyframes of candidates: ids, and poses relative to the previous keyframe with their covariance
    accumulated over the candidates in between that were not sent."""

    _T_keyframe_candidate: F64  # (4, 4)
    _cov: F64  # (6, 6), of it

    def __init__(self) -> None:
        self.next_id = 0
        self.first_of_segment = 0  # lowest id that the present segment has or will have
        self._has_reference = False  # False: the next keyframe starts a segment
        self._ids: dict[int, int] = {}  # of the newest keyframes, by stamp, ns
        self._reset_motion()

    def begin_segment(self) -> None:
        """Start a new segment: odometry broke."""
        self.first_of_segment = self.next_id
        self._has_reference = False
        self._reset_motion()

    def extend(self, candidate: OdometryKeyframe) -> None:
        """Add a candidate's motion, whether or not the candidate is sent."""
        if candidate.new_segment:
            self.begin_segment()
        T = candidate.T_previous_body
        self._T_keyframe_candidate = orthonormal(self._T_keyframe_candidate @ T)
        self._cov = compose_cov(T, self._cov, candidate.cov)

    def make_keyframe(self, candidate: OdometryKeyframe, stamp_ns: int) -> Keyframe:
        """Return the candidate given to `extend` last as the next keyframe."""
        T_ref_body, cov, earlier = self._T_keyframe_candidate, self._cov, EarlierPoses.empty()
        if not self._has_reference:
            T_ref_body = candidate.T_odom_body
        else:
            earlier = self._earlier_keyframes(candidate.earlier)
            if len(earlier) and earlier.ids[-1] == self.next_id - 1:  # more accurate than the chain
                T_ref_body = orthonormal(earlier.T_earlier_body[-1].astype(np.float64))
                cov = earlier.cov[-1].astype(np.float64)
            earlier = select_earlier(earlier, self.next_id)
        keyframe = Keyframe(
            id=self.next_id,
            reference=self.next_id - 1 if self._has_reference else -1,
            stamp_ns=stamp_ns,
            T_ref_body=T_ref_body,
            cov=cov,
            T_odom_body=candidate.T_odom_body,
            up=candidate.up,
            up_sigma=candidate.up_sigma,
            view=candidate.view,
            predecessor=self.next_id - 1,
            image=candidate.image,
            earlier=earlier,
        )
        if not self._has_reference:
            self._ids.clear()
        self._ids[stamp_ns] = keyframe.id
        if len(self._ids) > MAX_EARLIER:
            del self._ids[next(iter(self._ids))]
        self.next_id += 1
        self._has_reference = True
        self._reset_motion()
        return keyframe

    def _earlier_keyframes(self, candidates: EarlierPoses) -> EarlierPoses:
        """Return the poses relative to those candidates that became keyframes of this segment."""
        sent = [
            (row, self._ids[stamp]) for row, stamp in enumerate(candidates.ids.tolist()) if stamp in self._ids
        ]
        return candidates.take([row for row, _ in sent], [keyframe for _, keyframe in sent])

    def _reset_motion(self) -> None:
        """Restart the accumulated motion at the last keyframe, or at the start of the segment."""
        self._T_keyframe_candidate, self._cov = np.eye(4), np.zeros((6, 6))


_EARLIER_STEPS = 3, 7, 13  # keyframes back; a pose relative to each is sent beside that to the reference


def select_earlier(earlier: EarlierPoses, keyframe_id: int) -> EarlierPoses:
    """Return the poses relative to the keyframes nearest to `_EARLIER_STEPS` before this one.

    A chain of steps between neighbours loses what the tracker knows of longer motions in its window."""
    steps = keyframe_id - earlier.ids
    rows = sorted({int(np.abs(steps - step).argmin()) for step in _EARLIER_STEPS if (steps > 1).any()})
    rows = [row for row in rows if steps[row] > 1]
    return earlier.take(rows, earlier.ids[rows].tolist())
