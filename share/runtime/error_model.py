"""How wrong its tracker is, as an agent tells the edge: by the truth, by the error model, or not at all."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from share.metrics.frame_log import summary
from share.metrics.local_error import LocalError
from share.odometry.error_model.features import features
from share.odometry.error_model.history import MOST_AGO, Fared, Lately, Odometer
from share.odometry.error_model.model import Estimate, Network, estimate
from share.odometry.result import TrackResult
from share.rates import History
from share.types import U8, Candidate, Footing, Frame

_TIMES = 50_000  # estimates that a report is about, the newest: hours, at two keyframes a second


class Tracker(Protocol):
    """What of either tracker is asked here."""

    def footing(self) -> Footing: ...
    def keyframe(self, frame: Frame) -> Candidate: ...


class Errors(Protocol):
    """Of one agent."""

    def after(self, frame: Frame, result: TrackResult) -> float | None:
        """cm, after another frame; None where it is not known."""

    def keyframe(self, frame: Frame, tracker: Tracker) -> Candidate:
        """Has `tracker` make the frame just tracked a keyframe, and looks at what it has to know of it."""

    def close(self) -> None: ...

    def report(self) -> dict[str, Any]:
        """For report.json."""


def fared(frame: Frame, result: TrackResult) -> Fared:
    """What of a frame and its result is remembered."""
    heard = len(frame.imu) > 0
    return Fared(frame.stamp_ns, heard, result.state, result.found, result.points, result.surprise)


class Unknown:
    """Nobody tells."""

    def after(self, frame: Frame, result: TrackResult) -> float | None:
        return None

    def keyframe(self, frame: Frame, tracker: Tracker) -> Candidate:
        return tracker.keyframe(frame)

    def close(self) -> None:
        pass

    def report(self) -> dict[str, Any]:
        return {}


class ByTruth(Unknown):
    """An oracle, for experiments."""

    def __init__(self, error: LocalError) -> None:
        self._error = error

    def after(self, frame: Frame, result: TrackResult) -> float | None:
        return self._error.after(frame.stamp_ns, result.T_odom_body, result.new_stretch)


@dataclass(frozen=True, eq=False)
class _Job:
    image: U8
    footing: Footing
    lately: Lately


class AtOnce(Unknown):
    """The error model, where time is drawn (`share.lab.evaluate.virtual`): it has answered when `keyframe`
    returns. What it said last holds until it says something else."""

    def __init__(self, network: Network) -> None:
        self._network, self._odometer = network, Odometer()
        self._seen: deque[tuple[int, U8]] = deque(maxlen=MOST_AGO)  # stamps, images
        self._newest: Estimate | None = None

    def after(self, frame: Frame, result: TrackResult) -> float | None:
        self._odometer.frame(fared(frame, result))
        self._seen.append((frame.stamp_ns, frame.image0))
        newest = self._newest
        return None if newest is None or result.T_odom_body is None else newest.error_cm

    def keyframe(self, frame: Frame, tracker: Tracker) -> Candidate:
        footing, candidate = tracker.footing(), tracker.keyframe(frame)
        stamp_ns, image = self._seen[-1 - candidate.frames_ago]
        self._take(_Job(image, footing, self._odometer.keyframe(stamp_ns, candidate)))
        return candidate

    def _take(self, job: _Job) -> None:
        self._newest = self._estimate(job)

    def _estimate(self, job: _Job) -> Estimate:
        return estimate(self._network, features(job.image, job.footing, job.lately))


class ByModel(AtOnce):
    """The error model, in a thread of its own. A keyframe that comes while it is busy waits; one more, and
    the older is left out (policy drop_estimate)."""

    def __init__(self, network: Network, say: Callable[[str], None]) -> None:
        super().__init__(network)
        self._say = say
        self._waits: _Job | None = None
        self._wake = threading.Condition()
        self._ended = False
        self._ms = History(1, _TIMES)
        self._dropped = self._strange = 0
        self._thread = threading.Thread(target=self._work, name="error model", daemon=True)
        self._thread.start()

    def _take(self, job: _Job) -> None:
        with self._wake:
            self._dropped += self._waits is not None
            self._waits = job
            self._wake.notify()

    def close(self) -> None:
        with self._wake:
            self._ended = True
            self._wake.notify()
        self._thread.join(timeout=2)

    def report(self) -> dict[str, Any]:
        took = summary(np.array(self._ms.column(0), float))
        told = {"estimate_ms": took.report(), "drop_estimate": self._dropped}
        return {"error_model": {**told, "strange": self._strange}}

    def _work(self) -> None:
        while (job := self._next()) is not None:
            began = time.thread_time()
            try:
                found = self._estimate(job)
            except Exception as error:  # a network is a file from somewhere; odometry goes on without it
                self._newest = None
                self._say(f"the error model has failed and is left alone: {error}")
                return
            self._newest = found
            self._strange += found.strange
            self._ms.add([1e3 * (time.thread_time() - began)])

    def _next(self) -> _Job | None:
        with self._wake:
            self._wake.wait_for(lambda: self._ended or self._waits is not None)
            job, self._waits = self._waits, None
            return None if self._ended else job
