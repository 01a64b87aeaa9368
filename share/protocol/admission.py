"""Admission at the edge: limits on keyframes and new runs, and the registry of known runs."""

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

# Keyframe quota: the mapper work that one agent may cause, over all its runs.
#
# The work grows with the keypoints; a keyframe without any costs as much as _BASE_COST of them
# (docs/understand/robustness.md). With the default settings an agent sends keyframes of 500 keypoints, at
# most 5 a
# second (control.rate_max_hz), and resends up to 600 at once to a new edge. Twice that rate and 700 at once
# are accepted.
_BASE_COST = 250
_KEYFRAME_COST = 500 + _BASE_COST
_COST_HZ = 10.0 * _KEYFRAME_COST
_COST_BURST = 700.0 * _KEYFRAME_COST
_SEGMENT_FACTOR = 20  # a keyframe that starts a segment costs this much more: the mapper never forgets one
_OVERLOAD_TEXT = (
    f"more than {_COST_HZ / _KEYFRAME_COST * 500:.0f} keypoints a second: further keyframes are deferred"
)
_RATE_SLACK = 1.2  # keyframes arrive unevenly
_RATE_BURST = 10.0  # keyframes


class KeyframeQuota:
    """Limits the keyframes of each agent name.

    max_rate_hz: keyframes a second that the policy grants at most; None: unlimited."""

    def __init__(self, max_rate_hz: float | None) -> None:
        self._cost_buckets = TokenBuckets(_COST_BURST, _COST_HZ)
        self._rate_buckets = TokenBuckets(
            _RATE_BURST, None if max_rate_hz is None else _RATE_SLACK * max_rate_hz
        )

    def objection(self, name: str, keyframe: Keyframe, now_ns: int) -> str | None:
        """Return why this keyframe is not accepted now; None if it is, and charge its cost."""
        cost = (len(keyframe.view.uv) + _BASE_COST) * (1 if keyframe.reference >= 0 else _SEGMENT_FACTOR)
        return None if self._cost_buckets.bucket(name, now_ns).take(now_ns, cost=cost) else _OVERLOAD_TEXT

    def is_over_rate(self, name: str, now_ns: int) -> bool:
        """Return whether this accepted keyframe exceeds the highest rate that an agent may have."""
        return not self._rate_buckets.bucket(name, now_ns).take(now_ns)


# Limits on new runs: each stays in the report, and in the map once it has a keyframe. One name: as many as a
# person starts while trying things out; one key: a full room at once; the edge: two rooms.
_NAME_BURST = 8.0
_NAME_HZ = 0.1
_CREDENTIAL_BURST = 32.0
_CREDENTIAL_HZ = 0.25
_EDGE_BURST = 128.0
_EDGE_HZ = 2.0
_SILENT_S = 0.6  # an agent pings every 0.5 s


class NewRunLimits:
    """Limits the rate of new runs per name, per credential and for the whole edge.

    credential: as in `PeerMessageReceived`; "" without keys."""

    def __init__(self) -> None:
        self._total = TokenBucket(_EDGE_BURST, _EDGE_HZ)
        self._by_name = TokenBuckets(_NAME_BURST, _NAME_HZ)
        self._by_credential = TokenBuckets(_CREDENTIAL_BURST, _CREDENTIAL_HZ)

    def objection(self, name: str, credential: str, now_ns: int) -> str | None:
        """Return why this name may not start a new run now, and when it may; None if it may."""
        if wait_s := self._by_name.bucket(name, now_ns).wait_s(now_ns):
            return f"too many new runs of '{name}': try again in {ceil(wait_s)} s"
        if credential and (wait_s := self._by_credential.bucket(credential, now_ns).wait_s(now_ns)):
            return f"too many new runs of the key of '{name}': try again in {ceil(wait_s)} s"
        if wait_s := self._total.wait_s(now_ns):
            return f"too many new runs of all agents: try again in {ceil(wait_s)} s"
        return None

    def record(self, name: str, credential: str, now_ns: int) -> None:
        """Count a new run of this name that `objection` allowed."""
        self._total.take(now_ns)
        self._by_name.bucket(name, now_ns).take(now_ns)
        if credential:
            self._by_credential.bucket(credential, now_ns).take(now_ns)


class Admission:
    """Decides whether a run may join.

    tracks_agents: the edge tracks its agents (policy streamed), so agents must stream frames."""

    def __init__(self, config: EdgeConfig, tracks_agents: bool) -> None:
        self._config, self._tracks_agents = config, tracks_agents
        self._new_run_limits = NewRunLimits()

    def objection(
        self, event: PeerMessageReceived, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int
    ) -> str | None:
        """Return why this run may not join, for a person; None if it may. event: carried `hello`."""
        if not event.is_authorised_for(hello.name):
            return name_objection(hello.name, event.allowed_names or ())
        if hello.streams_frames and not self._tracks_agents:
            remedy = "start it with --policy streamed, or the agent without --streamed"
            return f"this edge does not track agents: {remedy}"
        if self._tracks_agents and not hello.streams_frames:
            return "this edge tracks its agents (policy streamed): start the agent with --streamed"
        if (existing := peers.get(event.peer_id)) is not None:
            same_name = existing.hello.name == hello.name
            return (
                None
                if same_name
                else f"this run id is in use by '{existing.hello.name}'; start the agent again"
            )
        capacity_objection = self.capacity_objection(hello, peers, now_ns)
        return capacity_objection or self._new_run_limits.objection(hello.name, event.credential, now_ns)

    def record_join(self, event: PeerMessageReceived, hello: Hello, now_ns: int) -> None:
        """Count a run that has joined."""
        self._new_run_limits.record(hello.name, event.credential, now_ns)

    def is_name_stale(self, name: str, peers: Mapping[bytes, Peer], now_ns: int) -> bool:
        """Return whether the present run of this name is silent: its agent may have been killed and
        restarted."""
        received_ns = [
            peer.last_received_ns for peer in peers.values() if not peer.is_gone and peer.hello.name == name
        ]
        return bool(received_ns) and now_ns - max(received_ns) > seconds_to_ns(_SILENT_S)

    def capacity_objection(self, hello: Hello, peers: Mapping[bytes, Peer], now_ns: int) -> str | None:
        """Return why an absent run may not become present beside the others; None if it may."""
        present = [peer for peer in peers.values() if not peer.is_gone]
        for peer in present:
            if peer.hello.name == hello.name and now_ns - peer.last_received_ns < seconds_to_ns(
                self._config.name_hold_s
            ):
                return f"the name '{hello.name}' is in use by another agent; choose another with --name"
        if len(present) >= self._config.max_agents:
            return f"the edge already serves {len(present)} agents, its limit (edge.max_agents)"
        return None


