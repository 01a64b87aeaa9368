"""Guided matching: match again near where an initial pose projects the points.

Without a prediction a descriptor must be very similar to count as a match; near the predicted position much
less similarity is enough. Source: Hartley and Zisserman (2004), section 4.7.1 and algorithm 11.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.mapping.recognition.refinement import transfer_keypoints
from share.types import F64
from share.vision.matching import DescriptorPairs


def guided_pairs(pairs: DescriptorPairs, T_c_q: F64, y_q: F64, y_c: F64, radius: float) -> DescriptorPairs:
    """Keep the pairs within `radius` (normalised coordinates) of where T_c_q (4, 4) projects them.

    y_q (N, 3), y_c (K, 3): keypoints with inverse depth, NaN if unknown. Each keypoint with a depth is
    projected; pairs without any depth are dropped.
    """
    query_in_candidate, candidate_in_query = _transfer(T_c_q, y_q), _transfer(se3.inverse(T_c_q), y_c)
    for axis in (0, 1):  # one coordinate after the other: each leaves few pairs for the next
        pairs = pairs.keep(_is_near(query_in_candidate[axis][pairs.rows], y_c[:, axis][pairs.cols], radius))
        pairs = pairs.keep(_is_near(candidate_in_query[axis][pairs.cols], y_q[:, axis][pairs.rows], radius))
    return pairs.keep(np.isfinite(y_q[pairs.rows, 2]) | np.isfinite(y_c[pairs.cols, 2]))


def _transfer(T: F64, y: F64) -> F64:
    """Projected keypoints (3, N): NaN where the depth is unknown, infinite behind the camera."""
    out = transfer_keypoints(T, y.T)
    out[:, np.isnan(out[2]) & np.isfinite(y[:, 2])] = np.inf
    return out


def _is_near(a: F64, b: F64, radius: float) -> NDArray[np.bool_]:
    """Mask of values within `radius`; unknown ones (NaN) pass."""
    return np.asarray(~(np.abs(a - b) > radius))
