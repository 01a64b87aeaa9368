"""How far odometry has gone astray since the map last set it right: what more keyframes can mend."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from share.core.rate import seconds
from share.geometry.se3 import compose_cov, position_sigma
from share.metrics.local_error import WINDOW_S
from share.types import F64, Keyframe

_REMEMBERED = 100  # keyframes since the last that was answered; older motion is summed up


class Drift:
    """Of one agent, from one answered keyframe to the next. Times are of the agent's clock, ns."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._motions: deque[tuple[int, int, F64, F64]] = deque()  # keyframe, when, T_last_this, cov

    def sent(self, keyframe: Keyframe, at_ns: int) -> None:
        """A keyframe is on its way; one without a reference begins a stretch, which is sure of itself."""
        if keyframe.reference < 0 or self._since_ns is None:
            self._motions.clear()
            self._since_ns = at_ns
            return
        self._motions.append((keyframe.id, at_ns, keyframe.T_ref_body, keyframe.cov))
        if len(self._motions) > _REMEMBERED:
            (_, _, _, cov), (second, when, T, more) = self._motions.popleft(), self._motions.popleft()
            self._motions.appendleft((second, when, T, compose_cov(T, cov, more)))

    def answered(self, keyframe: int) -> None:
        """The map has placed this one, and with it what came after."""
        while self._motions and self._motions[0][0] <= keyframe:
            self._since_ns = self._motions.popleft()[1]

    def expected_cm(self, local_cm: float | None, now_ns: int) -> float | None:
        """cm, of the newest sent keyframe's position; None before the first.

        local_cm: the error that odometry makes within `WINDOW_S` (`share.metrics.local_error`); it strays
        as a random walk does. None: by the covariances that odometry itself tells.
        """
        if self._since_ns is None:
            return None
        if local_cm is not None:
            return local_cm * math.sqrt(min(1.0, max(0, now_ns - self._since_ns) / seconds(WINDOW_S)))
        cov = np.zeros((6, 6))
        for _, _, T, more in self._motions:
            cov = compose_cov(T, cov, more)
        return 100 * position_sigma(cov)
