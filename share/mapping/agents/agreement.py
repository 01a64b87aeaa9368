"""Which agents agree on scale, calibration and how sure they are, and which must not move others.

Every two agents are compared by the loops between them (`share.mapping.agents.pairwise`), by all of them
and by the newest, for who is right at first may be wrong later. What differs both significantly and by more
than does no harm is a disagreement. Of several agents the one that disagrees with most is set apart, as in
pairwise consistency (Mangelson et al., ICRA 2018), with agents for loops; of two, nobody can say which is
wrong, and they keep a map each. An agent is a subject here, all runs of a name
(`share.mapping.agents.identities`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Container, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from share.mapping.agents.covariance_scales import CovarianceClaims, CovarianceScales, SegmentPair
from share.mapping.agents.identities import (
    AgentIdentities,
    first_of_each_kind,
    gravity_contradictions,
    outvoted_agents,
    scale_contradiction,
    severity,
)
from share.mapping.agents.pairwise import (
    AccumulatedOdometry,
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

_MAX_LOOPS = 32  # loops kept of two stretches
_MAX_SCALES = 160
_MAX_ROTATION_RAD = np.radians(1.5)  # rad, less does no harm
_MAX_NIS = 3.0  # beyond what honest agents are too sure
_MIN_DEPTH_SCALES, _MIN_LOOPS = 3, 8  # loops before a comparison by points, or by ways, says anything
_RECENT_DEPTH_SCALES, _RECENT_LOOPS = 6, 12  # newest loops that are looked at on their own
_MIN_INLIER_SHARE = 0.6  # of the loops must fit, or they are of more than one place
_END_SEVERITY = 0.6  # a disagreement ends below this part of what began it
_APPLY_SIGMAS, _KEEP_SIGMAS = (
    2.5,
    1.25,
)  # sigmas from which on, and down to which, a scale is taken into account
_MIN_SCALE_CHANGE = 0.001  # log scale that it has to change by
_ENDED_SEGMENTS: SegmentPair = (-1, -1)  # newest loops of stretches that are gone


@dataclass(frozen=True)
class AgentStanding:
    """Of an agent, for people. state: `agrees`, `set apart`, `disputed` or `unknown`. log_scale, sigma: of
    its depths against the others'; put_right: what of it is taken out; nis: see
    `share.mapping.agents.pairwise`; None where not known. doubt: the most that is held against it and
    another; 1 begins a disagreement. widened: by what the variances of its odometry are multiplied, for it is
    too sure of them."""

    state: str = "unknown"
    reason: str = ""
    log_scale: float | None = None
    sigma: float | None = None
    put_right: float = 0.0
    nis: float | None = None
    doubt: float = 0.0
    widened: float = 1.0


@dataclass(eq=False)
class _SegmentPairLoops:
    """Loops of two stretches. ways, newest: as all of them say, and the newest. news: since then."""

    loops: list[InterAgentLoop] = field(default_factory=list)
    comparison: OdometryComparison | None = None
    recent_comparison: OdometryComparison | None = None
    new_loops: int = 0


@dataclass(eq=False)
class _AgentPair:
    """Of two agents, the lesser first. met: by stretches, those that are gone as one. scales: of more loops,
    by which what does no harm is put right."""

    by_segments: dict[SegmentPair, _SegmentPairLoops] = field(default_factory=dict)
    depth_scales: deque[DepthScale] = field(default_factory=lambda: deque(maxlen=_MAX_SCALES))
    depth_scale: ScalarEstimate | None = None
    recent_depth_scale: ScalarEstimate | None = None  # of the newest of `depth_scales`
    pooled_depth_scale: ScalarEstimate | None = None  # of all of them
    severity: float = 0.0  # 1 begins a disagreement
    disagrees: bool = False
    reason_second: str = ""  # of the second, against the first
    reason_first: str = ""  # of the first, against the second

    @property
    def nis(self) -> float | None:
        """The most that loops of two stretches say; None where they are too few."""
        return max(
            (
                segment_loops.comparison.nis
                for segment_loops in self.by_segments.values()
                if segment_loops.comparison is not None
            ),
            default=None,
        )


AgentNames = tuple[str, str]


class AgentAgreement:
    """Of all agents, which are told by their runs. tolerance: log scale that does no harm. apart: agents
    that must not move others. disputed: pairs of which nobody can say who is wrong. scale: log of how much
    too long the metres of each are, so far as that is sure; 0 where it is not there."""

    def __init__(self, tolerance: float) -> None:
        self.quarantined: frozenset[str] = frozenset()
        self.disputed: frozenset[frozenset[str]] = frozenset()
        self.log_scales: dict[str, float] = {}
        self.identities = AgentIdentities()
        self._covariance_scales = CovarianceScales(CovarianceClaims())
        self._tolerance = tolerance
        self._accumulated: dict[int, AccumulatedOdometry] = {}
        self._pairs: dict[AgentNames, _AgentPair] = {}

    def add_run(self, run: str, name: str, credential: str | None = "") -> None:
        """A run of the agent of this name comes; what is held against the name is held against the run.
        voice: see `Subjects.speaks`."""
        self.identities.add_run(run, name, self.quarantined.union(*self.disputed), credential)

    def add_step(self, run: str, node_id: int, previous_id: int | None, T_ref_body: F64, cov: F64) -> None:
        """A new node, by odometry from the one before; None: it begins a stretch."""
        previous = None if previous_id is None else self._accumulated.get(previous_id)
        self._accumulated[node_id] = (
            AccumulatedOdometry.origin() if previous is None else previous.with_step(T_ref_body, cov)
        )
        if previous_id is not None:
            self._covariance_scales.add_step(self.identities.identity(run), T_ref_body, cov)

    def log_scale(self, run: str) -> float:
        """See `scale`."""
        return self.log_scales.get(self.identities.identity(run), 0.0)

    def covariance_scale(self, run: str) -> float:
        """By what the variances of its odometry have to be multiplied to be believed."""
        return self._covariance_scales.scales.get(self.identities.identity(run), 1.0)

    def remove_nodes(self, node_ids: Collection[int], live: Container[int]) -> None:
        """Nodes that are taken out. live: stretches that have others. What loops of those that have not said
        stays only so far as it decides who agrees: a disagreement does not end because its loops went."""
        for node_id in node_ids:
            self._accumulated.pop(node_id, None)
        removed_pairs = set[SegmentPair]()
        for pair in self._pairs.values():
            if ended_pairs := {
                m for m in pair.by_segments if m != _ENDED_SEGMENTS and not (m[0] in live and m[1] in live)
            }:
                removed_pairs |= ended_pairs
                ended_loops = [
                    pair.by_segments.get(_ENDED_SEGMENTS, _SegmentPairLoops()),
                    *(pair.by_segments.pop(segment_pair) for segment_pair in sorted(ended_pairs)),
                ]
                loops = [w for segment_loops in ended_loops for w in segment_loops.loops][-_MAX_LOOPS:]
                most_severe = max(ended_loops, key=self._severity) if pair.disagrees else _SegmentPairLoops()
                pair.by_segments[_ENDED_SEGMENTS] = _SegmentPairLoops(
                    loops, most_severe.comparison, most_severe.recent_comparison
                )
        self._covariance_scales.drop_evidence(sorted(removed_pairs))

    def remove_run(self, run: str) -> None:
        """A run of which nothing is left, and that will not come back. With the last of an agent's goes all
        that is known of it, but for what is held against its name."""
        removed = self.identities.remove_run(run, self.quarantined, frozenset[str]().union(*self.disputed))
        if removed is None:
            return
        self._pairs = {names: pair for names, pair in self._pairs.items() if removed not in names}
        self.quarantined -= {removed}
        self.disputed = frozenset(names for names in self.disputed if removed not in names)
        self.log_scales.pop(removed, None)
        self._covariance_scales.remove_agent(removed)

    def add_loop(
        self,
        agents: AgentNames,
        segments: tuple[int, int],
        edge: PoseEdge,
        scale: DepthScale | None,
        tilt: tuple[float, float] | None,
    ) -> bool:
        """A verified loop between two agents' runs, `edge` between its nodes; scale, tilt: see
        `InterAgentLoop`.
        Returns whether who is apart, or disputed, has changed."""
        first, second = (self.identities.identity(run) for run in agents)
        if self.identities.name(first) == self.identities.name(second):
            return False
        if first > second:
            first, second, segments, edge = second, first, segments[::-1], edge.reverse()
            scale = None if scale is None else scale.reverse()
        pair = self._pairs.setdefault((first, second), _AgentPair())
        self._covariance_scales.link(first, second)
        segment_loops = pair.by_segments.setdefault(segments, _SegmentPairLoops())
        a, b = self._accumulated[edge.a], self._accumulated[edge.b]
        segment_loops.loops.append(InterAgentLoop(a, b, edge.T_a_b, edge.cov, scale, tilt))
        if scale is not None:
            pair.depth_scales.append(scale)
        if len(segment_loops.loops) > _MAX_LOOPS:
            del segment_loops.loops[_most_redundant_loop(segment_loops.loops)]
        segment_loops.new_loops += 1
        if segment_loops.new_loops * 6 < len(segment_loops.loops):
            return False
        segment_loops.new_loops = 0
        did_disagree = pair.disagrees
        self._compare(pair, (first, second), segments)
        changed = self._update_quarantine() if pair.disagrees or did_disagree else False
        self._update_scales()
        return changed

    def separation_reason(self, first_runs: Collection[str], second_runs: Collection[str]) -> str:
        """Why these must not come into one map with those; empty if nothing is known against it."""
        for a in map(self.identities.identity, first_runs):
            for b in map(self.identities.identity, second_runs):
                if a != b and ({a, b} & self.quarantined or frozenset((a, b)) in self.disputed):
                    return f"{a} and {b} are quarantined from each other"
        return ""

    def unverified_reason(self, first_runs: Collection[str], second_runs: Collection[str]) -> str:
        """Why these must not come into one map with those before one of them was compared; empty if they
        may."""
        identities = {self.identities.identity(run) for run in (*first_runs, *second_runs)}
        unverified = self.identities.unverified & identities if len(identities) > 1 else set[str]()
        return (
            f"{min(unverified)} has to be compared first, {self._unverified_cause(min(unverified))}"
            if unverified
            else ""
        )

    def standing(self, run: str) -> AgentStanding:
        """How it stands with the others."""
        agent = self.identities.identity(run)
        pairs = {names: pair for names, pair in self._pairs.items() if agent in names}
        disagreeing = [(names, pair) for names, pair in pairs.items() if pair.disagrees]
        nis = max((pair.nis for pair in pairs.values() if pair.nis is not None), default=None)
        log, sigma = self._estimate_scales().get(agent, (None, None))
        state = "agrees" if any(self._is_agreed(pair) for pair in pairs.values()) else "unknown"
        reason = ""
        if agent in self.quarantined:
            state, reason = "set apart", _contradiction_text(agent, disagreeing) + ": check its calibration"
        elif any(frozenset(names) in self.disputed for names, _ in disagreeing):
            state, reason = (
                "disputed",
                f"{_contradiction_text(agent, disagreeing)}; undetermined which of the two is wrong",
            )
        elif agent in self.identities.unverified:
            state, reason = "unknown", f"not compared with the others {self._unverified_cause(agent)}"
        doubt = max((pair.severity for pair in pairs.values()), default=0.0)
        return AgentStanding(
            state,
            reason,
            log,
            sigma,
            self.log_scales.get(agent, 0.0),
            nis,
            doubt,
            self.covariance_scale(agent),
        )

    def _unverified_cause(self, unverified: str) -> str:
        if unverified in self.identities.suspected:
            return "since an earlier run of its name was quarantined"
        return "since the edge was started again"

    def contradictions(self) -> dict[AgentNames, float]:
        """What is held against every two agents that met, the lesser first; 1 begins a disagreement."""
        return {names: pair.severity for names, pair in self._pairs.items()}

    # ------------------------------------------------------------ two agents

    def _compare(self, pair: _AgentPair, names: AgentNames, segment_pair: SegmentPair) -> None:
        segment_loops = pair.by_segments[segment_pair]
        all_loops = [w for one in pair.by_segments.values() for w in one.loops]
        scales = [w.depth_scale for w in all_loops if w.depth_scale is not None]
        pair.depth_scale = _pool_scales(scales)
        pair.recent_depth_scale = (
            _pool_scales(list(pair.depth_scales)[-_RECENT_DEPTH_SCALES:])
            if len(scales) > _RECENT_DEPTH_SCALES
            else None
        )
        pair.pooled_depth_scale = _pool_scales(pair.depth_scales)
        equations_of_pair = _compare_paths(
            segment_loops,
            (self._covariance_scales.claims(names[0]), self._covariance_scales.claims(names[1])),
        )
        contradictions = [
            *self._depth_contradictions(pair),
            *gravity_contradictions(all_loops),
            *gravity_contradictions(segment_loops.loops[-_MIN_LOOPS:]),
        ]
        for one in pair.by_segments.values():
            contradictions += [
                *self._path_contradictions(one.comparison),
                *self._path_contradictions(one.recent_comparison),
            ]
        pair.severity = max((severity for severity, _, _ in contradictions), default=0.0)
        pair.disagrees = pair.severity >= (_END_SEVERITY if pair.disagrees else 1.0)
        if pair.disagrees:
            self._covariance_scales.drop_evidence(pair.by_segments)
        else:
            if _ENDED_SEGMENTS in pair.by_segments:
                pair.by_segments[_ENDED_SEGMENTS].comparison = pair.by_segments[
                    _ENDED_SEGMENTS
                ].recent_comparison = None
            self._mark_verified(pair, names)
            if (
                equations_of_pair is not None
                and segment_loops.comparison is not None
                and not self.quarantined & {*names}
            ):
                with suppress(np.linalg.LinAlgError):  # of absurd numbers, which say nothing
                    self._covariance_scales.set_evidence(
                        segment_pair, names, equations_of_pair, segment_loops.comparison.weights
                    )
        reported = sorted((f for f in contradictions if f[0] >= _END_SEVERITY), reverse=True)
        pair.reason_second, pair.reason_first = (
            first_of_each_kind([t for _, t, _ in reported]),
            first_of_each_kind([t for *_, t in reported]),
        )

    def _mark_verified(self, pair: _AgentPair, names: AgentNames) -> None:
        """Who was to be compared has been, if the other is not under suspicion itself. What was wrong with a
        name before may have been its way, so there depths are not enough."""
        has_comparison = any(
            segment_loops.comparison is not None for segment_loops in pair.by_segments.values()
        )
        for one, other in (names, names[::-1]):
            was_suspected = one in self.identities.suspected
            is_suspect = other in self.quarantined or (was_suspected and other in self.identities.unverified)
            if not is_suspect and (has_comparison or (self._is_agreed(pair) and not was_suspected)):
                self.identities.mark_verified(one)

    def _depth_contradictions(self, pair: _AgentPair) -> list[tuple[float, str, str]]:
        estimates = [points for points in (pair.depth_scale, pair.recent_depth_scale) if points is not None]
        words = "its depths are {} % {}", ("larger", "smaller")
        return [scale_contradiction(points, self._tolerance, *words) for points in estimates]

    def _path_contradictions(self, comparison: OdometryComparison | None) -> list[tuple[float, str, str]]:
        if comparison is None:
            return []
        out = []
        if comparison.inlier_share >= _MIN_INLIER_SHARE:
            out.append(
                scale_contradiction(
                    comparison.path_scale, self._tolerance, "its path is {} % {}", ("longer", "shorter")
                )
            )
            rotation_text = (
                f"its camera is rotated by {np.degrees(comparison.camera_rotation.value):.1f} "
                f"degrees against its calibration"
            )
            out.append(
                (severity(comparison.camera_rotation, _MAX_ROTATION_RAD), rotation_text, rotation_text)
            )
        text = f"loops are off by {comparison.nis:.1f} times its stated variance"
        out.append((comparison.nis / _MAX_NIS, text, text))
        return out

    def _severity(self, segment_loops: _SegmentPairLoops) -> float:
        """By its ways."""
        return max(
            (
                s
                for s, _, _ in (
                    *self._path_contradictions(segment_loops.comparison),
                    *self._path_contradictions(segment_loops.recent_comparison),
                )
            ),
            default=0.0,
        )

    def _is_agreed(self, pair: _AgentPair) -> bool:
        return (
            not pair.disagrees
            and pair.depth_scale is not None
            and pair.depth_scale.sigma < self._tolerance / 2
        )

    # ------------------------------------------------------------ all agents

    def _update_quarantine(self) -> bool:
        """Who is apart: whoever is outvoted by every voice that those may have whose voice is not known; one
        of a name that was set apart before is a suspect. Whether that has changed."""
        disagreeing = {frozenset(names) for names, pair in self._pairs.items() if pair.disagrees}
        agreeing = [names for names, pair in self._pairs.items() if self._is_agreed(pair)]
        agents = {name for names in self._pairs for name in names}
        suspects = {name for name in agents if self.identities.had_quarantined_run(name, self.quarantined)}
        quarantined = frozenset(agents)
        for credentials in self.identities.credential_hypotheses(agents):
            if quarantined:  # else no other way can change that
                quarantined &= outvoted_agents(disagreeing, agreeing, credentials, suspects)
        previous = self.quarantined, self.disputed
        self.quarantined = quarantined
        self.disputed = frozenset(names for names in disagreeing if not names & quarantined)
        self._covariance_scales.exclude(quarantined)
        return previous != (self.quarantined, self.disputed)

    def _update_scales(self) -> None:
        """What is sure of everybody's scale; nothing of those kept apart, for their maps are theirs."""
        separated = self.quarantined.union(*self.disputed)
        known = self._estimate_scales(separated)
        for agent in sorted(known.keys() | self.log_scales.keys()):
            log, sigma = known.get(agent, (0.0, 1.0))
            previous = self.log_scales.get(agent, 0.0)
            new = log if abs(log) > (_KEEP_SIGMAS if previous else _APPLY_SIGMAS) * sigma else 0.0
            if abs(new - previous) > _MIN_SCALE_CHANGE:
                self.log_scales[agent] = new

    def _estimate_scales(self, excluded: Collection[str] = ()) -> Mapping[str, tuple[float, float]]:
        """Log scale of every agent's depths against the median of those that are not apart, by least squares
        over all pairs but those with somebody who is left out; and its sigma."""
        gauges_by_pair = (
            (names, pair.pooled_depth_scale)
            for names, pair in self._pairs.items()
            if not {*names} & {*excluded}
        )
        known = [(names, gauge) for names, gauge in gauges_by_pair if gauge is not None]
        agents = sorted({name for names, _ in known for name in names})
        if not agents:
            return {}
        column = {name: i for i, name in enumerate(agents)}
        J, z = np.zeros((len(known), len(agents))), np.zeros(len(known))
        for row, ((a, b), points) in enumerate(known):
            J[row, column[a]], J[row, column[b]] = -1 / points.sigma, 1 / points.sigma
            z[row] = points.value / points.sigma
        x = np.linalg.pinv(J) @ z
        by_credential = {
            self.identities.credential(agent): x[column[agent]]
            for agent in agents
            if agent not in self.quarantined
        }
        x -= np.median([*by_credential.values()] or x)  # a voice counts once
        sigma = np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))
        return {name: (float(x[i]), float(sigma[i])) for name, i in column.items()}


