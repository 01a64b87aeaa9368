"""The agent's side of the protocol as a state machine, without sockets, threads or clock.

`AgentProtocol.handle` takes one event and the time and returns effects, deterministically. Odometry passes
through unchanged: the edge only moves the map under it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

from share.config import Config
from share.errors import UsageError
from share.metrics.frame_log import summary
from share.protocol import agent_events as ev
from share.protocol.agent_ledger import KeyframeChain, KeyframeLedger, LedgerEntry
from share.protocol.agent_status import StatusReporter, with_link
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, SendToEdge
from share.protocol.edge_clock import ClockEstimate, PingTracker
from share.protocol.edge_connection import EdgeConnection, WelcomeOutcome
from share.protocol.keyframe_pace import KeyframePace
from share.protocol.localisation import MapLocalisation, SelfEvaluation, pose_update
from share.timing import PeriodicTimer, seconds_to_ns
from share.types import F64, Correction, OdometryKeyframe
from share.vision.keyframe_images import with_less_quality
from share.wire import messages as m
from share.wire.codec import encode, message_bytes
from share.wire.layouts import Bytes

EVALUATION_S = 1.0  # longest interval of evaluations: with few keyframes the edge has to know sooner
NO_KEYFRAME = -1  # of an evaluation between keyframes
_COUNTERS = (
    *("bytes_up", "bytes_down", "poses", "candidates", "drop_rate"),
    *("corrections", "corrections_stale"),
)
_LEDGER_COUNTERS = (
    "sent",
    "resent",
    "acknowledged",
    "drop_oldest_acknowledged",
    "drop_oldest",
    "invalid_acks",
)


class AgentProtocol:
    """One run of one agent. `hello` is repeated until an edge welcomes it.

    It takes `FrameTracked` and `KeyframeMade`: it tracks its frames (else: `share.protocol.streaming`).
    """

    offline_text: ClassVar[str] = "tracking continues without the edge"
    slow_text: ClassVar[str] = "this machine is too slow"  # why poses are late
    makes_keyframes: ClassVar[bool] = True  # of its frames, and sends poses relative to them

    def __init__(self, hello: m.Hello, config: Config) -> None:
        self._config = config
        self._keyframe_chain, self._pace = KeyframeChain(), KeyframePace()
        self._ledger = KeyframeLedger(config.agent.keep_keyframes)
        self._localisation = MapLocalisation(config.agent.blend_s)
        self._self_evaluation = SelfEvaluation()
        self._evaluation_timer = PeriodicTimer(EVALUATION_S)
        self._status_reporter = StatusReporter(self.slow_text)
        self._connection = EdgeConnection(hello, config.link.silent_s, self.offline_text)
        self._pings = PingTracker()
        self._finish_deadline_ns: int | None = None
        self._ended = False
        self._counts: Counter[str] = Counter()
        self._effects: list[ev.AgentEffect] = []
        self._now_ns = 0  # of the event that is being handled

    def handle(self, event: ev.AgentEvent, now_ns: int) -> list[ev.AgentEffect]:
        """Return the effects of `event` at `now_ns` (host monotonic clock, never falling)."""
        if isinstance(event, ev.SendFailed):
            self._on_send_failed(event.effect)
        if self._ended:
            return []
        self._effects, self._now_ns = [], now_ns
        self._connection.begin(now_ns)
        self._status_reporter.begin(now_ns)
        match event:
            case ev.FrameTracked():
                self._on_frame_tracked(event)
            case ev.KeyframeMade():
                self._on_keyframe_made(event.frame, event.candidate)
            case ev.FrameArrived():
                self._on_frame_arrived(event)
            case EdgeMessageReceived():
                self._on_received(event.frames)
            case ev.InputFinished():
                self._status_reporter.finish()
                self._finish_deadline_ns = now_ns + seconds_to_ns(self._config.agent.finish_s)
            case Connected():  # a welcome tells sooner than a pong whether this edge knows us
                self._connection.mark_reached()
                self._send_hello()
            case ev.AgentTick():
                self._status_reporter.add_tick(event)
        if not self._ended:
            self._send_due()
        return self._effects

    def pending_effects(self) -> list[ev.AgentEffect]:
        """Return the effects of the newest event up to where its handling failed."""
        return self._effects

    @property
    def is_connected(self) -> bool:
        """Whether an edge has welcomed it and is not silent."""
        return self._connection.is_connected

    def report(self) -> dict[str, Any]:
        """Return counters and the present state as plain data."""
        return {
            **{name: self._counts[name] for name in _COUNTERS},
            **{name: self._ledger.counts[name] for name in _LEDGER_COUNTERS},
            "bad_messages": self._connection.bad_messages,
            "keyframes": self._keyframe_chain.next_id,
            "pending": len(self._ledger.pending),
            "kept": len(self._ledger),
            "unacknowledged": self._ledger.unacknowledged,
            "buffered_at_edge": self._ledger.buffered_at_edge,
            "rate_hz": self._pace.hz,
            "connected": self.is_connected,
            "edge_session": self._connection.sessions.session,
            "edge_sessions": len(self._connection.sessions),
            "map_id": self._localisation.map_frame.map_id,
            "revision": self._connection.sessions.revision,
            "refusal": self._connection.refusal,
            "settle_s": summary(list(self._localisation.settle_s)).report(),
            **self._pings.clock.report(),
        }

    def status(self, now_ns: int) -> m.Status:
        """Return the agent's status at `now_ns`."""
        return self._status_reporter.status(now_ns)

    def clock_estimate(self, now_ns: int) -> ClockEstimate:
        """Return the estimate of the edge's clock at `now_ns`."""
        return ClockEstimate.from_filter(self._pings.clock, now_ns, self._config.clock.claim_ms)

    # ------------------------------------------------------------ frames

    def _on_frame_arrived(self, event: ev.FrameArrived) -> None:
        """Take a frame that is not tracked yet; this agent tracks its own frames, so none comes."""

    def _on_frame_tracked(self, frame: ev.FrameTracked) -> None:
        self._status_reporter.add_frame(frame, self._now_ns)
        self._self_evaluation.local_cm = frame.error_cm
        if frame.new_segment:
            self._keyframe_chain.begin_segment()
            self._localisation.begin_segment()
        if frame.T_odom_body is not None and frame.state.has_pose:
            self._publish_pose(frame, frame.T_odom_body)
        if not (frame.is_keyframe and self.makes_keyframes):  # else when it is made
            self._finish_frame(frame, sent=False)

    def _publish_pose(self, frame: ev.FrameTracked, T_odom_body: F64) -> None:
        drift_cov = self._self_evaluation.drift.cov
        localised = self._localisation.localise(frame, T_odom_body, drift_cov, self._now_ns)
        self._effects.append(localised)
        if self.is_connected and self.makes_keyframes and self._pace.take_pose(self._now_ns):
            self._counts["poses"] += 1
            last, first = self._ledger.last_acknowledged, self._keyframe_chain.first_of_segment
            self._send(pose_update(localised, last, first, self._now_ns))

    def _on_keyframe_made(self, frame: ev.FrameTracked, candidate: OdometryKeyframe | None) -> None:
        """Make a keyframe of the candidate that came with `frame`, if the rate allows (else drop_rate)."""
        if candidate is None:
            self._finish_frame(replace(frame, is_keyframe=False), sent=False)
            return
        self._counts["candidates"] += 1
        self._self_evaluation.add_processing_time((self._now_ns - frame.arrived_ns) / 1e6)
        self._keyframe_chain.extend(candidate)
        unacknowledged = len(self._ledger.pending) if self.is_connected else 0
        sent = self._pace.take(candidate, unacknowledged, self._now_ns)
        if sent:
            if (quality := self._pace.jpeg_quality) is not None:
                candidate = replace(candidate, image=with_less_quality(candidate.image, quality))
            keyframe = self._keyframe_chain.make_keyframe(candidate, frame.stamp_ns)
            self._ledger.add(LedgerEntry(keyframe, frame.index, frame.arrived_ns))
            self._self_evaluation.add_keyframe(keyframe, frame)
        else:
            self._counts["drop_rate"] += 1
        self._finish_frame(frame, sent)

    def _send_evaluation(self, keyframe: int) -> None:
        """Send delay and error just before a keyframe, or between two (`NO_KEYFRAME`)."""
        self._evaluation_timer.postpone(self._now_ns + seconds_to_ns(EVALUATION_S))
        if self.is_connected and (evaluation := self.evaluation(keyframe, self._now_ns)) is not None:
            self._send(evaluation)

    def evaluation(self, keyframe: int, now_ns: int) -> m.Evaluation | None:
        """Return how the agent is served at `now_ns`; None before the first keyframe and round trip."""
        rtt_ms = self._pings.clock.rtt_ms
        return self._self_evaluation.evaluation(keyframe, rtt_ms, self._localisation, now_ns)

    def _finish_frame(self, frame: ev.FrameTracked, sent: bool) -> None:
        self._effects.append(
            ev.FrameDone(frame.stamp_ns, frame.track_ms, frame.state, frame.is_keyframe, sent)
        )

    # ------------------------------------------------------------ messages from the edge

    def _on_received(self, frames: Sequence[Bytes]) -> None:
        self._counts["bytes_down"] += message_bytes(frames)
        message, lines = self._connection.receive(frames, self._now_ns)
        self._effects += lines
        match message:
            case None:
                pass
            case m.Welcome():
                self._on_welcome(message)
            case m.Refused():
                self._on_refused(message)
            case m.Ack():  # one of an earlier session is rejected, but is no fault
                self._on_ack(message)
            case Correction():
                self._on_correction(message)
            case m.Rate():
                self._pace.set_rate(message, self._now_ns)
            case m.Pong():
                self._on_pong(message)
            case _:
                self._on_other_message(message)

    def _on_ack(self, ack: m.Ack) -> None:
        if not self._ledger.acknowledge(ack):
            self._were_sent("an acknowledgement", ack.next_keyframe - 1, *ack.buffered)
            return
        acks_ms = self._self_evaluation.delay.acknowledge(ack.next_keyframe, self._now_ns)
        self._pace.acknowledge(acks_ms, self._now_ns)

    def _on_other_message(self, message: m.Message) -> None:
        self._effects += self._connection.report_unexpected(message, "this agent", self._now_ns)

    def _report_invalid(self, text: str) -> None:
        self._effects += self._connection.report_invalid(text, self._now_ns)

    def _were_sent(self, message_name: str, *keyframes: int) -> bool:
        """Return whether an edge can have these keyframes; report a message about others."""
        is_sent = max(keyframes, default=-1) < self._ledger.next_unsent_id
        if not is_sent:
            self._report_invalid(f"the edge sent {message_name} of keyframes that were never sent; ignored")
        return is_sent

    def _on_welcome(self, welcome: m.Welcome) -> None:
        if not self._were_sent("a welcome", welcome.next_keyframe - 1):
            return
        is_restart = self._connection.sessions.session is not None
        outcome = self._connection.welcome(welcome)
        if outcome not in (WelcomeOutcome.OUTDATED, WelcomeOutcome.UNSOLICITED):
            self._pace.hold(welcome.hold_ms, self._now_ns)
        match outcome:
            case WelcomeOutcome.UNSOLICITED:
                self._report_invalid("the edge sent a welcome without a hello; ignored")
            case WelcomeOutcome.NEW_SESSION:
                self._begin_session(welcome, is_restart)
            case WelcomeOutcome.RECONNECTED:
                self._ledger.resume(welcome)
                self._print("reconnected to the edge")

    def _begin_session(self, welcome: m.Welcome, is_restart: bool) -> None:
        self._pace.begin_session(self._now_ns)
        self._pings.begin_session()
        pending = self._ledger.begin_session(welcome)
        if is_restart:
            self._print(f"the edge has restarted; {self._on_edge_restart(pending)}")
        else:
            self._print("connected to the edge")

    def _on_edge_restart(self, pending: int) -> str:
        """Adapt to a restarted edge; return what happens now, for a person. pending: number of keyframes."""
        return f"{pending} keyframes are resent"

    def _on_refused(self, refused: m.Refused) -> None:
        text = self._connection.refuse(refused, self._now_ns)
        is_new_run = self._status_reporter.has_just_begun(self._now_ns, self._connection.silence_limit_ns)
        if self._connection.sessions.session is None and is_new_run:
            self._ended = True
            self._effects.append(FailRun(UsageError(text)))
        else:
            self._print(f"{text}; {self.offline_text}")

    def _on_correction(self, correction: Correction) -> None:
        answered = correction.answered_keyframe
        if not self._were_sent("a correction", correction.segment_keyframe, answered):
            return
        is_of_segment = correction.segment_keyframe >= self._keyframe_chain.first_of_segment
        is_current = self.is_connected and is_of_segment
        if not (is_current and self._connection.sessions.accept_revision(correction.revision)):
            self._counts["corrections_stale"] += 1
            return
        self._counts["corrections"] += 1
        self._self_evaluation.drift.correct(answered)
        entry, corrected_ms = self._ledger.record_correction(answered, self._now_ns)
        if corrected_ms is not None:
            self._self_evaluation.delay.correct(answered, corrected_ms, self._now_ns)
        applied = self._localisation.apply_correction(correction, entry, corrected_ms, self._now_ns)
        self._effects.append(applied)

    def _on_pong(self, pong: m.Pong) -> None:
        if not self._pings.take_answer(pong):
            return
        if pong.session != self._connection.sessions.session:
            self._connection.is_connected = False  # the edge has restarted and does not know us: hello
            return
        self._pings.measure(pong, self._now_ns)
        self._ledger.record_answer(pong.sent_ns)

    # ------------------------------------------------------------ messages to the edge

    def _send_due(self) -> None:
        self._effects += self._connection.check_silence(self._now_ns)
        self._send_status()
        if self.is_connected:
            if (ping := self._pings.due_ping(self._now_ns)) is not None:
                self._send(ping)
            self._send_data()
            if self.makes_keyframes and self._evaluation_timer.fire_if_due(self._now_ns):
                self._send_evaluation(NO_KEYFRAME)
        elif self._connection.is_hello_due(self._now_ns):
            self._send_hello()
        deadline_ns = self._finish_deadline_ns
        if deadline_ns is not None and (self._is_idle or self._now_ns >= deadline_ns):
            self._finish()

    def _send_data(self) -> None:
        if self._pace.is_holding(self._now_ns):
            return
        for entry in self._ledger.take_due(self._now_ns, self._pace.window):
            if entry.attempts == 1:
                self._self_evaluation.delay.mark_sent(entry.keyframe.id, self._now_ns)
                self._send_evaluation(entry.keyframe.id)  # just before: the edge sees what the keyframe takes
            self._send_frames(encode(entry.keyframe), entry.keyframe.id)

    @property
    def _is_idle(self) -> bool:
        """Whether nothing is pending."""
        return not self._ledger.pending

    def _send_hello(self) -> None:
        for frames in self._connection.hello(self._now_ns):
            self._send_frames(frames)

    def _send_status(self) -> None:
        if (report := self._status_reporter.due_report(self._now_ns)) is not None:
            self._effects.append(report)
            if self.is_connected:
                waiting_ns = self._ledger.unacknowledged_for_ns(self._now_ns)
                self._send(with_link(report.status, waiting_ns, self.clock_estimate(self._now_ns)))

    def _finish(self) -> None:
        if self.is_connected:
            self._send(m.Bye())
        self._ended = True
        self._effects.append(ev.CloseLink())

    def _send(self, message: m.UplinkMessage) -> None:
        self._send_frames(encode(message))

    def _send_frames(self, frames: Sequence[Bytes], keyframe: int | None = None) -> None:
        self._counts["bytes_up"] += message_bytes(frames)
        self._effects.append(SendToEdge(frames, keyframe))

    def _on_send_failed(self, effect: SendToEdge | ev.SendFrameToEdge) -> None:
        self._counts["bytes_up"] -= message_bytes(effect.frames)
        if isinstance(effect, SendToEdge) and effect.keyframe_id is not None:
            self._ledger.record_send_failure(effect.keyframe_id)

    def _print(self, text: str) -> None:
        self._effects += self._connection.print(text, self._now_ns)
