"""Which runs of agents the edge takes in, and what it calls them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import ceil

from share.config import EdgeConfig
from share.core.edge_events import Received
from share.core.peer import Peer
from share.core.rate import Buckets, TokenBucket, seconds
from share.wire.messages import Hello, public_tag

# New runs that are taken in: each stays in the report, and in the map once it has a keyframe. Of one name as
# many as somebody starts who tries things out; of all names of a key, one full room at once; of all, two.
_NAME_BURST, _NAME_HZ = 8.0, 0.1
_VOICE_BURST, _VOICE_HZ = 32.0, 0.25
_EDGE_BURST, _EDGE_HZ = 128.0, 2.0


class Newcomers:
    """How often new runs may come, of each name, of all names of a key, and of the whole edge.

    voice: of the key that says hello (`Received`); "" where no keys are used."""

    def __init__(self) -> None:
        self._all = TokenBucket(_EDGE_BURST, _EDGE_HZ)
        self._of_name = Buckets(_NAME_BURST, _NAME_HZ)
        self._of_voice = Buckets(_VOICE_BURST, _VOICE_HZ)

    def objection(self, name: str, voice: str, now_ns: int) -> str | None:
        """Why no new run of this name may come now, and when one may; None if one may."""
        if wait_s := self._of_name.of(name, now_ns).wait_s(now_ns):
            return f"too many new runs of '{name}': try again in {ceil(wait_s)} s"
        if voice and (wait_s := self._of_voice.of(voice, now_ns).wait_s(now_ns)):
            return f"too many new runs of the key of '{name}': try again in {ceil(wait_s)} s"
        if wait_s := self._all.wait_s(now_ns):
            return f"too many new runs of all agents: try again in {ceil(wait_s)} s"
        return None

    def came(self, name: str, voice: str, now_ns: int) -> None:
        """A new run of this name, to which there was no objection."""
        self._all.take(now_ns)
        self._of_name.of(name, now_ns).take(now_ns)
        if voice:
            self._of_voice.of(voice, now_ns).take(now_ns)


class Admission:
    """tracks: whether this edge tracks its agents, which then stream."""

    def __init__(self, config: EdgeConfig, tracks: bool) -> None:
        self._config, self._tracks = config, tracks
        self._newcomers = Newcomers()

    def objection(
        self, event: Received, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int
    ) -> str | None:
        """Why this run cannot be taken in, for a person; None if it can. event: brought `hello`."""
        if not event.speaks_for(hello.name):
            return other_name(hello.name, event.names or ())
        if hello.streams and not self._tracks:
            return "this edge tracks nobody: start it with --policy streamed, or the agent without --streamed"
        if self._tracks and not hello.streams:
            return "this edge tracks its agents (policy streamed): start the agent with --streamed"
        if (known := peers.get(event.peer)) is not None:
            same = known.hello.name == hello.name
            return None if same else f"this run's number is in use by '{known.hello.name}'; start again"
        crowd = self.no_room(hello, peers, now_ns)
        return crowd or self._newcomers.objection(hello.name, event.voice, now_ns)

    def came(self, event: Received, hello: Hello, now_ns: int) -> None:
        """This new run was taken in."""
        self._newcomers.came(hello.name, event.voice, now_ns)

    def no_room(self, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int) -> str | None:
        """Why a run that is not present cannot be, beside those that are; None if it can."""
        present = [peer for peer in peers.values() if not peer.gone]
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


def other_name(name: str, names: Collection[str]) -> str:
    """Why who may speak for `names` is refused as `name`."""
    own = ", ".join(f"'{one}'" for one in sorted(names)) or "nobody"
    return f"its key speaks for {own}, not for '{name}'; at the edge: share keys authorize … --agent {name}"
