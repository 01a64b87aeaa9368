"""Matching again, where a rough pose says that the points should be.

Alone, a descriptor must be very like another to be believed; beside the place where its point must
appear, much less likeness says as much. Source: guided matching, Hartley and Zisserman (2004),
section 4.7.1 and algorithm 11.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.mapping.recognition.refinement import transfer_keypoints
from share.types import F64
from share.vision.matching import DescriptorPairs


def guided_pairs(pairs: DescriptorPairs, T_c_q: F64, y_q: F64, y_c: F64, radius: float) -> DescriptorPairs:
    """Those pairs that appear within `radius` (normalised coordinates) of where T_c_q (4, 4) moves them.

    y_q (N, 3), y_c (K, 3): keypoints with inverse depth, NaN if unknown. Whichever of the two has a
    depth is moved; a pair without any depth is left out.
    """
    query_in_candidate, candidate_in_query = _transfer(T_c_q, y_q), _transfer(se3.inverse(T_c_q), y_c)
    for axis in (0, 1):  # by one coordinate after the other, since each leaves few pairs for the next
        pairs = pairs.keep(_is_near(query_in_candidate[axis][pairs.rows], y_c[:, axis][pairs.cols], radius))
        pairs = pairs.keep(_is_near(candidate_in_query[axis][pairs.cols], y_q[:, axis][pairs.rows], radius))
    return pairs.keep(np.isfinite(y_q[pairs.rows, 2]) | np.isfinite(y_c[pairs.cols, 2]))


def _transfer(T: F64, y: F64) -> F64:
    """(3, N): NaN where the depth is unknown, infinite where it is behind the camera."""
    out = transfer_keypoints(T, y.T)
    out[:, np.isnan(out[2]) & np.isfinite(y[:, 2])] = np.inf
    return out


def _is_near(a: F64, b: F64, radius: float) -> NDArray[np.bool_]:
    """Not if they are known to be further apart."""
    return np.asarray(~(np.abs(a - b) > radius))
