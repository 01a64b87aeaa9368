"""Keyframes of one agent, from any order of arrival into the order in which they were made."""

from __future__ import annotations

from share.types import Keyframe
from share.wire.messages import MAX_HELD, Ack

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
