"""Sessions and revisions of an edge as its agent sees them; limits on the lines that faults may print."""

from __future__ import annotations

from collections import deque

from share.errors import printable
from share.timing import TokenBucket

_MAX_SESSIONS = 16  # remembered sessions: their messages may still be in flight
_MAX_REORDERING = 1000  # corrections; a larger step back is a restart of the counter


class EdgeSessions:
    """Sessions of the edge as the agent sees them. session: the present one; None before the first.

    A session starts with the answer to a hello, so an edge that names new sessions unasked cannot reset the
    agent with each message."""

    def __init__(self) -> None:
        self.session: int | None = None
        self.revision = -1  # of its newest correction
        self._recent: deque[int] = deque(maxlen=_MAX_SESSIONS)
        self._welcome_expected = False

    def __len__(self) -> int:
        """Number of remembered sessions."""
        return len(self._recent)

    def expect_welcome(self) -> None:
        """Record that a hello was sent."""
        self._welcome_expected = True

    def is_past(self, session: int) -> bool:
        """Return whether a message of this session was overtaken by one of a later session."""
        return session != self.session and session in self._recent

    def is_unsolicited(self, session: int) -> bool:
        """Return whether this is a new session that no hello asked for."""
        return session != self.session and not self._welcome_expected

    def begin(self, session: int) -> None:
        self.session, self.revision, self._welcome_expected = session, -1, False
        self._recent.append(session)

    def accept_revision(self, revision: int) -> bool:
        """Record a revision; return whether it is newer than all before. Serial number arithmetic as in RFC
        1982: one absurd revision does not make all later ones old."""
        newer = revision > self.revision or revision < self.revision - _MAX_REORDERING
        if newer:
            self.revision = revision
        return newer


# Limits on lines for a person, so that a peer cannot fill a terminal or a log.
_LINE_BURST = 20.0  # lines at once
_LINE_HZ = 0.2  # and one each 5 s after that
_MAX_REMEMBERED_LINES = 16
_MAX_LINE_LENGTH = 300  # characters
_QUIET_NS = 60_000_000_000  # a fault absent for this long is new again


class FaultDeduplicator:
    """Decides whether a fault that comes and goes is reported again."""

    def __init__(self) -> None:
        self._last_seen_ns: dict[str, int] = {}  # by text

    def is_new(self, text: str, now_ns: int) -> bool:
        """Record a fault. Return True the first time, and after it was absent for a minute."""
        last_ns = self._last_seen_ns.pop(text, None)
        self._last_seen_ns[text] = now_ns
        if len(self._last_seen_ns) > _MAX_REMEMBERED_LINES:
            del self._last_seen_ns[next(iter(self._last_seen_ns))]
        return last_ns is None or now_ns - last_ns > _QUIET_NS


class LineLimiter:
    """Limits the rate of lines. Suppressed lines are counted in the next one."""

    def __init__(self) -> None:
        self._bucket = TokenBucket(_LINE_BURST)
        self._bucket.set_rate(_LINE_HZ, 0)
        self._recent_lines: deque[str] = deque(maxlen=_MAX_REMEMBERED_LINES)
        self._suppressed = 0

    def admit(self, text: str, now_ns: int) -> str | None:
        """Return the line in printable characters; None if it is suppressed."""
        if not self._bucket.take(now_ns):
            self._suppressed += 1
            return None
        suppressed, self._suppressed = self._suppressed, 0
        line = printable(text[:_MAX_LINE_LENGTH])
        return f"{line} ({suppressed} lines before this were suppressed)" if suppressed else line

    def admit_once(self, text: str, now_ns: int) -> str | None:
        """Return the line as `admit` does; None too if it is among the recent ones."""
        if text in self._recent_lines:
            return None
        self._recent_lines.append(text)
        return self.admit(text, now_ns)
