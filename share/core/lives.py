"""Lives of the edge as an agent sees them: which is the present one, and how far its corrections are."""

from __future__ import annotations

from collections import deque

_REMEMBERED = 16  # earlier lives, whose messages may still be on their way
_REORDERED = 1000  # corrections that a network may deliver in another order; a longer step back is none


class Lives:
    """`session` numbers the present life, None before the first. A life begins with the answer to a hello, so
    an edge that names new ones unasked cannot make the agent begin anew with each message."""

    def __init__(self) -> None:
        self.session: int | None = None
        self.revision = -1  # of its newest correction
        self._seen: deque[int] = deque(maxlen=_REMEMBERED)
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
