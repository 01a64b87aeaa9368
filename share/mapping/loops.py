"""Loops between keyframes, and the test whether two loops agree.

Two loops between the same two maps are consistent if T_a1_b1 = T_a1_a2 T_a2_b2 T_b2_b1 within their
covariances and those of the paths a1 - a2 and b2 - b1. Source: pairwise consistency, Mangelson et al., ICRA
2018.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from share.checks import checked_array, checked_pose
from share.geometry import se3
from share.types import F64


class KeyframeKey(NamedTuple):
    """Identity of a keyframe. `agent` names one run of an agent; ids start again with each run."""

    agent: str
    id: int

    def __str__(self) -> str:
        return f"{self.agent}:{self.id}"


@dataclass(frozen=True, eq=False)
class Loop:
    """A verified relative pose of two keyframes: T_a_b (4, 4) of their bodies, cov (6, 6), inlier count.

    found_share: share of the points visible in both views that both views show
    (`share.mapping.missing_points`); None if not computed. is_confirmed: as in `Verification`; not kept in
    the map file.
    """

    a: KeyframeKey
    b: KeyframeKey
    T_a_b: F64
    cov: F64
    inliers: int
    found_share: float | None = None
    is_confirmed: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_a_b", checked_pose("T_a_b", self.T_a_b))
        object.__setattr__(self, "cov", checked_array("cov", self.cov, (6, 6), np.float64))

    @cached_property
    def keyframes(self) -> frozenset[KeyframeKey]:
        """The two keyframes, unordered."""
        return frozenset((self.a, self.b))

    @cached_property
    def view_offset(self) -> tuple[float, float]:
        """Distance (m) and angle (rad) between the two views."""
        return float(np.linalg.norm(self.T_a_b[:3, 3])), float(se3.rotation_angle(self.T_a_b))

    def reverse(self) -> Loop:
        """Return the loop from b to a. Cached, since a pending loop is reversed again and again."""
        return self._cached_reverse

    @cached_property
    def _cached_reverse(self) -> Loop:
        T_b_a, cov = se3.inverse(self.T_a_b), se3.inverse_cov(self.T_a_b, self.cov)
        return Loop(self.b, self.a, T_b_a, cov, self.inliers, self.found_share, self.is_confirmed)

    def __str__(self) -> str:
        return f"{self.a} - {self.b}"


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A relative pose T (..., 4, 4) with its covariance (..., 6, 6); a batch is iterable."""

    T: F64
    cov: F64

    def compose(self, other: RelativePose) -> RelativePose:
        return RelativePose(self.T @ other.T, se3.compose_cov(other.T, self.cov, other.cov))

    def __iter__(self) -> Iterator[RelativePose]:
        """Iterate over the poses of a batch."""
        return (RelativePose(T, cov) for T, cov in zip(self.T, self.cov, strict=True))


@dataclass(frozen=True)
class Disagreement:
    """Difference between two estimates of one relative pose."""

    chi2: float
    distance_m: float
    angle_deg: float

    def __str__(self) -> str:
        return f"{self.distance_m:.2f} m and {self.angle_deg:.1f}° apart, chi2 {self.chi2:.0f}"


def inverse_pose(pose: RelativePose) -> RelativePose:
    """Return T_b_a for T_a_b, with its covariance."""
    return RelativePose(se3.inverse(pose.T), se3.inverse_cov(pose.T, pose.cov))


def disagreement(first: RelativePose, second: RelativePose) -> Disagreement:
    """Compare two independent estimates of the same pose."""
    xi, chi2 = _difference(first, second)
    metres, radians = np.linalg.norm(xi[3:]), np.linalg.norm(xi[:3])
    return Disagreement(float(chi2), float(metres), float(np.degrees(radians)))


def pairwise_chi2(first: Loop, a1_a2: RelativePose, second: Sequence[Loop], b2_b1: RelativePose) -> F64:
    """Return the chi-square (N,) of each loop in `second` against `first`.

    a1_a2, b2_b1: relative poses (N, ...) between their ends on either side.
    """
    measured = RelativePose(
        np.array([loop.T_a_b for loop in second]), np.array([loop.cov for loop in second])
    )
    return _difference(RelativePose(first.T_a_b, first.cov), a1_a2.compose(measured).compose(b2_b1))[1]


def _difference(first: RelativePose, second: RelativePose) -> tuple[F64, F64]:
    """Return xi (..., 6) from `first` to `second` and its squared Mahalanobis length (...)."""
    xi = se3.log(se3.inverse(first.T) @ second.T)
    weighted = np.linalg.solve(first.cov + second.cov, xi[..., None])[..., 0]
    return xi, np.asarray((xi * weighted).sum(-1))
