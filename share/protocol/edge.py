"""The edge's side of the protocol as a state machine: admission, acknowledgements, corrections.

It uses no socket, thread, disk or clock: `Edge.handle` returns effects, which `share.runtime.edge` carries
out. The mapper (`share.mapping.mapper`) runs in its own process and answers with findings; the map writer
stores what must survive a crash and answers once it is on the disk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

from share import __version__
from share.config import Config
from share.errors import VersionError, WireError, describe_exception
from share.event_kinds import EventKind
from share.mapping.corrections import MapEvent
from share.mapping.map_changes import MapChange, RemoveRun, SaveCredential, SaveKeyframe, SaveRun
from share.plain_data import to_mapping
from share.protocol import edge_events as ed
from share.protocol.admission import Admission, RunRegistry, name_objection, new_run_key
from share.protocol.edge_records import DurabilityTracker, EventLog
from share.protocol.keyframe_intake import KeyframeQuota, OdometryBase, sanitise
from share.protocol.peer import Peer, RestoredRun, Sender, fault_warnings
from share.protocol.versions import refusal_of_version
from share.scheduling.policies import AgentReport
from share.scheduling.rate_scheduler import RateScheduler
from share.scheduling.room_budget import RateGrant
from share.timing import Throttle, seconds_to_ns
from share.types import Keyframe
from share.wire import messages as wire
from share.wire.codec import WIRE_VERSION, decode, encode, message_bytes

_VERSION_REFUSAL_HZ = 0.5  # refusals a second of a peer of another wire version, at most


class Edge:
    """Serves all agents of one room.

    session: names this start of the edge, so that agents notice a restart. has_store: acknowledge a keyframe
    only after `ChangesSaved`. restored: runs of earlier sessions. began_ns: origin of the times in records
    (default: the first event).
    """

    tracks_agents: ClassVar[bool] = False  # True where agents stream frames: `remote_tracking`

    def __init__(
        self,
        config: Config,
        session: int,
        has_store: bool = False,
        restored: Sequence[RestoredRun] = (),
        began_ns: int | None = None,
    ) -> None:
        self._config, self._session = config, session
        self._registry, self._unjoined = RunRegistry(), Sender()
        self.latest_poses = self._registry.latest_poses
        self._rate_scheduler = RateScheduler(config.control, config.edge.policy)
        self._admission = Admission(config.edge, self.tracks_agents, self._rate_scheduler.objection)
        self._quota = KeyframeQuota(self._rate_scheduler.max_rate_hz)
        self._event_log, self._version_throttle = EventLog(began_ns), Throttle(_VERSION_REFUSAL_HZ, 1.0)
        self._durability, self._internal_errors = DurabilityTracker(has_store), 0
        self._effects: list[ed.EdgeEffect] = []
        self._now_ns = 0  # of the event that is being handled
        for run in restored:
            self._registry.restore(run)

    def handle(self, event: ed.EdgeEvent, now_ns: int) -> list[ed.EdgeEffect]:
        """Return the effects of `event`. now_ns: the edge's clock, never falling.

        An exception is a bug of ours and costs this event only: it is counted and recorded."""
        self._event_log.start(now_ns)
        self._effects, self._now_ns = [], now_ns
        try:
            # first: after a hello, the keyframes of a forgotten run would count as known
            self._forget_empty_runs()
            self._dispatch(event)
        except Exception as error:
            self._on_internal_error(event, error)
        return self._effects

    def _dispatch(self, event: ed.EdgeEvent) -> None:
        match event:
            case ed.PeerMessageReceived():
                self._on_message(event)
            case ed.MapperResult():
                self._save(*event.changes)
                for finding in event.findings:
                    self._on_finding(finding)
                self._registry.mark_empty(event.empty_runs)
            case ed.ChangesSaved():
                self._acknowledge(*self._durability.mark_saved(event.ticket))
            case ed.EdgeTick():
                self._check_silence()

    def _on_internal_error(self, event: ed.EdgeEvent, error: Exception) -> None:
        self._internal_errors += 1
        peer = self._registry.get(event.peer_id) if isinstance(event, ed.PeerMessageReceived) else None
        reason = f"{type(event).__name__}: {describe_exception(error)}"
        if peer is not None:
            peer.refusals.add(reason, self._now_ns)
        self._record("internal error", peer, reason)

    # ------------------------------------------------------------------ messages

    def _on_message(self, event: ed.PeerMessageReceived) -> None:
        peer = self._registry.get(event.peer_id)
        (peer or self._unjoined).counts["bytes_up"] += message_bytes(event.frames)
        try:
            message = decode(event.frames)
        except VersionError as error:
            self._on_other_version(event.peer_id, error)
            return
        except WireError as error:
            self._count_bad_message(peer, str(error))
            return
        if peer is not None and not self._may_send(event, peer, message):
            return
        match message:
            case wire.Hello():
                self._on_hello(event, message)
            case wire.Ping():  # of an unjoined peer too: the session tells it to send a hello
                times = message.sent_ns, self._now_ns, self._now_ns
                self._send(event.peer_id, wire.Pong(message.sequence, *times, self._session))
            case wire.Bye() if peer:
                peer.status.leave()
                self._mark_gone(peer, "left", "sent bye")
            case _ if peer:
                self._on_agent_message(peer, message)
            case _:
                reason = f"a {type(message).__name__} before its hello"
                self._unjoined.count("unexpected", reason, self._now_ns)

    def _may_send(self, event: ed.PeerMessageReceived, peer: Peer, message: wire.Message) -> bool:
        """Return whether a known run may send: its credential allows it, and it is present or comes back."""
        if not event.is_authorised_for(peer.name):
            self._count_bad_message(None, f"a key that is not authorized for '{peer.name}' used its run")
            if isinstance(message, wire.Hello):  # only a hello is answered
                reason = name_objection(peer.name, event.allowed_names or ())
                self._send(event.peer_id, wire.Refused(reason))
                self._record("refused", None, reason)
            return False
        if peer.is_gone and not self._comes_back(peer, message):
            return False
        peer.mark_received(self._now_ns)
        if peer.credential != event.credential:  # it has changed, or was unknown
            peer.credential = event.credential
            self._effects.append(ed.SetCredential(peer.key, event.credential))
            if peer.odometry_base is not None:
                self._save(SaveCredential(peer.key, event.credential))
        return True

    def _on_agent_message(self, peer: Peer, message: wire.Message) -> None:
        """Handle a message of a joined agent."""
        match message:
            case Keyframe():
                self._on_keyframe(peer, message)
            case wire.PoseUpdate():
                peer.add_pose(message, self._now_ns)
            case wire.Status():
                peer.status.update(message, self._now_ns)
            case wire.Evaluation():
                self._on_evaluation(peer, message)
            case _:  # a downlink message
                reason = f"a {type(message).__name__} which agents must not send"
                peer.count("unexpected", reason, self._now_ns)

    def _on_evaluation(self, peer: Peer, evaluation: wire.Evaluation) -> None:
        peer.counts["evaluations"] += 1
        arrived = peer.counts["keyframes"], peer.counts["poses"]
        service = peer.computation.held_ms, self._registry.shares_map(peer)
        report = AgentReport(peer.hello.kind, evaluation, self._now_ns, *arrived, *service)
        t_s = self._event_log.elapsed_s(self._now_ns)
        self._send_grant(peer, self._rate_scheduler.evaluate(peer.name, report, peer.computation.ms, t_s))
        if (news := self._rate_scheduler.capacity_news(self._now_ns)) is not None:
            self._record("room full", None, news)

    def _send_grant(self, peer: Peer, grant: RateGrant | None) -> None:
        """Send what an agent may send, if that has changed; None: everything, which needs no message."""
        if grant is not None and grant != peer.grant:
            self._send(peer.id, wire.Rate(grant.hz, self._rate_scheduler.is_windowed, grant.pose_hz))
            peer.grant = grant

    def _on_other_version(self, peer_id: bytes, error: VersionError) -> None:
        self._unjoined.counts["other_version"] += 1
        reason = refusal_of_version(error)
        if reason is not None and self._version_throttle.admit(peer_id, self._now_ns) is not None:
            self._refuse(peer_id, reason, error.version)

    def _count_bad_message(self, peer: Peer | None, reason: str) -> None:
        """Count a bad message; record the first of each peer."""
        if (peer or self._unjoined).count("bad_messages", reason, self._now_ns) == 1:
            self._record("bad message", peer, reason, throttled=False)

    # ------------------------------------------------------------------ joining and leaving

    def _on_hello(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> None:
        """Welcome a new or known run, or refuse it. No answer while the name's present run may be dead: the
        agent repeats its hello."""
        if (reason := self._objection(event, hello)) is not None:
            if not self._admission.is_name_stale(hello.name, self._registry, self._now_ns):
                self._refuse(event.peer_id, reason)
            return
        self._welcome(self._registry.get(event.peer_id) or self._join(event, hello))

    def _objection(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> str | None:
        return self._admission.objection(event, hello, self._registry, self._now_ns)

    def _make_room(self, peer: Peer) -> None:
        """Send away who has to leave for a run that has joined."""
        for name in self._rate_scheduler.displaced(peer.name, peer.hello.kind, self._now_ns):
            for other in self._registry.values():
                if other.name == name and not other.is_gone:
                    self._refuse(other.id, f"no air left beside headsets: '{peer.name}' has joined")
                    self._mark_gone(other, "left", f"made room for '{peer.name}'")

    def _join(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> Peer:
        """Return the new run of an admitted hello."""
        if (idle := self._registry.oldest_idle()) is not None:
            self._forget(idle)
        self._admission.record_join(event, hello, self._now_ns)
        self._supersede(hello.name)
        key = new_run_key(hello, self._registry.by_key)
        peer = Peer(event.peer_id, hello, key, self._now_ns, credential=event.credential)
        self._registry.add(peer)
        self._effects.append(ed.AddRun(peer.key, peer.hello, event.credential))
        self._rate_scheduler.begin_run(peer.name)
        self._record("agent joined", peer, f"{hello.kind} '{hello.name}'")
        self._make_room(peer)
        return peer

    def _refuse(self, peer_id: bytes, reason: str, version: int = WIRE_VERSION) -> None:
        self._send(peer_id, wire.Refused(reason), version)
        (self._registry.get(peer_id) or self._unjoined).refusals.add(reason, self._now_ns)
        self._record("refused", None, reason)

    def _welcome(self, peer: Peer) -> None:
        """Send a welcome, and the last correction again: a hello means that the agent may have missed it."""
        peer.is_welcomed, hold_ms = True, self._rate_scheduler.hold_ms(peer.name, self._now_ns)
        self._send(peer.id, wire.Welcome(self._session, peer.durable_below, hold_ms))
        peer.grant = None
        self._send_grant(peer, self._rate_scheduler.first_grant(peer.name, peer.hello.kind, self._now_ns))
        if peer.last_finding is not None:
            self._send_correction(peer, peer.last_finding, is_repeat=True)

    def _comes_back(self, peer: Peer, message: wire.Message) -> bool:
        """Return whether a run that left is present again by this message."""
        if isinstance(message, wire.Bye):  # repeated or late
            return False
        if (reason := self._capacity_objection(peer)) is not None:
            if isinstance(message, wire.Hello | wire.Ping):  # keyframes are not answered one by one
                self._refuse(peer.id, reason)
            else:
                peer.refusals.add(reason, self._now_ns)
            return False
        self._readmit(peer)
        return True

    def _capacity_objection(self, peer: Peer) -> str | None:
        """Return why a run that left may not come back; None if it may."""
        return self._admission.capacity_objection(peer.hello, self._registry, self._now_ns)

    def _readmit(self, peer: Peer) -> None:
        self._supersede(peer.name)
        peer.is_gone = False
        self._registry.make_latest(peer)
        self._effects.append(ed.SetPresence(peer.key, True))
        self._record("reconnected", peer, "sends again")
        self._make_room(peer)

    def _supersede(self, name: str) -> None:
        """Mark present runs of this name as gone: they were silent too long, and a new run takes it."""
        for other in self._registry.values():
            if not other.is_gone and other.name == name:
                self._mark_gone(other, "silent", "name taken by a newer run")

    def _check_silence(self) -> None:
        limit_s = self._config.edge.silent_s
        for peer in self._registry.values():
            if not peer.is_gone and self._now_ns - peer.last_received_ns > seconds_to_ns(limit_s):
                self._mark_gone(peer, "silent", f"no message for {limit_s:g} s")

    def _mark_gone(self, peer: Peer, event: EventKind, reason: str) -> None:
        peer.is_gone = True
        peer.reorder_buffer.clear()
        self._effects.append(ed.SetPresence(peer.key, False))
        self._record(event, peer, reason)

    def _forget_empty_runs(self) -> None:
        for peer in self._registry.removable():
            self._forget(peer)
            self._save(RemoveRun(peer.key))
            self._record("forgotten", peer, f"the map has nothing left of run {peer.key}")

    def _forget(self, peer: Peer) -> None:
        """Remove a run and its state for good."""
        if self._registry.forget(peer):  # it was the latest of its name
            self._rate_scheduler.forget(peer.name)
        self._effects.append(ed.DropRun(peer.key))

    # ------------------------------------------------------------------ keyframes and the map

    def _on_keyframe(self, peer: Peer, keyframe: Keyframe) -> None:
        applicable = self._reorder(peer, keyframe)
        for ready in applicable:
            peer.counts["keyframes"] += 1
            peer.computation.add_keyframe(ready.id, self._now_ns)
            self._apply(peer, ready)
            self._durability.add_keyframe(peer, ready.id)
        self._acknowledge(*self._durability.take_durable())
        if not applicable:  # applied ones are acknowledged once they are durable
            self._acknowledge(peer)

    def _reorder(self, peer: Peer, keyframe: Keyframe) -> list[Keyframe]:
        """Return the keyframes that can be applied now; none if the agent exceeds its quota."""
        if peer.reorder_buffer.is_new(keyframe.id):  # duplicates cost nothing
            reason = peer.overload_reason or self._quota.objection(peer.hello, keyframe, self._now_ns)
            if reason is not None:
                peer.refusals.add(reason, self._now_ns)
                peer.overload.add(reason, self._now_ns)
                return []
        try:
            return peer.reorder_buffer.push(keyframe)
        except ValueError as error:
            self._count_bad_message(peer, str(error))
            return []

    def _apply(self, peer: Peer, keyframe: Keyframe) -> None:
        try:
            keyframe, problem = sanitise(keyframe, peer.odometry_base, peer.hello.rig.cam0)
        except ValueError as error:
            self._count_bad_message(peer, str(error))
            return
        if problem:
            self._suspect(peer, problem)
        # a run is stored with its first keyframe
        run = (SaveRun(peer.key, peer.hello, peer.credential),) if peer.odometry_base is None else ()
        peer.odometry_base = OdometryBase.from_keyframe(keyframe, peer.odometry_base)
        self._save(*run, SaveKeyframe(peer.key, keyframe))
        is_over_rate = self._quota.is_over_rate(peer.name, self._now_ns)
        self._effects.append(ed.AddKeyframe(peer.key, keyframe, is_over_rate))

    def _suspect(self, peer: Peer, problem: str) -> None:
        peer.suspect_keyframes.add(problem, self._now_ns)
        self._record("odometry suspect", peer, problem)

    def _save(self, *changes: MapChange) -> None:
        if (effect := self._durability.save(changes)) is not None:
            self._effects.append(effect)

    def _acknowledge(self, *peers: Peer) -> None:
        """Acknowledge the durable keyframes of these peers."""
        for peer in peers:
            peer.computation.acknowledge(peer.durable_below, self._now_ns)
            self._send(peer.id, peer.reorder_buffer.ack(peer.durable_below))

    def _on_finding(self, finding: MapEvent) -> None:
        """Record a decision of the mapper, and send its correction if there is one."""
        if finding.agent is None:
            self._record(finding.event, None, finding.reason, map_id=finding.map_id)
        elif (peer := self._registry.by_key.get(finding.agent)) is None:
            return  # forgotten in the meantime
        elif finding.event == "odometry suspect":
            self._suspect(peer, finding.reason)
        elif finding.correction is None:
            self._record(finding.event, peer, finding.reason, finding.event == "step failed")
        else:
            peer.last_finding = finding
            if not peer.is_gone and peer.is_welcomed:  # else the agent counts it to the earlier session
                self._send_correction(peer, finding)

    def _send_correction(self, peer: Peer, finding: MapEvent, is_repeat: bool = False) -> None:
        """Send a correction. is_repeat: sent again at the agent's request, so its record is throttled."""
        assert finding.correction is not None
        peer.revision += 1
        peer.counts["corrections"] += 1
        correction = replace(finding.correction, revision=peer.revision)
        peer.computation.answer(correction.answered_keyframe, self._now_ns)
        self._send(peer.id, correction)
        answered = {"revision": peer.revision, "answers": correction.answered_keyframe}
        self._record(finding.event, peer, finding.reason, is_repeat, map_id=correction.map_id, **answered)

    # ------------------------------------------------------------------ sending, records, reports

    def _send(self, peer_id: bytes, message: wire.DownlinkMessage, version: int = WIRE_VERSION) -> None:
        frames = encode(message, version)
        (self._registry.get(peer_id) or self._unjoined).counts["bytes_down"] += message_bytes(frames)
        self._effects.append(ed.SendToPeer(peer_id, frames))

    def _record(
        self, event: EventKind, peer: Peer | None, reason: str, throttled: bool = True, **fields: Any
    ) -> None:
        """Record an event. throttled: unless it is repeated too often, as a peer could cause it."""
        make = self._event_log.throttled_event if throttled else self._event_log.event
        if (effect := make(self._now_ns, event, peer.name if peer else None, reason, **fields)) is not None:
            self._effects.append(effect)

    def series(self) -> dict[str, Any]:
        """Return each agent's evaluations with QoE and rate (`RateScheduler.series`)."""
        return {peer.name: self._rate_scheduler.series(peer.name) for peer in self._registry.values()}

    def _peer_report(self, peer: Peer) -> dict[str, Any]:
        """Return the report of a run without what the mapper knows of it."""
        name = peer.name if self._registry.is_latest(peer) else None
        return peer.report(self._now_ns, self._rate_scheduler.report(name, peer.hello.kind))

    def report(self, map_report: dict[str, Any]) -> dict[str, Any]:
        """Return edge.json without `series`. map_report: of the mapper, whose `agents` are by run key. Runs
        go by `RunRegistry.label`."""
        peers, mapped = self._registry.values(), map_report.get("agents", {})
        return {
            "session": self._session,
            "policy": self._config.edge.policy,
            **map_report,
            "agents": {
                self._registry.label(peer): self._peer_report(peer) | mapped.get(peer.key, {})
                for peer in peers
            },
            "unjoined": dict(self._unjoined.counts),
            "refused": [
                *filter(None, [self._rate_scheduler.full_reason(self._now_ns)]),
                *fault_warnings(peers, self._unjoined, self._now_ns),
            ],
            "internal_errors": self._internal_errors,
            "forgotten_runs": self._registry.forgotten_count,
            "version": __version__,
            "config": to_mapping(self._config),
        }
