"""The agent's side of the protocol as a state machine, without sockets, threads or clock.

`Agent.handle` takes one event and the time and returns effects, deterministically. Odometry passes through
unchanged: the edge only moves the map under it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from share.config import Config
from share.errors import UsageError, VersionError, WireError
from share.protocol import agent_events as ev
from share.protocol.agent_ledger import KeyframeChain, KeyframeLedger, LedgerEntry
from share.protocol.agent_status import SelfEvaluation, StatusReporter
from share.protocol.edge_clock import ClockEstimate, PingTracker
from share.protocol.localisation import MapLocalisation, pose_update
from share.protocol.reply_validation import EdgeSessions, LineLimiter, ReplyValidator
from share.protocol.streaming import FrameStreamer
from share.protocol.versions import EdgeVersionProbe
from share.scheduling.keyframe_score import KeyframeScore
from share.timing import PeriodicTimer, TokenBucket, seconds_to_ns
from share.types import F64, Correction, Keyframe, KeyframeCandidate
from share.wire import messages as m
from share.wire.codec import Bytes, decode, encode, message_bytes

_COUNTERS = (
    *("bytes_up", "bytes_down", "bad_messages", "poses", "candidates", "drop_rate"),
    *("corrections", "corrections_stale"),
)
_LEDGER_COUNTERS = ("sent", "resent", "acknowledged", "drop_oldest_acknowledged", "drop_oldest", "bad_acks")
_RECENT_FRAMES = 8  # frames among which a candidate's own is found
_MIN_RATE_HZ = (
    0.1  # keyframe rate that an edge cannot undercut: without keyframes it could not evaluate again
)


class Agent:
    """One run of one agent. `hello` is repeated until an edge welcomes it.

    It takes `FrameTracked` and `KeyframeMade`, or `FrameArrived` where `hello.streams_frames`.
    """

    def __init__(self, hello: m.Hello, config: Config) -> None:
        link = config.link
        self._config = config
        self._name = hello.name
        self._hello = encode(hello)
        self._keyframe_chain = KeyframeChain()
        self._ledger = KeyframeLedger(config.agent, link)
        self._bucket = TokenBucket(config.agent.rate_burst)
        self._keyframe_score = KeyframeScore()
        self._localisation = MapLocalisation(config.agent)
        self._recent_frames: deque[ev.FrameTracked] = deque(maxlen=_RECENT_FRAMES)
        self._self_evaluation = SelfEvaluation(config.agent.tell_placement)
        self._streamer = FrameStreamer(config.stream) if hello.streams_frames else None
        self._pings = PingTracker(link, config.clock)
        self._hello_timer = PeriodicTimer(link.hello_s)
        self._status_reporter = StatusReporter(link.ping_s, hello.streams_frames)
        self._is_connected = False
        self._sessions = EdgeSessions()
        self._refusal: str | None = None  # last reason that the edge gave
        self._silence_limit_ns = seconds_to_ns(link.silent_s)
        self._last_received_ns: int | None = None  # or the first event
        self._silence_reported = False
        self._version_probe = EdgeVersionProbe()
        self._line_limiter = LineLimiter()
        self._validator = ReplyValidator(self._ledger, self._sessions, self._line_limiter, self._print_line)
        self._now_ns = 0  # of the newest event
        self._finish_deadline_ns: int | None = None
        self._ended = False
        self._counts: Counter[str] = Counter()
        self._effects: list[ev.AgentEffect] = []

    def handle(self, event: ev.AgentEvent, now_ns: int) -> list[ev.AgentEffect]:
        """Return the effects of `event` at `now_ns` (host monotonic clock, never falling)."""
        if isinstance(event, ev.SendFailed):
            self._on_send_failed(event.effect)
        if self._ended:
            return []
        self._effects, self._now_ns = [], now_ns
        if self._last_received_ns is None:
            self._last_received_ns = now_ns
        self._status_reporter.begin(now_ns)
        match event:
            case ev.FrameTracked():
                self._on_frame_tracked(event, now_ns)
            case ev.KeyframeMade():
                self._on_keyframe_made(event.frame, event.candidate, now_ns)
            case ev.FrameArrived() if self._streamer:
                self._status_reporter.add_image(event.arrived_ns)
                self._streamer.add_frame(event, self._is_connected)
            case ev.EdgeMessageReceived():
                self._on_received(event, now_ns)
            case ev.InputFinished():
                self._status_reporter.finish()
                self._finish_deadline_ns = now_ns + seconds_to_ns(self._config.agent.finish_s)
            case ev.Connected():  # a welcome tells sooner than a pong whether this edge knows us
                self._version_probe.mark_reached()
                self._send_hello(now_ns)
            case ev.AgentTick():
                self._status_reporter.add_tick(event)
        if not self._ended:
            self._send_due(now_ns)
        return self._effects

    def pending_effects(self) -> list[ev.AgentEffect]:
        """Return the effects of the newest event up to where its handling failed."""
        return self._effects

    @property
    def is_connected(self) -> bool:
        """Whether an edge has welcomed it and is not silent."""
        return self._is_connected

    def report(self) -> dict[str, Any]:
        """Return counters and the present state as plain data."""
        return {
            **{name: self._counts[name] for name in _COUNTERS},
            "bad_messages": self._validator.bad_messages,
            **{name: self._ledger.counts[name] for name in _LEDGER_COUNTERS},
            **(self._streamer.report() if self._streamer else {}),
            "keyframes": self._keyframe_chain.next_id,
            "open": self._ledger.pending,
            "unacknowledged": self._ledger.unacknowledged,
            "held": self._ledger.buffered_at_edge,
            "rate_hz": self._bucket.hz,
            "connected": self._is_connected,
            "edge_sessions": len(self._sessions),
            "map_id": self._localisation.map_frame.map_id,
            "revision": self._sessions.revision,
            "refusal": self._refusal,
            **self._pings.clock.report(),
        }

    def status(self, now_ns: int) -> m.Status:
        """Return the agent's status at `now_ns`."""
        return self._status_reporter.status(now_ns)

    def clock_estimate(self, now_ns: int) -> ClockEstimate:
        """Return the estimate of the edge's clock at `now_ns`."""
        return ClockEstimate.from_filter(self._pings.clock, now_ns, self._config.clock.claim_ms)

    # ------------------------------------------------------------ frames

    def _on_frame_tracked(self, frame: ev.FrameTracked, now_ns: int) -> None:
        self._status_reporter.add_frame(frame, now_ns)
        self._recent_frames.append(frame)
        if frame.new_segment:
            self._keyframe_chain.begin_segment()
            self._localisation.begin_segment()
        if frame.T_odom_body is not None and frame.state.has_pose:
            self._publish_localisation(frame, frame.T_odom_body, now_ns)
        if self._streamer or not frame.is_keyframe:
            self._finish_frame(frame, sent=False)

    def _on_keyframe_made(
        self, frame: ev.FrameTracked, candidate: KeyframeCandidate | None, now_ns: int
    ) -> None:
        if candidate is None:
            self._finish_frame(replace(frame, is_keyframe=False), sent=False)
        else:
            self._offer_candidate(frame, candidate, now_ns)

    def _offer_candidate(self, frame: ev.FrameTracked, candidate: KeyframeCandidate, now_ns: int) -> None:
        """Make a keyframe of the candidate that came with `frame`, if the rate allows (else drop_rate)."""
        source_frame = self._recent_frames[-1 - candidate.frames_ago]
        self._counts["candidates"] += 1
        # since the newest frame: extracting the view of an earlier frame delays no pose
        self._self_evaluation.add_processing_time((now_ns - frame.arrived_ns) / 1e6)
        self._keyframe_chain.extend(candidate)
        sent = self._bucket.take(now_ns, self._keyframe_score.is_above_median(candidate.view))
        if sent:
            keyframe = self._keyframe_chain.make_keyframe(candidate, source_frame.stamp_ns)
            self._add_keyframe(keyframe, source_frame, frame.error_cm, now_ns)
        else:
            self._counts["drop_rate"] += 1
        self._finish_frame(frame, sent)

    def _add_keyframe(
        self, keyframe: Keyframe, frame: ev.FrameTracked, error_cm: float | None, now_ns: int
    ) -> None:
        """Queue a keyframe of `frame` and send its evaluation. error_cm: expected error now; None:
        unknown."""
        self._ledger.add(LedgerEntry(keyframe, frame.index, frame.arrived_ns))
        self._self_evaluation.drift.add_keyframe(keyframe, frame.arrived_ns)
        if self._is_connected and (clock := self._pings.clock).rtt_ms is not None:
            self._send(
                self._self_evaluation.evaluation(
                    keyframe.id,
                    clock.rtt_ms,
                    error_cm,
                    self._localisation.T_odom_body,
                    self._localisation.map_frame,
                    now_ns,
                )
            )

    def _publish_localisation(self, frame: ev.FrameTracked, T_odom_body: F64, now_ns: int) -> None:
        self._effects.append(self._localisation.localise(frame, T_odom_body, now_ns))
        if self._is_connected and not self._streamer:
            self._counts["poses"] += 1
            last, first = self._ledger.last_acknowledged, self._keyframe_chain.first_of_segment
            self._send(pose_update(frame, T_odom_body, last, first))

    def _finish_frame(self, frame: ev.FrameTracked, sent: bool) -> None:
        self._effects.append(
            ev.FrameDone(frame.stamp_ns, frame.track_ms, frame.state, frame.is_keyframe, sent)
        )

    # ------------------------------------------------------------ messages from the edge

    def _on_received(self, event: ev.EdgeMessageReceived, now_ns: int) -> None:
        self._counts["bytes_down"] += message_bytes(event.frames)
        try:
            message = self._decode(event.frames)
        except WireError as error:
            self._validator.report_invalid(f"invalid message from the edge: {error}", now_ns)
            return
        if message is None:
            return
        self._last_received_ns = now_ns
        match message:
            case m.Welcome():
                self._on_welcome(message, now_ns)
            case m.Refused():
                self._on_refused(message, now_ns)
            case m.Ack():
                self._validator.take_ack(message, now_ns)
            case Correction():
                self._on_correction(message, now_ns)
            case m.Rate():
                self._bucket.set_rate(max(message.hz, _MIN_RATE_HZ), now_ns)
            case m.Pong():
                self._on_pong(message, now_ns)
            case m.RemoteTrackingResult() if self._streamer:
                self._on_remote_result(message, self._streamer, now_ns)
            case _:
                description = f"a {type(message).__name__}, which this agent does not expect"
                self._validator.report_invalid(f"the edge sent {description}", now_ns)

    def _decode(self, frames: Sequence[Bytes]) -> m.Message | None:
        """Decode a message. Print a line and return None for an edge of an older version. Raises
        WireError."""
        try:
            return decode(frames)
        except VersionError as error:
            if (line := self._version_probe.check_message(frames, error)) is not None:
                self._silence_reported = True
                self._print(f"{line}; {self._offline_text}")
            return None

    def _on_welcome(self, welcome: m.Welcome, now_ns: int) -> None:
        if not self._validator.accepts_welcome(welcome, now_ns):
            return
        was_disconnected, self._is_connected, self._silence_reported = not self._is_connected, True, False
        self._version_probe.mark_answered()
        if welcome.session != self._sessions.session:
            self._begin_session(welcome, now_ns)
        elif was_disconnected:
            self._ledger.resume(welcome)
            self._print("reconnected to the edge")

    def _begin_session(self, welcome: m.Welcome, now_ns: int) -> None:
        is_restart = self._sessions.session is not None
        self._sessions.begin(welcome.session)
        self._refusal = None
        self._bucket.set_rate(None, now_ns)
        self._pings.begin_session()
        pending = self._ledger.begin_session(welcome)
        if is_restart and self._streamer:
            self._streamer.reset()
            self._print("the edge has restarted; tracking starts again")
        elif is_restart:
            self._print(f"the edge has restarted; {pending} keyframes are resent")
        else:
            self._print("connected to the edge")

    def _on_refused(self, refused: m.Refused, now_ns: int) -> None:
        self._refusal = "".join(c if c.isprintable() else "?" for c in refused.reason)
        text = f"the edge refuses '{self._name}': {self._refusal}"
        if self._sessions.session is None and self._status_reporter.has_just_begun(
            now_ns, self._silence_limit_ns
        ):
            self._ended = True
            self._effects.append(ev.FailRun(UsageError(text)))
            return
        self._is_connected = False
        self._hello_timer.postpone(now_ns + seconds_to_ns(self._config.link.refused_s))
        self._print(f"{text}; {self._offline_text}")

    def _on_correction(self, correction: Correction, now_ns: int) -> None:
        if not self._validator.accepts_correction(correction, now_ns):
            return
        is_current = (
            self._is_connected and correction.segment_keyframe >= self._keyframe_chain.first_of_segment
        )
        if not (is_current and self._sessions.accept_revision(correction.revision)):
            self._counts["corrections_stale"] += 1
            return
        self._counts["corrections"] += 1
        self._self_evaluation.drift.correct(correction.answered_keyframe)
        entry, corrected_ms = self._ledger.record_correction(correction.answered_keyframe, now_ns)
        self._effects.append(self._localisation.apply_correction(correction, entry, corrected_ms, now_ns))

    def _on_remote_result(self, result: m.RemoteTrackingResult, streamer: FrameStreamer, now_ns: int) -> None:
        frame = streamer.take_result(result, now_ns)
        if frame is not None:
            self._effects.append(ev.FrameTrackedRemotely(frame, result.is_consistent, result.waiting_for))
            self._on_frame_tracked(frame, now_ns)

    def _on_pong(self, pong: m.Pong, now_ns: int) -> None:
        if not self._pings.take_answer(pong):
            return
        if pong.session != self._sessions.session:
            self._is_connected = False  # the edge has restarted and does not know us: hello
            return
        self._pings.measure(pong, now_ns)

    # ------------------------------------------------------------ messages to the edge

    def _send_due(self, now_ns: int) -> None:
        self._check_silence(now_ns)
        self._send_status(now_ns)
        if self._is_connected:
            if (ping := self._pings.due_ping(now_ns)) is not None:
                self._send(ping)
            for entry in self._ledger.take_due(now_ns):
                self._send_frames(encode(entry.keyframe), entry.keyframe.id)
            self._send_frame(now_ns)
        elif self._hello_timer.fire_if_due(now_ns):
            self._send_hello(now_ns)
        if self._finish_deadline_ns is not None and (self._is_done or now_ns >= self._finish_deadline_ns):
            self._finish()

    @property
    def _is_done(self) -> bool:
        """Whether nothing is pending."""
        return not self._ledger.pending and (self._streamer is None or self._streamer.is_idle)

    def _send_hello(self, now_ns: int) -> None:
        self._hello_timer.postpone(now_ns + seconds_to_ns(self._config.link.hello_s))
        self._sessions.expect_welcome()
        self._send_frames(self._hello)
        for ping in self._version_probe.pings(now_ns):
            self._send_frames(ping)

    def _check_silence(self, now_ns: int) -> None:
        assert self._last_received_ns is not None
        if now_ns - self._last_received_ns <= self._silence_limit_ns:
            return
        self._is_connected = False
        if not self._silence_reported:
            self._silence_reported = True
            problem = "the edge is silent" if self._sessions.session is not None else "no edge answers yet"
            self._print(f"{problem}; {self._offline_text}")

    def _send_status(self, now_ns: int) -> None:
        if (report := self._status_reporter.due_report(now_ns)) is not None:
            self._effects.append(report)
            if self._is_connected:
                self._send(report.status)

    def _send_frame(self, now_ns: int) -> None:
        frame = None if self._streamer is None else self._streamer.next_frame(now_ns)
        if frame is not None:
            frames = encode(frame)
            self._counts["bytes_up"] += message_bytes(frames)
            self._effects.append(ev.SendFrameToEdge(frame.index, frames))

    def _finish(self) -> None:
        if self._is_connected:
            self._send(m.Bye())
        self._ended = True
        self._effects.append(ev.CloseLink())

    def _send(self, message: m.UplinkMessage) -> None:
        self._send_frames(encode(message))

    def _send_frames(self, frames: Any, keyframe: int | None = None) -> None:
        self._counts["bytes_up"] += message_bytes(frames)
        self._effects.append(ev.SendToEdge(frames, keyframe))

    def _on_send_failed(self, effect: ev.SendToEdge | ev.SendFrameToEdge) -> None:
        self._counts["bytes_up"] -= message_bytes(effect.frames)
        if isinstance(effect, ev.SendFrameToEdge):
            if self._streamer is not None:
                self._streamer.cancel(effect.index)
        elif effect.keyframe_id is not None:
            self._ledger.record_send_failure(effect.keyframe_id)

    @property
    def _offline_text(self) -> str:
        return "no tracking without the edge" if self._streamer else "tracking continues without the edge"

    def _print(self, text: str) -> None:
        if (line := self._line_limiter.admit(text, self._now_ns)) is not None:
            self._print_line(line)

    def _print_line(self, line: str) -> None:
        self._effects.append(ev.PrintLine(line))
