"""Trackers of streaming agents, where the machine has no files or threads for another process."""

from __future__ import annotations

from typing import Any

import pytest
from helpers.hellos import hello_of

from share.config import Config
from share.protocol.edge_events import StartTracker, StopTracker, TrackerLost, TrackFrame
from share.runtime import tracker_processes
from share.runtime.tracker_processes import TrackerProcesses


@pytest.mark.parametrize(
    "error",
    [OSError(24, "Too many open files"), RuntimeError("can't start new thread")],
    ids=["files", "threads"],
)
def test_a_tracker_that_cannot_be_started_is_lost(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """Its agent waited for ever, and nothing was said."""

    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(tracker_processes, "WorkerProcess", fail)
    events = list[Any]()
    trackers = TrackerProcesses(Config(), events.append)
    trackers.execute(StartTracker("ann-0001", 3, hello_of("ann", 1).rig))
    (lost,) = events
    assert isinstance(lost, TrackerLost)
    assert (lost.key, lost.generation) == ("ann-0001", 3)
    assert lost.reason.startswith(f"could not be started: {error}; restarted in ")
    trackers.execute(TrackFrame("ann-0001", None))  # type: ignore[arg-type]  # of a frame that was on its way
    trackers.execute(StopTracker("ann-0001"))
    trackers.close()
