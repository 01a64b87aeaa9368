"""Agents and edges of different releases: each learns which wire version the other speaks, and says in one
line which is to be upgraded. Neither takes the other's messages.

An edge refuses whoever speaks another version, in a message of that version. An older edge answers nothing;
its agent finds out by pings of older versions, of which such an edge answers that of its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from share import __version__
from share.errors import VersionError
from share.timing import Throttle
from share.wire.codec import OLDEST_VERSION, WIRE_VERSION, Bytes, decode, encode, message_code
from share.wire.messages import Ping, Pong

_REFUSE_HZ = 0.5  # an agent of another version is answered at most so often
_MAX_UNANSWERED = 2  # hellos without an answer before older versions are tried
_OLDER_VERSIONS = range(OLDEST_VERSION, WIRE_VERSION)


def upgrade_advice(edge_version: int, agent_version: int) -> str:
    """By their wire versions."""
    return "upgrade the agent" if agent_version < edge_version else "upgrade the edge"


class VersionRefusals:
    """At the edge: what is said to peers of other wire versions."""

    def __init__(self) -> None:
        self._throttle = Throttle(_REFUSE_HZ, 1.0)

    def refusal(self, peer_id: bytes, error: VersionError, now_ns: int) -> str | None:
        """The line to refuse it by; None where it has just been said, or where this was a ping.

        A ping of an older version is a newer agent's question, whose answer would be that this is an edge of
        that version.
        """
        if error.code == message_code(Ping) or self._throttle.admit(peer_id, now_ns) is None:
            return None
        own_text = f"this edge is SHARE {__version__} (wire {WIRE_VERSION})"
        return (
            f"{own_text}, this agent "
            f"speaks wire {error.version}: "
            f"{upgrade_advice(WIRE_VERSION, error.version)}"
        )


class EdgeVersionProbe:
    """At the agent: finds out the wire version of an edge that does not answer it."""

    def __init__(self) -> None:
        self._is_reached = False  # the link, an edge
        self._hello_count = 0  # hellos since then, or since it last answered
        self._pings: deque[tuple[int, Ping]] = deque(
            maxlen=4 * len(_OLDER_VERSIONS)
        )  # under way, with their versions
        self._reported: int | None = None

    def mark_reached(self) -> None:
        """The link has reached an edge, perhaps another one."""
        self._is_reached, self._hello_count = True, 0

    def mark_answered(self) -> None:
        """The edge speaks our version."""
        self._hello_count, self._reported = 0, None
        self._pings.clear()

    def pings(self, now_ns: int) -> list[list[Bytes]]:
        """What is to be sent with a hello: nothing at first, then a ping of each older version."""
        self._hello_count += self._is_reached
        if self._hello_count <= _MAX_UNANSWERED:
            return []
        pings = [(version, Ping(self._hello_count, now_ns)) for version in _OLDER_VERSIONS]
        self._pings.extend(pings)
        return [encode(ping, version) for version, ping in pings]

    def check_message(self, frames: Sequence[Bytes], error: VersionError) -> str | None:
        """What to say, once, of a message of another version; None where it answers no ping.

        Raises WireError where it is none of an older version that can be understood.
        """
        if error.version not in _OLDER_VERSIONS:
            raise error
        pong = decode(frames, (error.version,))
        if not isinstance(pong, Pong):
            raise error
        is_answer = (error.version, Ping(pong.sequence, pong.sent_ns)) in self._pings
        if not is_answer or self._reported == error.version:
            return None
        self._reported = error.version
        return older_edge_text(error.version)


def older_edge_text(version: int) -> str:
    """For a person at the agent."""
    own_text = f"this SHARE {__version__} wire {WIRE_VERSION}"
    return f"the edge speaks wire {version}, {own_text}: {upgrade_advice(version, WIRE_VERSION)}"
