"""The connection of an agent to its edge: hellos, welcomes, refusals, silence; sessions of the edge."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum, auto

from share.errors import VersionError, WireError, printable
from share.protocol.common_events import PrintLine
from share.protocol.versions import EdgeVersionProbe
from share.timing import LineLimiter, PeriodicTimer, seconds_to_ns
from share.wire import messages as m
from share.wire.codec import decode, encode
from share.wire.layouts import Bytes
from share.wire.room_messages import ClientHello

HELLO_S = 0.5  # interval of hellos, until welcomed
REFUSED_S = 5.0  # a running agent that was refused asks again after this
_MAX_SESSIONS = 16  # remembered sessions: their messages may still be in flight
_MAX_REORDERING = 1000  # corrections; a larger step back is a restart of the counter


class EdgeSessions:
    """Sessions of the edge as the agent sees them. session: the present one; None before the first.

    A session starts with the answer to a hello, so unsolicited session ids cannot reset the
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


class WelcomeOutcome(Enum):
    """Result of a welcome."""

    OUTDATED = auto()  # of an earlier session
    UNSOLICITED = auto()
    NEW_SESSION = auto()
    RECONNECTED = auto()
    REPEATED = auto()


class EdgeConnection:
    """Whether an edge serves the agent, and what a person is shown of it.

    offline_text: what becomes of the agent without an edge.
    """

    def __init__(self, hello: m.Hello | ClientHello, silent_s: float, offline_text: str) -> None:
        self.is_connected = False  # an edge has welcomed it and is not silent
        self.refusal: str | None = None  # last reason that the edge gave
        self.sessions = EdgeSessions()
        self.bad_messages = 0  # that no edge should send
        self.silence_limit_ns = seconds_to_ns(silent_s)
        self._name, self._hello, self._offline_text = hello.name, encode(hello), offline_text
        self._hello_timer = PeriodicTimer(HELLO_S)
        self._version_probe = EdgeVersionProbe()
        self._line_limiter = LineLimiter()
        self._last_received_ns: int | None = None  # or the first event
        self._silence_reported = False

    def begin(self, now_ns: int) -> None:
        """Set the time from which silence counts, at the first event."""
        if self._last_received_ns is None:
            self._last_received_ns = now_ns

    def mark_reached(self) -> None:
        """Record that the link has reached an edge."""
        self._version_probe.mark_reached()

    def is_hello_due(self, now_ns: int) -> bool:
        return not self.is_connected and self._hello_timer.fire_if_due(now_ns)

    def hello(self, now_ns: int) -> list[list[Bytes]]:
        """Return the messages that ask for a welcome, each as its frames."""
        self._hello_timer.postpone(now_ns + seconds_to_ns(HELLO_S))
        self.sessions.expect_welcome()
        return [self._hello, *self._version_probe.pings(now_ns)]

    def receive(self, frames: Sequence[Bytes], now_ns: int) -> tuple[m.Message | None, list[PrintLine]]:
        """Return the message; or None, and why, where it is invalid or of an edge of an older version."""
        try:
            try:
                message = decode(frames)
            except VersionError as error:
                return None, self._report_version(frames, error, now_ns)
        except WireError as error:
            return None, self.report_invalid(f"invalid message from the edge: {error}", now_ns)
        self._last_received_ns = now_ns
        return message, []

    def _report_version(self, frames: Sequence[Bytes], error: VersionError, now_ns: int) -> list[PrintLine]:
        """Return the line about an edge of an older version, once. Raises the error of any other message."""
        line = self._version_probe.check_message(frames, error)
        if line is None:
            return []
        self._silence_reported = True
        return self.print(f"{line}; {self._offline_text}", now_ns)

    def check_silence(self, now_ns: int) -> list[PrintLine]:
        """Disconnect from an edge that is silent, and say so once."""
        assert self._last_received_ns is not None
        if now_ns - self._last_received_ns <= self.silence_limit_ns:
            return []
        self.is_connected = False
        if self._silence_reported:
            return []
        self._silence_reported = True
        problem = "the edge is silent" if self.sessions.session is not None else "no edge answers yet"
        return self.print(f"{problem}; {self._offline_text}", now_ns)

    def welcome(self, welcome: m.Welcome) -> WelcomeOutcome:
        """Connect, unless the welcome is of an earlier session or no hello asked for it."""
        if self.sessions.is_past(welcome.session):
            return WelcomeOutcome.OUTDATED
        if self.sessions.is_unsolicited(welcome.session):
            return WelcomeOutcome.UNSOLICITED
        was_connected, self.is_connected, self._silence_reported = self.is_connected, True, False
        self._version_probe.mark_answered()
        if welcome.session != self.sessions.session:
            self.sessions.begin(welcome.session)
            self.refusal = None
            return WelcomeOutcome.NEW_SESSION
        return WelcomeOutcome.REPEATED if was_connected else WelcomeOutcome.RECONNECTED

    def refuse(self, refused: m.Refused, now_ns: int) -> str:
        """Record a refusal; return its line. A hello follows after a while."""
        self.is_connected = False
        self.refusal = printable(refused.reason)
        self._hello_timer.postpone(now_ns + seconds_to_ns(REFUSED_S))
        return f"the edge refuses '{self._name}': {self.refusal}"

    # ------------------------------------------------------------ lines for a person

    def print(self, text: str, now_ns: int) -> list[PrintLine]:
        """Return the line, unless there are too many."""
        line = self._line_limiter.admit(text, now_ns)
        return [] if line is None else [PrintLine(line)]

    def report_invalid(self, text: str, now_ns: int) -> list[PrintLine]:
        """Count a message that no edge should send; return its line if it is new."""
        self.bad_messages += 1
        line = self._line_limiter.admit_new(text, now_ns)
        return [] if line is None else [PrintLine(line)]

    def report_unexpected(self, message: m.Message, receiver: str, now_ns: int) -> list[PrintLine]:
        """Count a message that is not for this kind of receiver; return its line if it is new."""
        name = type(message).__name__
        return self.report_invalid(f"the edge sent a {name}, which {receiver} does not expect", now_ns)
