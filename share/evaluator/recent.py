"""What the last seconds were like, since the error of the last seconds is what is to be told.

A keyframe shows how well its tracker fares now; what was lost three seconds ago, in the dark, is still lost.
"""

from __future__ import annotations

import math

import numpy as np

from share.evaluator.odometer import Lately
from share.evaluator.scalars import MANY, score
from share.types import F32, TrackState

RECENT = (
    "mean score",
    "least score",
    "most score",
    "way",
    "turn",
    "mean surprise",
    "most surprise",
    "refused",
    "mean matches",
    "least matches",
    "weak",
    "blind",
    "deaf",
    "gap",
)
_BLIND = (TrackState.INERTIAL_ONLY, TrackState.LOST)
_FAR_M, _TURNED_RAD = 5.0, 5.0  # count as 1
_AMAZED = 100.0  # squared sigmas, the same
_GAP_S, _SHORT_S = 5.0, 0.1  # between two frames: 1, and where the logarithm begins


def recent(lately: Lately) -> F32:
    """(14,) as `RECENT`, each about 0 to 1: the tracking score (`scalars`) of the keyframes; how far the body
    went and turned; and of the frames, how surprised the tracker was, what share of the features it found it
    refused, how many it believed, in what share of them it was weak, blind (the IMU alone, or lost) and
    deaf (without an IMU), and the longest time between two."""
    scores = [score(sigma_cm) for sigma_cm in lately.sigmas_cm]
    frames = lately.frames
    stamps_ns, found, believed = (np.array([fared[k] for fared in frames]) for k in (0, 3, 4))
    surprise = np.log1p([fared.surprise for fared in frames]) / math.log1p(_AMAZED)
    refused = np.where(found > 0, np.maximum(0, 1 - believed / np.maximum(found, 1)), 0)
    matches = np.log1p(believed) / math.log1p(MANY)
    gap_s = np.diff(stamps_ns).max(initial=0) * 1e-9
    spells = [(f.state is TrackState.WEAK, f.state in _BLIND, not f.heard) for f in frames]
    return np.array(
        [
            np.mean(scores),
            min(scores),
            max(scores),
            lately.way_m / _FAR_M,
            lately.turn_rad / _TURNED_RAD,
            surprise.mean(),
            surprise.max(),
            refused.mean(),
            matches.mean(),
            matches.min(),
            *np.mean(spells, axis=0),
            math.log1p(gap_s / _SHORT_S) / math.log1p(_GAP_S / _SHORT_S),
        ],
        np.float32,
    )
