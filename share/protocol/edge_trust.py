"""Which messages of an edge can be true: an agent believes no others, whoever the edge is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from share.protocol.agent_ledger import Ledger
from share.rates import TokenBucket
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


# ---- Lives of the edge as an agent sees them: which is the present one, and how far its corrections are.

_REMEMBERED_LIVES = 16  # earlier lives, whose messages may still be on their way
_REORDERED = 1000  # corrections that a network may deliver in another order; a longer step back is none


class Lives:
    """`session` numbers the present life, None before the first. A life begins with the answer to a hello, so
    an edge that names new ones unasked cannot make the agent begin anew with each message."""

    def __init__(self) -> None:
        self.session: int | None = None
        self.revision = -1  # of its newest correction
        self._seen: deque[int] = deque(maxlen=_REMEMBERED_LIVES)
        self._asked = False

    def __len__(self) -> int:
        """How many there were, of those remembered."""
        return len(self._seen)

    def ask(self) -> None:
        """A hello is on its way."""
        self._asked = True

    def is_over(self, session: int) -> bool:
        """Whether a message of it was overtaken on its way by one of a later life."""
        return session != self.session and session in self._seen

    def is_unasked(self, session: int) -> bool:
        return session != self.session and not self._asked

    def begin(self, session: int) -> None:
        self.session, self.revision, self._asked = session, -1, False
        self._seen.append(session)

    def is_newer(self, revision: int) -> bool:
        """Whether a correction is newer than all before; takes note of it. By serial number arithmetic, as in
        RFC 1982: one absurd revision does not make all that follow it old."""
        newer = revision > self.revision or revision < self.revision - _REORDERED
        if newer:
            self.revision = revision
        return newer


# ---- Lines for a person, so few that nobody who causes them can fill a terminal or a log.

_BURST, _HZ = 20.0, 0.2  # lines at once, and then one each 5 s
_REMEMBERED_LINES = 16  # complaints
_LONGEST = 300
_GONE_NS = 60_000_000_000


class Lasting:
    """Of a trouble that comes and goes: whether it is to be said."""

    def __init__(self) -> None:
        self._there: dict[str, int] = {}  # when it was last there

    def begins(self, text: str, now_ns: int) -> bool:
        """It is there: True the first time, and where it had been gone for a minute."""
        since_ns = self._there.pop(text, None)
        self._there[text] = now_ns
        if len(self._there) > _REMEMBERED_LINES:
            del self._there[next(iter(self._there))]
        return since_ns is None or now_ns - since_ns > _GONE_NS


class Lines:
    """What may be said now. What was left out is counted, and told with the next line."""

    def __init__(self) -> None:
        self._bucket = TokenBucket(_BURST)
        self._bucket.limit(_HZ, 0)
        self._complaints: deque[str] = deque(maxlen=_REMEMBERED_LINES)
        self._left_out = 0

    def say(self, text: str, now_ns: int) -> str | None:
        """The line in printable characters; None where it is left out."""
        if not self._bucket.take(now_ns):
            self._left_out += 1
            return None
        more, self._left_out = self._left_out, 0
        line = "".join(c if c.isprintable() else "?" for c in text[:_LONGEST])
        return f"{line} ({more} lines before this were left out)" if more else line

    def complain(self, text: str, now_ns: int) -> str | None:
        """The same; None too where this was said lately."""
        if text in self._complaints:
            return None
        self._complaints.append(text)
        return self.say(text, now_ns)