def new_run_key(hello: Hello, used_keys: Collection[str]) -> str:
    """Return the public key of a run: its name and enough of its public tag to be unique."""
    digits, tag = 4, public_tag(hello.run_id)
    while (key := f"{hello.name}-{tag[:digits]}") in used_keys:
        digits += 1
    return key


def name_objection(name: str, allowed_names: Collection[str]) -> str:
    """Return why a peer authorised for `allowed_names` is refused as `name`, with the remedy."""
    allowed = ", ".join(f"'{one}'" for one in sorted(allowed_names)) or "no agent"
    return (
        f"its key is authorized for {allowed}, not for '{name}'; on the edge run: "
        f"share keys authorize … --agent {name}"
    )


# Registry of the runs that an edge knows, ended ones included.
_MAX_IDLE = 256  # runs that left without a keyframe; beyond, the oldest is forgotten
_MAX_FORGOTTEN = 65_536  # forgotten runs that are still recognised; older ones have been silent for hours


class RunRegistry(Mapping[bytes, Peer]):
    """Runs by their peer id on the link. Each run has a key that names it everywhere else; the run of a name
    that joined or came back last is the latest."""

    def __init__(self) -> None:
        self._peers: dict[bytes, Peer] = {}
        self._peer_id_by_key: dict[str, bytes] = {}
        self._runs_by_name: dict[str, dict[str, Peer]] = {}  # by key, the latest last
        self._empty_runs: dict[str, int] = {}  # runs without anything in the map: their newest keyframe
        self._forgotten_ids: dict[bytes, None] = {}
        self.forgotten_count = 0  # since the edge started

    def __getitem__(self, peer_id: bytes) -> Peer:
        return self._peers[peer_id]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._peers)

    def __len__(self) -> int:
        return len(self._peers)

    @property
    def peer_id_by_key(self) -> Mapping[str, bytes]:
        """Peer id of each run."""
        return self._peer_id_by_key

    def is_latest(self, peer: Peer) -> bool:
        """Return whether no other run of its name joined or came back later."""
        return next(reversed(self._runs_by_name[peer.hello.name])) == peer.key

    def label(self, peer: Peer) -> str:
        """Return the run's label in reports: its name if it is the latest, else name/tag. No name contains
        "/"."""
        name = peer.hello.name
        return name if self.is_latest(peer) else f"{name}/{peer.key.removeprefix(f'{name}-')}"

    def add(self, peer_id: bytes, peer: Peer) -> None:
        """Add a run; it becomes the latest of its name."""
        self._peers[peer_id] = peer
        self._peer_id_by_key[peer.key] = peer_id
        self.make_latest(peer)

    def make_latest(self, peer: Peer) -> None:
        """Make a known run the latest of its name."""
        runs = self._runs_by_name.setdefault(peer.hello.name, {})
        runs.pop(peer.key, None)
        runs[peer.key] = peer

    def restore(self, run: RestoredRun) -> None:
        """Add a run of an earlier session. It is absent, and may resume where it was."""
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
        """Record that the map has nothing left of these runs. Values: newest keyframes it has seen."""
        self._empty_runs.update(runs)

    def removable(self) -> list[Peer]:
        """Return absent runs that the map has nothing of. A run that has come back is kept."""
        out = []
        for key, newest in list(self._empty_runs.items()):
            peer = self._peers[self._peer_id_by_key[key]] if key in self._peer_id_by_key else None
            if peer is None or (peer.odometry_base is not None and peer.odometry_base.id > newest):
                del self._empty_runs[key]
            elif peer.is_gone and not peer.pending_saves:
                out.append(peer)
        return out

    def forget(self, peer: Peer) -> bool:
        """Remove a run for good. Return whether it was the latest of its name."""
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
        """Return whether this session has forgotten the run, and with it the keyframes that it
        acknowledged."""
        return peer_id in self._forgotten_ids

    def forget_idle(self) -> tuple[Peer, bool] | None:
        """Forget the oldest of too many runs without a keyframe. Return it and whether it was the latest of
        its name, or None."""
        idle = [(peer.last_received_ns, peer_id) for peer_id, peer in self._peers.items() if peer.is_idle]
        if len(idle) < _MAX_IDLE:
            return None
        peer = self._peers[min(idle)[1]]
        return peer, self.forget(peer)
