"""Estimates by how much agents understate the covariances of their odometry, from the loops between them.

With the loops' equations (`share.mapping.agents.pairwise`) and f_a, f_b, g the factors by which the variances
of either random walk and of the loops exceed the stated ones,

    cov(xi) = f_a W_a + f_b W_b + g S,    xi = J G + noise,

a variance-components model. With P the inverse covariance that projects out G, and y = xi,

    q_k = y' P V_k P y,    F_kl = tr(P V_k P V_l),    E q = F (f_a, f_b, g)

for any factors in P, so the equations of all pairs add up; at the solution this is restricted maximum
likelihood. F is in degrees of freedom over f^2, so a prior of n degrees of freedom adds n of them: with few
loops the factors stay at 1, or higher for an agent that states much less than the others
(`StatedCovariances`). No factor below 1 is applied. Source: C. R. Rao, *Estimation of variance and covariance
components: MINQUE theory*, J. Multivariate Analysis 1, 1971; Patterson and Thompson, *Biometrika* 58, 1971.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.agents.pairwise import ComparisonEquations
from share.types import F64, I64

_MAX_STEPS = 64  # newest of each agent
_MIN_STEPS = 8
_STATED_TOLERANCE = 2.25  # variance (1.5 sigma), by which good agents differ as they move differently
_MAX_STATED_SCALE = 100.0  # variance; without evidence from loops no more is applied
_SAME_MEDIAN = 0.02  # of the logarithm; with a smaller change, all agents' scales need not be estimated anew
_LEVER_M = 1.0  # length of a step equivalent to a rotation of 1 rad


class StatedCovariances:
    """Compares the covariances that agents state for their steps.

    Before loops give evidence, the agent that states the least would bend the others in a merge. So until
    then no agent counts as much more certain than the best of the others, by the median variance of its steps
    over their size, for position and rotation. Covariances come here inflated (`inflate_covariance`), so one
    far below the floor counts as the floor.
    """

    def __init__(self) -> None:
        self._steps: dict[str, deque[tuple[float, float]]] = {}
        self._medians: dict[str, F64] = {}
        self._excluded: set[str] = set()
        self._linked: dict[str, set[str]] = {}

    @property
    def known_agents(self) -> set[str]:
        return set(self._medians)

    def add_step(self, agent: str, T_ref_body: F64, cov: F64) -> bool:
        """Add a step (4, 4) with its covariance (6, 6); return whether the agent's median changed, and it is
        compared with others."""
        size = float(np.linalg.norm(T_ref_body[:3, 3]) + _LEVER_M * se3.rotation_angle(T_ref_body))
        rotation_variance, position_variance = float(np.trace(cov[:3, :3])), float(np.trace(cov[3:, 3:]))
        if not min(size, rotation_variance, position_variance) > 0:
            return False
        steps = self._steps.setdefault(agent, deque(maxlen=_MAX_STEPS))
        steps.append((np.log(rotation_variance / size), np.log(position_variance / size)))
        if len(steps) < _MIN_STEPS:
            return False
        median = np.median(np.array(steps), axis=0)
        if agent in self._medians and np.abs(median - self._medians[agent]).max() < _SAME_MEDIAN:
            return False
        self._medians[agent] = median
        return bool(self._linked.get(agent))

    def link(self, first: str, second: str) -> None:
        """Compare these agents from now on: there is a loop between them."""
        self._linked.setdefault(first, set()).add(second)
        self._linked.setdefault(second, set()).add(first)

    def remove_agent(self, agent: str) -> None:
        self._steps.pop(agent, None)
        self._medians.pop(agent, None)
        self._excluded.discard(agent)
        for other in self._linked.pop(agent, set()):
            self._linked[other].discard(agent)

    def exclude(self, agents: Collection[str]) -> bool:
        """Compare no agent with these; return whether the set changed."""
        previous, self._excluded = self._excluded, set(agents)
        return previous != self._excluded

    def min_scale(self, agent: str) -> float:
        """Least factor on the agent's variances; 1 where they are not unusual."""
        linked = self._linked.get(agent, set()) - self._excluded
        others = [self._medians[name] for name in linked if name in self._medians]
        if agent not in self._medians or not others:
            return 1.0
        smallest = np.min(others, axis=0)
        ratio = float(np.exp((smallest - self._medians[agent]).max()))
        return min(max(1.0, ratio / _STATED_TOLERANCE), _MAX_STATED_SCALE)


_MIN_LOOP_WEIGHT = 0.4  # false loops are no evidence on odometry
_MIN_LOOPS = 8
_PRIOR_DOF = 4.0  # of an agent's factor
_LOOP_PRIOR_SCALE = 1.7  # true loops understate their variance a little
_LOOP_PRIOR_DOF = 12.0
_MIN_SCALE, _MAX_SCALE = 0.25, 1e4
_APPLY_ABOVE = 2.0  # factor at which it is applied
_KEEP_ABOVE = 1.5  # factor down to which it stays applied
_MIN_CHANGE_RATIO = 1.25

SegmentPair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class _VarianceEvidence:
    """Evidence of the loops of two segments, of agents a and b.

    q (3,), F (3, 3): of either random walk and of the loops, computed at the factors linearised_at (3,).
    """

    agents: tuple[str, str]
    q: F64
    F: F64
    linearised_at: F64


