"""Whether images and IMU tell of one motion, and whether the filter is where it takes itself to be."""

from __future__ import annotations

import numpy as np

from share.config import InertialConfig
from share.estimator.inertial import ekf
from share.estimator.inertial.state import State
from share.estimator.middle import median
from share.types import F64

_OVER_S, _LEAST_S = 5.0, 1.0  # averaged over; of frames, before anything is said
_BEGIN_S = 1.0  # in which a filter that has just begun finds its bearings
_FEWEST = 25  # features that say something
_ASTRAY, _REFUSED_S = 3, 1.0  # frames with nothing of what should be there; time with nothing believed
_LONGEST_S = 0.2  # that one frame counts for
_SURPRISED = 0.8  # of the median squared Mahalanobis distance, which is 0.05 to 0.6 where all is well


class Agreement:
    """A camera that is turned or shifted against its calibration, or whose clock is off, is tracked all the
    same, a little beside where the IMU says, all features alike, frame after frame: none is refused for it.
    With 5 degrees and 5 cm the median rises to 1.2 to 3 (docs/vio.md)."""

    def __init__(self) -> None:
        self._mean, self._seconds = 0.0, 0.0

    def add(self, surprise: F64, seconds: float) -> None:
        """`ekf.surprise` (M,) of a frame's features, and how long it was since the frame before."""
        if len(surprise) < _FEWEST:
            return
        self._seconds += seconds
        heard = self._seconds - _BEGIN_S
        if heard <= 0:
            return
        share = min(seconds / min(heard, _OVER_S), 1.0)
        self._mean += share * (median(surprise) - self._mean)

    @property
    def sound(self) -> bool:
        """False where they contradict each other."""
        return self._seconds < _BEGIN_S + _LEAST_S or self._mean < _SURPRISED


class Straying:
    """Frames that show something and nothing of what they should, or for long nothing that is believed: then
    the filter is wrong, and not the light. What has left the view tells nothing."""

    def __init__(self, weak: int, blind: int) -> None:
        """So many features are little to go by; with fewer than `blind` there is no seeing."""
        self._weak, self._blind = weak, blind
        self._frames, self._refused_s = 0, 0.0

    def add(self, textured: bool, due: int, found: int, seen: int, seconds: float) -> None:
        """A frame, `seconds` after the one before. textured: it shows something. Of the filter's features
        `due` should be in view, `found` look as they should, `seen` were believed as well."""
        if textured and due >= self._weak:
            self._frames = self._frames + 1 if found < self._blind else 0
        if due >= self._blind:  # else all was refused in the frame before, and is gone
            refused = textured and seen < self._blind
            self._refused_s = self._refused_s + min(seconds, _LONGEST_S) if refused else 0.0

    @property
    def suspected(self) -> bool:
        """True from the first such frame on."""
        return self._frames > 0 or self._refused_s > 0

    @property
    def certain(self) -> bool:
        """True where it has gone on for too long."""
        return self._frames >= _ASTRAY or self._refused_s > _REFUSED_S


def trusted(s: State, config: InertialConfig) -> bool:
    """Finite, no faster than a person or robot can be, and not gone too far unseen."""
    finite = np.isfinite(s.T).all() and np.isfinite(s.v).all() and np.isfinite(s.cov).all()
    return bool(finite and np.linalg.norm(s.v) < config.max_speed_m_s and ekf.drift_m(s) < config.lost_m)
