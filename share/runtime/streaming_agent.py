"""The process of an agent that the edge tracks (policy `streamed`).

    reader: decode, wait until the frame is due -> main: state machine, link, files

A recording starts once the edge can track it, so that its beginning is not lost; from then on nothing
waits for the edge.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from share.cameras.live import LiveSource
from share.protocol import agent_events as ev
from share.protocol.streaming import StreamingAgent
from share.runtime.agent import TICK_MS, AgentRun
from share.runtime.arrivals import READ_AHEAD
from share.runtime.pipeline import check_trackable
from share.types import Frame

TRACKER_START_S = 20.0  # longest wait of a recording for the edge's tracker before it plays


class StreamingAgentRun(AgentRun):
    """`AgentRun` that sends frames to the edge instead of tracking them."""

    state_machine = StreamingAgent

    def _prepare(self) -> None:
        check_trackable(self._source.name, self._source.rig)
        self._free_slots = threading.Semaphore(READ_AHEAD)  # frames between the threads: policy block
        self._can_start = threading.Event()

    def _track(self) -> None:
        if not isinstance(self._source, LiveSource):
            self._await_edge()
        super()._track()

    def _await_edge(self) -> None:
        deadline = time.monotonic() + TRACKER_START_S
        while not (self._can_start.wait(TICK_MS / 1e3) or self._shared.stop.is_set()):
            if time.monotonic() >= deadline:
                self._notify("the edge does not track this agent yet; the recording starts anyway")
                break

    def _track_frame(self, frame: Frame, arrived_ns: int) -> None:
        while not self._free_slots.acquire(timeout=0.1):
            if self._shared.stop.is_set():
                return
        self._post(ev.FrameArrived(frame, arrived_ns))

    def _loop(self) -> None:
        cpu = time.thread_time()
        super()._loop()
        self._log.cpu_s = time.thread_time() - cpu

    def _handle(self, event: ev.AgentEvent) -> None:
        if isinstance(event, ev.FrameArrived):
            self._free_slots.release()
        super()._handle(event)
        if self._state_machine.is_connected:
            self._can_start.set()

    def _execute(self, effect: ev.AgentEffect) -> None:
        match effect:
            case ev.SendFrameToEdge():
                if not self._link.send(effect.frames):
                    self._handle(ev.SendFailed(effect))
            case ev.FrameTrackedRemotely():
                self._log.add_result(effect.frame.new_segment, effect.is_consistent, effect.frame.waiting_for)
            case _:
                super()._execute(effect)

    def _report(self) -> dict[str, Any]:
        protocol = self._state_machine.report()
        untracked = protocol["arrived"] - protocol["answered"]
        return super()._report() | {"untracked": untracked}
