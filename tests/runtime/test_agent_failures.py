"""Failures within an agent's run: of the tracker, a keyframe, the error model or the edge."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import cycle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.config import AgentConfig, Config
from share.odometry.track_result import TrackResult
from share.runtime import agent, guarded_tracker
from share.runtime.agent import AgentRun
from share.runtime.error_estimators import NoErrorEstimate
from share.types import Frame, ImuBatch, OdometryKeyframe, TrackState, View

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

    def make_keyframe(self, frame: Frame) -> OdometryKeyframe:
        self._do("keyframe")
        return OdometryKeyframe(np.eye(4), np.eye(4), 1e-6 * np.eye(6), np.zeros(3), 0.01, VIEW, True)

    def finish_keyframe(self) -> None:
        self._do("settle")

    def reset_after_failure(self, frame: Frame) -> None:
        self._do("give up")


class Link:
    """Takes everything and gives nothing. wake: called at each event posted."""

    def __init__(self, wake: Callable[[], None], trouble: Callable[[], str | None]) -> None:
        self.wake, self.trouble = wake, trouble

    def send(self, frames: object) -> bool:
        return True

    def receive(self, timeout_ms: int) -> None:
        time.sleep(0.001)

    def poll_connected(self) -> bool:
        return True

    def close(self) -> None:
        pass


@pytest.fixture
def run_of(monkeypatch: pytest.MonkeyPatch) -> Callable[..., AgentRun]:
    """Makes a run of FRAME alone, or of `frames`, with a tracker of one's own."""

    def make(
        said: list[str],
        tracker: Tracker,
        estimator: NoErrorEstimate | None = None,
        wake: Callable[[], None] = lambda: None,
        trouble: Callable[[], str | None] = lambda: None,
    ) -> AgentRun:
        hello = hello_of("ann", 1)
        losses = SimpleNamespace(counts={})
        source: Any = SimpleNamespace(name="a", rig=hello.rig, losses=losses, report=dict)
        monkeypatch.setattr(agent, "read_frames", lambda *arguments: iter([FRAME]))
        monkeypatch.setattr(guarded_tracker, "make_tracker", lambda *arguments: tracker)
        settings = Config(agent=AgentConfig(finish_s=0.2))
        link: Any = Link(wake, trouble)
        return AgentRun(source, hello, settings, lambda: link, None, said.append, error_estimator=estimator)

    return make


@pytest.mark.parametrize(
    ("fails", "sent", "calls"),
    [
        ("", 1, ["keyframe", "settle"]),
        ("keyframe", 0, ["keyframe", "give up", "settle"]),
        ("settle", 1, ["keyframe", "settle", "give up"]),
    ],
)
def test_a_frame_is_logged_also_if_its_keyframe_fails(
    run_of: Callable[..., AgentRun], fails: str, sent: int, calls: list[str]
) -> None:
    said, tracker = list[str](), Tracker(fails)
    run = run_of(said, tracker)
    run.run()
    assert [run.report[key] for key in ("frames", "keyframes", "sent")] == [1, sent, sent]
    assert tracker.calls == calls
    assert sum("LinAlgError" in line for line in said) == bool(fails)


def test_a_keyframe_that_cannot_be_posted_is_no_failure_of_the_tracker(
    run_of: Callable[..., AgentRun],
) -> None:
    tracker, woken = Tracker(), list[int]()

    def wake() -> None:
        woken.append(1)
        if len(woken) == 2:
            raise OSError("no such socket")

    with pytest.raises(OSError, match="no such socket"):
        run_of([], tracker, wake=wake).run()
    assert tracker.calls == ["keyframe"]


def test_an_error_model_that_fails_costs_its_estimate(run_of: Callable[..., AgentRun]) -> None:
    class Broken(NoErrorEstimate):
        def update(self, frame: Frame, result: TrackResult) -> float | None:
            raise FloatingPointError("overflow")

    said, tracker = list[str](), Tracker()
    run = run_of(said, tracker, Broken())
    run.run()
    assert (run.report["keyframes"], tracker.calls) == (1, ["keyframe", "settle"])
    assert sum("FloatingPointError" in line for line in said) == 1


def test_an_edge_that_admits_and_refuses_in_turn_is_reported_once(run_of: Callable[..., AgentRun]) -> None:
    said, asked = list[str](), cycle(["refused: the edge requires keys", None])
    run = run_of(said, Tracker(), trouble=lambda: next(asked))
    run.run()
    assert said == ["refused: the edge requires keys"]
