"""A mounting found otherwise, checked by hand-eye from the paths of both bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.calibration.handeye import HandEye, hand_eye
from share.errors import DataError
from share.geometry import se3
from share.types import F64, I64

_SPAN_NS = 1_000_000_000  # of a motion: long enough to turn, short enough not to drift
_APART = 4.0  # standard errors by which two ways may differ


@dataclass(frozen=True, eq=False)
class Check:
    """turned rad, shifted m: how far `found` is from what was to be checked; sigmas: that in standard errors
    of hand-eye (Mahalanobis over the square root of six)."""

    found: HandEye
    turned: float
    shifted: float
    sigmas: float

    @property
    def agrees(self) -> bool:
        return self.sigmas < _APART


def check(T_a_b: F64, stamps_ns: I64, T_a: F64, T_b: F64) -> Check:
    """T_a_b (4, 4) by paths T_a, T_b (N, 4, 4) of both bodies at stamps (N,), each in its own world.

    Raises DataError where they are too short, or turn about one axis only.
    """
    first, last = _motions(stamps_ns)
    if not len(first):
        raise DataError("hand-eye: the two paths do not overlap by a second; are they of one recording?")
    found = hand_eye(_between(T_a, first, last), _between(T_b, first, last))
    error = se3.log(se3.inverse(found.T_a_b) @ T_a_b)
    shared = max(1.0, _SPAN_NS / float(np.median(np.diff(stamps_ns))))  # motions that overlap tell the same
    sigmas = np.sqrt(error @ np.linalg.solve(found.cov * shared, error) / len(error))
    turned, shifted = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    return Check(found, float(turned), float(shifted), float(sigmas))


def _motions(stamps_ns: I64) -> tuple[I64, I64]:
    """Places (M,) where motions of about a second begin and end; none over a gap."""
    last = np.searchsorted(stamps_ns, stamps_ns + _SPAN_NS)
    first = np.flatnonzero(last < len(stamps_ns))
    near = stamps_ns[last[first]] - stamps_ns[first] < 1.5 * _SPAN_NS
    return first[near], last[first[near]]


def _between(T: F64, first: I64, last: I64) -> F64:
    return np.asarray(se3.inverse(T[first]) @ T[last], np.float64)
