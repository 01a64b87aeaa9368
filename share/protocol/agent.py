"""The agent's side of the protocol, without sockets, threads or a clock of its own.

`handle` takes one event and the time, and returns what is to be done. The same events at the same times
give the same effects. Odometry passes through untouched: the edge only moves the map under it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from share.config import Config
from share.errors import UsageError, VersionError, WireError
from share.protocol import agent_events as ev
from share.protocol.agent_ledger import Chain, Entry, Ledger
from share.protocol.agent_status import OwnError, OwnStatus
from share.protocol.edge_clock import ClockClaim, Pings
from share.protocol.edge_trust import Belief, Lines, Lives
from share.protocol.localisation import Whereabouts, pose_update
from share.protocol.streaming import Streaming
from share.protocol.versions import EdgeVersion
from share.rates import Every, TokenBucket, seconds
from share.scheduling.keyframe_value import Worth
from share.types import F64, Candidate, Correction, Keyframe
from share.wire import messages as m
from share.wire.codec import Bytes, decode, encode, size

_COUNTED = (
    *("bytes_up", "bytes_down", "bad_messages", "poses", "candidates", "drop_rate"),
    *("corrections", "corrections_stale"),
)
_BOOKED = ("sent", "resent", "acknowledged", "drop_oldest_acknowledged", "drop_oldest", "bad_acks")
_RECENT = 8  # frames: a candidate is of one of the last few
_LEAST_HZ = 0.1  # keyframes that an edge cannot forbid: without any it would learn of no reason to allow more


class Agent:
    """One run of one agent. `hello` is repeated until an edge welcomes it.

    It is given FrameTracked and KeyframeMade, or where `hello.streams`, FrameArrived.
    """

    def __init__(self, hello: m.Hello, config: Config) -> None:
        link = config.link
        self._config = config
        self._name = hello.name
        self._hello = encode(hello)
        self._chain = Chain()
        self._ledger = Ledger(config.agent, link)
        self._bucket = TokenBucket(config.agent.rate_burst)
        self._worth = Worth()
        self._where = Whereabouts(config.agent)
        self._recent: deque[ev.FrameTracked] = deque(maxlen=_RECENT)
        self._error = OwnError(config.agent.tell_placement)
        self._streaming = Streaming(config.stream) if hello.streams else None
        self._pings = Pings(link, config.clock)
        self._hello_timer = Every(link.hello_s)
        self._status = OwnStatus(link.ping_s, hello.streams)
        self._connected = False
        self._lives = Lives()
        self._refusal: str | None = None  # the edge's last
        self._silent_ns = seconds(link.silent_s)
        self._heard_ns: int | None = None  # or when waiting for the edge began
        self._silence_said = False
        self._edge_version = EdgeVersion()
        self._lines = Lines()
        self._belief = Belief(self._ledger, self._lives, self._lines, self._add_line)
        self._now_ns = 0  # of the newest event
        self._finish_by_ns: int | None = None
        self._ended = False
        self._counts: Counter[str] = Counter()
        self._effects: list[ev.AgentEffect] = []

    def handle(self, event: ev.AgentEvent, now_ns: int) -> list[ev.AgentEffect]:
        """What to do about `event` at `now_ns` (host monotonic clock, never falling)."""
        if isinstance(event, ev.NotTaken):
            self._not_taken(event.sent)
        if self._ended:
            return []
        self._effects, self._now_ns = [], now_ns
        if self._heard_ns is None:
            self._heard_ns = now_ns
        self._status.begin(now_ns)
        match event:
            case ev.FrameTracked():
                self._frame_tracked(event, now_ns)
            case ev.KeyframeMade():
                self._keyframe_made(event.frame, event.candidate, now_ns)
            case ev.FrameArrived() if self._streaming:
                self._status.image_came(event.arrived_ns)
                self._streaming.arrived(event, self._connected)
            case ev.Received():
                self._received(event, now_ns)
            case ev.Finished():
                self._status.over()
                self._finish_by_ns = now_ns + seconds(self._config.agent.finish_s)
            case ev.Connected():  # whether it knows us, its welcome says sooner than a ping's answer
                self._edge_version.reached()
                self._send_hello(now_ns)
            case ev.Tick():
                self._status.ticked(event)
        if not self._ended:
            self._keep_up(now_ns)
        return self._effects

    def unfinished(self) -> list[ev.AgentEffect]:
        """What the newest event had led to before its handling failed."""
        return self._effects

    @property
    def connected(self) -> bool:
        """To an edge that has welcomed it and is not silent."""
        return self._connected

    def report(self) -> dict[str, Any]:
        """Counters and the present state, as plain data."""
        return {
            **{name: self._counts[name] for name in _COUNTED},
            "bad_messages": self._belief.bad_messages,
            **{name: self._ledger.counts[name] for name in _BOOKED},
            **(self._streaming.report() if self._streaming else {}),
            "keyframes": self._chain.next_id,
            "open": self._ledger.open,
            "unacknowledged": self._ledger.unacknowledged,
            "held": self._ledger.held,
            "rate_hz": self._bucket.hz,
            "connected": self._connected,
            "edge_sessions": len(self._lives),
            "map_id": self._where.frame.map_id,
            "revision": self._lives.revision,
            "refusal": self._refusal,
            **self._pings.clock.report(),
        }

    def status(self, now_ns: int) -> m.Status:
        """What it knows of its own state at `now_ns`."""
        return self._status.at(now_ns)

    def clock(self, now_ns: int) -> ClockClaim:
        """What may be said of the edge's clock at `now_ns`."""
        return ClockClaim.of(self._pings.clock, now_ns, self._config.clock.claim_ms)

    # ------------------------------------------------------------ frames

    def _frame_tracked(self, frame: ev.FrameTracked, now_ns: int) -> None:
        self._status.tracked(frame, now_ns)
        self._recent.append(frame)
        if frame.new_stretch:
            self._chain.break_off()
            self._where.break_off()
        if frame.T_odom_body is not None and frame.state.has_pose:
            self._localised(frame, frame.T_odom_body, now_ns)
        if self._streaming or not frame.keyframe:
            self._frame_done(frame, sent=False)

    def _keyframe_made(self, frame: ev.FrameTracked, candidate: Candidate | None, now_ns: int) -> None:
        if candidate is None:
            self._frame_done(replace(frame, keyframe=False), sent=False)
        else:
            self._offer(frame, candidate, now_ns)

    def _offer(self, frame: ev.FrameTracked, candidate: Candidate, now_ns: int) -> None:
        """Makes a keyframe of a candidate that came with `frame`, if the rate allows (drop_rate)."""
        own = self._recent[-1 - candidate.frames_ago]
        self._counts["candidates"] += 1
        self._error.processed((now_ns - frame.arrived_ns) / 1e6)  # a view that is made later delays nobody
        self._chain.extend(candidate)
        sent = self._bucket.take(now_ns, self._worth.is_rather_high(candidate.view))
        if sent:
            keyframe = self._chain.keyframe(candidate, own.stamp_ns)
            self._add(keyframe, own, frame.error_cm, now_ns)
        else:
            self._counts["drop_rate"] += 1
        self._frame_done(frame, sent)

    def _add(self, keyframe: Keyframe, frame: ev.FrameTracked, error_cm: float | None, now_ns: int) -> None:
        """A keyframe made of `frame`, and how wrong odometry is by now, where that is known."""
        self._ledger.add(Entry(keyframe, frame.index, frame.arrived_ns))
        self._error.drift.sent(keyframe, frame.arrived_ns)
        if self._connected and (clock := self._pings.clock).rtt_ms is not None:
            self._send(
                self._error.evaluation(
                    keyframe.id,
                    clock.rtt_ms,
                    error_cm,
                    self._where.T_odom_body,
                    self._where.frame,
                    now_ns,
                )
            )

    def _localised(self, frame: ev.FrameTracked, T_odom_body: F64, now_ns: int) -> None:
        self._effects.append(self._where.localised(frame, T_odom_body, now_ns))
        if self._connected and not self._streaming:
            self._counts["poses"] += 1
            last, first = self._ledger.last_acknowledged, self._chain.first_of_stretch
            self._send(pose_update(frame, T_odom_body, last, first))

    def _frame_done(self, frame: ev.FrameTracked, sent: bool) -> None:
        self._effects.append(ev.FrameDone(frame.stamp_ns, frame.track_ms, frame.state, frame.keyframe, sent))

    # ------------------------------------------------------------ what the edge says

    def _received(self, event: ev.Received, now_ns: int) -> None:
        self._counts["bytes_down"] += size(event.frames)
        try:
            message = self._decode(event.frames)
        except WireError as error:
            self._belief.complain(f"a message from the edge is not understood: {error}", now_ns)
            return
        if message is None:
            return
        self._heard_ns = now_ns
        match message:
            case m.Welcome():
                self._welcomed(message, now_ns)
            case m.Refused():
                self._refused(message, now_ns)
            case m.Ack():
                self._belief.take(message, now_ns)
            case Correction():
                self._corrected(message, now_ns)
            case m.Rate():
                self._bucket.limit(max(message.hz, _LEAST_HZ), now_ns)
            case m.Pong():
                self._ponged(message, now_ns)
            case m.Tracked() if self._streaming:
                self._tracked_afar(message, self._streaming, now_ns)
            case _:
                what = f"a {type(message).__name__}, which is not for this agent"
                self._belief.complain(f"the edge sent {what}", now_ns)

    def _decode(self, frames: Sequence[Bytes]) -> m.Message | None:
        """None for what an edge of an older version says, of which a person is told. Raises WireError."""
        try:
            return decode(frames)
        except VersionError as error:
            if (line := self._edge_version.heard(frames, error)) is not None:
                self._silence_said = True
                self._say(f"{line}; {self._alone}")
            return None

    def _welcomed(self, welcome: m.Welcome, now_ns: int) -> None:
        if not self._belief.welcomes(welcome, now_ns):
            return
        returned, self._connected, self._silence_said = not self._connected, True, False
        self._edge_version.answered()
        if welcome.session != self._lives.session:
            self._new_session(welcome, now_ns)
        elif returned:
            self._ledger.resume(welcome)
            self._say("the edge is back")

    def _new_session(self, welcome: m.Welcome, now_ns: int) -> None:
        again = self._lives.session is not None
        self._lives.begin(welcome.session)
        self._refusal = None
        self._bucket.limit(None, now_ns)
        self._pings.begin()
        held = self._ledger.begin(welcome)
        if again and self._streaming:
            self._streaming.edge_restarted()
            self._say("the edge has restarted; it begins tracking anew")
        elif again:
            self._say(f"the edge has restarted; it is sent {held} keyframes again")
        else:
            self._say("connected to the edge")

    def _refused(self, refused: m.Refused, now_ns: int) -> None:
        self._refusal = "".join(c if c.isprintable() else "?" for c in refused.reason)
        text = f"the edge refuses '{self._name}': {self._refusal}"
        if self._lives.session is None and self._status.has_just_begun(now_ns, self._silent_ns):
            self._ended = True
            self._effects.append(ev.Fail(UsageError(text)))
            return
        self._connected = False
        self._hello_timer.postpone(now_ns + seconds(self._config.link.refused_s))
        self._say(f"{text}; {self._alone}")

    def _corrected(self, correction: Correction, now_ns: int) -> None:
        if not self._belief.corrects(correction, now_ns):
            return
        of_now = self._connected and correction.about >= self._chain.first_of_stretch  # of odometry
        if not (of_now and self._lives.is_newer(correction.revision)):
            self._counts["corrections_stale"] += 1
            return
        self._counts["corrections"] += 1
        self._error.drift.answered(correction.answers)
        entry, corrected_ms = self._ledger.answered(correction.answers, now_ns)
        self._effects.append(self._where.correct(correction, entry, corrected_ms, now_ns))

    def _tracked_afar(self, answer: m.Tracked, streaming: Streaming, now_ns: int) -> None:
        frame = streaming.tracked(answer, now_ns)
        if frame is not None:
            self._effects.append(ev.TrackedAfar(frame, answer.sound, answer.waits))
            self._frame_tracked(frame, now_ns)

    def _ponged(self, pong: m.Pong, now_ns: int) -> None:
        if not self._pings.answers(pong):
            return
        if pong.session != self._lives.session:
            self._connected = False  # the edge has restarted and does not know us: hello
            return
        self._pings.measure(pong, now_ns)

    # ------------------------------------------------------------ what is due

    def _keep_up(self, now_ns: int) -> None:
        self._watch_silence(now_ns)
        self._say_status(now_ns)
        if self._connected:
            if (ping := self._pings.due(now_ns)) is not None:
                self._send(ping)
            for entry in self._ledger.due(now_ns):
                self._send_frames(encode(entry.keyframe), entry.keyframe.id)
            self._send_frame(now_ns)
        elif self._hello_timer.due(now_ns):
            self._send_hello(now_ns)
        if self._finish_by_ns is not None and (self._is_done or now_ns >= self._finish_by_ns):
            self._end()

    @property
    def _is_done(self) -> bool:
        """Nothing is waited for."""
        return not self._ledger.open and (self._streaming is None or self._streaming.is_idle)

    def _send_hello(self, now_ns: int) -> None:
        self._hello_timer.postpone(now_ns + seconds(self._config.link.hello_s))
        self._lives.ask()
        self._send_frames(self._hello)
        for ping in self._edge_version.pings(now_ns):
            self._send_frames(ping)

    def _watch_silence(self, now_ns: int) -> None:
        assert self._heard_ns is not None
        if now_ns - self._heard_ns <= self._silent_ns:
            return
        self._connected = False
        if not self._silence_said:
            self._silence_said = True
            gone = "the edge is silent" if self._lives.session is not None else "no edge answers yet"
            self._say(f"{gone}; {self._alone}")

    def _say_status(self, now_ns: int) -> None:
        if (said := self._status.due(now_ns)) is not None:
            self._effects.append(said)
            if self._connected:
                self._send(said.status)

    def _send_frame(self, now_ns: int) -> None:
        frame = None if self._streaming is None else self._streaming.next(now_ns)
        if frame is not None:
            frames = encode(frame)
            self._counts["bytes_up"] += size(frames)
            self._effects.append(ev.SendFrame(frame.index, frames))

    def _end(self) -> None:
        if self._connected:
            self._send(m.Bye())
        self._ended = True
        self._effects.append(ev.Stop())

    def _send(self, message: m.Up) -> None:
        self._send_frames(encode(message))

    def _send_frames(self, frames: Any, keyframe: int | None = None) -> None:
        self._counts["bytes_up"] += size(frames)
        self._effects.append(ev.Send(frames, keyframe))

    def _not_taken(self, sent: ev.Send | ev.SendFrame) -> None:
        self._counts["bytes_up"] -= size(sent.frames)
        if isinstance(sent, ev.SendFrame):
            if self._streaming is not None:
                self._streaming.not_taken(sent.index)
        elif sent.keyframe is not None:
            self._ledger.not_taken(sent.keyframe)

    @property
    def _alone(self) -> str:
        return "nobody tracks this agent" if self._streaming else "tracking goes on alone"

    def _say(self, text: str) -> None:
        if (line := self._lines.say(text, self._now_ns)) is not None:
            self._add_line(line)

    def _add_line(self, line: str) -> None:
        self._effects.append(ev.Say(line))
