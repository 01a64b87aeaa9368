"""An agent as a process: three threads and two bounded queues round the state machine of `core.agent`.

    reader: decode, wait until the sensor would have delivered -> tracker: pose, then keyframe
        -> main: the machine, the link, the files

A live camera has no reader: the tracker takes what is newest (`run.arrivals`).

A recording is played at its own pace and no frame of it is dropped: the reader waits when the tracker
is behind (policy `block`), while a frame still counts as arrived when it was due. So the poses of a
recording are the same to the last digit on any machine, with an edge or without, and lateness shows
in the latency, where it belongs. With `agent.late_ms` the loop holds its rate instead (policy `drop_late`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from share import __version__, config
from share.cameras.live import LiveSource
from share.errors import DataError
from share.metrics.frame_log import RunLog
from share.net.transport import AgentLink
from share.odometry.result import TrackResult
from share.plain_data import to_mapping
from share.protocol import agent_events as ev
from share.protocol.agent import Agent
from share.protocol.edge_trust import Lasting
from share.runtime.agent_files import AgentFiles
from share.runtime.arrivals import Arrivals, Late, Lateness, Played, Seen
from share.runtime.error_model import Errors, Unknown
from share.runtime.guarded_tracker import Guard, GuardedTracker
from share.runtime.imu_memory import ImuMemory
from share.runtime.pipeline import check_trackable, frames_of
from share.runtime.pose_feed import PoseFeed
from share.runtime.scribe import Scribe, Written
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters
from share.startup import Heap
from share.types import Frame
from share.wire import messages as m

TICK_MS = 50
_POSTED = 64  # events between tracker and main: policy block, as the camera keeps the newest of what waits
_AT_ONCE = 64  # messages of the edge in one tick: more wait in the link, so that no flood takes the processor
_OVERDUE_S = 5.0  # beyond agent.finish_s: the machine should have ended the run


@dataclass(frozen=True, eq=False)
class Status:
    """For the live line. idle: no frame was tracked of late."""

    frames: int
    state: str
    report: Callable[[], dict[str, Any]]
    idle: bool = False


@dataclass
class _Shared:
    """What the threads tell each other."""

    inbox: queue.Queue[ev.AgentEvent] = field(default_factory=lambda: queue.Queue(_POSTED))
    stop: threading.Event = field(default_factory=threading.Event)
    closed: threading.Event = field(default_factory=threading.Event)  # nobody takes from the inbox any more
    error: BaseException | None = None  # what ended a thread


class AgentRun:
    """One run: `go` returns when the recording is over and everything is acknowledged and written.

    A damaged image costs its frame; a recording that cannot be read on ends the run in good order,
    and then raises.
    """

    def __init__(
        self,
        source: Source,
        hello: m.Hello,
        settings: config.Config,
        connect: Callable[[], AgentLink],
        out: Path | None,
        say: Callable[[str], None],
        show: Callable[[Status], None] = lambda status: None,
        verbose: bool = False,
        errors: Errors | None = None,
        poses: PoseFeed | None = None,
    ) -> None:
        """errors: tells how wrong the tracker is. poses: who else is told where this agent is."""
        self._source, self._settings = source, settings
        self._say, self._show, self._verbose = say, show, verbose
        self._guard = Guard(say)
        self._machine = Agent(hello, settings)
        self._memory: ImuMemory | None = None  # of who tracks itself
        self._prepare()
        self._files, self._scribe = AgentFiles(out, say), Scribe(out, say)
        self._log = RunLog(Written(self._files.frames, self._scribe))
        self._errors, self._poses = Unknown() if errors is None else errors, poses
        self._late = Late(settings.agent.late_ms)
        self._lateness = Lateness(say, "the edge" if hello.streams else "this machine")
        self._counters = SequencerCounters()
        self._link = connect()  # last: whatever is wrong with the above has been said by now
        self._shared = _Shared()
        self._arrivals = self._make_arrivals()
        self._damaged = 0
        self._ended = False
        self._tick_ns = 0  # when the present tick ends
        self._received = 0  # messages in it
        self._over_ns: int | None = None  # when the last frame was done
        self.report: dict[str, Any] = {}
        self._troubles = Lasting()
        self.trouble: str | None = None  # why the edge does not let this agent in

    def _prepare(self) -> None:
        """Raises what is wrong with the source before there is a link."""
        check_trackable(self._source.name, self._source.rig)
        self._memory = ImuMemory(self._source, self._settings.inertial, self._say)
        self._tracker = GuardedTracker(self._source.rig, self._settings, self._guard, self._memory.bias)

    def stop(self) -> None:
        """End early, in good order: no more frames, but what was sent is still waited for."""
        self._shared.stop.set()
        self._arrivals.stop()

    def go(self) -> None:
        """Raises what ended the run before its time, after everything was closed."""
        tracker = threading.Thread(target=self._track, name="tracker", daemon=True)
        tracker.start()
        try:
            self._loop()
            self.report = self._report()
            self._scribe.do(partial(self._files.finish, self._log, self.report))
        finally:
            self.stop()
            self._shared.closed.set()
            self._scribe.do(self._files.release)
            self._link.close()
            if self._poses is not None:
                self._poses.close()
            tracker.join(timeout=4)
            if self._memory is not None:
                self._scribe.do(partial(self._memory.keep, self._tracker.bias))
            self._errors.close()
            self._scribe.end()
        self._scribe.check()
        if self._shared.error is not None:
            raise self._shared.error

    # ------------------------------------------------------------------ frames

    def _make_arrivals(self) -> Arrivals:
        if isinstance(self._source, LiveSource):
            return Seen(self._decoded, self._source)
        return Played(self._decoded, self._late)

    def _decoded(self) -> Iterator[Frame]:
        return frames_of(
            self._source, self._settings, self._counters, self._skip_damaged, self._log.add_decode, self._say
        )

    def _skip_damaged(self, error: DataError) -> None:
        self._damaged += 1
        self._say(f"a frame is left out: {error}")

    # ------------------------------------------------------------------ tracker

    def _track(self) -> None:
        try:
            for frame, arrived_ns in self._arrivals.each():
                self._track_one(frame, arrived_ns)
        except BaseException as error:
            self._shared.error = error
        finally:
            self._post(ev.Finished())

    def _track_one(self, frame: Frame, arrived_ns: int) -> None:
        cpu = time.thread_time()
        result = self._tracker.track(frame)
        tracked = ev.FrameTracked(
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            arrived_ns=arrived_ns,
            done_ns=time.monotonic_ns(),
            state=result.state,
            T_odom_body=result.T_odom_body,
            keyframe=result.keyframe,
            new_stretch=result.new_stretch,
            error_cm=self._error_cm(frame, result),
            waits=result.waits,
        )
        self._post(tracked)  # the pose goes out before others are served
        self._log.add_result(result.new_stretch, result.sound, result.waits)
        if result.keyframe:
            self._keyframe(frame, tracked)
        self._tracker.attempt("settling a frame", frame, self._tracker.settle)
        self._log.imu_doubted = self._tracker.doubted
        self._log.cpu_s += time.thread_time() - cpu

    def _error_cm(self, frame: Frame, result: TrackResult) -> float | None:
        error_cm: float | None = None
        with self._guard.step("estimating the error"):
            error_cm = self._errors.after(frame, result)
        return error_cm

    def _keyframe(self, frame: Frame, tracked: ev.FrameTracked) -> None:
        make = partial(self._errors.keyframe, frame, self._tracker)
        candidate = self._tracker.attempt("making a keyframe", frame, make)
        self._post(ev.KeyframeMade(tracked, candidate))

    def _post(self, event: ev.AgentEvent) -> None:
        """Waits for room, as long as anybody takes what is posted."""
        while not self._shared.closed.is_set():
            try:
                self._shared.inbox.put(event, timeout=0.1)
                break
            except queue.Full:
                continue
        self._link.wake()

    # ------------------------------------------------------------------ main

    def _loop(self) -> None:
        heap = Heap()
        while not self._ended and not self._is_overdue():
            heap.tidy(time.monotonic())
            self._listen()
            while not self._shared.inbox.empty():
                self._take(self._shared.inbox.get())
            self._handle(self._arrivals.tick())

    def _listen(self) -> None:
        """One message of the edge, or what the tracker posts, or the end of the tick."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._tick_ns:
            self._tick_ns, self._received = now_ns + TICK_MS * 1_000_000, 0
        if self._received >= _AT_ONCE:
            with contextlib.suppress(queue.Empty):
                self._take(self._shared.inbox.get(timeout=(self._tick_ns - now_ns) * 1e-9))
            return
        frames = self._link.receive(TICK_MS)
        self._say_trouble()
        if self._link.connected():
            self._handle(ev.Connected())
        if frames is not None:
            self._received += 1
            self._handle(ev.Received(frames))

    def _take(self, event: ev.AgentEvent) -> None:
        if isinstance(event, ev.Finished):
            self._over_ns = time.monotonic_ns()
        self._handle(event)

    def _is_overdue(self) -> bool:
        """Whether the machine should have ended the run long ago."""
        patience_s = self._settings.agent.finish_s + _OVERDUE_S
        return self._over_ns is not None and time.monotonic_ns() - self._over_ns > patience_s * 1e9

    def _say_trouble(self) -> None:
        self.trouble = self._link.trouble()
        if self.trouble is not None and self._troubles.begins(self.trouble, time.monotonic_ns()):
            self._say(self.trouble)

    def _handle(self, event: ev.AgentEvent) -> None:
        """One guarded step: what fails costs this event, and never the run."""
        try:
            effects = self._machine.handle(event, time.monotonic_ns())
        except Exception as error:
            self._guard.note(f"handling {type(event).__name__}", error)
            effects = self._machine.unfinished()
        for effect in effects:
            with self._guard.step(f"carrying out {type(effect).__name__}"):
                self._carry_out(effect)

    def _carry_out(self, effect: ev.AgentEffect) -> None:
        match effect:
            case ev.Send():
                if not self._link.send(effect.frames):
                    self._handle(ev.NotTaken(effect))
            case ev.Localised():
                self._localised(effect)
            case ev.FrameDone():
                if self._poses is not None and not effect.state.has_pose:
                    self._poses.tell(effect.stamp_ns, effect.state)
                self._lateness.done(effect.track_ms)
                self._log.add(effect.stamp_ns, effect.track_ms, effect.state, effect.keyframe, effect.sent)
                self._show_status(self._machine.status(time.monotonic_ns()))
            case ev.StatusSaid() if effect.idle:
                self._say_idle(effect)
            case ev.CorrectionApplied():
                if effect.stamp_ns is not None and effect.corrected_ms is not None:
                    self._log.mark_corrected(effect.stamp_ns, effect.corrected_ms)
                if self._verbose:
                    self._say(_correction(effect))
            case ev.Say():
                self._say(effect.text)
            case ev.Fail():
                self._scribe.do(self._files.discard)
                raise effect.error
            case ev.Stop():
                self._ended = True

    def _localised(self, at: ev.Localised) -> None:
        T_map_body = None if at.T_map_odom is None or at.map_id is None else at.T_map_odom @ at.T_odom_body
        if self._poses is not None:  # first: somebody waits for it
            age_ms = (time.monotonic_ns() - at.arrived_ns) / 1e6
            self._poses.tell(at.stamp_ns, at.state, age_ms, at.stretch, at.T_odom_body, T_map_body, at.map_id)
        self._scribe.do(partial(self._files.odom, at.stamp_ns, at.T_odom_body))
        if T_map_body is not None and at.map_id is not None:
            self._scribe.do(partial(self._files.map, at.stamp_ns, T_map_body, at.map_id))

    def _say_idle(self, said: ev.StatusSaid) -> None:
        """No frame says it: the pose that was told last is not where the agent is now."""
        if self._poses is not None and said.stamp_ns is not None:
            self._poses.tell(said.stamp_ns, said.status.state, said.status.pose_age_ms)
        self._show_status(said.status, idle=True)

    def _show_status(self, status: m.Status, idle: bool = False) -> None:
        state = f"{status.state}, {status.reason}," if status.reason else str(status.state)
        self._show(Status(len(self._log), state, self._machine.report, idle))

    def _report(self) -> dict[str, Any]:
        protocol = self._machine.report()
        frames = self._log.report()
        return {
            **frames,
            "corrections": protocol["corrections"],
            "bytes_up": protocol["bytes_up"],
            "bytes_down": protocol["bytes_down"],
            "damaged_images": self._damaged,
            "failed_steps": self._guard.failed,
            "left_out": self._source.losses.counts,
            "drop_late": self._late.dropped,
            **self._lateness.report(),
            **self._source.report(),
            **({} if self._memory is None else self._memory.report()),
            **self._errors.report(),
            "sequencer": dataclasses.asdict(self._counters),
            "clock": self._machine.clock(time.monotonic_ns()).report(),
            "protocol": protocol,
            "version": __version__,
            "config": to_mapping(self._settings),
        }


def _correction(effect: ev.CorrectionApplied) -> str:
    after = "" if effect.corrected_ms is None else f", {effect.corrected_ms:.0f} ms after its frame"
    answers = "" if effect.keyframe is None else f", answers keyframe {effect.keyframe}{after}"
    return f"correction {effect.revision} of map {effect.map_id}{answers}"
