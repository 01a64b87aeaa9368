"""The error model of an agent never delays or ends it."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from share.odometry.track_result import TrackResult
from share.runtime.error_estimators import BackgroundErrorModel, SynchronousErrorModel
from share.types import FeatureStatistics, Frame, OdometryKeyframe, TrackState, View

NOTHING = View(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8))
STANDS_ON = FeatureStatistics(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0), 0, 0)
CANDIDATE = OdometryKeyframe(np.eye(4), np.eye(4), np.zeros((6, 6)), np.zeros(3), 0.0, NOTHING)
TRACKED, LOST = TrackResult(TrackState.OK, np.eye(4)), TrackResult(TrackState.LOST, None)


class Tracker:
    def feature_statistics(self):
        return STANDS_ON

    def make_keyframe(self, frame):
        return CANDIDATE


class Network:
    """Says that the error is as many cm as the picture is bright; waits until it may."""

    def __init__(self) -> None:
        self.may = threading.Event()
        self.seen: list[float] = []

    def get_inputs(self):
        return []

    def run(self, names, inputs):
        self.seen.append(float(inputs["picture"].mean()))
        assert self.may.wait(5)
        if self.seen[-1] > 200:
            raise RuntimeError("too bright")
        log = np.log(self.seen[-1])
        return [np.array([[log, log - 1, log + 1]]), np.zeros((1, 64)), np.array([0.5])]


def frame(brightness: int) -> Frame:
    return Frame(brightness, brightness, np.full((48, 64), brightness, np.uint8))


def keyframe(errors: SynchronousErrorModel, brightness: int) -> None:
    errors.update(frame(brightness), TRACKED)
    errors.make_keyframe(frame(brightness), Tracker())


def until(reached, limit_s: float = 5.0) -> None:
    end = time.monotonic() + limit_s
    while not reached():
        assert time.monotonic() < end
        time.sleep(0.002)


def test_an_estimate_holds_until_the_next():
    network, said = Network(), []
    network.may.set()
    errors = BackgroundErrorModel(network, said.append)
    assert errors.update(frame(0), TRACKED) is None
    keyframe(errors, 3)
    until(lambda: errors.update(frame(1), TRACKED) is not None)
    assert errors.update(frame(1), TRACKED) == pytest.approx(3)
    assert errors.update(frame(2), LOST) is None  # there is no pose that could be wrong
    errors.close()
    reported = errors.report()["error_model"]
    assert reported["estimate_ms"]["n"] == 1
    assert (reported["dropped_estimates"], reported["unfamiliar"], said) == (0, 0, [])


def test_timings_cover_the_newest_estimates(monkeypatch):
    monkeypatch.setattr("share.runtime.error_estimators._MAX_TIMINGS", 3)
    network = Network()
    network.may.set()
    errors = BackgroundErrorModel(network, print)
    for brightness in range(1, 6):
        keyframe(errors, brightness)
        until(lambda at=brightness: network.seen[-1:] == [at])
    errors.close()
    assert errors.report()["error_model"]["estimate_ms"]["n"] == 3


def test_a_busy_model_drops_the_older_keyframe():
    network = Network()
    errors = BackgroundErrorModel(network, lambda text: None)
    began = time.monotonic()
    keyframe(errors, 1)
    until(lambda: network.seen == [1.0])  # it is at work, and waits
    for brightness in (2, 3, 4):
        keyframe(errors, brightness)
    assert time.monotonic() - began < 2
    network.may.set()
    until(lambda: errors.update(frame(1), TRACKED) == pytest.approx(4))
    errors.close()
    assert network.seen == [1.0, 4.0]
    assert errors.report()["error_model"]["dropped_estimates"] == 2


def test_a_failing_network_is_switched_off_and_reported():
    network, said = Network(), []
    network.may.set()
    errors = BackgroundErrorModel(network, said.append)
    keyframe(errors, 5)
    until(lambda: errors.update(frame(1), TRACKED) is not None)
    keyframe(errors, 250)
    until(lambda: said)
    assert said == ["the error model failed and is switched off: too bright"]
    keyframe(errors, 6)
    assert errors.update(frame(2), TRACKED) is None
    errors.close()


def test_in_virtual_time_an_estimate_is_immediate():
    network = Network()
    network.may.set()
    errors = SynchronousErrorModel(network)
    assert errors.update(frame(0), TRACKED) is None
    keyframe(errors, 7)
    assert errors.update(frame(1), TRACKED) == pytest.approx(7)
    assert errors.update(frame(1), LOST) is None


def test_a_keyframe_is_estimated_by_the_image_that_it_is_made_of():
    network = Network()
    network.may.set()
    errors = SynchronousErrorModel(network)
    for brightness in (3, 40, 90):
        errors.update(frame(brightness), TRACKED)
    errors.make_keyframe(frame(90), Tracker())
    assert network.seen == [90.0]
