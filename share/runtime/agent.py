"""The agent process: three threads and two bounded queues around the state machine `share.protocol.agent`.

    reader: decode, wait until the frame is due -> tracker: pose, then keyframe (`frame_consumers`)
        -> main: state machine, link, files

A live camera has no reader thread: the tracker takes the newest frame (`share.runtime.arrivals`).

A recording is played at its recorded pace: the reader waits when the tracker is behind (policy `block`),
while a frame still counts as arrived when it was due. So the poses of a robot's recording are the same to the
last digit on any machine, with or without an edge, and lateness shows in the latency. A headset's are where
the machine keeps up: what is later than `agent.late_ms` gets a predicted pose instead (policy `drop_late`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from share import __version__, config
from share.cameras.live import LiveSource
from share.errors import DataError
from share.metrics.frame_log import RunLog
from share.net.transport import AgentLink
from share.plain_data import to_mapping
from share.protocol import agent_events as ev
from share.protocol.agent import AgentProtocol
from share.protocol.agent_health import LIMITS
from share.protocol.common_events import Connected, EdgeMessageReceived, FailRun, PrintLine, SendToEdge
from share.protocol.streaming import StreamingAgent
from share.runtime.arrivals import (
    FrameArrivals,
    LateFrameDropper,
    LatenessMonitor,
    LiveArrivals,
    RecordedArrivals,
    late_limit_ms,
)
from share.runtime.error_estimators import ErrorEstimator, NoErrorEstimate
from share.runtime.fault_guard import FaultGuard
from share.runtime.frame_consumers import FrameConsumer, LocalTracking, RemoteTracking
from share.runtime.output_writer import OutputWriter
from share.runtime.pipeline import check_trackable, read_frames
from share.runtime.pose import PoseSink, localised_pose
from share.runtime.run_files import AgentFiles, BackgroundLines
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters
from share.startup import HeapTrimmer
from share.timing import LineLimiter
from share.types import Frame
from share.wire import messages as m

TICK_MS = 50
# Events between tracker and main. Policy block: a live camera's own queue keeps the newest images.
_INBOX_SIZE = 64
_MAX_MESSAGES_PER_TICK = 64  # from the edge; the rest waits in the link: a flood cannot use up the CPU
_OVERDUE_MARGIN_S = 5.0  # after agent.finish_s: by then the state machine should have ended the run


@dataclass(frozen=True, eq=False)
class LiveStatus:
    """Contents of the live line. idle: no frame was tracked recently."""

    frames: int
    state: str
    report: Callable[[], dict[str, Any]]
    idle: bool = False


@dataclass
class _ThreadState:
    """State shared by the threads."""

    inbox: queue.Queue[ev.AgentEvent] = field(default_factory=lambda: queue.Queue(_INBOX_SIZE))
    stop: threading.Event = field(default_factory=threading.Event)
    closed: threading.Event = field(default_factory=threading.Event)  # the inbox is no longer read
    error: BaseException | None = None  # that ended a thread


class AgentRun:
    """One run of an agent. `run` returns when the recording is over and all is acknowledged and written.

    A damaged image costs its frame. A recording that becomes unreadable ends the run cleanly; then `run`
    raises.
    """

    def __init__(
        self,
        source: Source,
        hello: m.Hello,
        settings: config.Config,
        connect: Callable[[], AgentLink],
        out: Path | None,
        notify: Callable[[str], None],
        show: Callable[[LiveStatus], None] = lambda status: None,
        verbose: bool = False,
        error_estimator: ErrorEstimator | None = None,
        pose_sinks: Sequence[PoseSink] = (),
    ) -> None:
        """error_estimator: estimates the tracking error of keyframes. pose_sinks: get every
        pose, and are closed at the end."""
        self._source, self._settings = source, settings
        self._notify, self._show, self._verbose = notify, show, verbose
        self._guard = FaultGuard(notify)
        self._state_machine = (StreamingAgent if hello.streams_frames else AgentProtocol)(hello, settings)
        check_trackable(source.name, source.rig)  # before files are made and the edge sees this agent
        self._shared = _ThreadState()
        self._files, self._output_writer = AgentFiles(out, notify), OutputWriter(out, notify)
        self._log = RunLog(BackgroundLines(self._files.frame_lines, self._output_writer))
        estimator = NoErrorEstimate() if error_estimator is None else error_estimator
        self._consumer: FrameConsumer = (
            RemoteTracking(source, settings, self._log, self._shared.stop, notify)
            if hello.streams_frames
            else LocalTracking(source, settings, self._guard, estimator, self._log, notify)
        )
        self._pose_sinks = pose_sinks
        self._late_dropper = LateFrameDropper(late_limit_ms(settings.agent.late_ms, hello))
        tolerated_ms = LIMITS[hello.kind].pose_ms
        self._lateness_monitor = LatenessMonitor(notify, self._consumer.bottleneck, tolerated_ms)
        self._counters = SequencerCounters()
        self._link = connect()  # last: any error above is raised before the edge sees this agent
        self._arrivals = self._make_arrivals()
        self._damaged_images = 0
        self._ended = False
        self._tick_end_ns = 0
        self._messages_in_tick = 0
        self._finished_ns: int | None = None  # when the input ended
        self.report: dict[str, Any] = {}
        self._trouble_lines = LineLimiter()
        self.trouble: str | None = None  # why the edge refuses this agent

    def stop(self) -> None:
        """End early and cleanly: read no more frames, but wait for outstanding acknowledgements."""
        self._shared.stop.set()
        self._arrivals.stop()

    def run(self) -> None:
        """Run until the source ends or `stop`. Raises any error that ended it early, after closing
        everything."""
        tracker = threading.Thread(target=self._track, name="tracker", daemon=True)
        tracker.start()
        try:
            self._loop()
            self.report = self._report()
            self._output_writer.submit(partial(self._files.finish, self._log, self.report))
        finally:
            self.stop()
            self._shared.closed.set()
            self._output_writer.submit(self._files.release)
            self._link.close()
            for sink in self._pose_sinks:
                sink.close()
            tracker.join(timeout=4)
            self._consumer.close(self._output_writer.submit)
            self._output_writer.stop()
        self._output_writer.check()
        if self._shared.error is not None:
            raise self._shared.error

    # ------------------------------------------------------------------ frames

    def _make_arrivals(self) -> FrameArrivals:
        if isinstance(self._source, LiveSource):
            return LiveArrivals(self._decode_frames, self._source.feed)
        return RecordedArrivals(self._decode_frames, self._late_dropper)

    def _decode_frames(self) -> Iterator[Frame]:
        return read_frames(
            self._source,
            self._settings,
            self._counters,
            self._skip_damaged,
            self._log.add_decode_time,
            self._notify,
        )

    def _skip_damaged(self, error: DataError) -> None:
        self._damaged_images += 1
        self._notify(f"frame skipped: {error}")

    # ------------------------------------------------------------------ tracker

    def _track(self) -> None:
        try:
            self._consumer.start()
            for frame, arrived_ns, is_late in self._arrivals.iter_frames():
                handle = self._consumer.predict if is_late else self._consumer.consume
                handle(frame, arrived_ns, self._post)
        except BaseException as error:
            self._shared.error = error
        finally:
            self._post(ev.InputFinished())

    def _post(self, event: ev.AgentEvent) -> None:
        """Put `event` into the inbox; wait while it is full, unless it is no longer read."""
        while not self._shared.closed.is_set():
            try:
                self._shared.inbox.put(event, timeout=0.1)
                break
            except queue.Full:
                continue
        self._link.wake()

    # ------------------------------------------------------------------ main

    def _loop(self) -> None:
        heap, cpu_start_s = HeapTrimmer(), time.thread_time()
        while not self._ended and not self._is_overdue():
            heap.trim_if_due(time.monotonic())
            self._receive()
            while not self._shared.inbox.empty():
                self._handle_posted(self._shared.inbox.get())
            self._handle(self._arrivals.tick())
        self._consumer.loop_ended(time.thread_time() - cpu_start_s)

    def _receive(self) -> None:
        """Handle one message from the edge; return early for a posted event or at the end of the tick."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._tick_end_ns:
            self._tick_end_ns, self._messages_in_tick = now_ns + TICK_MS * 1_000_000, 0
        if self._messages_in_tick >= _MAX_MESSAGES_PER_TICK:
            with contextlib.suppress(queue.Empty):
                self._handle_posted(self._shared.inbox.get(timeout=(self._tick_end_ns - now_ns) * 1e-9))
            return
        frames = self._link.receive(TICK_MS)
        self._notify_trouble()
        if self._link.poll_connected():
            self._handle(Connected())
        if frames is not None:
            self._messages_in_tick += 1
            self._handle(EdgeMessageReceived(frames))

    def _handle_posted(self, event: ev.AgentEvent) -> None:
        if isinstance(event, ev.InputFinished):
            self._finished_ns = time.monotonic_ns()
        self._handle(event)

    def _is_overdue(self) -> bool:
        """Return whether the state machine has failed to end the run in time."""
        limit_s = self._settings.agent.finish_s + _OVERDUE_MARGIN_S
        return self._finished_ns is not None and time.monotonic_ns() - self._finished_ns > limit_s * 1e9

    def _notify_trouble(self) -> None:
        self.trouble = self._link.trouble()
        if self.trouble is not None:
            line = self._trouble_lines.admit_new(self.trouble, time.monotonic_ns())
            if line is not None:
                self._notify(line)

    def _handle(self, event: ev.AgentEvent) -> None:
        """Handle one event. A failure costs this event, not the run."""
        try:
            effects = self._state_machine.handle(event, time.monotonic_ns())
        except Exception as error:
            self._guard.record(f"handling {type(event).__name__}", error)
            effects = self._state_machine.pending_effects()
        self._consumer.event_handled(event, self._state_machine.is_connected)
        for effect in effects:
            with self._guard.step(f"executing {type(effect).__name__}"):
                self._execute(effect)

    def _execute(self, effect: ev.AgentEffect) -> None:
        match effect:
            case SendToEdge() | ev.SendFrameToEdge():
                if not self._link.send(effect.frames):
                    self._handle(ev.SendFailed(effect))
            case ev.FrameTrackedRemotely():
                self._log.add_result(effect.frame.new_segment, effect.is_consistent, effect.frame.waiting_for)
            case ev.LocalisedPose():
                self._publish_pose(effect)
            case ev.FrameDone():
                if not effect.state.has_pose:
                    for sink in self._pose_sinks:
                        sink.publish_state(effect.stamp_ns, effect.state)
                self._lateness_monitor.record(effect.track_ms)
                self._log.add(
                    effect.stamp_ns, effect.track_ms, effect.state, effect.is_keyframe, effect.is_sent
                )
                self._show_status(self._state_machine.status(time.monotonic_ns()))
            case ev.StatusReport() if effect.is_stale:
                self._show_idle(effect)
            case ev.CorrectionApplied():
                if effect.stamp_ns is not None and effect.corrected_ms is not None:
                    self._log.add_correction(effect.stamp_ns, effect.corrected_ms)
                if self._verbose:
                    self._notify(_describe_correction(effect))
            case PrintLine():
                self._notify(effect.text)
            case FailRun():
                self._output_writer.submit(self._files.discard)
                raise effect.error
            case ev.CloseLink():
                self._ended = True

    def _publish_pose(self, localised: ev.LocalisedPose) -> None:
        age_ms = (time.monotonic_ns() - localised.arrived_ns) / 1e6
        pose = localised_pose(localised, age_ms, self._state_machine.is_connected)
        for sink in self._pose_sinks:  # first: their delay matters
            sink.publish(pose)
        self._output_writer.submit(partial(self._files.write_odom_pose, pose.stamp_ns, pose.T_odom_body))
        if pose.T_map_body is not None and pose.map_id is not None:
            self._output_writer.submit(
                partial(self._files.write_map_pose, pose.stamp_ns, pose.T_map_body, pose.map_id)
            )

    def _show_idle(self, event: ev.StatusReport) -> None:
        """Publish and show that the last pose is stale; no frame reports this."""
        for sink in self._pose_sinks:
            if event.stamp_ns is not None:
                sink.publish_state(event.stamp_ns, event.status.state, event.status.pose_age_ms)
        self._show_status(event.status, idle=True)

    def _show_status(self, status: m.Status, idle: bool = False) -> None:
        state = f"{status.state}, {status.reason}," if status.reason else str(status.state)
        self._show(LiveStatus(len(self._log), state, self._state_machine.report, idle))

    def _report(self) -> dict[str, Any]:
        protocol = self._state_machine.report()
        frames = self._log.report()
        return {
            **frames,
            "corrections": protocol["corrections"],
            "bytes_up": protocol["bytes_up"],
            "bytes_down": protocol["bytes_down"],
            "damaged_images": self._damaged_images,
            "failed_steps": self._guard.failure_count,
            "skipped": self._source.losses.counts,
            "dropped_late": self._late_dropper.dropped,
            **self._lateness_monitor.report(),
            **self._source.report(),
            **self._consumer.report(protocol),
            "sequencer": dataclasses.asdict(self._counters),
            "clock": self._state_machine.clock_estimate(time.monotonic_ns()).report(),
            "protocol": protocol,
            "version": __version__,
            "config": to_mapping(self._settings),
        }


def _describe_correction(effect: ev.CorrectionApplied) -> str:
    after = "" if effect.corrected_ms is None else f", {effect.corrected_ms:.0f} ms after its frame"
    answers = "" if effect.keyframe_id is None else f", answers keyframe {effect.keyframe_id}{after}"
    jump = ", the pose jumps" if effect.jumps else ""
    return f"correction {effect.revision} of map {effect.map_id}{answers}{jump}"
