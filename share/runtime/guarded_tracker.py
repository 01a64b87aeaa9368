"""A tracker whose failures cost the frame that they come in, and not the process."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from share.config import Config
from share.errors import ShareError
from share.geometry.camera import ImuBias, Rig
from share.odometry.result import TrackResult
from share.runtime.pipeline import tracker_of
from share.types import Candidate, Footing, Frame, TrackState

# ---- A step that fails costs what it was about, and not the process.

_MOST_SAID = 16  # kinds of failure


class Guard:
    """Counts steps that failed, and says each kind once, with the place in the program."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.failed = 0
        self._say = say
        self._said: set[str] = set()

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Within it any error but a ShareError, which ends a run by intent, costs only this step."""
        try:
            yield
        except ShareError:
            raise
        except Exception as error:
            self.note(what, error)

    def note(self, what: str, error: Exception) -> None:
        self.failed += 1
        at = traceback.extract_tb(error.__traceback__)[-1]
        kind = f"{what}: {type(error).__name__} at {at.filename.rpartition('/')[2]}:{at.lineno}"
        if kind not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(kind)
            text = "".join(c if c.isprintable() else "?" for c in str(error))[:200]
            self._say(f"{kind}: {text}; it is left out and the run goes on")


T = TypeVar("T")


class GuardedTracker:
    """The estimator that fits a rig, see `InertialTracker`. What fails in it, a matrix that has no inverse or
    a library that refuses its numbers, is counted and said by `guard`. The frame is LOST, and the next one
    looks for itself among the places that the tracker knows; if that fails too, a new one begins."""

    def __init__(self, rig: Rig, config: Config, guard: Guard, bias: ImuBias | None = None) -> None:
        """bias: of the rig's IMU, where that is known."""
        self._make = partial(tracker_of, rig, config, bias)
        self._tracker, self._guard = self._make(), guard
        self.bias: ImuBias | None = None  # as was learnt by the last keyframe by which any was
        self._has_posed = False  # since it failed last
        self._doubted = 0  # by trackers before this one

    def track(self, frame: Frame) -> TrackResult:
        result = self.attempt("tracking a frame", frame, lambda: self._tracker.track(frame))
        if result is None:
            return TrackResult(TrackState.LOST, None)
        self._has_posed = self._has_posed or result.T_odom_body is not None
        return result

    def attempt(self, what: str, frame: Frame, step: Callable[[], T]) -> T | None:
        """Of `frame`, the last; None where it fails. An error that is for a person goes on."""
        try:
            return step()
        except ShareError:
            raise
        except Exception as error:
            self._guard.note(what, error)
            self._give_up(frame)
            return None

    def finish(self, frame: Frame, keyframe: bool) -> None:
        """What is left to do for the frame just tracked, where nobody else is to have what it shows.
        keyframe: whether it is one."""
        if keyframe:
            self.attempt("making a keyframe", frame, partial(self.keyframe, frame))
        self.attempt("settling a frame", frame, self._tracker.settle)

    def keyframe(self, frame: Frame) -> Candidate:
        """Within `attempt`; so `settle` and `footing`."""
        candidate = self._tracker.keyframe(frame)
        self.bias = self._tracker.bias or self.bias
        return candidate

    def settle(self) -> None:
        self._tracker.settle()

    def footing(self) -> Footing:
        return self._tracker.footing()

    @property
    def doubted(self) -> int:
        """How many IMU samples were not believed, since the beginning."""
        return self._doubted + self._tracker.doubted

    def _give_up(self, frame: Frame) -> None:
        had_posed, self._has_posed = self._has_posed, False
        try:
            if had_posed:
                self._tracker.give_up(frame)
                return
        except Exception as error:
            self._guard.note("looking for itself again", error)
        self._doubted += self._tracker.doubted
        self._tracker = self._make()
