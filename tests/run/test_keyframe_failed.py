"""A keyframe that fails costs itself: its frame is in the run's log, and what fails elsewhere is not taken
for a failure of the tracker."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.config import Config
from share.odometry.track_result import TrackResult
from share.runtime.agent import AgentRun
from share.runtime.error_estimators import NoErrorEstimate
from share.types import Frame, ImuBatch, KeyframeCandidate, TrackState, View

FRAME = Frame(10**9, 0, np.zeros((480, 640), np.uint8), None, None, ImuBatch.empty())
VIEW = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))


class Tracker:
    """Wants every frame as a keyframe; `fails`: what it cannot do."""

    rejected_imu_samples, bias = 0, None

    def __init__(self, fails: str = "") -> None:
        self._fails = fails
        self.calls: list[str] = []

    def _do(self, what: str) -> None:
        self.calls.append(what)
        if what == self._fails:
            raise np.linalg.LinAlgError("singular matrix")

    def track(self, frame: Frame) -> TrackResult:
        return TrackResult(TrackState.OK, np.eye(4), True, 40, True)

    def make_keyframe(self, frame: Frame) -> KeyframeCandidate:
        self._do("keyframe")
        return KeyframeCandidate(np.eye(4), np.eye(4), 1e-6 * np.eye(6), np.zeros(3), 0.01, VIEW, True)

    def finish_keyframe(self) -> None:
        self._do("settle")

    def reset_after_failure(self, frame: Frame) -> None:
        self._do("give up")


@contextmanager
def run_of(tracker: Tracker, said: list[str]) -> Iterator[AgentRun]:
    hello = hello_of("ann", 1)
    source: Any = SimpleNamespace(name="a", rig=hello.rig)
    link: Any = SimpleNamespace(wake=lambda: None, send=lambda frames: True)
    run = AgentRun(source, hello, Config(), lambda: link, None, said.append)
    run._tracker._tracker = tracker  # type: ignore[assignment]
    try:
        yield run
    finally:
        run._files.release()
        run._output_writer.stop()


def tracked(run: AgentRun) -> list[tuple[bool, bool]]:
    """Whether each frame that is in the log then is a keyframe, and was given an id."""
    run._track_frame(FRAME, 0)
    while not run._shared.inbox.empty():
        run._handle_posted(run._shared.inbox.get())
    rows = run._log.frames()
    return list(zip(rows.keyframe.tolist(), rows.sent.tolist(), strict=True))


@pytest.mark.parametrize(
    ("fails", "logged", "calls"),
    [
        ("", (True, True), ["keyframe", "settle"]),
        ("keyframe", (False, False), ["keyframe", "give up", "settle"]),
        ("settle", (True, True), ["keyframe", "settle", "give up"]),
    ],
)
def test_a_frame_is_logged_whatever_became_of_its_keyframe(
    fails: str, logged: tuple[bool, bool], calls: list[str]
) -> None:
    said, tracker = list[str](), Tracker(fails)
    with run_of(tracker, said) as run:
        assert tracked(run) == [logged]
    assert tracker.calls == calls
    assert sum("LinAlgError" in line for line in said) == bool(fails)


def test_what_fails_in_posting_a_keyframe_is_no_failure_of_the_tracker() -> None:
    tracker, woken = Tracker(), list[int]()

    def wake() -> None:
        woken.append(1)
        if len(woken) == 2:
            raise OSError("no such socket")

    with run_of(tracker, []) as run:
        run._link.wake = wake  # type: ignore[method-assign]
        with pytest.raises(OSError, match="no such socket"):
            run._track_frame(FRAME, 0)
    assert tracker.calls == ["keyframe"]


def test_an_error_model_that_fails_costs_its_estimate() -> None:
    class Broken(NoErrorEstimate):
        def update(self, frame: Frame, result: TrackResult) -> float | None:
            raise FloatingPointError("overflow")

    said, tracker = list[str](), Tracker()
    with run_of(tracker, said) as run:
        run._error_estimator = Broken()
        assert tracked(run) == [(True, True)]
    assert tracker.calls == ["keyframe", "settle"]
    assert sum("FloatingPointError" in line for line in said) == 1
