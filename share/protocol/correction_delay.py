"""The delay from a frame to the correction that answers it, as the agent and as the edge see it.

d = tau_track + tau_comm + tau_comp: the agent measures all of it, and tau_track; the edge tau_comp.
"""

from __future__ import annotations

import math

_TIME_CONSTANT_S = 1.0  # of the filters: at 1 Hz the newest delay has a weight of 0.63
_MAX_ACKNOWLEDGED = 64  # keyframes that a correction may still answer
_MAX_WAITING = 1000  # keyframes; further ones do not change which one waits longest


class FilteredDelay:
    """Average of delays, ms, by which older ones fade with time. None before the first."""

    def __init__(self) -> None:
        self.ms: float | None = None
        self._updated_ns = 0

    def add(self, ms: float, now_ns: int) -> None:
        """Add a delay measured now."""
        elapsed_s = max(0, now_ns - self._updated_ns) / 1e9
        weight = 1.0 if self.ms is None else -math.expm1(-elapsed_s / _TIME_CONSTANT_S)
        self.ms = (self.ms or 0.0) + weight * (ms - (self.ms or 0.0))
        self._updated_ns = now_ns


class CorrectionDelay:
    """Delay d of one agent, filtered; times by the agent's clock, ns.

    d is the time until the acknowledgement, which every keyframe gets, plus that from there to the
    correction, which only some get. An unacknowledged keyframe counts with its present age.
    """

    def __init__(self) -> None:
        self._to_ack, self._to_correction = FilteredDelay(), FilteredDelay()
        self._waiting: dict[int, int] = {}  # arrival of the frame, by keyframe id
        self._sent_ns: dict[int, int] = {}  # of those that wait and were sent, by keyframe id
        self._acknowledged_ms: dict[int, float] = {}  # after the frame's arrival, by id, of the newest
        self._newest_ack_ms = 0.0

    def add_keyframe(self, keyframe: int, arrived_ns: int) -> None:
        """Add a keyframe that is made now."""
        if len(self._waiting) < _MAX_WAITING:
            self._waiting[keyframe] = arrived_ns

    def mark_sent(self, keyframe: int, now_ns: int) -> None:
        """Record that a keyframe is sent now, for the first time in this session of the edge."""
        if keyframe in self._waiting:
            self._sent_ns[keyframe] = now_ns

    def acknowledge(self, next_keyframe: int, now_ns: int) -> list[float]:
        """Record that the edge has all keyframes below an id. Return what each new one took since it was
        sent, ms."""
        acks_ms = []
        for keyframe in [keyframe for keyframe in self._waiting if keyframe < next_keyframe]:
            self._acknowledged_ms[keyframe] = (now_ns - self._waiting.pop(keyframe)) / 1e6
            self._to_ack.add(self._acknowledged_ms[keyframe], now_ns)
            # the edge may acknowledge what was never sent
            acks_ms.append((now_ns - self._sent_ns.pop(keyframe, now_ns)) / 1e6)
            self._newest_ack_ms = acks_ms[-1]
        while len(self._acknowledged_ms) > _MAX_ACKNOWLEDGED:
            del self._acknowledged_ms[next(iter(self._acknowledged_ms))]
        return acks_ms

    def correct(self, keyframe: int, corrected_ms: float, now_ns: int) -> None:
        """Record the first correction that answers a keyframe, so long after its frame arrived."""
        acknowledged_ms = self._acknowledged_ms.get(keyframe, corrected_ms)
        self._to_correction.add(max(0.0, corrected_ms - acknowledged_ms), now_ns)

    def ms(self, now_ns: int) -> float | None:
        """Return the delay, ms; None before the first keyframe."""
        if self._to_ack.ms is None and not self._waiting:
            return None
        return max(self._to_ack.ms or 0.0, self.waiting_ms(now_ns)) + (self._to_correction.ms or 0.0)

    def ack_ms(self, now_ns: int) -> float:
        """Return how long the newest acknowledgement took, or how long one is overdue, if longer; 0 before
        the first keyframe."""
        sent_ns = min(self._sent_ns.values(), default=now_ns)
        return max(self._newest_ack_ms, (now_ns - sent_ns) / 1e6)

    def waiting_ms(self, now_ns: int) -> float:
        """Return how long ago the frame of the oldest keyframe that is not acknowledged arrived; 0 without
        one."""
        return (now_ns - next(iter(self._waiting.values()), now_ns)) / 1e6


_MAX_COMPUTING = 64  # newest keyframes of a run that a correction may still answer


class ComputationDelay:
    """tau_comp of one run: from a keyframe's arrival at the edge until the correction that answers it is
    sent, filtered, ms; 0 before the first. held_ms: the same until its acknowledgement is sent, for which the
    edge's disk may be waited for. Times by the edge's clock, ns."""

    def __init__(self) -> None:
        self._filtered, self._held = FilteredDelay(), FilteredDelay()
        self._received_ns: dict[int, int] = {}
        self._unacknowledged_ns: dict[int, int] = {}

    def add_keyframe(self, keyframe: int, now_ns: int) -> None:
        """Add a keyframe that arrives now."""
        for received_ns in (self._received_ns, self._unacknowledged_ns):
            received_ns[keyframe] = now_ns
            if len(received_ns) > _MAX_COMPUTING:
                del received_ns[next(iter(received_ns))]

    def acknowledge(self, next_keyframe: int, now_ns: int) -> None:
        """Record that all keyframes below an id are acknowledged now."""
        for keyframe in [keyframe for keyframe in self._unacknowledged_ns if keyframe < next_keyframe]:
            self._held.add((now_ns - self._unacknowledged_ns.pop(keyframe)) / 1e6, now_ns)

    def answer(self, keyframe: int, now_ns: int) -> None:
        """Record that a correction answers a keyframe, the first that does."""
        if (received_ns := self._received_ns.pop(keyframe, None)) is not None:
            self._filtered.add((now_ns - received_ns) / 1e6, now_ns)

    @property
    def ms(self) -> float:
        return self._filtered.ms or 0.0

    @property
    def held_ms(self) -> float:
        return self._held.ms or 0.0
