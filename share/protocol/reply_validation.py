"""Which messages of an edge can be true: an agent believes no others, whoever the edge is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from share.protocol.agent_ledger import KeyframeLedger
from share.timing import TokenBucket
from share.types import Correction
from share.wire import messages as m


class ReplyValidator:
    """Of one agent, by its ledger and the lives of the edge that it knows.

    What is not believed is counted, and each kind is said once.
    """

    def __init__(
        self,
        ledger: KeyframeLedger,
        sessions: EdgeSessions,
        line_limiter: LineLimiter,
        print_line: Callable[[str], None],
    ) -> None:
        """lines: limits what is said; say: is told a line that may be."""
        self.bad_messages = 0
        self._ledger, self._sessions, self._line_limiter, self._print_line = (
            ledger,
            sessions,
            line_limiter,
            print_line,
        )

    def report_invalid(self, text: str, now_ns: int) -> None:
        """A message that no edge should send."""
        self.bad_messages += 1
        if (line := self._line_limiter.admit_once(text, now_ns)) is not None:
            self._print_line(line)

    def accepts_welcome(self, welcome: m.Welcome, now_ns: int) -> bool:
        """Whether this welcome is of the present life of the edge, or of a new one that was asked."""
        if self._sessions.is_past(welcome.session):
            return False
        if self._reports_unsent("a welcome", now_ns, welcome.next_keyframe - 1):
            return False
        if self._sessions.is_unsolicited(welcome.session):
            self.report_invalid("the edge sent a welcome without a hello; ignored", now_ns)
            return False
        return True

    def accepts_correction(self, correction: Correction, now_ns: int) -> bool:
        """Whether it speaks of keyframes that the edge can have."""
        return not self._reports_unsent(
            "a correction", now_ns, correction.segment_keyframe, correction.answered_keyframe
        )

    def take_ack(self, ack: m.Ack, now_ns: int) -> None:
        """Into the ledger, which refuses what an earlier life of the edge says, too: that is no lie."""
        if not self._ledger.acknowledge(ack):
            self._reports_unsent("an acknowledgement", now_ns, ack.next_keyframe - 1, *ack.buffered)

    def _reports_unsent(self, message_name: str, now_ns: int, *keyframes: int) -> bool:
        unsent = max(keyframes, default=-1) >= self._ledger.next_unsent_id
        if unsent:
            self.report_invalid(
                f"the edge sent {message_name} of keyframes that were never sent; ignored", now_ns
            )
        return unsent


# ---- Lives of the edge as an agent sees them: which is the present one, and how far its corrections are.

_MAX_SESSIONS = 16  # earlier lives, whose messages may still be on their way
_MAX_REORDERING = 1000  # corrections that a network may deliver in another order; a longer step back is none


class EdgeSessions:
    """`session` numbers the present life, None before the first. A life begins with the answer to a hello, so
    an edge that names new ones unasked cannot make the agent begin anew with each message."""

    def __init__(self) -> None:
        self.session: int | None = None
        self.revision = -1  # of its newest correction
        self._recent: deque[int] = deque(maxlen=_MAX_SESSIONS)
        self._welcome_expected = False

    def __len__(self) -> int:
        """How many there were, of those remembered."""
        return len(self._recent)

    def expect_welcome(self) -> None:
        """A hello is on its way."""
        self._welcome_expected = True

    def is_past(self, session: int) -> bool:
        """Whether a message of it was overtaken on its way by one of a later life."""
        return session != self.session and session in self._recent

    def is_unsolicited(self, session: int) -> bool:
        return session != self.session and not self._welcome_expected

    def begin(self, session: int) -> None:
        self.session, self.revision, self._welcome_expected = session, -1, False
        self._recent.append(session)

    def accept_revision(self, revision: int) -> bool:
        """Whether a correction is newer than all before; takes note of it. By serial number arithmetic, as in
        RFC 1982: one absurd revision does not make all that follow it old."""
        newer = revision > self.revision or revision < self.revision - _MAX_REORDERING
        if newer:
            self.revision = revision
        return newer


# ---- Lines for a person, so few that nobody who causes them can fill a terminal or a log.

_LINE_BURST, _LINE_HZ = 20.0, 0.2  # lines at once, and then one each 5 s
_MAX_REMEMBERED_LINES = 16  # complaints
_MAX_LINE_LENGTH = 300
_QUIET_NS = 60_000_000_000


class FaultDeduplicator:
    """Of a trouble that comes and goes: whether it is to be said."""

    def __init__(self) -> None:
        self._last_seen_ns: dict[str, int] = {}  # when it was last there

    def is_new(self, text: str, now_ns: int) -> bool:
        """It is there: True the first time, and where it had been gone for a minute."""
        last_ns = self._last_seen_ns.pop(text, None)
        self._last_seen_ns[text] = now_ns
        if len(self._last_seen_ns) > _MAX_REMEMBERED_LINES:
            del self._last_seen_ns[next(iter(self._last_seen_ns))]
        return last_ns is None or now_ns - last_ns > _QUIET_NS


class LineLimiter:
    """What may be said now. What was left out is counted, and told with the next line."""

    def __init__(self) -> None:
        self._bucket = TokenBucket(_LINE_BURST)
        self._bucket.set_rate(_LINE_HZ, 0)
        self._recent_lines: deque[str] = deque(maxlen=_MAX_REMEMBERED_LINES)
        self._suppressed = 0

    def admit(self, text: str, now_ns: int) -> str | None:
        """The line in printable characters; None where it is left out."""
        if not self._bucket.take(now_ns):
            self._suppressed += 1
            return None
        suppressed, self._suppressed = self._suppressed, 0
        line = "".join(c if c.isprintable() else "?" for c in text[:_MAX_LINE_LENGTH])
        return f"{line} ({suppressed} lines before this were left out)" if suppressed else line

    def admit_once(self, text: str, now_ns: int) -> str | None:
        """The same; None too where this was said lately."""
        if text in self._recent_lines:
            return None
        self._recent_lines.append(text)
        return self.admit(text, now_ns)
