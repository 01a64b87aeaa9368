"""Comparison of two agents: their loops, and the contradictions between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from share.mapping.agents.covariance_scales import SegmentPair
from share.mapping.agents.pairwise import (
    ComparisonEquations,
    InterAgentLoop,
    OdometryComparison,
    ScalarEstimate,
    compare_odometry,
    comparison_equations,
    robust_depth_scale,
    solve_comparison,
)
from share.mapping.graph.edges import PoseEdge
from share.mapping.recognition.depth_scale import DepthScale
from share.types import F64

SCALE_TOLERANCE = 0.015  # log scale that is harmless; agents disagree whose depths or paths differ by more
_MAX_LOOPS = 32  # kept of two segments
_MAX_SCALES = 160
_MAX_ROTATION_RAD = np.radians(1.5)  # harmless below
_MAX_NIS = 3.0  # larger than that of good agents that understate their covariances
_MIN_DEPTH_SCALES = 3  # loops for a comparison of depths
_MIN_LOOPS = 8  # loops for a comparison of paths
_RECENT_DEPTH_SCALES = 6  # newest loops that are compared separately
_RECENT_LOOPS = 12
_MIN_INLIER_SHARE = 0.6  # of the loops; with fewer they are of more than one place
_END_SEVERITY = 0.6  # a disagreement begins at 1 and ends below this
_ENDED_SEGMENTS: SegmentPair = (-1, -1)  # key of the newest loops of removed segments
_MIN_SIGMAS = 4.5  # significance of a disagreement: none by chance in thousands of comparisons
_MAX_TILT_RAD = np.radians(1.0)  # harmless below
_MIN_TILTS = 8  # loops with known up directions
_MIN_VIEWS = 8  # keyframes of either agent in loops that contradict: loops of one view share its error

# Severity, a disagreement begins at 1; text about the second agent, and about the first.
Contradiction = tuple[float, str, str]


@dataclass(eq=False)
class SegmentPairLoops:
    """Loops of two segments, compared by all of them and by the newest. new_loops: not yet compared."""

    loops: list[InterAgentLoop] = field(default_factory=list)
    comparison: OdometryComparison | None = None
    recent_comparison: OdometryComparison | None = None
    new_loops: int = 0

    def add(self, loop: InterAgentLoop) -> bool:
        """Add a loop; return whether enough are new for another comparison."""
        self.loops.append(loop)
        if len(self.loops) > _MAX_LOOPS:
            del self.loops[_most_redundant_loop(self.loops)]
        self.new_loops += 1
        if self.new_loops * 6 < len(self.loops):
            return False
        self.new_loops = 0
        return True

    def compare(self, covariance_scales: tuple[float, float]) -> ComparisonEquations | None:
        """Compare by all loops and by the newest; return the equations of all.

        None with too few loops, or where absurd numbers leave no solution. covariance_scales: see
        `solve_comparison`.
        """
        self.comparison = self.recent_comparison = None
        if len(self.loops) < _MIN_LOOPS:
            return None
        with suppress(np.linalg.LinAlgError):
            equations = comparison_equations(self.loops)
            self.comparison = solve_comparison(equations, covariance_scales)
            if len(self.loops) > _RECENT_LOOPS:
                self.recent_comparison = compare_odometry(self.loops[-_RECENT_LOOPS:], covariance_scales)
            return equations
        return None


class AgentPair:
    """Comparison of two agents, in alphabetical order.

    by_segments: loops by pair of segments; those of ended segments are pooled. severity: a disagreement
    begins at 1. reason_second: contradictions of the second agent against the first; reason_first: the
    reverse. pooled_depth_scale: of more loops than are kept in by_segments.
    """

    def __init__(self) -> None:
        self.by_segments: dict[SegmentPair, SegmentPairLoops] = {}
        self.pooled_depth_scale: ScalarEstimate | None = None
        self.severity = 0.0
        self.disagrees = False
        self.reason_second = self.reason_first = ""
        self._depth_scales = deque[DepthScale](maxlen=_MAX_SCALES)
        self._depth_scale: ScalarEstimate | None = None
        self._recent_depth_scale: ScalarEstimate | None = None

    @property
    def nis(self) -> float | None:
        """Largest value over pairs of segments; None with too few loops."""
        comparisons = (segment_loops.comparison for segment_loops in self.by_segments.values())
        return max((comparison.nis for comparison in comparisons if comparison is not None), default=None)

    @property
    def has_path_comparison(self) -> bool:
        """True if two segments have enough loops to compare the paths."""
        return any(segment_loops.comparison is not None for segment_loops in self.by_segments.values())

    @property
    def agrees(self) -> bool:
        """True if the depths are known to agree and nothing contradicts."""
        depth_scale = self._depth_scale
        return not self.disagrees and depth_scale is not None and depth_scale.sigma < SCALE_TOLERANCE / 2

    def add_loop(self, segment_pair: SegmentPair, loop: InterAgentLoop) -> bool:
        """Add a loop; return whether it is time for another comparison."""
        segment_loops = self.by_segments.setdefault(segment_pair, SegmentPairLoops())
        if loop.depth_scale is not None:
            self._depth_scales.append(loop.depth_scale)
        return segment_loops.add(loop)

    def compare(
        self, segment_pair: SegmentPair, covariance_scales: tuple[float, float]
    ) -> ComparisonEquations | None:
        """Compare by all loops, with new path estimates of these segments; return their equations."""
        segment_loops = self.by_segments[segment_pair]
        all_loops = [loop for others in self.by_segments.values() for loop in others.loops]
        scales = [loop.depth_scale for loop in all_loops if loop.depth_scale is not None]
        self._depth_scale, self._recent_depth_scale = _pool_scales(scales), None
        if len(scales) > _RECENT_DEPTH_SCALES:
            self._recent_depth_scale = _pool_scales(list(self._depth_scales)[-_RECENT_DEPTH_SCALES:])
        self.pooled_depth_scale = _pool_scales(self._depth_scales)
        equations = segment_loops.compare(covariance_scales)
        contradictions = [
            *self._depth_contradictions(),
            *gravity_contradictions(all_loops),
            *gravity_contradictions(segment_loops.loops[-_RECENT_LOOPS:]),
        ]
        for others in self.by_segments.values():
            contradictions += self._path_contradictions(others)
        self.severity = max((severity for severity, _, _ in contradictions), default=0.0)
        self.disagrees = self.severity >= (_END_SEVERITY if self.disagrees else 1.0)
        reported = sorted((c for c in contradictions if c[0] >= _END_SEVERITY), reverse=True)
        self.reason_second = first_of_each_kind([text for _, text, _ in reported])
        self.reason_first = first_of_each_kind([text for *_, text in reported])
        if not self.disagrees and _ENDED_SEGMENTS in self.by_segments:
            ended = self.by_segments[_ENDED_SEGMENTS]
            ended.comparison = ended.recent_comparison = None
        return equations

    def end_segments(self, live: Container[int]) -> set[SegmentPair]:
        """Pool the loops of segments that are not live; return their pairs.

        They stay as evidence of agreement only: a disagreement does not end because its loops were removed.
        """
        ended = {
            pair
            for pair in self.by_segments
            if pair != _ENDED_SEGMENTS and not (pair[0] in live and pair[1] in live)
        }
        if not ended:
            return ended
        ended_loops = [
            self.by_segments.get(_ENDED_SEGMENTS, SegmentPairLoops()),
            *(self.by_segments.pop(pair) for pair in sorted(ended)),
        ]
        loops = [loop for segment_loops in ended_loops for loop in segment_loops.loops][-_MAX_LOOPS:]
        most_severe = max(ended_loops, key=self._path_severity) if self.disagrees else SegmentPairLoops()
        self.by_segments[_ENDED_SEGMENTS] = SegmentPairLoops(
            loops, most_severe.comparison, most_severe.recent_comparison
        )
        return ended

    def _depth_contradictions(self) -> list[Contradiction]:
        estimates = [scale for scale in (self._depth_scale, self._recent_depth_scale) if scale is not None]
        words = "its depths are {} % {}", ("larger", "smaller")
        return [scale_contradiction(scale, *words) for scale in estimates]

    def _path_contradictions(self, segment_loops: SegmentPairLoops) -> list[Contradiction]:
        out: list[Contradiction] = []
        if _count_views(segment_loops.loops) < _MIN_VIEWS:
            return out
        for comparison in (segment_loops.comparison, segment_loops.recent_comparison):
            if comparison is None:
                continue
            if comparison.inlier_share >= _MIN_INLIER_SHARE:
                words = "its path is {} % {}", ("longer", "shorter")
                out.append(scale_contradiction(comparison.path_scale, *words))
                rotation = comparison.camera_rotation
                degrees = np.degrees(rotation.value)
                text = f"its camera is rotated by {degrees:.1f} degrees against its calibration"
                out.append((severity(rotation, _MAX_ROTATION_RAD), text, text))
            text = f"its loops deviate by {comparison.nis:.1f} times the variance that it states"
            out.append((comparison.nis / _MAX_NIS, text, text))
        return out

    def _path_severity(self, segment_loops: SegmentPairLoops) -> float:
        return max((value for value, _, _ in self._path_contradictions(segment_loops)), default=0.0)


def _pool_scales(scales: Collection[DepthScale]) -> ScalarEstimate | None:
    return robust_depth_scale(list(scales)) if len(scales) >= _MIN_DEPTH_SCALES else None


def _most_redundant_loop(loops: list[InterAgentLoop]) -> int:
    """Index of the older of the two loops whose ends are closest."""
    positions = np.array([(loop.a.index, loop.b.index) for loop in loops])
    distance = np.abs(positions[:, None] - positions[None]).sum(2).astype(float)
    np.fill_diagonal(distance, np.inf)
    first, second = np.unravel_index(int(distance.argmin()), distance.shape)
    return int(min(first, second))


# Contradictions


def _count_views(loops: Sequence[InterAgentLoop]) -> int:
    """Count the keyframes in the loops, of the agent that has fewer."""
    return min(len({loop.a.index for loop in loops}), len({loop.b.index for loop in loops}))


def tilt_between(
    up_a: F64, sigma_a: float, up_b: F64, sigma_b: float, edge: PoseEdge
) -> tuple[float, float] | None:
    """Angle between two up directions (3,) across a loop, and its sigma, rad; None if one is unknown."""
    if not up_a.any() or not up_b.any():
        return None
    up_b_in_a = edge.T_a_b[:3, :3] @ up_b
    cross = np.linalg.norm(np.cross(up_a, up_b_in_a)) / np.linalg.norm(up_a) / np.linalg.norm(up_b)
    sigma = np.sqrt(sigma_a**2 + sigma_b**2 + np.trace(edge.cov[:3, :3]) / 3)
    return float(np.arcsin(min(1.0, float(cross)))), float(sigma)


def gravity_contradictions(loops: list[InterAgentLoop]) -> list[Contradiction]:
    """Contradiction between the two agents' up directions, if enough loops know them."""
    with_tilt = [loop for loop in loops if loop.tilt is not None]
    if len(with_tilt) < _MIN_TILTS or _count_views(with_tilt) < _MIN_VIEWS:
        return []
    known = np.array([loop.tilt for loop in with_tilt])
    angle, sigmas = float(np.median(known[:, 0])), float(np.median(known[:, 0] / known[:, 1]))
    text = f"its up direction is {np.degrees(angle):.1f} degrees off"
    return [(min(angle / _MAX_TILT_RAD, sigmas / _MIN_SIGMAS), text, text)]


def severity(estimate: ScalarEstimate, tolerance: float) -> float:
    """Severity 1 is reached at the tolerance or at the required significance, whichever comes later."""
    return min(abs(estimate.value) / tolerance, estimate.significance / _MIN_SIGMAS)


def scale_contradiction(estimate: ScalarEstimate, text: str, words: tuple[str, str]) -> Contradiction:
    """Contradiction in scale, with either agent's text; `text` has places for the size and a word."""
    size = f"{100 * abs(np.expm1(estimate.value)):.1f} ± {100 * np.exp(estimate.value) * estimate.sigma:.1f}"
    more, less = (text.format(size, word) for word in words)
    return (severity(estimate, SCALE_TOLERANCE), *((more, less) if estimate.value > 0 else (less, more)))


def first_of_each_kind(texts: list[str]) -> str:
    """Keep the first text of each kind, by its first two words."""
    kinds = {" ".join(text.split()[:2]): text for text in reversed(texts)}
    return ", ".join(text for text in texts if text in kinds.values())
