"""Is an edge there, does it take our keys, does it speak our version, and how far is it?"""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from contextlib import closing

from share.core.checkup import Finding, fail, ok
from share.core.versions import EdgeVersion
from share.errors import VersionError, WireError
from share.io.keys import AgentKeys
from share.io.transport import AgentLink, connect
from share.wire.codec import Bytes, decode, encode
from share.wire.messages import Message, Ping, Pong

_PATIENCE_S = 4.0


def probe(address: str, keys: AgentKeys | None, patience_s: float = _PATIENCE_S) -> Finding:
    """By pings, which an edge answers to strangers: no agent is made. Raises UsageError for an address."""
    with closing(connect(address, secrets.randbits(63), keys)) as link:
        try:
            took_s = _round_trip(link, time.monotonic() + patience_s)
        except WireError as error:
            return fail("edge", f"{address}: {error}", "install one version of SHARE on both machines")
        trouble = link.trouble()
    if took_s is not None:
        return ok("edge", f"{address}: answers in {took_s * 1e3:.1f} ms")
    if trouble is not None:
        return fail("edge", f"{address}: {trouble}")
    mend = f"start it there: share edge --bind {address}; is the port open?"
    return fail("edge", f"{address}: no answer within {patience_s:g} s", mend)


def _round_trip(link: AgentLink, until_s: float) -> float | None:
    """Of the quickest answer to several pings, s; None where none came."""
    sent, edge = 0, EdgeVersion()
    edge.reached()
    took: list[float] = []
    while time.monotonic() < until_s and len(took) < 5:
        sent += link.send(encode(Ping(sent, time.monotonic_ns())))
        if not took:
            for ping in edge.pings(time.monotonic_ns()):
                link.send(ping)
        frames = link.receive(100)
        message = None if frames is None else _decoded(frames, edge)
        if isinstance(message, Pong):
            took.append((time.monotonic_ns() - message.sent_ns) / 1e9)
    return min(took, default=None)


def _decoded(frames: Sequence[Bytes], edge: EdgeVersion) -> Message | None:
    """Raises WireError, which says of an older edge that it is one."""
    try:
        return decode(frames)
    except VersionError as error:
        if (line := edge.heard(frames, error)) is None:
            return None
        raise WireError(line) from None
