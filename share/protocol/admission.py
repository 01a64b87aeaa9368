"""Admission at the edge: which agents may join, limits on new runs, and the registry of known runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import ceil

from share.config import EdgeConfig
from share.mapping.agent_runs import AgentRuns
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MAX_FORGOTTEN_RUNS
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.peer import Peer, RestoredRun, Sender
from share.scheduling.rate_scheduler import RateScheduler
from share.timing import TokenBucket, TokenBuckets, seconds_to_ns
from share.wire.messages import Hello, PoseUpdate, peer_id, peer_tag, public_tag

# Limits on new runs, each at once and a second: each run stays in the map once it has a keyframe. One name:
# as many as a person starts while trying things out; one key: a full room; the edge: two.
_NAME_LIMIT, _CREDENTIAL_LIMIT, _EDGE_LIMIT = (8.0, 0.1), (32.0, 0.25), (128.0, 2.0)
_SILENT_S = 0.6  # an agent pings every 0.5 s
NAME_HOLD_S = 3.0  # a name stays in use for this long after its agent's last message


class NewRunLimits:
    """Limits the rate of new runs per name, per credential and for the whole edge.

    credential: as in `PeerMessageReceived`; "" without keys."""

    def __init__(self) -> None:
        self._total = TokenBucket(*_EDGE_LIMIT)
        self._by_name, self._by_credential = TokenBuckets(*_NAME_LIMIT), TokenBuckets(*_CREDENTIAL_LIMIT)

    def objection(self, name: str, credential: str, now_ns: int) -> str | None:
        """Return why this name may not start a new run now, and when it may; None if it may."""
        for owner, bucket in self._buckets(name, credential, now_ns):
            if wait_s := bucket.wait_s(now_ns):
                return f"too many new runs of {owner}: try again in {ceil(wait_s)} s"
        return None

    def record(self, name: str, credential: str, now_ns: int) -> None:
        """Count a new run of this name that `objection` allowed."""
        for _, bucket in self._buckets(name, credential, now_ns):
            bucket.take(now_ns)

    def _buckets(self, name: str, credential: str, now_ns: int) -> Iterator[tuple[str, TokenBucket]]:
        yield f"'{name}'", self._by_name.bucket(name, now_ns)
        if credential:
            yield f"the key of '{name}'", self._by_credential.bucket(credential, now_ns)
        yield "all agents", self._total


class Admission:
    """Decides whether a run may join.

    tracks_agents: the edge tracks its agents (policy streamed), so agents must stream frames.
    rate_scheduler: its policy says whether the room has air for one more."""

    def __init__(self, config: EdgeConfig, tracks_agents: bool, rate_scheduler: RateScheduler) -> None:
        self._max_agents, self._tracks_agents = config.max_agents, tracks_agents
        self._new_run_limits, self._rate_scheduler = NewRunLimits(), rate_scheduler

    def objection(
        self, event: PeerMessageReceived, hello: Hello, runs: RunRegistry, now_ns: int
    ) -> str | None:
        """Return why this run may not join, for a person; None if it may. event: carried `hello`."""
        if not event.is_authorised_for(hello.name):
            return name_objection(hello.name, event)
        if peer_id(hello.run_id) != event.peer_id:  # the run would come back as another
            return "its hello says another run id than its connection; start the agent again"
        if hello.streams_frames and not self._tracks_agents:
            remedy = "start it with --policy streamed, or the agent without --streamed"
            return f"this edge does not track agents: {remedy}"
        if self._tracks_agents and not hello.streams_frames:
            return "this edge tracks its agents (policy streamed): start the agent with --streamed"
        if (existing := runs.get(event.peer_id)) is not None:
            in_use = f"this run id is in use by '{existing.name}'; start the agent again"
            return None if existing.name == hello.name else in_use
        return self.capacity_objection(hello, runs, now_ns) or self._new_run_limits.objection(
            hello.name, event.credential, now_ns
        )

    def record_join(self, event: PeerMessageReceived, hello: Hello, now_ns: int) -> None:
        """Count a run that has joined."""
        self._new_run_limits.record(hello.name, event.credential, now_ns)

    def is_name_stale(self, name: str, runs: RunRegistry, now_ns: int) -> bool:
        """Return whether the present run of this name is silent: its agent may have been killed and
        restarted."""
        received_ns = [peer.last_received_ns for peer in runs.present() if peer.name == name]
        return bool(received_ns) and now_ns - max(received_ns) > seconds_to_ns(_SILENT_S)

    def capacity_objection(self, hello: Hello, runs: RunRegistry, now_ns: int) -> str | None:
        """Return why an absent run may not become present beside the others; None if it may."""
        present = runs.present()
        for peer in present:
            since_ns = now_ns - peer.last_received_ns
            if peer.name == hello.name and since_ns < seconds_to_ns(NAME_HOLD_S):
                return f"the name '{hello.name}' is in use by another agent; choose another with --name"
        if len(present) >= self._max_agents:
            return f"the edge already serves {len(present)} agents, its limit (edge.max_agents)"
        return self._rate_scheduler.policy.objection(hello.name, hello.kind, now_ns)


def new_run_key(hello: Hello, used_keys: Collection[str]) -> str:
    """Return the public key of a run: its name and enough of its public tag to be unique."""
    digits, tag = 4, public_tag(hello.run_id)
    while (key := f"{hello.name}-{tag[:digits]}") in used_keys:
        digits += 1
    return key


def name_objection(name: str, event: PeerMessageReceived) -> str:
    """Return why the sender is refused as `name`, for which it is not authorised, with the remedy."""
    allowed = ", ".join(f"'{one}'" for one in sorted(event.allowed_names or ())) or "no agent"
    if not event.credential:  # without keys only a site's room has names
        return f"this room is for {allowed}, not for '{name}': see `agents` of the room in the rooms file"
    return (
        f"its key is authorized for {allowed}, not for '{name}'; on the edge run: "
        f"share keys authorize … --agent {name}"
    )


def misuse_text(event: PeerMessageReceived, name: str) -> str:
    """Return what a sender did that sent as a run of `name`, for which it is not authorised."""
    if not event.credential:
        return f"the run of '{name}' was used in a room where it may not be"
    return f"a key that is not authorized for '{name}' used its run"


# Registry of the runs that an edge knows, ended ones included.
_MAX_MISSED = 64  # runs that went without a bye; more at once are the network's fault
_MAX_IDLE = 256  # runs that left without a keyframe; beyond, the oldest is forgotten


@dataclass(frozen=True)
class ForgottenRun:
    """What is kept of a forgotten run, in case its agent comes back. next_keyframe: above all ids that it
    had. session: as in `Peer`; None: of an earlier start of the edge. revision: of its newest correction in
    that session."""

    next_keyframe: int
    session: int | None = None
    revision: int = 0


class RunRegistry(Mapping[bytes, Peer]):
    """Runs by their peer id on the link. Each run has a key that names it everywhere else; the run of a name
    that joined or came back last is the latest. Of several runs in a map file with one id the first has it,
    and the others are known by their keys only. unjoined: what is counted of all other peers together.
    forgotten: next keyframes of runs that earlier sessions have forgotten, by `public_tag`."""

    def __init__(self, forgotten: Mapping[str, int]) -> None:
        self.unjoined = Sender()
        self.by_key: dict[str, Peer] = {}
        self._peers: dict[bytes, Peer] = {}
        self._runs = AgentRuns()
        self._idle: dict[str, Peer] = {}  # absent runs without a keyframe
        self._missed: dict[str, Peer] = {}  # that went without a bye, the latest last
        self._empty_runs: dict[str, int] = {}  # runs without anything in the map: their newest keyframe
        self._forgotten: dict[str, ForgottenRun] = {}  # by public tag, the latest last
        for tag, next_keyframe in forgotten.items():
            self._remember(tag, ForgottenRun(next_keyframe))
        self.forgotten_count = 0  # since the edge started

    def __getitem__(self, peer_id: bytes) -> Peer:
        return self._peers[peer_id]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._peers)

    def __len__(self) -> int:
        return len(self._peers)

    def sender(self, peer_id: bytes) -> Sender:
        """Return the run, or `unjoined`."""
        return self.get(peer_id) or self.unjoined

    def present(self) -> list[Peer]:
        """Return the runs that have not left."""
        return [self.by_key[key] for key in self._runs.present()]

    def listed(self, max_names: int, now_ns: int) -> list[Peer]:
        """Return the runs that a report lists: see `AgentRuns.listed`, and those that are missed."""
        self._missed = {key: peer for key, peer in self._missed.items() if peer.is_missed(now_ns)}
        listed = dict.fromkeys([*self._runs.listed(max_names), *self._missed])
        return [self.by_key[key] for key in listed]

    def mark_present(self, peer: Peer) -> None:
        """Record that a known run takes part; it becomes the latest of its name."""
        peer.is_gone = False
        self._runs.set_present(peer.key, True)
        self._idle.pop(peer.key, None)
        self._missed.pop(peer.key, None)

    def mark_gone(self, peer: Peer) -> None:
        """Record that a run has left."""
        peer.is_gone = True
        self._runs.set_present(peer.key, False)
        if peer.is_idle:
            self._idle[peer.key] = peer
        if peer.is_missed(peer.last_received_ns):
            self._missed[peer.key] = peer
            if len(self._missed) > _MAX_MISSED:
                del self._missed[next(iter(self._missed))]

    def mark_heard(self, peer: Peer) -> None:
        """Record that a run which has left sent something: a report lists it again."""
        self._runs.set_present(peer.key, False)

    def is_latest(self, peer: Peer) -> bool:
        """Return whether no other run of its name joined or came back later."""
        return self._runs.is_latest(peer.key)

    def shares_map(self, peer: Peer) -> bool:
        """Return whether a run shares a map with another that is present, or no other is."""
        others = [other for other in self.present() if other is not peer]
        return not others or peer.map_id in {other.map_id for other in others} - {None}

    def latest_poses(self) -> dict[str, PoseUpdate]:
        """Return the newest pose of each present run, by run key."""
        return {peer.key: peer.latest_pose for peer in self.present() if peer.latest_pose is not None}

    def label(self, peer: Peer) -> str:
        """Return the run's label in reports: its name if it is the latest, else name/tag. No name contains
        "/"."""
        tag = peer.key.removeprefix(f"{peer.name}-")
        return peer.name if self.is_latest(peer) else f"{peer.name}/{tag}"

    def add(self, peer: Peer) -> None:
        """Add a run that takes part."""
        self._peers.setdefault(peer.id, peer)
        self.by_key[peer.key] = peer
        self._runs.add(peer.key, peer.name)
        self.mark_present(peer)

    def restore(self, run: RestoredRun, session: int) -> None:
        """Add a run of an earlier session, which is absent. session: of the edge."""
        peer = run.peer(session)
        self.add(peer)
        self.mark_gone(peer)
        if run.odometry_base is None:
            self._empty_runs[run.key] = -1

    def hand_over(self, peer: Peer) -> None:
        """Leave an absent run in place of one that goes on in another room."""
        self._remove(peer)
        self.restore(RestoredRun.from_peer(peer), peer.session)

    def take_over(self, peer: Peer) -> bool:
        """Add a run that comes from another room. Return whether it was here before."""
        absent = self.by_key.get(peer.key)
        if absent is not None:
            self._remove(absent)
        self.add(peer)
        return absent is not None

    def mark_empty(self, runs: Iterable[KeyframeKey]) -> None:
        """Record that the map has nothing left of these runs. Values: newest keyframes it has seen."""
        self._empty_runs.update(runs)

    def removable(self) -> list[Peer]:
        """Return absent runs that the map has nothing of. A run that has come back is kept."""
        out = []
        for key, newest in list(self._empty_runs.items()):
            peer = self.by_key.get(key)
            if peer is None or (peer.odometry_base is not None and peer.odometry_base.id > newest):
                del self._empty_runs[key]
            elif peer.is_gone and not peer.pending_saves:
                out.append(peer)
        return out

    def forget(self, peer: Peer) -> bool:
        """Remove a run for good. Return whether it was the latest of its name."""
        was_latest, had_id = self.is_latest(peer), self._peers.get(peer.id) is peer
        self._remove(peer)
        self._empty_runs.pop(peer.key, None)
        self.forgotten_count += peer.odometry_base is not None
        if had_id and (next_keyframe := peer.reorder_buffer.next_keyframe) > 0:
            self._remember(peer_tag(peer.id), ForgottenRun(next_keyframe, peer.session, peer.revision))
        return was_latest

    def _remove(self, peer: Peer) -> None:
        del self.by_key[peer.key]
        if self._peers.get(peer.id) is peer:
            del self._peers[peer.id]
        self._runs.remove(peer.key)
        self._idle.pop(peer.key, None)
        self._missed.pop(peer.key, None)

    def _remember(self, tag: str, run: ForgottenRun) -> None:
        self._forgotten.pop(tag, None)
        self._forgotten[tag] = run
        if len(self._forgotten) > MAX_FORGOTTEN_RUNS:
            del self._forgotten[next(iter(self._forgotten))]

    def forgotten(self, peer_id: bytes) -> ForgottenRun | None:
        """Return what is kept of a peer's run that was forgotten and has not come back; None of others."""
        return None if peer_id in self._peers else self._forgotten.get(peer_tag(peer_id))

    def forgotten_next_keyframes(self) -> dict[str, int]:
        """Return the next keyframes of forgotten runs, for a session that follows."""
        return {tag: run.next_keyframe for tag, run in self._forgotten.items()}

    def oldest_idle(self) -> Peer | None:
        """Return the oldest of too many runs without a keyframe, None if they are not too many."""
        if len(self._idle) < _MAX_IDLE:
            return None
        return min(self._idle.values(), key=lambda peer: (peer.last_received_ns, peer.id))
