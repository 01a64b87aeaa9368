"""The edge as a state machine: who speaks to it, what it answers, and when a keyframe is safe.

It sees no socket, thread, disk or clock: `handle(event, now_ns)` answers effects, `share.runtime.edge`
carries them out. What keyframes mean is the mapper's business (`share.mapping.mapper`), which has a process
of its own and answers with findings; what must survive a crash goes to the keeper, which answers once it has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

from share import __version__
from share.config import Config
from share.errors import VersionError, WireError, describe
from share.mapping.changes import Change, ForgetRun, KeepKeyframe, KeepRun, KeepVoice
from share.mapping.steps import Finding
from share.plain_data import to_mapping
from share.protocol import edge_events as ed
from share.protocol.admission import Admission, Allowance, Runs, new_key, other_name
from share.protocol.edge_records import Records, Safekeeping
from share.protocol.peer import Known, Peer, Strangers, refused_lines
from share.protocol.versions import OtherVersions
from share.rates import seconds
from share.scheduling.policies import Schedule
from share.types import Keyframe
from share.wire import messages as wire
from share.wire.codec import VERSION, decode, encode


class Edge:
    """All agents of one room. `session` names this life of the edge, so that agents notice a new one.

    keeps: what is applied is acknowledged only once it is `Kept`. known: runs of earlier lives.
    began_ns: times in records count from here (default: the first event).
    """

    tracks: ClassVar[bool] = False  # agents stream: `share.protocol.remote_tracking`

    def __init__(
        self,
        config: Config,
        session: int,
        keeps: bool = False,
        known: Sequence[Known] = (),
        began_ns: int | None = None,
    ) -> None:
        self._config, self._session = config, session
        self._runs = Runs()
        self._schedule = Schedule(config.control, config.edge.policy)
        self._strangers = Strangers()
        self._admission = Admission(config.edge, self.tracks)
        self._allowance = Allowance(self._schedule.most_hz)
        self._records, self._versions = Records(began_ns), OtherVersions()
        self._internal_errors = 0
        self._safekeeping = Safekeeping(keeps)
        self._effects: list[ed.Effect] = []
        self._now_ns = 0  # of the newest event
        for run in known:
            self._runs.recall(run)

    def handle(self, event: ed.Event, now_ns: int) -> list[ed.Effect]:
        """What `event` leads to. `now_ns` is the edge's clock and never goes back.

        An exception, which is a fault of ours, costs this event only: it is counted and said."""
        self._records.begin(now_ns)
        self._effects, self._now_ns = [], now_ns
        try:
            self._react(event, now_ns)
        except Exception as error:
            self._failed(event, error, now_ns)
        return self._effects

    def _failed(self, event: ed.Event, error: Exception, now_ns: int) -> None:
        self._internal_errors += 1
        peer = self._runs.get(event.peer) if isinstance(event, ed.Received) else None
        reason = f"{type(event).__name__}: {describe(error)}"
        if peer is not None:
            peer.refusals.add(reason, now_ns)
        self._record_seldom(now_ns, "internal error", peer, reason)

    def _react(self, event: ed.Event, now_ns: int) -> None:
        self._forget_emptied(now_ns)  # before one of them says hello: its keyframes would be taken as known
        match event:
            case ed.Received():
                self._receive(event, now_ns)
            case ed.Found():
                self._keep(*event.changes)
                for finding in event.findings:
                    self._found(finding, now_ns)
                self._runs.emptied(event.emptied)
            case ed.Kept():
                self._acknowledge(*self._safekeeping.kept(event.ticket))
            case ed.Tick():
                self._notice_silence(now_ns)

    # ------------------------------------------------------------------ messages

    def _receive(self, event: ed.Received, now_ns: int) -> None:
        peer = self._runs.get(event.peer)
        counts = self._of(peer).counts
        counts["bytes_up"] += sum(len(frame) for frame in event.frames)
        try:
            message = decode(event.frames)
        except VersionError as error:
            self._other_version(event.peer, error, now_ns)
            return
        except WireError as error:
            self._complain(peer, str(error), now_ns)
            return
        if peer is not None and not event.speaks_for(peer.hello.name):
            self._not_its_run(event, peer.hello.name, message, now_ns)
            return
        if peer is not None and not self._heard(event.peer, peer, message, now_ns):
            return
        if peer is not None and peer.voice != event.voice:
            self._spoken_for(peer, event.voice)
        match message:
            case wire.Hello():
                self._greet(event, message, now_ns)
            case wire.Ping():  # a stranger's too: our session tells it to say hello
                pong = wire.Pong(message.sequence, message.sent_ns, now_ns, now_ns, self._session)
                self._send(event.peer, pong)
            case wire.Bye() if peer:
                peer.status.left()
                self._gone(peer, "left", "said bye", now_ns)
            case _ if peer:
                self._told(event.peer, peer, message, now_ns)
            case _:  # from a stranger
                self._unexpected(None, message, now_ns)

    def _not_its_run(self, event: ed.Received, name: str, message: wire.Message, now_ns: int) -> None:
        """A key speaks for a run whose name is not its own, or was taken from it. It is answered who asks."""
        self._complain(None, f"a key that does not speak for '{name}' used its run", now_ns)
        if isinstance(message, wire.Hello):
            reason = other_name(name, event.names or ())
            self._send(event.peer, wire.Refused(reason))
            self._record_seldom(now_ns, "refused", None, reason)

    def _told(self, peer_id: bytes, peer: Peer, message: wire.Message, now_ns: int) -> None:
        """What an agent says of itself."""
        match message:
            case Keyframe():
                self._keyframe(peer, message, now_ns)
            case wire.PoseUpdate():
                peer.counts["poses"] += 1
                peer.status.posed(message.state, now_ns)
            case wire.Status():
                peer.status.told(message, now_ns)
            case wire.Evaluation():
                self._evaluated(peer_id, peer, message, now_ns)
            case _:  # not this agent's word
                self._unexpected(peer, message, now_ns)

    def _unexpected(self, peer: Peer | None, message: wire.Message, now_ns: int) -> None:
        self._of(peer).counts["unexpected"] += 1
        what = "before its hello" if peer is None else "which is not an agent's to send"
        self._of(peer).refusals.add(f"a {type(message).__name__} {what}", now_ns)

    def _other_version(self, peer_id: bytes, error: VersionError, now_ns: int) -> None:
        self._strangers.counts["other_version"] += 1
        if (reason := self._versions.refusal(peer_id, error, now_ns)) is not None:
            self._refuse(peer_id, reason, now_ns, error.version)

    def _complain(self, peer: Peer | None, reason: str, now_ns: int) -> None:
        """Counts a bad message; says the first of each peer."""
        counts = self._of(peer).counts
        counts["bad_messages"] += 1
        self._of(peer).refusals.add(reason, now_ns)
        if counts["bad_messages"] == 1:
            self._record(now_ns, "bad message", peer, reason)

    def _heard(self, peer_id: bytes, peer: Peer, message: wire.Message, now_ns: int) -> bool:
        """Whether it is present now. Who was gone comes back only where its name and a place are free."""
        if peer.gone:
            if isinstance(message, wire.Bye):  # said again, or late
                return False
            if (reason := self._no_room(peer, now_ns)) is not None:
                if isinstance(message, wire.Hello | wire.Ping):  # not each of many keyframes is answered
                    self._refuse(peer_id, reason, now_ns)
                else:
                    peer.refusals.add(reason, now_ns)
                return False
            self._come_back(peer, now_ns)
        peer.heard_ns, peer.was_heard = now_ns, True
        return True

    def _no_room(self, peer: Peer, now_ns: int) -> str | None:
        """Why a run that is gone cannot come back; None if it can."""
        return self._admission.no_room(peer.hello, self._runs, now_ns)

    def _come_back(self, peer: Peer, now_ns: int) -> None:
        self._supersede(peer.hello.name, now_ns)
        peer.gone = False
        self._runs.came_back(peer)
        self._effects.append(ed.Present(peer.key, True))
        self._record_seldom(now_ns, "back", peer, "is heard again")

    def _supersede(self, name: str, now_ns: int) -> None:
        """A run of this name comes: one that is present has been silent for so long that it lost the name."""
        for other in self._runs.values():
            if not other.gone and other.hello.name == name:
                self._gone(other, "silent", "another run has its name now", now_ns)

    def _notice_silence(self, now_ns: int) -> None:
        for peer in self._runs.values():
            if not peer.gone and now_ns - peer.heard_ns > seconds(self._config.edge.silent_s):
                self._gone(peer, "silent", f"nothing heard for {self._config.edge.silent_s:g} s", now_ns)

    def _gone(self, peer: Peer, what: str, reason: str, now_ns: int) -> None:
        peer.gone = True
        peer.inorder.drop_waiting()
        self._effects.append(ed.Present(peer.key, False))
        self._record_seldom(now_ns, what, peer, reason)

    # ------------------------------------------------------------------ coming in

    def _greet(self, event: ed.Received, hello: wire.Hello, now_ns: int) -> None:
        """Welcome a new run or a known one; refuse a name that somebody else is using, once that is sure: who
        gets no answer says hello again."""
        peer_id = event.peer
        if (reason := self._objection(event, hello, now_ns)) is not None:
            if not self._admission.is_soon_free(hello.name, self._runs, now_ns):
                self._refuse(peer_id, reason, now_ns)
            return
        if peer_id not in self._runs:
            if (idle := self._runs.forget_idle()) is not None:
                self._forget(*idle)
            self._admission.came(event, hello, now_ns)
            self._supersede(hello.name, now_ns)
            key = new_key(hello, self._runs.by_key)
            self._enter(peer_id, Peer(hello, key, now_ns, voice=event.voice))
            self._schedule.begin(hello.name)
            joined = f"{hello.kind} '{hello.name}'"
            self._record_seldom(now_ns, "joined the edge", self._runs[peer_id], joined)
        self._welcome(peer_id, self._runs[peer_id], now_ns)

    def _objection(self, event: ed.Received, hello: wire.Hello, now_ns: int) -> str | None:
        if self._runs.was_forgotten(event.peer):
            return f"this run of '{hello.name}' was forgotten while it was away: start the agent again"
        return self._admission.objection(event, hello, self._runs, now_ns)

    def _refuse(self, peer_id: bytes, reason: str, now_ns: int, version: int = VERSION) -> None:
        self._send(peer_id, wire.Refused(reason), version)
        self._of(self._runs.get(peer_id)).refusals.add(reason, now_ns)
        self._record_seldom(now_ns, "refused", None, reason)

    def _welcome(self, peer_id: bytes, peer: Peer, now_ns: int) -> None:
        """Who says hello has lost the edge: whatever was on its way to him may be gone, or was not taken."""
        peer.greeted = True
        self._send(peer_id, wire.Welcome(self._session, peer.safe))
        if peer.newest is not None:
            self._correct(peer_id, peer, peer.newest, now_ns, again=True)

    def _enter(self, peer_id: bytes, peer: Peer) -> None:
        self._runs.add(peer_id, peer)
        self._effects.append(ed.Join(peer.key, peer.hello, peer.voice or ""))

    def _spoken_for(self, peer: Peer, voice: str) -> None:
        """By another key than before, or by one that was not known."""
        peer.voice = voice
        self._effects.append(ed.Speaks(peer.key, voice))
        if peer.foot is not None:
            self._keep(KeepVoice(peer.key, voice))

    def _forget_emptied(self, now_ns: int) -> None:
        for peer in self._runs.forgettable():
            self._forget(peer, self._runs.forget(peer))
            self._keep(ForgetRun(peer.key))
            self._record_seldom(now_ns, "forgotten", peer, f"nothing is left of its run {peer.key}")

    def _forget(self, peer: Peer, was_latest: bool) -> None:
        """Of a run of which there is nothing."""
        self._effects.append(ed.Forget(peer.key))
        if was_latest:
            self._schedule.drop(peer.hello.name)

    # ------------------------------------------------------------------ keyframes

    def _keyframe(self, peer: Peer, keyframe: Keyframe, now_ns: int) -> None:
        applicable = self._in_order(peer, keyframe, now_ns)
        for ready in applicable:
            peer.counts["keyframes"] += 1
            self._apply(peer, ready, now_ns)
            self._safekeeping.applied(peer, ready.id)
        self._acknowledge(*self._safekeeping.safe())
        if not applicable:  # the others are acknowledged once they are safe
            self._acknowledge(peer)

    def _in_order(self, peer: Peer, keyframe: Keyframe, now_ns: int) -> list[Keyframe]:
        """What can be applied now; nothing of an agent that sends more than is taken in."""
        if peer.inorder.is_new(keyframe.id):  # else it costs nothing
            name = peer.hello.name
            reason = peer.too_many() or self._allowance.objection(name, keyframe, now_ns)
            if reason is not None:
                peer.refusals.add(reason, now_ns)
                peer.held_back.note(reason, now_ns)
                return []
        try:
            return peer.inorder.push(keyframe)
        except ValueError as error:
            self._complain(peer, str(error), now_ns)
            return []

    def _apply(self, peer: Peer, keyframe: Keyframe, now_ns: int) -> None:
        # no run without a keyframe is kept
        run = (KeepRun(peer.key, peer.hello, peer.voice),) if peer.foot is None else ()
        try:
            keyframe, complaint = peer.place(keyframe)
        except ValueError as error:
            self._complain(peer, str(error), now_ns)
            return
        if complaint:
            peer.doubts.add(complaint, now_ns)
            self._record_seldom(now_ns, "odometry doubted", peer, complaint)
        assert peer.foot is not None
        self._keep(*run, KeepKeyframe(peer.key, keyframe))
        extra = self._allowance.is_extra(peer.hello.name, now_ns)
        self._effects.append(ed.Add(peer.key, keyframe, extra))

    def _keep(self, *changes: Change) -> None:
        if (keep := self._safekeeping.keep(changes)) is not None:
            self._effects.append(keep)

    def _acknowledge(self, *peers: Peer) -> None:
        """What is safe of them by now."""
        for peer in peers:
            self._send(self._runs.by_key[peer.key], peer.inorder.ack(peer.safe))

    def _evaluated(self, peer_id: bytes, peer: Peer, told: wire.Evaluation, now_ns: int) -> None:
        peer.counts["evaluations"] += 1
        hello, t_s = peer.hello, self._records.since_began_s(now_ns)
        rate_hz = self._schedule.evaluated(hello.name, hello.kind, told, now_ns, t_s)
        if rate_hz is not None:
            self._send(peer_id, wire.Rate(rate_hz))

    # ------------------------------------------------------------------ the map

    def _found(self, finding: Finding, now_ns: int) -> None:
        """Write down what the mapper decided, and send what follows from it."""
        if (peer_id := self._runs.by_key.get(finding.agent)) is None:  # forgotten meanwhile
            return
        peer = self._runs[peer_id]
        if finding.correction is None:
            record = self._record_seldom if finding.what == "job failed" else self._record
            record(now_ns, finding.what, peer, finding.reason)
            return
        peer.newest = finding
        if not peer.gone and peer.greeted:  # who has not been greeted takes us for our predecessor
            self._correct(peer_id, peer, finding, now_ns)

    def _correct(
        self, peer_id: bytes, peer: Peer, finding: Finding, now_ns: int, again: bool = False
    ) -> None:
        """again: as it asked for it, so that it is not said each time."""
        assert finding.correction is not None
        peer.revision += 1
        peer.counts["corrections"] += 1
        correction = replace(finding.correction, revision=peer.revision)
        self._send(peer_id, correction)
        fields = {"map_id": correction.map_id, "revision": peer.revision, "answers": correction.answers}
        record = self._record_seldom if again else self._record
        record(now_ns, finding.what, peer, finding.reason, **fields)

    # ------------------------------------------------------------------ going out

    def _send(self, peer_id: bytes, message: wire.Down, version: int = VERSION) -> None:
        frames = encode(message, version)
        self._of(self._runs.get(peer_id)).counts["bytes_down"] += sum(len(frame) for frame in frames)
        self._effects.append(ed.Send(peer_id, frames))

    def _of(self, peer: Peer | None) -> Peer | Strangers:
        return peer or self._strangers

    def _record(self, now_ns: int, what: str, peer: Peer | None, reason: str, **fields: Any) -> None:
        agent = peer.hello.name if peer else None
        self._effects.append(self._records.of(now_ns, what, agent, reason, **fields))

    def _record_seldom(self, now_ns: int, what: str, peer: Peer | None, reason: str, **fields: Any) -> None:
        """For what a peer can cause at any rate."""
        agent = peer.hello.name if peer else None
        if (record := self._records.seldom(now_ns, what, agent, reason, **fields)) is not None:
            self._effects.append(record)

    def series(self) -> dict[str, Any]:
        """Of every agent, its evaluations and what came of them (`share.scheduling.policies`)."""
        return {peer.hello.name: self._schedule.series(peer.hello.name) for peer in self._runs.values()}

    def _report_of(self, peer: Peer) -> dict[str, Any]:
        """What is known of it beside what was heard."""
        is_latest = self._runs.is_latest(peer)
        return self._schedule.report(peer.hello.name) if is_latest else dict.fromkeys(Schedule.REPORTED)

    def report(self, mapped: dict[str, Any]) -> dict[str, Any]:
        """edge.json: per agent and in all, but for `series`. mapped: the mapper's report, whose `agents` are
        by run. An agent stands under its name, its earlier runs as `Runs.label` has them."""
        of_agents, now_ns = mapped.get("agents", {}), self._now_ns
        return {
            "session": self._session,
            "policy": self._config.edge.policy,
            **mapped,
            "agents": {
                self._runs.label(peer): peer.report(now_ns)
                | self._report_of(peer)
                | of_agents.get(peer.key, {})
                for peer in self._runs.values()
            },
            "strangers": dict(self._strangers.counts),
            "refused": refused_lines(self._runs.values(), self._strangers, now_ns),
            "internal_errors": self._internal_errors,
            "forgotten_runs": self._runs.forgotten,
            "version": __version__,
            "config": to_mapping(self._config),
        }
