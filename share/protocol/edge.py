"""The edge's side of the protocol as a state machine: admission, acknowledgements, corrections.

It uses no socket, thread, disk or clock: `EdgeProtocol.handle` returns effects, which
`share.runtime.served_room` carries out. The mapper (`share.mapping.mapper`) runs in its own process and
answers with map events; the map writer stores what must survive a crash and answers once it is on the disk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from share import __version__
from share.config import Config
from share.errors import VersionError, WireError, describe_exception
from share.mapping.corrections import MapEvent
from share.mapping.map_changes import SaveKeyframe, SaveObject, SavePoses, SaveRun
from share.plain_data import to_mapping
from share.protocol import edge_events as ed
from share.protocol.admission import RunRegistry, misuse_text
from share.protocol.client_registry import Client
from share.protocol.client_service import CLIENT_MESSAGES, ClientService
from share.protocol.common_events import Tick
from share.protocol.edge_membership import RoomMembership, RunTrackers
from share.protocol.edge_records import EdgeOutput
from share.protocol.keyframe_intake import KeyframeQuota, OdometryBase, sanitise
from share.protocol.peer import Peer, RestoredRun, fault_warnings
from share.protocol.versions import refusal_of_version
from share.scheduling.policies import AgentReport
from share.scheduling.rate_scheduler import RateScheduler
from share.timing import Throttle
from share.types import Frame, Keyframe
from share.wire import messages as wire
from share.wire.codec import decode, message_bytes, message_type
from share.wire.room_messages import ClientHello

_VERSION_REFUSAL_HZ = 0.5  # refusals a second of a peer of another wire version, at most

_BEFORE_HELLO: frozenset[type] = frozenset((wire.Hello, ClientHello, wire.Ping))  # what any peer may send


class EdgeProtocol:
    """Serves all agents of one room.

    session: names this start of the edge, so that agents notice a restart. has_store: acknowledge a keyframe
    only after `ChangesSaved`. restored: runs of earlier sessions; objects: of the room. began_ns: origin of
    the times in records (default: the first event). trackers: those that the edge runs for its agents.
    forgotten: as in `StoredMap`.
    """

    _agent_messages = frozenset(get_args(wire.UplinkMessage)) - {Frame} | {ClientHello}

    def __init__(
        self,
        config: Config,
        session: int,
        has_store: bool = False,
        restored: Sequence[RestoredRun] = (),
        began_ns: int | None = None,
        objects: Sequence[SaveObject] = (),
        trackers: RunTrackers | None = None,
        forgotten: Mapping[str, int] | None = None,
    ) -> None:
        self._config, self._session, self._registry = config, session, RunRegistry(forgotten or {})
        self._config_report = to_mapping(config)
        for run in restored:
            self._registry.restore(run, session)
        self.latest_poses = self._registry.latest_poses
        self.forgotten_next_keyframes = self._registry.forgotten_next_keyframes
        self._out = EdgeOutput(self._registry, has_store, began_ns)
        self._rate_scheduler = RateScheduler(config.control, config.edge.policy)
        self.room = ClientService(self._out, self._registry, session, config.edge.silent_s, objects)
        self.room.restore(
            run.last_correction_event for run in restored if run.last_correction_event is not None
        )
        self._membership = RoomMembership(
            config,
            session,
            self._registry,
            self._out,
            self._rate_scheduler,
            self.room,
            trackers or RunTrackers(),
        )
        self._quota = KeyframeQuota(self._rate_scheduler.max_rate_hz)
        self._version_throttle, self._internal_errors = Throttle(_VERSION_REFUSAL_HZ, 1.0), 0

    def handle(self, event: ed.EdgeEvent, now_ns: int) -> list[ed.EdgeEffect]:
        """Return the effects of `event`. now_ns: the edge's clock, never decreasing.

        An exception is a bug in SHARE. Only this event is lost; it is counted and recorded."""
        self._out.begin(now_ns)
        try:
            # first: after a hello, the keyframes of a forgotten run would count as known
            self._membership.forget_empty_runs()
            self._dispatch(event)
        except Exception as error:
            self._on_internal_error(event, error)
        return self._out.effects

    def _dispatch(self, event: ed.EdgeEvent) -> None:
        match event:
            case ed.PeerMessageReceived():
                self._on_message(event)
            case ed.MapperResult():
                self._out.save(*event.changes)
                for map_event in event.map_events:
                    self._on_map_event(map_event)
                self._registry.mark_empty(event.empty_runs)
                for change in event.changes:
                    if isinstance(change, SavePoses):
                        self.room.add_solved(set(change.map_ids))
            case ed.ChangesSaved():
                self._acknowledge(*self._out.durability.mark_saved(event.ticket))
                self.room.mark_saved(event.ticket)
            case Tick():
                self._membership.check_silence()
                for map_event in self._membership.end_entries():
                    self._on_map_event(map_event)
                self.room.tick()

    def _on_internal_error(self, event: ed.EdgeEvent, error: Exception) -> None:
        self._internal_errors += 1
        peer = self._registry.get(event.peer_id) if isinstance(event, ed.PeerMessageReceived) else None
        reason = f"{type(event).__name__}: {describe_exception(error)}"
        if peer is not None:
            peer.refusals.add(reason, self._out.now_ns)
        self._out.record("internal error", peer, reason)

    # ------------------------------------------------------------------ messages

    def _on_message(self, event: ed.PeerMessageReceived) -> None:
        peer, client = self._registry.get(event.peer_id), self.room.clients.get(event.peer_id)
        known = client or peer
        if known is not None and not event.is_authorised_for(known.name):
            known = None  # a run is not to blame for who uses it with another's key
        sender = known or self._registry.unjoined
        if peer is not None and peer is known and peer.is_gone:
            self._registry.mark_heard(peer)
        sender.counts["bytes_up"] += message_bytes(event.frames)
        try:
            kind = message_type(event.frames)
            if (reason := self._type_objection(kind, peer, client)) is not None:
                sender.count("unexpected", reason, self._out.now_ns)
                return
            message = decode(event.frames)
        except VersionError as error:
            self._on_other_version(event.peer_id, error)
            return
        except WireError as error:
            self._out.count_bad_message(known, str(error), throttled=client is not None)
            return
        if peer is not None and not self._membership.may_send(event, peer, message):
            return
        if client is not None and not self.room.may_send(event, client):
            self._out.count_bad_message(None, misuse_text(event, client.name))
            return
        match message:
            case ClientHello():
                self.room.on_hello(event, message)
            case wire.Hello():
                self._membership.on_hello(event, message)
            case wire.Ping():
                # a stranger may think that it has joined: whom the edge has forgotten says hello again
                session = wire.NO_SESSION if client is None else self._session
                session = session if peer is None else peer.session
                self._out.send(event.peer_id, wire.Pong.answering(message, self._out.now_ns, session))
            case _ if client is not None:
                self.room.on_message(event, client, message)
            case wire.Bye() if peer:
                peer.status.leave()
                self._membership.mark_gone(peer, "left", "sent bye")
            case _ if peer:
                self._on_agent_message(peer, message)

    def _type_objection(self, kind: type, peer: Peer | None, client: Client | None) -> str | None:
        """Return why this peer may not send such a message; None if it may."""
        if client is not None:
            allowed, objection = CLIENT_MESSAGES, ", which clients must not send"
        elif peer is not None:
            allowed, objection = self._agent_messages, ", which agents must not send"
        else:
            allowed, objection = _BEFORE_HELLO, " before its hello"
        return None if kind in allowed else f"a message {kind.__name__}{objection}"

    def _on_agent_message(self, peer: Peer, message: wire.Message) -> None:
        """Handle a message of a joined agent."""
        match message:
            case Keyframe():
                self._on_keyframe(peer, message)
            case wire.PoseUpdate():
                peer.add_pose(message, self._out.now_ns)
            case wire.Status():
                peer.status.update(message, self._out.now_ns)
            case wire.Evaluation():
                self._on_evaluation(peer, message)

    def _on_evaluation(self, peer: Peer, evaluation: wire.Evaluation) -> None:
        peer.counts["evaluations"] += 1
        peer.rtt_ms = evaluation.rtt_ms or None  # 0: before its first round trip
        report = AgentReport(
            kind=peer.hello.kind,
            evaluation=evaluation,
            now_ns=self._out.now_ns,
            keyframes=peer.counts["keyframes"],
            poses=peer.counts["poses"],
            held_ms=peer.computation.held_ms,
            is_placed=self._registry.shares_map(peer),
            arrival_ms=peer.arrival_ms,
        )
        computation_ms, t_s = peer.computation.ms, self._out.elapsed_s
        grant = self._rate_scheduler.evaluate(peer.name, report, computation_ms, t_s)
        self._membership.send_grant(peer, grant)
        if (change := self._rate_scheduler.capacity_change(self._out.now_ns)) is not None:
            self._out.record("room full", None, change)

    def _on_other_version(self, peer_id: bytes, error: VersionError) -> None:
        self._registry.unjoined.counts["other_version"] += 1
        reason = refusal_of_version(error)
        if reason is not None and self._version_throttle.admit(peer_id, self._out.now_ns) is not None:
            self._membership.refuse(peer_id, reason, error.version)

    # ------------------------------------------------------------------ keyframes and the map

    def _on_keyframe(self, peer: Peer, keyframe: Keyframe) -> None:
        # an agent that cannot evaluate yet sends nothing just before its keyframe
        if peer.counts["evaluations"] and peer.reorder_buffer.is_new(keyframe.id):
            peer.arrival_ms = peer.since_last_ns / 1e6
        applicable = self._reorder(peer, keyframe)
        for ready in applicable:
            peer.counts["keyframes"] += 1
            peer.computation.add_keyframe(ready.id, self._out.now_ns)
            self._apply(peer, ready)
            self._out.durability.add_keyframe(peer, ready.id)
        self._acknowledge(*self._out.durability.take_durable())
        if not applicable:  # applied ones are acknowledged once they are durable
            self._acknowledge(peer)

    def _reorder(self, peer: Peer, keyframe: Keyframe) -> list[Keyframe]:
        """Return the keyframes that can be applied now; none if the agent exceeds its quota."""
        if peer.reorder_buffer.is_new(keyframe.id):  # duplicates cost nothing
            reason = peer.overload_reason or self._quota.objection(peer.hello, keyframe, self._out.now_ns)
            if reason is not None:
                peer.refusals.add(reason, self._out.now_ns)
                peer.overload.add(reason, self._out.now_ns)
                return []
        try:
            return peer.reorder_buffer.push(keyframe)
        except ValueError as error:
            self._out.count_bad_message(peer, str(error))
            return []

    def _apply(self, peer: Peer, keyframe: Keyframe) -> None:
        try:
            is_entering = peer.entry is not None and peer.entry.is_entering
            base, camera = peer.odometry_base, peer.hello.rig.cam0
            keyframe, problem = sanitise(keyframe, base, camera, peer.forgotten_below, is_entering)
        except ValueError as error:
            self._out.count_bad_message(peer, str(error))
            return
        if problem:
            self._suspect(peer, problem)
        # a run is stored with its first keyframe
        is_first = peer.odometry_base is None or is_entering
        run = (SaveRun(peer.key, peer.hello, peer.credential),) if is_first else ()
        if peer.entry is not None:
            peer.entry.is_entering = False
        peer.odometry_base = OdometryBase.from_keyframe(keyframe, peer.odometry_base)
        if keyframe.reference < 0:
            self.room.maps.begin_segment(peer.key, keyframe.id)
        self._out.save(*run, SaveKeyframe(peer.key, keyframe))
        is_over_rate = self._quota.is_over_rate(peer.name, self._out.now_ns)
        self._out.add(ed.AddKeyframe(peer.key, keyframe, is_over_rate))

    def _suspect(self, peer: Peer, problem: str) -> None:
        peer.suspect_keyframes.add(problem, self._out.now_ns)
        self._out.record("odometry suspect", peer, problem)

    def _acknowledge(self, *peers: Peer) -> None:
        """Acknowledge the durable keyframes of these peers."""
        for peer in peers:
            peer.computation.acknowledge(peer.durable_below, self._out.now_ns)
            self._out.send(peer.id, peer.reorder_buffer.ack(peer.durable_below))

    def _on_map_event(self, map_event: MapEvent) -> None:
        """Record a decision of the mapper, and send its correction if there is one."""
        peer = None if map_event.agent is None else self._registry.by_key.get(map_event.agent)
        if peer is not None and peer.entry is not None and peer.entry.withholds(peer.key, map_event):
            return
        self.room.on_map_event(map_event)
        if map_event.agent is None:
            self._out.record(map_event.event, None, map_event.reason, map_id=map_event.map_id)
        elif peer is None:
            return  # forgotten in the meantime
        elif map_event.event == "odometry suspect":
            self._suspect(peer, map_event.reason)
        elif map_event.correction is None:
            self._out.record(map_event.event, peer, map_event.reason, map_event.event == "step failed")
        else:
            peer.last_correction_event = map_event
            if not peer.is_gone and peer.is_welcomed:  # else the agent counts it to the earlier session
                self._out.send_correction(peer, map_event)

    # ------------------------------------------------------------------ runs that change the room

    def knows(self, peer_id: bytes) -> int | None:
        """Return the number of keyframes that a run of this peer has sent, also one that was forgotten, 0 for
        a client; None if neither is known."""
        if (peer := self._registry.get(peer_id)) is not None:
            return peer.reorder_buffer.next_keyframe
        if (forgotten := self._registry.forgotten(peer_id)) is not None:
            return forgotten.next_keyframe
        return None if self.room.clients.get(peer_id) is None else 0

    def is_present(self, name: str) -> bool:
        """Return whether a run of this name takes part."""
        return any(peer.name == name for peer in self._registry.present())

    @property
    def is_empty(self) -> bool:
        """Whether neither a run nor a client takes part."""
        return not self._registry.present() and not any(True for _ in self.room.clients)

    def run(self, key: str) -> Peer | None:
        """Return the run of this key; None if it is not known."""
        return self._registry.by_key.get(key)

    def note_refused_entry(self, peer: Peer, room: str, reason: str, now_ns: int) -> list[ed.EdgeEffect]:
        """Record that a run may not go on in another room."""
        self._out.begin(now_ns)
        self._out.record("room changed", peer, f"stays here: room '{room}' refuses it: {reason}")
        return self._out.effects

    def may_leave(self, key: str) -> bool:
        """Return whether a run takes part, and no keyframe of it waits for the disk."""
        peer = self._registry.by_key.get(key)
        return peer is not None and not peer.is_gone and not peer.pending_saves

    def entry_objection(self, peer: Peer, now_ns: int) -> str | None:
        """Return why a run may not come from another room; None if it may."""
        self._out.begin(now_ns)
        return self._membership.entry_objection(peer)

    def hand_over(self, peer: Peer, room: str, now_ns: int) -> list[ed.EdgeEffect]:
        """Let a run that `may_leave` go on in another room. Return the effects here."""
        self._out.begin(now_ns)
        self._membership.hand_over(peer, room)
        return self._out.effects

    def take_over(self, peer: Peer, room: str, place: MapEvent, now_ns: int) -> list[ed.EdgeEffect]:
        """Take in a run that leaves another room; `entry_objection` has none. place: where it was found in a
        map of this room, which it is shown at once. Its next keyframe starts a segment."""
        self._out.begin(now_ns)
        self._membership.take_over(peer, room)
        self._on_map_event(place)
        return self._out.effects

    # ------------------------------------------------------------------ reports

    def series(self) -> dict[str, Any]:
        """Return each agent's evaluations with QoE and rate (`RateScheduler.series`)."""
        return {peer.name: self._rate_scheduler.series(peer.name) for peer in self._registry.values()}

    def _peer_report(self, peer: Peer) -> dict[str, Any]:
        """Return the report of a run without what the mapper knows of it."""
        is_latest = self._registry.is_latest(peer)
        rating = self._rate_scheduler.report(peer.name if is_latest else None, peer.hello.kind)
        return peer.report(self._out.now_ns, rating, is_latest)

    def report(self, map_report: dict[str, Any]) -> dict[str, Any]:
        """Return edge.json without `series`. map_report: of the mapper, with `agents` by run key. Names of
        runs are `RunRegistry.label`. Of absent runs it lists the recent ones and counts the rest."""
        peers = self._registry.listed(self._config.edge.max_agents, self._out.now_ns)
        mapped = map_report.get("agents", {})
        return {
            "session": self._session,
            "policy": self._config.edge.policy,
            **map_report,
            "agents": {
                self._registry.label(peer): self._peer_report(peer) | mapped.get(peer.key, {})
                for peer in peers
            },
            "unlisted_runs": len(self._registry.by_key) - len(peers),
            "unjoined": dict(self._registry.unjoined.counts),
            "refused": [
                *filter(None, [self._rate_scheduler.full_reason(self._out.now_ns)]),
                *fault_warnings(peers, self._registry.unjoined, self._out.now_ns),
                *self.room.warnings(),
            ],
            **self.room.report(),
            "internal_errors": self._internal_errors,
            "forgotten_runs": self._registry.forgotten_count,
            "version": __version__,
            "config": self._config_report,
        }
