"""Sessions and revisions of an edge as its agent sees them."""

from __future__ import annotations

from collections import deque

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
