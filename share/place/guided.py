"""Matching again, where a rough pose says that the points should be.

Alone, a descriptor must be very like another to be believed; beside the place where its point must
appear, much less likeness says as much. Source: guided matching, Hartley and Zisserman (2004),
section 4.7.1 and algorithm 11.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.place.matching import Pairs
from share.place.refine import move
from share.types import F64


def beside(pairs: Pairs, T_c_q: F64, y_q: F64, y_c: F64, radius: float) -> Pairs:
    """Those pairs that appear within `radius` (normalised coordinates) of where T_c_q (4, 4) moves them.

    y_q (N, 3), y_c (K, 3): keypoints with inverse depth, NaN if unknown. Whichever of the two has a
    depth is moved; a pair without any depth is left out.
    """
    there = _apart(move(T_c_q, y_q), y_q, y_c, pairs.rows, pairs.cols)
    back = _apart(move(se3.inverse(T_c_q), y_c), y_c, y_q, pairs.cols, pairs.rows)
    known = np.isfinite(y_q[pairs.rows, 2]) | np.isfinite(y_c[pairs.cols, 2])
    return pairs.only((np.fmax(there, back) <= radius) & known)


def _apart(moved: F64, source: F64, target: F64, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> F64:
    """Distance (M,) in the image; NaN where the depth is unknown, infinite where it is behind the camera."""
    off: F64 = np.abs(moved[rows, :2] - target[cols, :2]).max(1)
    off[np.isnan(off) & np.isfinite(source[rows, 2])] = np.inf
    return off
