"""Which runs of agents the edge takes in, and what it calls them."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from share.config import EdgeConfig
from share.core.edge_events import Received
from share.core.peer import Peer
from share.core.rate import seconds
from share.wire.messages import Hello, public_tag


class Admission:
    """tracks: whether this edge tracks its agents, which then stream."""

    def __init__(self, config: EdgeConfig, tracks: bool) -> None:
        self._config, self._tracks = config, tracks

    def objection(
        self, event: Received, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int
    ) -> str | None:
        """Why this run cannot be taken in, for a person; None if it can. event: brought `hello`."""
        if not event.speaks_for(hello.name):
            return _other_name(hello.name, event.names or ())
        if hello.streams and not self._tracks:
            return "this edge tracks nobody: start it with --policy streamed, or the agent without --streamed"
        if self._tracks and not hello.streams:
            return "this edge tracks its agents (policy streamed): start the agent with --streamed"
        if (known := peers.get(event.peer)) is not None:
            same = known.hello.name == hello.name
            return None if same else f"this run's number is in use by '{known.hello.name}'; start again"
        return self._no_room(hello, [peer for peer in peers.values() if not peer.gone], now_ns)

    def _no_room(self, hello: Hello, present: Collection[Peer], now_ns: int) -> str | None:
        for peer in present:
            if peer.hello.name == hello.name and now_ns - peer.heard_ns < seconds(self._config.name_hold_s):
                return f"the name '{hello.name}' is in use by another agent; choose another with --name"
        if len(present) >= self._config.max_agents:
            return f"the edge serves {len(present)} agents already, as many as it may (edge.max_agents)"
        return None


def new_key(hello: Hello, taken: Collection[str]) -> str:
    """Names the run to everybody: as much of its public tag as sets it apart from other runs of that name."""
    digits, tag = 4, public_tag(hello.run_id)
    while (key := f"{hello.name}-{tag[:digits]}") in taken:
        digits += 1
    return key


def _other_name(name: str, names: Collection[str]) -> str:
    own = ", ".join(f"'{one}'" for one in sorted(names)) or "nobody"
    return f"its key speaks for {own}, not for '{name}'; at the edge: share keys authorize … --agent {name}"
