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
from share.mapping.map_changes import MapChange, RemoveRun, SaveCredential, SaveKeyframe, SaveRun
from share.mapping.steps import MapEvent
from share.plain_data import to_mapping
from share.protocol import edge_events as ed
from share.protocol.admission import Admission, KeyframeQuota, RunRegistry, name_objection, new_run_key
from share.protocol.edge_records import DurabilityTracker, EventLog
from share.protocol.peer import Peer, RestoredRun, UnjoinedPeers, refusal_warnings
from share.protocol.versions import VersionRefusals
from share.scheduling.policies import RateScheduler
from share.timing import seconds_to_ns
from share.types import Keyframe
from share.wire import messages as wire
from share.wire.codec import WIRE_VERSION, decode, encode


class Edge:
    """Serves all agents of one room.

    session: names this start of the edge, so that agents notice a restart. has_store: acknowledge a keyframe
    only after `ChangesSaved`. restored: runs of earlier sessions. began_ns: origin of the times in records
    (default: the first event).
    """

    tracks_agents: ClassVar[bool] = False  # agents stream: `share.protocol.remote_tracking`

    def __init__(
        self,
        config: Config,
        session: int,
        has_store: bool = False,
        restored: Sequence[RestoredRun] = (),
        began_ns: int | None = None,
    ) -> None:
        self._config, self._session = config, session
        self._registry = RunRegistry()
        self._rate_scheduler = RateScheduler(config.control, config.edge.policy)
        self._unjoined = UnjoinedPeers()
        self._admission = Admission(config.edge, self.tracks_agents)
        self._quota = KeyframeQuota(self._rate_scheduler.max_rate_hz)
        self._event_log, self._version_refusals = EventLog(began_ns), VersionRefusals()
        self._internal_errors = 0
        self._durability = DurabilityTracker(has_store)
        self._effects: list[ed.EdgeEffect] = []
        self._now_ns = 0  # of the newest event
        for run in restored:
            self._registry.restore(run)

    def handle(self, event: ed.EdgeEvent, now_ns: int) -> list[ed.EdgeEffect]:
        """Return the effects of `event`. now_ns: the edge's clock, never falling.

        An exception is a bug of ours and costs this event only: it is counted and recorded."""
        self._event_log.start(now_ns)
        self._effects, self._now_ns = [], now_ns
        try:
            self._dispatch(event, now_ns)
        except Exception as error:
            self._on_internal_error(event, error, now_ns)
        return self._effects

    def _on_internal_error(self, event: ed.EdgeEvent, error: Exception, now_ns: int) -> None:
        self._internal_errors += 1
        peer = self._registry.get(event.peer_id) if isinstance(event, ed.PeerMessageReceived) else None
        reason = f"{type(event).__name__}: {describe_exception(error)}"
        if peer is not None:
            peer.refusals.add(reason, now_ns)
        self._record_throttled(now_ns, "internal error", peer, reason)

    def _dispatch(self, event: ed.EdgeEvent, now_ns: int) -> None:
        # first: after a hello, the keyframes of a forgotten run would count as known
        self._forget_empty_runs(now_ns)
        match event:
            case ed.PeerMessageReceived():
                self._on_message(event, now_ns)
            case ed.MapperResult():
                self._save(*event.changes)
                for finding in event.findings:
                    self._on_finding(finding, now_ns)
                self._registry.mark_empty(event.empty_runs)
            case ed.ChangesSaved():
                self._acknowledge(*self._durability.mark_saved(event.ticket))
            case ed.EdgeTick():
                self._check_silence(now_ns)

    # ------------------------------------------------------------------ messages

    def _on_message(self, event: ed.PeerMessageReceived, now_ns: int) -> None:
        peer = self._registry.get(event.peer_id)
        counts = self._peer_or_unjoined(peer).counts
        counts["bytes_up"] += sum(len(frame) for frame in event.frames)
        try:
            message = decode(event.frames)
        except VersionError as error:
            self._on_other_version(event.peer_id, error, now_ns)
            return
        except WireError as error:
            self._count_bad_message(peer, str(error), now_ns)
            return
        if peer is not None and not event.is_authorised_for(peer.hello.name):
            self._on_foreign_credential(event, peer.hello.name, message, now_ns)
            return
        if peer is not None and not self._ensure_present(event.peer_id, peer, message, now_ns):
            return
        if peer is not None and peer.credential != event.credential:
            self._set_credential(peer, event.credential)
        match message:
            case wire.Hello():
                self._on_hello(event, message, now_ns)
            case wire.Ping():  # of an unjoined peer too: the session tells it to send a hello
                pong = wire.Pong(message.sequence, message.sent_ns, now_ns, now_ns, self._session)
                self._send(event.peer_id, pong)
            case wire.Bye() if peer:
                peer.status.leave()
                self._mark_gone(peer, "left", "sent bye", now_ns)
            case _ if peer:
                self._on_agent_message(event.peer_id, peer, message, now_ns)
            case _:  # of an unjoined peer
                self._count_unexpected(None, message, now_ns)

    def _on_foreign_credential(
        self, event: ed.PeerMessageReceived, name: str, message: wire.Message, now_ns: int
    ) -> None:
        """Refuse a credential that is not, or no longer, authorised for the run's name. Only a hello is
        answered."""
        self._count_bad_message(None, f"a key that is not authorized for '{name}' used its run", now_ns)
        if isinstance(message, wire.Hello):
            reason = name_objection(name, event.allowed_names or ())
            self._send(event.peer_id, wire.Refused(reason))
            self._record_throttled(now_ns, "refused", None, reason)

    def _on_agent_message(self, peer_id: bytes, peer: Peer, message: wire.Message, now_ns: int) -> None:
        """Handle a message of a joined agent."""
        match message:
            case Keyframe():
                self._on_keyframe(peer, message, now_ns)
            case wire.PoseUpdate():
                peer.counts["poses"] += 1
                peer.status.add_pose(message.state, now_ns)
            case wire.Status():
                peer.status.update(message, now_ns)
            case wire.Evaluation():
                self._on_evaluation(peer_id, peer, message, now_ns)
            case _:  # a downlink message
                self._count_unexpected(peer, message, now_ns)

    def _count_unexpected(self, peer: Peer | None, message: wire.Message, now_ns: int) -> None:
        self._peer_or_unjoined(peer).counts["unexpected"] += 1
        detail = "before its hello" if peer is None else "which agents must not send"
        self._peer_or_unjoined(peer).refusals.add(f"a {type(message).__name__} {detail}", now_ns)

    def _on_other_version(self, peer_id: bytes, error: VersionError, now_ns: int) -> None:
        self._unjoined.counts["other_version"] += 1
        if (reason := self._version_refusals.refusal(peer_id, error, now_ns)) is not None:
            self._refuse(peer_id, reason, now_ns, error.version)

    def _count_bad_message(self, peer: Peer | None, reason: str, now_ns: int) -> None:
        """Count a bad message; record the first of each peer."""
        counts = self._peer_or_unjoined(peer).counts
        counts["bad_messages"] += 1
        self._peer_or_unjoined(peer).refusals.add(reason, now_ns)
        if counts["bad_messages"] == 1:
            self._record(now_ns, "bad message", peer, reason)

    def _ensure_present(self, peer_id: bytes, peer: Peer, message: wire.Message, now_ns: int) -> bool:
        """Return whether the run is present. One that left is readmitted if its name and a place are free."""
        if peer.is_gone:
            if isinstance(message, wire.Bye):  # repeated or late
                return False
            if (reason := self._capacity_objection(peer, now_ns)) is not None:
                if isinstance(message, wire.Hello | wire.Ping):  # keyframes are not answered one by one
                    self._refuse(peer_id, reason, now_ns)
                else:
                    peer.refusals.add(reason, now_ns)
                return False
            self._readmit(peer, now_ns)
        peer.last_received_ns, peer.has_sent = now_ns, True
        return True

    def _capacity_objection(self, peer: Peer, now_ns: int) -> str | None:
        """Return why a run that left may not come back; None if it may."""
        return self._admission.capacity_objection(peer.hello, self._registry, now_ns)

    def _readmit(self, peer: Peer, now_ns: int) -> None:
        self._supersede(peer.hello.name, now_ns)
        peer.is_gone = False
        self._registry.make_latest(peer)
        self._effects.append(ed.SetPresence(peer.key, True))
        self._record_throttled(now_ns, "reconnected", peer, "sends again")

    def _supersede(self, name: str, now_ns: int) -> None:
        """Mark present runs of this name as gone: they were silent too long, and a new run takes it."""
        for other in self._registry.values():
            if not other.is_gone and other.hello.name == name:
                self._mark_gone(other, "silent", "name taken by a newer run", now_ns)

    def _check_silence(self, now_ns: int) -> None:
        for peer in self._registry.values():
            if not peer.is_gone and now_ns - peer.last_received_ns > seconds_to_ns(
                self._config.edge.silent_s
            ):
                self._mark_gone(peer, "silent", f"no message for {self._config.edge.silent_s:g} s", now_ns)

    def _mark_gone(self, peer: Peer, event: str, reason: str, now_ns: int) -> None:
        peer.is_gone = True
        peer.reorder_buffer.clear()
        self._effects.append(ed.SetPresence(peer.key, False))
        self._record_throttled(now_ns, event, peer, reason)

    # ------------------------------------------------------------------ joining and leaving

    def _on_hello(self, event: ed.PeerMessageReceived, hello: wire.Hello, now_ns: int) -> None:
        """Welcome a new or known run, or refuse it. No answer while the name's present run may be dead: the
        agent repeats its hello."""
        peer_id = event.peer_id
        if (reason := self._objection(event, hello, now_ns)) is not None:
            if not self._admission.is_name_stale(hello.name, self._registry, now_ns):
                self._refuse(peer_id, reason, now_ns)
            return
        if peer_id not in self._registry:
            if (idle := self._registry.forget_idle()) is not None:
                self._forget(*idle)
            self._admission.record_join(event, hello, now_ns)
            self._supersede(hello.name, now_ns)
            key = new_run_key(hello, self._registry.peer_id_by_key)
            self._add_run(peer_id, Peer(hello, key, now_ns, credential=event.credential))
            self._rate_scheduler.begin_run(hello.name)
            description = f"{hello.kind} '{hello.name}'"
            self._record_throttled(now_ns, "agent joined", self._registry[peer_id], description)
        self._welcome(peer_id, self._registry[peer_id], now_ns)

    def _objection(self, event: ed.PeerMessageReceived, hello: wire.Hello, now_ns: int) -> str | None:
        if self._registry.was_forgotten(event.peer_id):
            return f"this run of '{hello.name}' was forgotten during its absence: start the agent again"
        return self._admission.objection(event, hello, self._registry, now_ns)

    def _refuse(self, peer_id: bytes, reason: str, now_ns: int, version: int = WIRE_VERSION) -> None:
        self._send(peer_id, wire.Refused(reason), version)
        self._peer_or_unjoined(self._registry.get(peer_id)).refusals.add(reason, now_ns)
        self._record_throttled(now_ns, "refused", None, reason)

    def _welcome(self, peer_id: bytes, peer: Peer, now_ns: int) -> None:
        """Send a welcome, and the last correction again: a hello means that the agent may have missed it."""
        peer.is_welcomed = True
        self._send(peer_id, wire.Welcome(self._session, peer.durable_below))
        if peer.last_finding is not None:
            self._send_correction(peer_id, peer, peer.last_finding, now_ns, is_repeat=True)

    def _add_run(self, peer_id: bytes, peer: Peer) -> None:
        self._registry.add(peer_id, peer)
        self._effects.append(ed.AddRun(peer.key, peer.hello, peer.credential or ""))

    def _set_credential(self, peer: Peer, credential: str) -> None:
        """Record the credential of a run, which has changed or was unknown."""
        peer.credential = credential
        self._effects.append(ed.SetCredential(peer.key, credential))
        if peer.odometry_base is not None:
            self._save(SaveCredential(peer.key, credential))

    def _forget_empty_runs(self, now_ns: int) -> None:
        for peer in self._registry.removable():
            self._forget(peer, self._registry.forget(peer))
            self._save(RemoveRun(peer.key))
            self._record_throttled(now_ns, "forgotten", peer, f"the map has nothing left of run {peer.key}")

    def _forget(self, peer: Peer, was_latest: bool) -> None:
        """Drop the state of a forgotten run."""
        self._effects.append(ed.DropRun(peer.key))
        if was_latest:
            self._rate_scheduler.forget(peer.hello.name)

    # ------------------------------------------------------------------ keyframes

    def _on_keyframe(self, peer: Peer, keyframe: Keyframe, now_ns: int) -> None:
        applicable = self._reorder(peer, keyframe, now_ns)
        for ready in applicable:
            peer.counts["keyframes"] += 1
            self._apply(peer, ready, now_ns)
            self._durability.add_keyframe(peer, ready.id)
        self._acknowledge(*self._durability.take_durable())
        if not applicable:  # applied ones are acknowledged once they are durable
            self._acknowledge(peer)

    def _reorder(self, peer: Peer, keyframe: Keyframe, now_ns: int) -> list[Keyframe]:
        """Return the keyframes that can be applied now; none if the agent exceeds its quota."""
        if peer.reorder_buffer.is_new(keyframe.id):  # duplicates cost nothing
            name = peer.hello.name
            reason = peer.overload_reason() or self._quota.objection(name, keyframe, now_ns)
            if reason is not None:
                peer.refusals.add(reason, now_ns)
                peer.overload.record(reason, now_ns)
                return []
        try:
            return peer.reorder_buffer.push(keyframe)
        except ValueError as error:
            self._count_bad_message(peer, str(error), now_ns)
            return []

    def _apply(self, peer: Peer, keyframe: Keyframe, now_ns: int) -> None:
        # a run is stored with its first keyframe
        run = (SaveRun(peer.key, peer.hello, peer.credential),) if peer.odometry_base is None else ()
        try:
            keyframe, problem = peer.sanitise(keyframe)
        except ValueError as error:
            self._count_bad_message(peer, str(error), now_ns)
            return
        if problem:
            peer.suspect_keyframes.add(problem, now_ns)
            self._record_throttled(now_ns, "odometry suspect", peer, problem)
        assert peer.odometry_base is not None
        self._save(*run, SaveKeyframe(peer.key, keyframe))
        is_over_rate = self._quota.is_over_rate(peer.hello.name, now_ns)
        self._effects.append(ed.AddKeyframe(peer.key, keyframe, is_over_rate))

    def _save(self, *changes: MapChange) -> None:
        if (effect := self._durability.save(changes)) is not None:
            self._effects.append(effect)

    def _acknowledge(self, *peers: Peer) -> None:
        """Acknowledge the durable keyframes of these peers."""
        for peer in peers:
            self._send(self._registry.peer_id_by_key[peer.key], peer.reorder_buffer.ack(peer.durable_below))

    def _on_evaluation(self, peer_id: bytes, peer: Peer, evaluation: wire.Evaluation, now_ns: int) -> None:
        peer.counts["evaluations"] += 1
        hello, t_s = peer.hello, self._event_log.elapsed_s(now_ns)
        rate_hz = self._rate_scheduler.evaluate(hello.name, hello.kind, evaluation, now_ns, t_s)
        if rate_hz is not None:
            self._send(peer_id, wire.Rate(rate_hz))

    # ------------------------------------------------------------------ the map

    def _on_finding(self, finding: MapEvent, now_ns: int) -> None:
        """Record a decision of the mapper, and send its correction if there is one."""
        if (peer_id := self._registry.peer_id_by_key.get(finding.agent)) is None:  # forgotten in the meantime
            return
        peer = self._registry[peer_id]
        if finding.correction is None:
            recorder = self._record_throttled if finding.event == "step failed" else self._record
            recorder(now_ns, finding.event, peer, finding.reason)
            return
        peer.last_finding = finding
        if not peer.is_gone and peer.is_welcomed:  # before the welcome it takes us for the session before
            self._send_correction(peer_id, peer, finding, now_ns)

    def _send_correction(
        self, peer_id: bytes, peer: Peer, finding: MapEvent, now_ns: int, is_repeat: bool = False
    ) -> None:
        """Send a correction. is_repeat: sent again at the agent's request, so its record is throttled."""
        assert finding.correction is not None
        peer.revision += 1
        peer.counts["corrections"] += 1
        correction = replace(finding.correction, revision=peer.revision)
        self._send(peer_id, correction)
        fields = {
            "map_id": correction.map_id,
            "revision": peer.revision,
            "answers": correction.answered_keyframe,
        }
        recorder = self._record_throttled if is_repeat else self._record
        recorder(now_ns, finding.event, peer, finding.reason, **fields)

    # ------------------------------------------------------------------ sending, records, reports

    def _send(self, peer_id: bytes, message: wire.DownlinkMessage, version: int = WIRE_VERSION) -> None:
        frames = encode(message, version)
        self._peer_or_unjoined(self._registry.get(peer_id)).counts["bytes_down"] += sum(
            len(frame) for frame in frames
        )
        self._effects.append(ed.SendToPeer(peer_id, frames))

    def _peer_or_unjoined(self, peer: Peer | None) -> Peer | UnjoinedPeers:
        return peer or self._unjoined

    def _record(self, now_ns: int, event: str, peer: Peer | None, reason: str, **fields: Any) -> None:
        agent = peer.hello.name if peer else None
        self._effects.append(self._event_log.event(now_ns, event, agent, reason, **fields))

    def _record_throttled(
        self, now_ns: int, event: str, peer: Peer | None, reason: str, **fields: Any
    ) -> None:
        """Record an event that a peer can cause at any rate."""
        agent = peer.hello.name if peer else None
        if (effect := self._event_log.throttled_event(now_ns, event, agent, reason, **fields)) is not None:
            self._effects.append(effect)

    def series(self) -> dict[str, Any]:
        """Return each agent's evaluations with QoE and rate (`RateScheduler.series`)."""
        return {
            peer.hello.name: self._rate_scheduler.series(peer.hello.name) for peer in self._registry.values()
        }

    def _peer_report(self, peer: Peer) -> dict[str, Any]:
        """Return the report fields of a run that do not come from its messages."""
        is_latest = self._registry.is_latest(peer)
        return (
            self._rate_scheduler.report(peer.hello.name)
            if is_latest
            else dict.fromkeys(RateScheduler.REPORT_FIELDS)
        )

    def report(self, map_report: dict[str, Any]) -> dict[str, Any]:
        """Return edge.json without `series`. map_report: of the mapper, whose `agents` are by run key. Runs
        go by `RunRegistry.label`."""
        agent_reports, now_ns = map_report.get("agents", {}), self._now_ns
        return {
            "session": self._session,
            "policy": self._config.edge.policy,
            **map_report,
            "agents": {
                self._registry.label(peer): peer.report(now_ns)
                | self._peer_report(peer)
                | agent_reports.get(peer.key, {})
                for peer in self._registry.values()
            },
            "unjoined": dict(self._unjoined.counts),
            "refused": refusal_warnings(self._registry.values(), self._unjoined, now_ns),
            "internal_errors": self._internal_errors,
            "forgotten_runs": self._registry.forgotten_count,
            "version": __version__,
            "config": to_mapping(self._config),
        }
