"""How much too sure agents are of their odometry, as the loops between them tell.

With the loops' equations (`share.mapping.agents.pairwise`) and f_a, f_b, g the factors by which the
variances of either walk and of the loops are really larger than claimed,

    cov(xi) = f_a W_a + f_b W_b + g S,    xi = J G + noise,

which is a model of variance components. With P the inverse covariance that leaves no G, and y = xi,

    q_k = y' P V_k P y,    F_kl = tr(P V_k P V_l),    E q = F (f_a, f_b, g)

whatever factors P was made with, so what all pairs say simply adds up; at the solution it is restricted
maximum likelihood. F is in units of degrees of freedom over f^2, so a prior of n degrees of freedom is n more
of them: of few loops the factors are as before any, 1, or above where an agent claims to be much surer than
any other (`CovarianceClaims`). Nobody is believed to be less sure than it says.
Source: C. R. Rao, *Estimation of variance and covariance components: MINQUE theory*, J. Multivariate Analysis
1, 1971; Patterson and Thompson, *Biometrika* 58, 1971.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.agents.pairwise import ComparisonEquations
from share.types import F64, I64

# ---- No agent is believed to be surer than a good one can be, whatever it says.


def inflate_covariance(config: MergeConfig, T_ref_body: F64, cov: F64) -> F64:
    """The covariance (6, 6) of a step, as it is believed: agents are surer of themselves than they should be;
    none is surer than the floor, which grows with the step."""
    angle_rad, length_m = float(se3.rotation_angle(T_ref_body)), float(np.linalg.norm(T_ref_body[:3, 3]))
    rad2 = np.radians(config.odometry_floor_deg) ** 2 + (config.odometry_floor_per_rad * angle_rad) ** 2
    m2 = config.odometry_floor_m**2 + (config.odometry_floor_per_m * length_m) ** 2
    return config.odometry_scale**2 * cov + np.diag([rad2] * 3 + [m2] * 3)


# ---- How sure agents are of their odometry, beside each other, by what they say and as far as it is
# believed.
#
# Nothing shows in loops yet when two maps are joined, and who is surest bends the others. So until loops
# tell, nobody is believed to be much surer than the surest of the others: by variances of its steps over
# their size, in the median, for position and for turn. The covariances come here as they are believed, with
# their floors (`share.mapping.agents.covariance_scales`): a claim far below a floor counts as the floor, and
# is widened from there.

_MAX_STEPS = 64  # of each agent: the newest
_MIN_STEPS = 8
_CLAIM_TOLERANCE = 2.25  # variance: 1.5 sigma, as honest agents differ by how they move
_MAX_CLAIM_SCALE = 100.0  # variance: words alone say no more
_LEVER_M = 1.0  # m: a turn of 1 rad is a step of this


class CovarianceClaims:
    """Of agents, by what they say of their steps."""

    def __init__(self) -> None:
        self._steps: dict[str, deque[tuple[float, float]]] = {}
        self._medians: dict[str, F64] = {}
        self._excluded: set[str] = set()
        self._linked: dict[str, set[str]] = {}

    @property
    def known_agents(self) -> set[str]:
        """Of whom enough is known."""
        return set(self._medians)

    def add_step(self, agent: str, T_ref_body: F64, cov: F64) -> bool:
        """A step (4, 4) and its covariance (6, 6). Whether what it claims is known anew."""
        size = float(np.linalg.norm(T_ref_body[:3, 3]) + _LEVER_M * se3.rotation_angle(T_ref_body))
        rotation_variance, position_variance = float(np.trace(cov[:3, :3])), float(np.trace(cov[3:, 3:]))
        if not min(size, rotation_variance, position_variance) > 0:
            return False
        steps = self._steps.setdefault(agent, deque(maxlen=_MAX_STEPS))
        steps.append((np.log(rotation_variance / size), np.log(position_variance / size)))
        if len(steps) < _MIN_STEPS:
            return False
        self._medians[agent] = np.median(np.array(steps), axis=0)
        return True

    def link(self, first: str, second: str) -> None:
        """There is a loop between them: from now on they are measured by each other."""
        self._linked.setdefault(first, set()).add(second)
        self._linked.setdefault(second, set()).add(first)

    def remove_agent(self, agent: str) -> None:
        """Nothing is left of it."""
        self._steps.pop(agent, None)
        self._medians.pop(agent, None)
        self._excluded.discard(agent)
        for other in self._linked.pop(agent, set()):
            self._linked[other].discard(agent)

    def exclude(self, agents: Collection[str]) -> bool:
        """Nobody is measured by these, from now on. Whether that is news."""
        previous, self._excluded = self._excluded, set(agents)
        return previous != self._excluded

    def min_scale(self, agent: str) -> float:
        """By what its variances have to be multiplied at least; 1 where it says nothing unusual."""
        linked = self._linked.get(agent, set()) - self._excluded
        others = [self._medians[name] for name in linked if name in self._medians]
        if agent not in self._medians or not others:
            return 1.0
        smallest = np.min(others, axis=0)
        ratio = float(np.exp((smallest - self._medians[agent]).max()))
        return min(max(1.0, ratio / _CLAIM_TOLERANCE), _MAX_CLAIM_SCALE)


_MIN_LOOP_WEIGHT = 0.4  # weight that a loop must have: what is false says nothing of odometry
_MIN_LOOPS = 8  # such loops
_PRIOR_DOF = 4.0  # of an agent
_LOOP_PRIOR_SCALE, _LOOP_PRIOR_DOF = 1.7, 12.0  # honest loops are a little too sure, see `consistency`
_MIN_SCALE, _MAX_SCALE = 0.25, 1e4
_APPLY_ABOVE, _KEEP_ABOVE = 2.0, 1.5  # variance from which on, and down to which, it is taken into account
_MIN_CHANGE_RATIO = 1.25  # by what part it has to change

SegmentPair = tuple[int, int]  # two stretches


@dataclass(frozen=True, eq=False)
class _VarianceEvidence:
    """By loops of two stretches, of agents a and b: q (3,), F (3, 3), of either walk and of the loops, made
    with these factors (3,)."""

    agents: tuple[str, str]
    q: F64
    F: F64
    linearised_at: F64


class CovarianceScales:
    """factor: of each agent's variances of odometry; 1 where it is not there."""

    def __init__(self, claims: CovarianceClaims) -> None:
        self.scales: dict[str, float] = {}
        self._claims = claims
        self._estimates: dict[str, float] = {}  # as estimated
        self._loop_scales: dict[SegmentPair, float] = {}
        self._evidence: dict[SegmentPair, _VarianceEvidence] = {}

    def add_step(self, agent: str, T_ref_body: F64, cov: F64) -> None:
        """A step (4, 4) of its odometry, with its covariance (6, 6)."""
        if self._claims.add_step(agent, T_ref_body, cov):
            self._estimate()

    def claims(self, agent: str) -> float:
        """See `Claims.least`."""
        return self._claims.min_scale(agent)

    def link(self, first: str, second: str) -> None:
        """There is a loop between these agents."""
        self._claims.link(first, second)

    def set_evidence(
        self, segment_pair: SegmentPair, agents: tuple[str, str], equations: ComparisonEquations, weights: F64
    ) -> None:
        """What loops of two stretches say by now, of weight (N,) each; it takes the place of what they said
        before. Raises LinAlgError where absurd numbers leave no solution."""
        self.link(*agents)
        inliers = np.flatnonzero(weights > _MIN_LOOP_WEIGHT)
        if len(inliers) < _MIN_LOOPS:
            self.drop_evidence([segment_pair])
            return
        estimates = [self._estimates.get(agent, self._claims.min_scale(agent)) for agent in agents]
        factors = np.array([*estimates, self._loop_scales.get(segment_pair, _LOOP_PRIOR_SCALE)])
        self._evidence[segment_pair] = _VarianceEvidence(
            agents, *_variance_components(equations, inliers, factors), factors
        )
        self._estimate()

    def drop_evidence(self, segment_pairs: Iterable[SegmentPair]) -> None:
        """What these loops say is of two worlds, or of what is gone."""
        dropped = [
            segment_pair
            for segment_pair in segment_pairs
            if self._evidence.pop(segment_pair, None) is not None
        ]
        if dropped:
            self._estimate()

    def exclude(self, agents: Collection[str]) -> None:
        """What these and others say of each other is of two worlds; nobody is measured by what they claim."""
        if self._claims.exclude(agents):
            self._estimate()
        self.drop_evidence(
            [
                segment_pair
                for segment_pair, evidence in self._evidence.items()
                if set(evidence.agents) & set(agents)
            ]
        )

    def remove_agent(self, agent: str) -> None:
        """Nothing is left of it."""
        self._evidence = {
            segment_pair: evidence
            for segment_pair, evidence in self._evidence.items()
            if agent not in evidence.agents
        }
        self._claims.remove_agent(agent)
        self._estimate()
        self.scales.pop(agent, None)

    def _estimate(self) -> None:
        agents = sorted({name for evidence in self._evidence.values() for name in evidence.agents})
        column, n = {name: i for i, name in enumerate(agents)}, len(agents)
        size = n + len(self._evidence)
        q, F, linearised_at = np.zeros(size), np.zeros((size, size)), np.full(size, _MAX_SCALE)
        for row, evidence in enumerate(self._evidence.values(), start=n):
            rows = [column[name] for name in evidence.agents] + [row]
            q[rows] += evidence.q
            F[np.ix_(rows, rows)] += evidence.F
            linearised_at[rows] = np.minimum(linearised_at[rows], evidence.linearised_at)
        claimed = np.array([self._claims.min_scale(name) for name in agents])
        prior = np.append(claimed, np.full(len(self._evidence), _LOOP_PRIOR_SCALE))
        dof = np.append(np.full(n, _PRIOR_DOF), np.full(len(self._evidence), _LOOP_PRIOR_DOF))
        prior_information = dof / np.where(linearised_at < _MAX_SCALE, linearised_at, prior) ** 2
        estimates = np.linalg.solve(F + np.diag(prior_information), q + prior_information * prior).clip(
            _MIN_SCALE, _MAX_SCALE
        )
        self._loop_scales = dict(zip(self._evidence, estimates[n:].tolist(), strict=True))
        self._estimates = dict(zip(agents, estimates[:n].tolist(), strict=True))
        for name in sorted({*agents, *self.scales, *self._claims.known_agents}):
            self._update_scale(name, self._estimates.get(name, self._claims.min_scale(name)))

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
