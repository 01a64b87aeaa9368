"""Membership of runs in a room: hello, welcome, refusal, reconnection, timeout, leave."""

from __future__ import annotations

from collections.abc import Sequence

from share.config import Config
from share.event_kinds import EventKind
from share.geometry.camera import Rig
from share.mapping.corrections import MapEvent
from share.mapping.map_changes import RemoveRun, SaveCredential
from share.protocol import edge_events as ed
from share.protocol.admission import (
    Admission,
    ForgottenRun,
    RunRegistry,
    misuse_text,
    name_objection,
    new_run_key,
)
from share.protocol.client_service import ClientService
from share.protocol.edge_records import EdgeOutput
from share.protocol.keyframe_intake import ReorderBuffer
from share.protocol.peer import Peer, RoomEntry
from share.scheduling.rate_scheduler import RateScheduler
from share.scheduling.room_budget import RateGrant
from share.timing import seconds_to_ns
from share.wire import messages as wire
from share.wire.codec import WIRE_VERSION

_ENTRY_S = 5.0  # in which a run that has come from another room enters a map of this one


class RunTrackers:
    """Trackers that the edge runs for the room's runs. Here none: agents track themselves. Another kind is
    `remote_tracking.RemoteTrackers`."""

    tracks_agents = False

    def objection(self, key: str | None, rig: Rig) -> str | None:
        """Return why no tracker can start for a run (key None: a new run); None if one can."""
        return None

    def add(self, key: str, rig: Rig) -> None:
        """Add a run that has joined."""

    def remove(self, key: str) -> None:
        """Remove a run that is forgotten."""

    def start(self, key: str) -> Sequence[ed.TrackerEffect]:
        """Start the run's tracker, unless it is running."""
        return ()

    def stop(self, key: str) -> Sequence[ed.TrackerEffect]:
        """Stop the run's tracker, if it is running."""
        return ()

    def is_ready(self, key: str) -> bool:
        """Return whether the run may be welcomed."""
        return True


