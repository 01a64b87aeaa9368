"""Wire version mismatch between agent and edge: each finds the other's version and says which to upgrade.

An edge refuses a peer of another version, in a message of that version. An older edge does not answer; the
agent finds its version by pings of older versions, of which such an edge answers its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from share import __version__
from share.errors import VersionError
from share.wire.codec import OLDEST_VERSION, WIRE_VERSION, decode, encode
from share.wire.layouts import MESSAGE_CODES, Bytes
from share.wire.messages import Ping, Pong

_MAX_UNANSWERED = 2  # unanswered hellos before older versions are tried
_OLDER_VERSIONS = range(OLDEST_VERSION, WIRE_VERSION)


def upgrade_advice(edge_version: int, agent_version: int) -> str:
    """Return which side to upgrade, by their wire versions."""
    return "upgrade the agent" if agent_version < edge_version else "upgrade the edge"


def refusal_of_version(error: VersionError) -> str | None:
    """Return why an edge refuses a message of another version; None for a ping, which stays unanswered.

    A ping of an older version is a newer agent's probe: an answer would mean an edge of that version.
    """
    if error.code == MESSAGE_CODES[Ping]:
        return None
    advice = upgrade_advice(WIRE_VERSION, error.version)
    own_text = f"this edge is SHARE {__version__} (wire {WIRE_VERSION})"
    return f"{own_text}, this agent speaks wire {error.version}: {advice}"


class EdgeVersionProbe:
    """The agent's probe for the wire version of an edge that does not answer."""

    def __init__(self) -> None:
        self._is_reached = False  # the link has reached an edge
        self._hello_count = 0  # since then, or since the last answer
        # version and ping, in flight
        self._pings: deque[tuple[int, Ping]] = deque(maxlen=4 * len(_OLDER_VERSIONS))
        self._reported: int | None = None

    def mark_reached(self) -> None:
        """Record that the link has reached an edge, perhaps another one."""
        self._is_reached, self._hello_count = True, 0

    def mark_answered(self) -> None:
        """Record that the edge speaks our version."""
        self._hello_count, self._reported = 0, None
        self._pings.clear()

    def pings(self, now_ns: int) -> list[list[Bytes]]:
        """Return what to send with a hello: nothing at first, then a ping of each older version."""
        self._hello_count += self._is_reached
        if self._hello_count <= _MAX_UNANSWERED:
            return []
        pings = [(version, Ping(self._hello_count, now_ns)) for version in _OLDER_VERSIONS]
        self._pings.extend(pings)
        return [encode(ping, version) for version, ping in pings]

    def check_message(self, frames: Sequence[Bytes], error: VersionError) -> str | None:
        """Return the line to print for a message of an older version, once; None if it answers no ping.

        Raises WireError if it is no pong of an older version.
        """
        if error.version not in _OLDER_VERSIONS or error.code != MESSAGE_CODES[Pong]:
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
    """Return the agent's line for an edge of an older version."""
    own_text = f"this SHARE {__version__} wire {WIRE_VERSION}"
    return f"the edge speaks wire {version}, {own_text}: {upgrade_advice(version, WIRE_VERSION)}"
