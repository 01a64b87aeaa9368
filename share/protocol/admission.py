"""Which runs of agents the edge takes in, and what it calls them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from math import ceil

from share.config import EdgeConfig
from share.mapping.loops import KeyframeKey
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.peer import Peer, ReorderBuffer, RestoredRun
from share.timing import TokenBucket, TokenBuckets, seconds_to_ns
from share.types import Keyframe
from share.wire.messages import Hello, peer_id, public_tag

# ---- How much one agent may make the mapper work, whatever runs it begins.

# Of every keypoint the mapper's work is about the same, and of a keyframe without any as of so many
# (docs/robustness.md). An agent of the shipped settings sends keyframes of 500, at most 5 a second
# (control.rate_max_hz), and to a new edge at once what its ledger holds, 600. Twice that rate is taken in,
# and 700 at once.
_BASE_COST = 250
_KEYFRAME_COST = 500 + _BASE_COST
_COST_HZ, _COST_BURST = 10.0 * _KEYFRAME_COST, 700.0 * _KEYFRAME_COST
_SEGMENT_FACTOR = 20  # times: what begins a stretch of odometry stays in the mapper for as long as it runs
_OVERLOAD_TEXT = (
    f"keyframes come with more than {_COST_HZ / _KEYFRAME_COST * 500:.0f} keypoints a second: the rest waits"
)
_RATE_SLACK, _RATE_BURST = 1.2, 10.0  # rates arrive a little uneven


class KeyframeQuota:
    """Of each name. most_hz: keyframes a second that an agent may send; None: any number."""

    def __init__(self, max_rate_hz: float | None) -> None:
        self._cost_buckets = TokenBuckets(_COST_BURST, _COST_HZ)
        self._rate_buckets = TokenBuckets(
            _RATE_BURST, None if max_rate_hz is None else _RATE_SLACK * max_rate_hz
        )

    def objection(self, name: str, keyframe: Keyframe, now_ns: int) -> str | None:
        """Why this keyframe is not taken in now; None: it is, and counts."""
        cost = (len(keyframe.view.uv) + _BASE_COST) * (1 if keyframe.reference >= 0 else _SEGMENT_FACTOR)
        return None if self._cost_buckets.bucket(name, now_ns).take(now_ns, cost=cost) else _OVERLOAD_TEXT

    def is_over_rate(self, name: str, now_ns: int) -> bool:
        """Whether this keyframe, which is taken in, is more than its agent was ever asked for."""
        return not self._rate_buckets.bucket(name, now_ns).take(now_ns)


# New runs that are taken in: each stays in the report, and in the map once it has a keyframe. Of one name as
# many as somebody starts who tries things out; of all names of a key, one full room at once; of all, two.
_NAME_BURST, _NAME_HZ = 8.0, 0.1
_CREDENTIAL_BURST, _CREDENTIAL_HZ = 32.0, 0.25
_EDGE_BURST, _EDGE_HZ = 128.0, 2.0
_SILENT_S = 0.6  # an agent pings every half second


class NewRunLimits:
    """How often new runs may come, of each name, of all names of a key, and of the whole edge.

    voice: of the key that says hello (`PeerMessageReceived`); "" where no keys are used."""

    def __init__(self) -> None:
        self._total = TokenBucket(_EDGE_BURST, _EDGE_HZ)
        self._by_name = TokenBuckets(_NAME_BURST, _NAME_HZ)
        self._by_credential = TokenBuckets(_CREDENTIAL_BURST, _CREDENTIAL_HZ)

    def objection(self, name: str, credential: str, now_ns: int) -> str | None:
        """Why no new run of this name may come now, and when one may; None if one may."""
        if wait_s := self._by_name.bucket(name, now_ns).wait_s(now_ns):
            return f"too many new runs of '{name}': try again in {ceil(wait_s)} s"
        if credential and (wait_s := self._by_credential.bucket(credential, now_ns).wait_s(now_ns)):
            return f"too many new runs of the key of '{name}': try again in {ceil(wait_s)} s"
        if wait_s := self._total.wait_s(now_ns):
            return f"too many new runs of all agents: try again in {ceil(wait_s)} s"
        return None

    def record(self, name: str, credential: str, now_ns: int) -> None:
        """A new run of this name, to which there was no objection."""
        self._total.take(now_ns)
        self._by_name.bucket(name, now_ns).take(now_ns)
        if credential:
            self._by_credential.bucket(credential, now_ns).take(now_ns)


class Admission:
    """tracks: whether this edge tracks its agents, which then stream."""

    def __init__(self, config: EdgeConfig, tracks_agents: bool) -> None:
        self._config, self._tracks_agents = config, tracks_agents
        self._new_run_limits = NewRunLimits()

    def objection(
        self, event: PeerMessageReceived, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int
    ) -> str | None:
        """Why this run cannot be taken in, for a person; None if it can. event: brought `hello`."""
        if not event.is_authorised_for(hello.name):
            return name_objection(hello.name, event.allowed_names or ())
        if hello.streams_frames and not self._tracks_agents:
            return "this edge tracks nobody: start it with --policy streamed, or the agent without --streamed"
        if self._tracks_agents and not hello.streams_frames:
            return "this edge tracks its agents (policy streamed): start the agent with --streamed"
        if (existing := peers.get(event.peer_id)) is not None:
            same_name = existing.hello.name == hello.name
            return (
                None if same_name else f"this run's number is in use by '{existing.hello.name}'; start again"
            )
        capacity_objection = self.capacity_objection(hello, peers, now_ns)
        return capacity_objection or self._new_run_limits.objection(hello.name, event.credential, now_ns)

    def record_join(self, event: PeerMessageReceived, hello: Hello, now_ns: int) -> None:
        """This new run was taken in."""
        self._new_run_limits.record(hello.name, event.credential, now_ns)

    def is_name_stale(self, name: str, peers: Mapping[bytes, Peer], now_ns: int) -> bool:
        """Whether a run of this name is silent, perhaps for ever: its agent was killed and starts again."""
        received_ns = [
            peer.last_received_ns for peer in peers.values() if not peer.is_gone and peer.hello.name == name
        ]
        return bool(received_ns) and now_ns - max(received_ns) > seconds_to_ns(_SILENT_S)

    def capacity_objection(self, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int) -> str | None:
        """Why a run that is not present cannot be, beside those that are; None if it can."""
        present = [peer for peer in peers.values() if not peer.is_gone]
        for peer in present:
            if peer.hello.name == hello.name and now_ns - peer.last_received_ns < seconds_to_ns(
                self._config.name_hold_s
            ):
                return f"the name '{hello.name}' is in use by another agent; choose another with --name"
        if len(present) >= self._config.max_agents:
            return f"the edge serves {len(present)} agents already, as many as it may (edge.max_agents)"
        return None


def new_run_key(hello: Hello, used_keys: Collection[str]) -> str:
    """Names the run to everybody: as much of its public tag as sets it apart from other runs of that name."""
    digits, tag = 4, public_tag(hello.run_id)
    while (key := f"{hello.name}-{tag[:digits]}") in used_keys:
        digits += 1
    return key


def name_objection(name: str, allowed_names: Collection[str]) -> str:
    """Why who may speak for `allowed_names` is refused as `name`."""
    allowed = ", ".join(f"'{one}'" for one in sorted(allowed_names)) or "nobody"
    return (
        f"its key speaks for {allowed}, not for '{name}'; at the edge: share keys authorize … --agent {name}"
    )


# ---- The runs of agents that an edge knows, also those that are over.

_MAX_IDLE = 256  # gone without a keyframe; the oldest is forgotten
_MAX_FORGOTTEN = (
    65_536  # runs that are known to have been forgotten; of the others nobody was heard for hours
)


class RunRegistry(Mapping[bytes, Peer]):
    """By who speaks for them on the link. Each has a key, which names it everywhere else, and of each name
    the one that came or came back last is that agent's present one."""

    def __init__(self) -> None:
        self._peers: dict[bytes, Peer] = {}
        self._peer_id_by_key: dict[str, bytes] = {}
        self._runs_by_name: dict[str, dict[str, Peer]] = {}  # by key, the present one last
        # runs of which the map has nothing any more, and their newest keyframe
        self._empty_runs: dict[str, int] = {}
        self._forgotten_ids: dict[bytes, None] = {}
        self.forgotten_count = 0  # how many, since the edge began

    def __getitem__(self, peer_id: bytes) -> Peer:
        return self._peers[peer_id]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._peers)

    def __len__(self) -> int:
        return len(self._peers)

    @property
    def peer_id_by_key(self) -> Mapping[str, bytes]:
        """Who speaks for each run."""
        return self._peer_id_by_key

    def is_latest(self, peer: Peer) -> bool:
        """Whether no other run of that name came, or came back, after it."""
        return next(reversed(self._runs_by_name[peer.hello.name])) == peer.key

    def label(self, peer: Peer) -> str:
        """Of this run in reports: its name, if it is the latest of that; else also the end of its key, behind
        a character that is in no name, so that no name can be taken for it."""
        name = peer.hello.name
        return name if self.is_latest(peer) else f"{name}/{peer.key.removeprefix(f'{name}-')}"

    def add(self, peer_id: bytes, peer: Peer) -> None:
        """It is its name's present one from now on."""
        self._peers[peer_id] = peer
        self._peer_id_by_key[peer.key] = peer_id
        self.make_latest(peer)

    def make_latest(self, peer: Peer) -> None:
        """It is its name's present one again."""
        runs = self._runs_by_name.setdefault(peer.hello.name, {})
        runs.pop(peer.key, None)
        runs[peer.key] = peer

    def restore(self, run: RestoredRun) -> None:
        """One of an earlier life: it is not here, but may go on where it was."""
        next_keyframe = run.next_keyframe
        peer = Peer(
            run.hello,
            run.key,
            0,
            ReorderBuffer(next_keyframe),
            next_keyframe,
            run.odometry_base,
            is_gone=True,
            is_welcomed=False,
        )
        peer.last_finding, peer.has_sent, peer.credential = run.last_finding, False, run.credential
        self.add(peer_id(run.hello.run_id), peer)
        if run.odometry_base is None:
            self._empty_runs[run.key] = -1

    def mark_empty(self, runs: Iterable[KeyframeKey]) -> None:
        """The map has nothing of these any more, that has had their keyframes up to those."""
        self._empty_runs.update(runs)

    def removable(self) -> list[Peer]:
        """Runs that are gone and of which nothing is left. One that has come back meanwhile is kept."""
        out = []
        for key, newest in list(self._empty_runs.items()):
            peer = self._peers[self._peer_id_by_key[key]] if key in self._peer_id_by_key else None
            if peer is None or (peer.odometry_base is not None and peer.odometry_base.id > newest):
                del self._empty_runs[key]
            elif peer.is_gone and not peer.pending_saves:
                out.append(peer)
        return out

    def forget(self, peer: Peer) -> bool:
        """For good; returns whether it was its name's present one."""
        peer_id = self._peer_id_by_key.pop(peer.key)
        del self._peers[peer_id]
        self._empty_runs.pop(peer.key, None)
        was_latest, name = self.is_latest(peer), peer.hello.name
        del self._runs_by_name[name][peer.key]
        if not self._runs_by_name[name]:
            del self._runs_by_name[name]
        if peer.odometry_base is not None:
            self.forgotten_count += 1
            self._forgotten_ids[peer_id] = None
            if len(self._forgotten_ids) > _MAX_FORGOTTEN:
                del self._forgotten_ids[next(iter(self._forgotten_ids))]
        return was_latest

    def was_forgotten(self, peer_id: bytes) -> bool:
        """Whether this run was, in this life of the edge: keyframes that were acknowledged are not known."""
        return peer_id in self._forgotten_ids

    def forget_idle(self) -> tuple[Peer, bool] | None:
        """Who joins again and again without a keyframe fills no memory: the run that is forgotten now, if one
        is, and whether it was its name's present one."""
        idle = [(peer.last_received_ns, peer_id) for peer_id, peer in self._peers.items() if peer.is_idle]
        if len(idle) < _MAX_IDLE:
            return None
        peer = self._peers[min(idle)[1]]
        return peer, self.forget(peer)
