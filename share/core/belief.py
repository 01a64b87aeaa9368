"""Which messages of an edge can be true: an agent believes no others, whoever the edge is."""

from __future__ import annotations

from collections.abc import Callable

from share.core.ledger import Ledger
from share.core.lines import Lines
from share.core.lives import Lives
from share.types import Correction
from share.wire import messages as m


class Belief:
    """Of one agent, by its ledger and the lives of the edge that it knows.

    What is not believed is counted, and each kind is said once.
    """

    def __init__(self, ledger: Ledger, lives: Lives, lines: Lines, say: Callable[[str], None]) -> None:
        """lines: limits what is said; say: is told a line that may be."""
        self.bad_messages = 0
        self._ledger, self._lives, self._lines, self._say = ledger, lives, lines, say

    def complain(self, text: str, now_ns: int) -> None:
        """A message that no edge should send."""
        self.bad_messages += 1
        if (line := self._lines.complain(text, now_ns)) is not None:
            self._say(line)

    def welcomes(self, welcome: m.Welcome, now_ns: int) -> bool:
        """Whether this welcome is of the present life of the edge, or of a new one that was asked."""
        if self._lives.is_over(welcome.session):
            return False
        if self._is_unsent("a welcome", now_ns, welcome.next_keyframe - 1):
            return False
        if self._lives.is_unasked(welcome.session):
            self.complain("the edge sent a welcome that nobody asked for; it is not believed", now_ns)
            return False
        return True

    def corrects(self, correction: Correction, now_ns: int) -> bool:
        """Whether it speaks of keyframes that the edge can have."""
        return not self._is_unsent("a correction", now_ns, correction.about, correction.answers)

    def take(self, ack: m.Ack, now_ns: int) -> None:
        """Into the ledger, which refuses what an earlier life of the edge says, too: that is no lie."""
        if not self._ledger.acknowledge(ack):
            self._is_unsent("an acknowledgement", now_ns, ack.next_keyframe - 1, *ack.held)

    def _is_unsent(self, what: str, now_ns: int, *keyframes: int) -> bool:
        unsent = max(keyframes, default=-1) >= self._ledger.next_unsent
        if unsent:
            self.complain(
                f"the edge sent {what} of keyframes that were never sent; it is not believed", now_ns
            )
        return unsent