class CovarianceScales:
    """scales: factor on the variances of each agent's odometry; 1 where missing. evidence: by segments."""

    def __init__(self, stated: StatedCovariances | None = None) -> None:
        self.scales: dict[str, float] = {}
        self.stated = StatedCovariances() if stated is None else stated
        self._estimates: dict[str, float] = {}  # before thresholds
        self._loop_scales: dict[SegmentPair, float] = {}
        self.evidence: dict[SegmentPair, _VarianceEvidence] = {}

    def add_step(self, agent: str, T_ref_body: F64, cov: F64) -> bool:
        """Add a step (4, 4) of an agent's odometry with its covariance (6, 6); return whether scales may have
        changed."""
        if is_compared := self.stated.add_step(agent, T_ref_body, cov):
            self._estimate()
        return is_compared

    def set_evidence(
        self, segment_pair: SegmentPair, agents: tuple[str, str], equations: ComparisonEquations, weights: F64
    ) -> None:
        """Replace the evidence of two segments by that of their loops, of weight (N,) each.

        Raises LinAlgError where absurd numbers leave no solution.
        """
        self.stated.link(*agents)
        inliers = np.flatnonzero(weights > _MIN_LOOP_WEIGHT)
        if len(inliers) < _MIN_LOOPS:
            self.drop_evidence([segment_pair])
            return
        estimates = [self._estimates.get(agent, self.stated.min_scale(agent)) for agent in agents]
        factors = np.array([*estimates, self._loop_scales.get(segment_pair, _LOOP_PRIOR_SCALE)])
        self.evidence[segment_pair] = _VarianceEvidence(
            agents, *_variance_components(equations, inliers, factors), factors
        )
        self._estimate()

    def drop_evidence(self, segment_pairs: Iterable[SegmentPair]) -> None:
        """Drop the evidence of these segments: their odometries contradict, or are removed."""
        dropped = [pair for pair in segment_pairs if self.evidence.pop(pair, None) is not None]
        if dropped:
            self._estimate()

    def exclude(self, agents: Collection[str]) -> None:
        """Drop the evidence of these agents, and compare no stated covariances with theirs."""
        if self.stated.exclude(agents):
            self._estimate()
        excluded = set(agents)
        self.drop_evidence([pair for pair, one in self.evidence.items() if excluded & set(one.agents)])

    def remove_agent(self, agent: str) -> None:
        self.evidence = {pair: one for pair, one in self.evidence.items() if agent not in one.agents}
        self.stated.remove_agent(agent)
        self._estimate()
        self.scales.pop(agent, None)

    def _estimate(self) -> None:
        agents = sorted({name for evidence in self.evidence.values() for name in evidence.agents})
        column, n = {name: i for i, name in enumerate(agents)}, len(agents)
        size = n + len(self.evidence)
        q, F, linearised_at = np.zeros(size), np.zeros((size, size)), np.full(size, _MAX_SCALE)
        for row, evidence in enumerate(self.evidence.values(), start=n):
            rows = [column[name] for name in evidence.agents] + [row]
            q[rows] += evidence.q
            F[np.ix_(rows, rows)] += evidence.F
            linearised_at[rows] = np.minimum(linearised_at[rows], evidence.linearised_at)
        min_scales = np.array([self.stated.min_scale(name) for name in agents])
        prior = np.append(min_scales, np.full(len(self.evidence), _LOOP_PRIOR_SCALE))
        dof = np.append(np.full(n, _PRIOR_DOF), np.full(len(self.evidence), _LOOP_PRIOR_DOF))
        prior_information = dof / np.where(linearised_at < _MAX_SCALE, linearised_at, prior) ** 2
        estimates = np.linalg.solve(F + np.diag(prior_information), q + prior_information * prior).clip(
            _MIN_SCALE, _MAX_SCALE
        )
        self._loop_scales = dict(zip(self.evidence, estimates[n:].tolist(), strict=True))
        self._estimates = dict(zip(agents, estimates[:n].tolist(), strict=True))
        for name in sorted({*agents, *self.scales, *self.stated.known_agents}):
            self._update_scale(name, self._estimates.get(name, self.stated.min_scale(name)))

    def _update_scale(self, name: str, estimate: float) -> None:
        previous = self.scales.get(name, 1.0)
        estimate = estimate if estimate > (_KEEP_ABOVE if previous > 1 else _APPLY_ABOVE) else 1.0
        if max(estimate / previous, previous / estimate) > _MIN_CHANGE_RATIO:
            self.scales[name] = estimate


def _variance_components(equations: ComparisonEquations, inliers: I64, factors: F64) -> tuple[F64, F64]:
    n = len(inliers)
    loop_cov = np.zeros((n, 6, n, 6))
    loop_cov[range(n), :, range(n)] = equations.loop_cov[inliers]
    block = np.ix_(inliers, np.arange(6), inliers, np.arange(6))
    parts = [
        V.reshape(6 * n, 6 * n) for V in (equations.walk_cov_a[block], equations.walk_cov_b[block], loop_cov)
    ]
    J, y = equations.J[inliers][:, :, :6].reshape(6 * n, 6), equations.xi[inliers].ravel()
    inverse = np.linalg.inv(sum(f * V for f, V in zip(factors, parts, strict=True)))
    IJ = inverse @ J
    P = inverse - IJ @ np.linalg.solve(J.T @ IJ, IJ.T)
    Py, PV = P @ y, [P @ V for V in parts]
    q = np.array([float(Py @ V @ Py) for V in parts])
    return q, np.array([[float((A * B.T).sum()) for B in PV] for A in PV])
