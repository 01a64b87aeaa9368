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
from share.rates import Throttle
from share.wire.codec import OLDEST, VERSION, Bytes, code_of, decode, encode
from share.wire.messages import Ping, Pong

_REFUSE_HZ = 0.5  # an agent of another version is answered at most so often
_PATIENCE = 2  # hellos without an answer before older versions are tried
_OLDER = range(OLDEST, VERSION)


def which_to_upgrade(edge: int, agent: int) -> str:
    """By their wire versions."""
    return "upgrade the agent" if agent < edge else "upgrade the edge"


class OtherVersions:
    """At the edge: what is said to peers of other wire versions."""

    def __init__(self) -> None:
        self._throttle = Throttle(_REFUSE_HZ, 1.0)

    def refusal(self, peer: bytes, error: VersionError, now_ns: int) -> str | None:
        """The line to refuse it by; None where it has just been said, or where this was a ping.

        A ping of an older version is a newer agent's question, whose answer would be that this is an edge of
        that version.
        """
        if error.code == code_of(Ping) or self._throttle.admit(peer, now_ns) is None:
            return None
        us = f"this edge is SHARE {__version__} (wire {VERSION})"
        return f"{us}, this agent speaks wire {error.version}: {which_to_upgrade(VERSION, error.version)}"


class EdgeVersion:
    """At the agent: finds out the wire version of an edge that does not answer it."""

    def __init__(self) -> None:
        self._reached = False  # the link, an edge
        self._asked = 0  # hellos since then, or since it last answered
        self._pings: deque[tuple[int, Ping]] = deque(maxlen=4 * len(_OLDER))  # under way, with their versions
        self._said: int | None = None

    def reached(self) -> None:
        """The link has reached an edge, perhaps another one."""
        self._reached, self._asked = True, 0

    def answered(self) -> None:
        """The edge speaks our version."""
        self._asked, self._said = 0, None
        self._pings.clear()

    def pings(self, now_ns: int) -> list[list[Bytes]]:
        """What is to be sent with a hello: nothing at first, then a ping of each older version."""
        self._asked += self._reached
        if self._asked <= _PATIENCE:
            return []
        pings = [(version, Ping(self._asked, now_ns)) for version in _OLDER]
        self._pings.extend(pings)
        return [encode(ping, version) for version, ping in pings]

    def heard(self, frames: Sequence[Bytes], error: VersionError) -> str | None:
        """What to say, once, of a message of another version; None where it answers no ping.

        Raises WireError where it is none of an older version that can be understood.
        """
        if error.version not in _OLDER:
            raise error
        pong = decode(frames, (error.version,))
        if not isinstance(pong, Pong):
            raise error
        known = (error.version, Ping(pong.sequence, pong.sent_ns)) in self._pings
        if not known or self._said == error.version:
            return None
        self._said = error.version
        return edge_is_older(error.version)


def edge_is_older(version: int) -> str:
    """For a person at the agent."""
    us = f"this SHARE {__version__} wire {VERSION}"
    return f"the edge speaks wire {version}, {us}: {which_to_upgrade(version, VERSION)}"
