"""Which runs of agents the edge takes in, and what it calls them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from math import ceil

from share.config import EdgeConfig
from share.mapping.loops import Key
from share.protocol.edge_events import Received
from share.protocol.peer import InOrder, Known, Peer
from share.rates import Buckets, TokenBucket, seconds
from share.types import Keyframe
from share.wire.messages import Hello, peer_id, public_tag

# ---- How much one agent may make the mapper work, whatever runs it begins.

# Of every keypoint the mapper's work is about the same, and of a keyframe without any as of so many
# (docs/robustness.md). An agent of the shipped settings sends keyframes of 500, at most 5 a second
# (control.rate_max_hz), and to a new edge at once what its ledger holds, 600. Twice that rate is taken in,
# and 700 at once.
_BARE = 250
_KEYFRAME = 500 + _BARE
_HZ, _BURST = 10.0 * _KEYFRAME, 700.0 * _KEYFRAME
_FOUNDING = 20  # times: what begins a stretch of odometry stays in the mapper for as long as it runs
_SAID = f"keyframes come with more than {_HZ / _KEYFRAME * 500:.0f} keypoints a second: the rest waits"
_SLACK, _AT_ONCE = 1.2, 10.0  # rates arrive a little uneven


class Allowance:
    """Of each name. most_hz: keyframes a second that an agent may send; None: any number."""

    def __init__(self, most_hz: float | None) -> None:
        self._work = Buckets(_BURST, _HZ)
        self._asked = Buckets(_AT_ONCE, None if most_hz is None else _SLACK * most_hz)

    def objection(self, name: str, keyframe: Keyframe, now_ns: int) -> str | None:
        """Why this keyframe is not taken in now; None: it is, and counts."""
        cost = (len(keyframe.view.uv) + _BARE) * (1 if keyframe.reference >= 0 else _FOUNDING)
        return None if self._work.of(name, now_ns).take(now_ns, cost=cost) else _SAID

    def is_extra(self, name: str, now_ns: int) -> bool:
        """Whether this keyframe, which is taken in, is more than its agent was ever asked for."""
        return not self._asked.of(name, now_ns).take(now_ns)


# New runs that are taken in: each stays in the report, and in the map once it has a keyframe. Of one name as
# many as somebody starts who tries things out; of all names of a key, one full room at once; of all, two.
_NAME_BURST, _NAME_HZ = 8.0, 0.1
_VOICE_BURST, _VOICE_HZ = 32.0, 0.25
_EDGE_BURST, _EDGE_HZ = 128.0, 2.0
_MUTE_S = 0.6  # an agent pings every half second


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

    def is_soon_free(self, name: str, peers: Mapping[bytes, Peer], now_ns: int) -> bool:
        """Whether a run of this name is silent, perhaps for ever: its agent was killed and starts again."""
        heard_ns = [peer.heard_ns for peer in peers.values() if not peer.gone and peer.hello.name == name]
        return bool(heard_ns) and now_ns - max(heard_ns) > seconds(_MUTE_S)

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


# ---- The runs of agents that an edge knows, also those that are over.

_MAX_IDLE = 256  # gone without a keyframe; the oldest is forgotten
_MAX_FORGOTTEN = (
    65_536  # runs that are known to have been forgotten; of the others nobody was heard for hours
)


class Runs(Mapping[bytes, Peer]):
    """By who speaks for them on the link. Each has a key, which names it everywhere else, and of each name
    the one that came or came back last is that agent's present one."""

    def __init__(self) -> None:
        self._peers: dict[bytes, Peer] = {}
        self._by_key: dict[str, bytes] = {}
        self._of_name: dict[str, dict[str, Peer]] = {}  # by key, the present one last
        # runs of which the map has nothing any more, and their newest keyframe
        self._emptied: dict[str, int] = {}
        self._forgotten: dict[bytes, None] = {}
        self.forgotten = 0  # how many, since the edge began

    def __getitem__(self, peer: bytes) -> Peer:
        return self._peers[peer]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._peers)

    def __len__(self) -> int:
        return len(self._peers)

    @property
    def by_key(self) -> Mapping[str, bytes]:
        """Who speaks for each run."""
        return self._by_key

    def is_latest(self, peer: Peer) -> bool:
        """Whether no other run of that name came, or came back, after it."""
        return next(reversed(self._of_name[peer.hello.name])) == peer.key

    def label(self, peer: Peer) -> str:
        """Of this run in reports: its name, if it is the latest of that; else also the end of its key, behind
        a character that is in no name, so that no name can be taken for it."""
        name = peer.hello.name
        return name if self.is_latest(peer) else f"{name}/{peer.key.removeprefix(f'{name}-')}"

    def add(self, peer_id: bytes, peer: Peer) -> None:
        """It is its name's present one from now on."""
        self._peers[peer_id] = peer
        self._by_key[peer.key] = peer_id
        self.came_back(peer)

    def came_back(self, peer: Peer) -> None:
        """It is its name's present one again."""
        runs = self._of_name.setdefault(peer.hello.name, {})
        runs.pop(peer.key, None)
        runs[peer.key] = peer

    def recall(self, run: Known) -> None:
        """One of an earlier life: it is not here, but may go on where it was."""
        asked = run.next_keyframe
        peer = Peer(run.hello, run.key, 0, InOrder(asked), asked, run.foot, gone=True, greeted=False)
        peer.newest, peer.was_heard, peer.voice = run.finding, False, run.voice
        self.add(peer_id(run.hello.run_id), peer)
        if run.foot is None:
            self._emptied[run.key] = -1

    def emptied(self, runs: Iterable[Key]) -> None:
        """The map has nothing of these any more, that has had their keyframes up to those."""
        self._emptied.update(runs)

    def forgettable(self) -> list[Peer]:
        """Runs that are gone and of which nothing is left. One that has come back meanwhile is kept."""
        out = []
        for key, newest in list(self._emptied.items()):
            peer = self._peers[self._by_key[key]] if key in self._by_key else None
            if peer is None or (peer.foot is not None and peer.foot.id > newest):
                del self._emptied[key]
            elif peer.gone and not peer.unsafe:
                out.append(peer)
        return out

    def forget(self, peer: Peer) -> bool:
        """For good; returns whether it was its name's present one."""
        peer_id = self._by_key.pop(peer.key)
        del self._peers[peer_id]
        self._emptied.pop(peer.key, None)
        was_latest, name = self.is_latest(peer), peer.hello.name
        del self._of_name[name][peer.key]
        if not self._of_name[name]:
            del self._of_name[name]
        if peer.foot is not None:
            self.forgotten += 1
            self._forgotten[peer_id] = None
            if len(self._forgotten) > _MAX_FORGOTTEN:
                del self._forgotten[next(iter(self._forgotten))]
        return was_latest

    def was_forgotten(self, peer_id: bytes) -> bool:
        """Whether this run was, in this life of the edge: keyframes that were acknowledged are not known."""
        return peer_id in self._forgotten

    def forget_idle(self) -> tuple[Peer, bool] | None:
        """Who joins again and again without a keyframe fills no memory: the run that is forgotten now, if one
        is, and whether it was its name's present one."""
        idle = [(peer.heard_ns, peer_id) for peer_id, peer in self._peers.items() if peer.is_idle]
        if len(idle) < _MAX_IDLE:
            return None
        peer = self._peers[min(idle)[1]]
        return peer, self.forget(peer)
