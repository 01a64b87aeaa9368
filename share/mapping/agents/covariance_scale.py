"""How much too sure agents are of their odometry, as the loops between them tell.

With the loops' equations (`share.mapping.agents.consistency`) and f_a, f_b, g the factors by which the
variances of either walk and of the loops are really larger than claimed,

    cov(xi) = f_a W_a + f_b W_b + g S,    xi = J G + noise,

which is a model of variance components. With P the inverse covariance that leaves no G, and y = xi,

    q_k = y' P V_k P y,    F_kl = tr(P V_k P V_l),    E q = F (f_a, f_b, g)

whatever factors P was made with, so what all pairs say simply adds up; at the solution it is restricted
maximum likelihood. F is in units of degrees of freedom over f^2, so a prior of n degrees of freedom is n more
of them: of few loops the factors are as before any, 1, or above where an agent claims to be much surer than
any other (`Claims`). Nobody is believed to be less sure than it says.
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
from share.mapping.agents.consistency import Equations
from share.types import F64, I64, Keyframe

# ---- No agent is believed to be surer than a good one can be, whatever it says.


def believed(config: MergeConfig, T_ref_body: F64, cov: F64) -> F64:
    """The covariance (6, 6) of a step, as it is believed: agents are surer of themselves than they should be;
    none is surer than the floor, which grows with the step."""
    turn, way = float(se3.angle(T_ref_body)), float(np.linalg.norm(T_ref_body[:3, 3]))
    rad2 = np.radians(config.odometry_floor_deg) ** 2 + (config.odometry_floor_per_rad * turn) ** 2
    m2 = config.odometry_floor_m**2 + (config.odometry_floor_per_m * way) ** 2
    return config.odometry_scale**2 * cov + np.diag([rad2] * 3 + [m2] * 3)


def plumb_line(config: MergeConfig, keyframe: Keyframe) -> F64:
    """See `share.mapping.graph.edges`: no camera sits on its IMU better than it was calibrated."""
    size = float(np.linalg.norm(keyframe.up))
    sigma = np.hypot(keyframe.up_sigma, np.radians(config.gravity_floor_deg))
    return keyframe.up / (size * sigma) if size else np.zeros(3)


# ---- How sure agents are of their odometry, beside each other, by what they say and as far as it is
# believed.
#
# Nothing shows in loops yet when two maps are joined, and who is surest bends the others. So until loops
# tell, nobody is believed to be much surer than the surest of the others: by variances of its steps over
# their size, in the median, for position and for turn. The covariances come here as they are believed, with
# their floors (`share.mapping.agents.covariance_scale`): a claim far below a floor counts as the floor, and
# is widened from there.

_STEPS = 64  # of each agent: the newest
_ENOUGH_STEPS = 8
_LEEWAY = 2.25  # variance: 1.5 sigma, as honest agents differ by how they move
_LARGEST_CLAIM = 100.0  # variance: words alone say no more
_LEVER = 1.0  # m: a turn of 1 rad is a step of this


class Claims:
    """Of agents, by what they say of their steps."""

    def __init__(self) -> None:
        self._of: dict[str, deque[tuple[float, float]]] = {}
        self._middle: dict[str, F64] = {}
        self._out: set[str] = set()
        self._met: dict[str, set[str]] = {}

    @property
    def agents(self) -> set[str]:
        """Of whom enough is known."""
        return set(self._middle)

    def add(self, agent: str, T_ref_body: F64, cov: F64) -> bool:
        """A step (4, 4) and its covariance (6, 6). Whether what it claims is known anew."""
        size = float(np.linalg.norm(T_ref_body[:3, 3]) + _LEVER * se3.angle(T_ref_body))
        turn, way = float(np.trace(cov[:3, :3])), float(np.trace(cov[3:, 3:]))
        if not min(size, turn, way) > 0:
            return False
        steps = self._of.setdefault(agent, deque(maxlen=_STEPS))
        steps.append((np.log(turn / size), np.log(way / size)))
        if len(steps) < _ENOUGH_STEPS:
            return False
        self._middle[agent] = np.median(np.array(steps), axis=0)
        return True

    def met(self, one: str, other: str) -> None:
        """There is a loop between them: from now on they are measured by each other."""
        self._met.setdefault(one, set()).add(other)
        self._met.setdefault(other, set()).add(one)

    def remove(self, agent: str) -> None:
        """Nothing is left of it."""
        self._of.pop(agent, None)
        self._middle.pop(agent, None)
        self._out.discard(agent)
        for other in self._met.pop(agent, set()):
            self._met[other].discard(agent)

    def leave_out(self, agents: Collection[str]) -> bool:
        """Nobody is measured by these, from now on. Whether that is news."""
        was, self._out = self._out, set(agents)
        return was != self._out

    def least(self, agent: str) -> float:
        """By what its variances have to be multiplied at least; 1 where it says nothing unusual."""
        whom = self._met.get(agent, set()) - self._out
        others = [self._middle[name] for name in whom if name in self._middle]
        if agent not in self._middle or not others:
            return 1.0
        surest = np.min(others, axis=0)
        surer = float(np.exp((surest - self._middle[agent]).max()))
        return min(max(1.0, surer / _LEEWAY), _LARGEST_CLAIM)


_FITS = 0.4  # weight that a loop must have: what is false says nothing of odometry
_ENOUGH_LOOPS = 8  # such loops
_PRIOR_DOF = 4.0  # of an agent
_LOOP_PRIOR, _LOOP_DOF = 1.7, 12.0  # honest loops are a little too sure, see `consistency`
_LEAST, _LARGEST_SCALE = 0.25, 1e4
_TELLS, _TELLS_STILL = 2.0, 1.5  # variance from which on, and down to which, it is taken into account
_CHANGES = 1.25  # by what part it has to change

Meeting = tuple[int, int]  # two stretches


@dataclass(frozen=True, eq=False)
class _Told:
    """By loops of two stretches, of agents a and b: q (3,), F (3, 3), of either walk and of the loops, made
    with these factors (3,)."""

    agents: tuple[str, str]
    q: F64
    F: F64
    factors: F64


class Sureness:
    """factor: of each agent's variances of odometry; 1 where it is not there."""

    def __init__(self, claims: Claims) -> None:
        self.factor: dict[str, float] = {}
        self._claims = claims
        self._now: dict[str, float] = {}  # as estimated
        self._loops: dict[Meeting, float] = {}
        self._told: dict[Meeting, _Told] = {}

    def claimed(self, agent: str, T_ref_body: F64, cov: F64) -> None:
        """A step (4, 4) of its odometry, with its covariance (6, 6)."""
        if self._claims.add(agent, T_ref_body, cov):
            self._settle()

    def claims(self, agent: str) -> float:
        """See `Claims.least`."""
        return self._claims.least(agent)

    def met(self, one: str, other: str) -> None:
        """There is a loop between these agents."""
        self._claims.met(one, other)

    def take(self, meeting: Meeting, agents: tuple[str, str], e: Equations, weight: F64) -> None:
        """What loops of two stretches say by now, of weight (N,) each; it takes the place of what they said
        before. Raises LinAlgError where absurd numbers leave no solution."""
        self.met(*agents)
        fits = np.flatnonzero(weight > _FITS)
        if len(fits) < _ENOUGH_LOOPS:
            self.leave([meeting])
            return
        now = [self._now.get(agent, self._claims.least(agent)) for agent in agents]
        factors = np.array([*now, self._loops.get(meeting, _LOOP_PRIOR)])
        self._told[meeting] = _Told(agents, *_components(e, fits, factors), factors)
        self._settle()

    def leave(self, meetings: Iterable[Meeting]) -> None:
        """What these loops say is of two worlds, or of what is gone."""
        gone = [meeting for meeting in meetings if self._told.pop(meeting, None) is not None]
        if gone:
            self._settle()

    def forget(self, agents: Collection[str]) -> None:
        """What these and others say of each other is of two worlds; nobody is measured by what they claim."""
        if self._claims.leave_out(agents):
            self._settle()
        self.leave([meeting for meeting, told in self._told.items() if set(told.agents) & set(agents)])

    def remove(self, agent: str) -> None:
        """Nothing is left of it."""
        self._told = {meeting: told for meeting, told in self._told.items() if agent not in told.agents}
        self._claims.remove(agent)
        self._settle()
        self.factor.pop(agent, None)

    def _settle(self) -> None:
        agents = sorted({name for told in self._told.values() for name in told.agents})
        at, n = {name: i for i, name in enumerate(agents)}, len(agents)
        size = n + len(self._told)
        q, F, made_with = np.zeros(size), np.zeros((size, size)), np.full(size, _LARGEST_SCALE)
        for row, told in enumerate(self._told.values(), start=n):
            where = [at[name] for name in told.agents] + [row]
            q[where] += told.q
            F[np.ix_(where, where)] += told.F
            made_with[where] = np.minimum(made_with[where], told.factors)
        least = np.array([self._claims.least(name) for name in agents])
        prior = np.append(least, np.full(len(self._told), _LOOP_PRIOR))
        dof = np.append(np.full(n, _PRIOR_DOF), np.full(len(self._told), _LOOP_DOF))
        sure = dof / np.where(made_with < _LARGEST_SCALE, made_with, prior) ** 2
        found = np.linalg.solve(F + np.diag(sure), q + sure * prior).clip(_LEAST, _LARGEST_SCALE)
        self._loops = dict(zip(self._told, found[n:].tolist(), strict=True))
        self._now = dict(zip(agents, found[:n].tolist(), strict=True))
        for name in sorted({*agents, *self.factor, *self._claims.agents}):
            self._tell(name, self._now.get(name, self._claims.least(name)))

    def _tell(self, name: str, now: float) -> None:
        was = self.factor.get(name, 1.0)
        now = now if now > (_TELLS_STILL if was > 1 else _TELLS) else 1.0
        if max(now / was, was / now) > _CHANGES:
            self.factor[name] = now


def _components(e: Equations, fits: I64, factors: F64) -> tuple[F64, F64]:
    n = len(fits)
    own = np.zeros((n, 6, n, 6))
    own[range(n), :, range(n)] = e.own[fits]
    among = np.ix_(fits, np.arange(6), fits, np.arange(6))
    parts = [V.reshape(6 * n, 6 * n) for V in (e.walk_a[among], e.walk_b[among], own)]
    J, y = e.J[fits][:, :, :6].reshape(6 * n, 6), e.xi[fits].ravel()
    inverse = np.linalg.inv(sum(f * V for f, V in zip(factors, parts, strict=True)))
    IJ = inverse @ J
    P = inverse - IJ @ np.linalg.solve(J.T @ IJ, IJ.T)
    Py, PV = P @ y, [P @ V for V in parts]
    q = np.array([float(Py @ V @ Py) for V in parts])
    return q, np.array([[float((A * B.T).sum()) for B in PV] for A in PV])