class RoomMembership:
    """The runs of a room and their presence. Effects go to `out`."""

    def __init__(
        self,
        config: Config,
        session: int,
        registry: RunRegistry,
        out: EdgeOutput,
        rate_scheduler: RateScheduler,
        room: ClientService,
        trackers: RunTrackers,
    ) -> None:
        self._session, self._registry, self._out = session, registry, out
        self._silent_s = config.edge.silent_s
        self._rate_scheduler, self._room, self._trackers = rate_scheduler, room, trackers
        self._admission = Admission(config.edge, trackers.tracks_agents, rate_scheduler)

    def on_hello(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> None:
        """Welcome a new or known run, or refuse it. No answer while the name's present run may be dead: the
        agent repeats its hello."""
        if (reason := self._objection(event, hello)) is not None:
            if not self._admission.is_name_stale(hello.name, self._registry, self._out.now_ns):
                self.refuse(event.peer_id, reason)
            return
        self.welcome(self._registry.get(event.peer_id) or self._join(event, hello))

    def _objection(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> str | None:
        if (reason := self._admission.objection(event, hello, self._registry, self._out.now_ns)) is not None:
            return reason
        existing = self._registry.get(event.peer_id)
        return self._trackers.objection(None if existing is None else existing.key, hello.rig)

    def _make_room(self, peer: Peer) -> None:
        """Remove the robots that are displaced by a run that has joined."""
        displaced = self._rate_scheduler.policy.displaced(peer.name, peer.hello.kind, self._out.now_ns)
        for other in self._registry.present() if displaced else ():
            if other.name in displaced:
                self.refuse(other.id, f"no air left beside headsets: '{peer.name}' has joined")
                other.status.leave()  # it was sent away: nobody misses it
                self.mark_gone(other, "left", f"made room for '{peer.name}'")

    def _join(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> Peer:
        """Return the new run of an admitted hello."""
        if (idle := self._registry.oldest_idle()) is not None:
            self._forget(idle)
        self._admission.record_join(event, hello, self._out.now_ns)
        self._supersede(hello.name)
        peer = self._new_peer(event, hello)
        self._registry.add(peer)
        self._out.add(ed.AddRun(peer.key, peer.hello, event.credential))
        self._rate_scheduler.begin_run(peer.name)
        goes_on = f"; goes on with keyframe {peer.forgotten_below}: those before are forgotten"
        who = f"{hello.kind} '{hello.name}'{goes_on if peer.forgotten_below else ''}"
        self._out.record("agent joined", peer, who)
        self._make_room(peer)
        self._trackers.add(peer.key, hello.rig)
        return peer

    def _new_peer(self, event: ed.PeerMessageReceived, hello: wire.Hello) -> Peer:
        """Return the run. One that was forgotten goes on after the keyframes that it had: they are not asked
        for again, and count as known if they come."""
        forgotten = self._registry.forgotten(event.peer_id) or ForgottenRun(0)
        session = self._session if forgotten.session is None else forgotten.session
        return Peer(
            id=event.peer_id,
            hello=hello,
            key=new_run_key(hello, self._registry.by_key),
            last_received_ns=self._out.now_ns,
            session=session,
            reorder_buffer=ReorderBuffer(forgotten.next_keyframe),
            durable_below=forgotten.next_keyframe,
            forgotten_below=forgotten.next_keyframe,
            revision=forgotten.revision,
            credential=event.credential,
        )

    def refuse(self, peer_id: bytes, reason: str, version: int = WIRE_VERSION) -> None:
        self._out.send(peer_id, wire.Refused(reason), version)
        self._registry.sender(peer_id).refusals.add(reason, self._out.now_ns)
        self._out.record("refused", None, reason)

    def welcome(self, peer: Peer) -> None:
        """Send a welcome, and the last correction again: a hello means that the agent may have missed it.
        Where the edge tracks it, only once its tracker is ready."""
        self._out.add(*self._trackers.start(peer.key))
        if not self._trackers.is_ready(peer.key):
            return
        peer.is_welcomed, hold_ms = True, self._rate_scheduler.policy.hold_ms(peer.name, self._out.now_ns)
        self._out.send(peer.id, wire.Welcome(peer.session, peer.durable_below, hold_ms))
        self._send_first_grant(peer)
        if peer.last_correction_event is not None:
            self._out.send_correction(peer, peer.last_correction_event, is_repeat=True)

    def _try_readmit(self, peer: Peer, message: wire.Message) -> bool:
        """Return whether a run that left is present again by this message."""
        if isinstance(message, wire.Bye):  # repeated or late
            return False
        if (reason := self._capacity_objection(peer)) is not None:
            if isinstance(message, wire.Hello | wire.Ping):  # keyframes are not answered one by one
                self.refuse(peer.id, reason)
            else:
                peer.refusals.add(reason, self._out.now_ns)
            return False
        self._readmit(peer)
        return True

    def _capacity_objection(self, peer: Peer) -> str | None:
        """Return why a run that left may not come back; None if it may."""
        reason = self._admission.capacity_objection(peer.hello, self._registry, self._out.now_ns)
        return reason or self._trackers.objection(peer.key, peer.hello.rig)

    def _readmit(self, peer: Peer) -> None:
        self._supersede(peer.name)
        self._registry.mark_present(peer)
        self._out.add(ed.SetPresence(peer.key, True))
        self._out.record("reconnected", peer, "sends again")
        self._make_room(peer)
        self._out.add(*self._trackers.start(peer.key))

    # ------------------------------------------------------------ runs that change the room

    def hand_over(self, peer: Peer, room: str) -> None:
        """Let a present run whose keyframes are all stored go on in another room."""
        self._registry.hand_over(peer)
        self._room.send_away(peer.name, f"its agent goes on in room '{room}'")
        self._rate_scheduler.forget(peer.name)
        self._out.add(ed.SetPresence(peer.key, False))
        self._out.record("room changed", peer, f"goes on in room '{room}'")

    def entry_objection(self, peer: Peer) -> str | None:
        """Return why a run may not come from another room; None if it may."""
        named, known = self._registry.by_key.get(peer.key), self._registry.get(peer.id)
        if named is not known:
            return f"another run is called {peer.key} there" if named else "it has another name there"
        return self._admission.capacity_objection(peer.hello, self._registry, self._out.now_ns)

    def take_over(self, peer: Peer, room: str) -> None:
        """Take in a run from another room; nothing objects."""
        peer.entry = RoomEntry(self._out.now_ns + seconds_to_ns(_ENTRY_S))
        self._supersede(peer.name)
        was_here = self._registry.take_over(peer)
        change = (
            ed.SetPresence(peer.key, True)
            if was_here
            else ed.AddRun(peer.key, peer.hello, peer.credential or "")
        )
        self._out.add(change)
        self._rate_scheduler.begin_run(peer.name)
        self._out.record("room changed", peer, f"comes from room '{room}'")
        self._make_room(peer)
        self._send_first_grant(peer)

    def end_entries(self) -> list[MapEvent]:
        """Return the withheld corrections of runs that entered some time ago and are in a map of their
        own."""
        out = []
        for peer in self._registry.present():
            entry = peer.entry
            if entry is not None and not entry.is_entering and self._out.now_ns >= entry.until_ns:
                out += [] if entry.withheld is None else [entry.withheld]
                peer.entry = None
        return out

    def _supersede(self, name: str) -> None:
        """Mark present runs of this name as gone: they were silent too long, and a new run takes it."""
        for other in self._registry.present():
            if other.name == name:
                self.mark_gone(other, "silent", "replaced by a newer run of the same name")

    def check_silence(self) -> None:
        for peer in self._registry.present():
            if self._out.now_ns - peer.last_received_ns > seconds_to_ns(self._silent_s):
                self.mark_gone(peer, "silent", f"no message for {self._silent_s:g} s")

    def mark_gone(self, peer: Peer, event: EventKind, reason: str) -> None:
        self._registry.mark_gone(peer)
        peer.reorder_buffer.clear()
        self._out.add(ed.SetPresence(peer.key, False))
        self._out.record(event, peer, reason)
        self._out.add(*self._trackers.stop(peer.key))

    def forget_empty_runs(self) -> None:
        for peer in self._registry.removable():
            self._forget(peer)
            self._out.save(RemoveRun(peer.key))
            self._out.record("forgotten", peer, f"the map no longer holds any keyframe of run {peer.key}")

    def _forget(self, peer: Peer) -> None:
        """Remove a run and its state for good."""
        if self._registry.forget(peer):  # it was the latest of its name
            self._rate_scheduler.forget(peer.name)
        self._out.add(ed.DropRun(peer.key))
        self._room.maps.forget(peer.key)
        self._trackers.remove(peer.key)

    def may_send(self, event: ed.PeerMessageReceived, peer: Peer, message: wire.Message) -> bool:
        """Return whether a known run may send: its credential allows it, and it is present or comes back."""
        if not event.is_authorised_for(peer.name):
            self._out.count_bad_message(None, misuse_text(event, peer.name))
            if isinstance(message, wire.Hello):  # only a hello is answered
                reason = name_objection(peer.name, event)
                self._out.send(event.peer_id, wire.Refused(reason))
                self._out.record("refused", None, reason)
            return False
        if peer.is_gone and not self._try_readmit(peer, message):
            return False
        peer.mark_received(self._out.now_ns)
        if peer.credential != event.credential:  # it has changed, or was unknown
            peer.credential = event.credential
            self._out.add(ed.SetCredential(peer.key, event.credential))
            if peer.odometry_base is not None:
                self._out.save(SaveCredential(peer.key, event.credential))
        return True

    def _send_first_grant(self, peer: Peer) -> None:
        peer.grant = None
        first = self._rate_scheduler.policy.first_grant(peer.name, peer.hello.kind, self._out.now_ns)
        self.send_grant(peer, first)

    def send_grant(self, peer: Peer, grant: RateGrant | None) -> None:
        """Send what an agent may send, if that has changed; None: everything, which needs no message."""
        if grant is not None and grant != peer.grant:
            is_windowed = self._rate_scheduler.policy.is_windowed
            self._out.send(peer.id, wire.Rate(grant.hz, is_windowed, grant.pose_hz, grant.jpeg_quality))
            peer.grant = grant
