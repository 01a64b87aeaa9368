"""Is an edge there, does it take our keys, does it speak our version, and how far is it?"""

from __future__ import annotations

import secrets
import time
from contextlib import closing

from share.core.checkup import Finding, fail, ok
from share.errors import WireError
from share.io.keys import AgentKeys
from share.io.transport import AgentLink, connect
from share.wire.codec import decode, encode
from share.wire.messages import Ping, Pong

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
    sent = 0
    took: list[float] = []
    while time.monotonic() < until_s and len(took) < 5:
        sent += link.send(encode(Ping(sent, time.monotonic_ns())))
        frames = link.receive(100)
        message = None if frames is None else decode(frames)
        if isinstance(message, Pong):
            took.append((time.monotonic_ns() - message.sent_ns) / 1e9)
    return min(took, default=None)