def _compare_paths(
    segment_loops: _SegmentPairLoops, widths: tuple[float, float]
) -> ComparisonEquations | None:
    """Of all of its loops; None where they are too few, or absurd numbers leave no solution. widths: by what
    either's claims alone are widened, see `solve_comparison`."""
    segment_loops.comparison = segment_loops.recent_comparison = None
    if len(segment_loops.loops) < _MIN_LOOPS:
        return None
    with suppress(np.linalg.LinAlgError):
        equations_of_pair = comparison_equations(segment_loops.loops)
        segment_loops.comparison = solve_comparison(equations_of_pair, widths)
        if len(segment_loops.loops) > _RECENT_LOOPS:
            segment_loops.recent_comparison = compare_odometry(segment_loops.loops[-_RECENT_LOOPS:], widths)
        return equations_of_pair
    return None


def _pool_scales(scales: Collection[DepthScale]) -> ScalarEstimate | None:
    return robust_depth_scale(list(scales)) if len(scales) >= _MIN_DEPTH_SCALES else None


def _contradiction_text(agent: str, disagreeing: list[tuple[AgentNames, _AgentPair]]) -> str:
    """From the pairs in which it disagrees."""
    texts = []
    for (first, second), pair in disagreeing:
        other, text = (first, pair.reason_second) if agent == second else (second, pair.reason_first)
        texts.append(f"against {other} {text}")
    return "; ".join(texts)


def _most_redundant_loop(loops: list[InterAgentLoop]) -> int:
    """Of the two loops that are most alike by where they end, the older."""
    positions = np.array([(w.a.index, w.b.index) for w in loops])
    distance = np.abs(positions[:, None] - positions[None]).sum(2).astype(float)
    np.fill_diagonal(distance, np.inf)
    first, second = np.unravel_index(int(distance.argmin()), distance.shape)
    return int(min(first, second))
