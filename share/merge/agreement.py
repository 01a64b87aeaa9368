"""Which agents agree on scale, calibration and how sure they are, and which must not move others.

Every two agents are compared by the loops between them (`share.merge.consistency`). What differs both
significantly and by more than does no harm is a disagreement. Of several agents the one that disagrees with
most is set apart, as in pairwise consistency (Mangelson et al., ICRA 2018), with agents for loops; of two,
nobody can say which is wrong, and they keep a map each.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from share.graph.posegraph import Edge
from share.merge.consistency import Comparison, Estimate, Walked, Witness, compare, points_scale
from share.place.scale import Scale
from share.types import F64

_MOST = 32  # loops kept of two stretches
_MOST_SCALES = 160
_SIGMAS = 4.5  # that a difference must have: of thousands of comparisons none by chance
_TURN, _TILT = np.radians(1.5), np.radians(1.0)  # rad, less does no harm
_NIS = 3.0  # beyond what honest agents are too sure
_ENOUGH_POINTS, _ENOUGH_PATH = 3, 8  # loops before a comparison by points, or by ways, says anything
_INSIDE = 0.6  # of the loops must fit, or they are of more than one place
_CALM = 0.6  # a disagreement ends below this part of what began it
_TELLS, _TELLS_STILL = 2.5, 1.25  # sigmas from which on, and down to which, a scale is taken into account
_SCALE_STEP = 0.001  # log scale that it has to change by


@dataclass(frozen=True)
class Standing:
    """Of an agent, for people. state: `agrees`, `set apart`, `disputed` or `unknown`. log_scale, sigma: of
    its depths against the others'; put_right: what of it is taken out; nis: see `share.merge.consistency`;
    None where not known. doubt: the most that is held against it and another; 1 begins a disagreement."""

    state: str = "unknown"
    reason: str = ""
    log_scale: float | None = None
    sigma: float | None = None
    put_right: float = 0.0
    nis: float | None = None
    doubt: float = 0.0


@dataclass(eq=False)
class _Pair:
    """Of two agents, the lesser first. loops: by stretches. scales: of more loops, by which what does no harm
    is put right. news: loops since it was compared."""

    loops: dict[tuple[int, int], list[Witness]] = field(default_factory=dict)
    scales: deque[Scale] = field(default_factory=lambda: deque(maxlen=_MOST_SCALES))
    points: Estimate | None = None
    gauge: Estimate | None = None  # of `scales`
    ways: Comparison | None = None
    doubt: float = 0.0  # 1 begins a disagreement
    disagrees: bool = False
    what: str = ""  # of the second, against the first
    turned: str = ""  # of the first, against the second
    news: int = 0


Names = tuple[str, str]


class Agreement:
    """Of all agents. tolerance: log scale that does no harm. apart: agents that must not move others.
    disputed: pairs of which nobody can say who is wrong. scale: log of how much too long the metres of each
    are, so far as that is sure; 0 where it is not there. unproven: agents of an earlier life that may have
    been set apart; they stay so until they have been compared."""

    def __init__(self, tolerance: float) -> None:
        self.apart: frozenset[str] = frozenset()
        self.disputed: frozenset[frozenset[str]] = frozenset()
        self.scale: dict[str, float] = {}
        self.unproven: set[str] = set()
        self._tolerance = tolerance
        self._walked: dict[int, Walked] = {}
        self._pairs: dict[Names, _Pair] = {}

    def walk(self, number: int, before: int | None, T_ref_body: F64, cov: F64) -> None:
        """A new node, by odometry from the one before; None: it begins a stretch."""
        last = None if before is None else self._walked.get(before)
        self._walked[number] = Walked.start() if last is None else last.on(T_ref_body, cov)

    def forget(self, numbers: Collection[int]) -> None:
        """Nodes that are taken out."""
        for number in numbers:
            self._walked.pop(number, None)

    def witness(
        self,
        agents: Names,
        stretches: tuple[int, int],
        edge: Edge,
        scale: Scale | None,
        tilt: tuple[float, float] | None,
    ) -> bool:
        """A verified loop between two agents, `edge` between its nodes; scale, tilt: see `Witness`. Returns
        whether who is apart, or disputed, has changed."""
        if agents[0] > agents[1]:
            agents, stretches, edge = agents[::-1], stretches[::-1], edge.reverse()
            scale = None if scale is None else scale.reverse()
        pair = self._pairs.setdefault(agents, _Pair())
        loops = pair.loops.setdefault(stretches, [])
        a, b = self._walked[edge.a], self._walked[edge.b]
        loops.append(Witness(a, b, edge.T_a_b, edge.cov, scale, tilt))
        if scale is not None:
            pair.scales.append(scale)
        if len(loops) > _MOST:
            del loops[_least_telling(loops)]
        pair.news += 1
        if pair.news * 6 < len(loops):
            return False
        pair.news = 0
        was = pair.disagrees
        self._compare(pair, agents)
        changed = self._decide() if pair.disagrees or was else False
        self._gauge()
        return changed

    def forbids(self, ones: Collection[str], others: Collection[str]) -> str:
        """Why these must not come into one map with those; empty if nothing is known against it."""
        for a in ones:
            for b in others:
                if a != b and ({a, b} & self.apart or frozenset((a, b)) in self.disputed):
                    return f"{a} and {b} are kept apart"
        return ""

    def standing(self, agent: str) -> Standing:
        """How it stands with the others."""
        pairs = {names: pair for names, pair in self._pairs.items() if agent in names}
        bad = [(names, pair) for names, pair in pairs.items() if pair.disagrees]
        nis = max((pair.ways.nis for pair in pairs.values() if pair.ways), default=None)
        log, sigma = self._scales().get(agent, (None, None))
        state = "agrees" if any(self._agrees(pair) for pair in pairs.values()) else "unknown"
        reason = ""
        if agent in self.apart:
            state, reason = "set apart", _reason(agent, bad) + ": check its calibration"
        elif any(frozenset(names) in self.disputed for names, _ in bad):
            state, reason = "disputed", f"{_reason(agent, bad)}; nobody can say which of the two is wrong"
        elif agent in self.unproven:
            state, reason = "unknown", "not compared with the others since the edge was started again"
        doubt = max((pair.doubt for pair in pairs.values()), default=0.0)
        return Standing(state, reason, log, sigma, self.scale.get(agent, 0.0), nis, doubt)

    def doubts(self) -> dict[Names, float]:
        """What is held against every two agents that met, the lesser first; 1 begins a disagreement."""
        return {names: pair.doubt for names, pair in self._pairs.items()}

    # ------------------------------------------------------------ two agents

    def _compare(self, pair: _Pair, names: Names) -> None:
        every = [w for loops in pair.loops.values() for w in loops]
        most = max(pair.loops.values(), key=len)
        scales = [w.scale for w in every if w.scale is not None]
        pair.points = points_scale(scales) if len(scales) >= _ENOUGH_POINTS else None
        pair.gauge = points_scale(pair.scales) if len(pair.scales) >= _ENOUGH_POINTS else None
        pair.ways = _compared(most) if len(most) >= _ENOUGH_PATH else None
        found = [*self._by_points(pair), *self._by_ways(pair), *_by_gravity(every)]
        pair.doubt = max((severity for severity, _, _ in found), default=0.0)
        pair.disagrees = pair.doubt >= (_CALM if pair.disagrees else 1.0)
        if self._agrees(pair) or (len(most) >= _ENOUGH_PATH and not pair.disagrees):
            self.unproven.difference_update(names)
        said = [(text, turned) for severity, text, turned in found if severity >= _CALM]
        pair.what, pair.turned = ", ".join(t for t, _ in said), ", ".join(t for _, t in said)

    def _by_points(self, pair: _Pair) -> list[tuple[float, str, str]]:
        if pair.points is None:
            return []
        return [_told(pair.points, self._tolerance, "its depths are {} % {}", ("larger", "smaller"))]

    def _by_ways(self, pair: _Pair) -> list[tuple[float, str, str]]:
        ways = pair.ways
        if ways is None:
            return []
        out = []
        if ways.inside >= _INSIDE:
            out.append(_told(ways.path, self._tolerance, "its way is {} % {}", ("longer", "shorter")))
            turn = f"its camera is turned by {np.degrees(ways.turn.value):.1f} degrees against what it says"
            out.append((_severity(ways.turn, _TURN), turn, turn))
        sure = f"loops are off by {ways.nis:.1f} times the variance that it claims"
        out.append((ways.nis / _NIS, sure, sure))
        return out

    def _agrees(self, pair: _Pair) -> bool:
        return not pair.disagrees and pair.points is not None and pair.points.sigma < self._tolerance / 2

    # ------------------------------------------------------------ all agents

    def _decide(self) -> bool:
        """Who is apart, from who disagrees with whom. Whether that has changed."""
        left = {frozenset(names) for names, pair in self._pairs.items() if pair.disagrees}
        friends = Counter(n for names, pair in self._pairs.items() if self._agrees(pair) for n in names)
        apart = set[str]()
        while left:
            against = Counter(name for names in left for name in names)
            rank = {name: (count, -friends[name]) for name, count in against.items()}
            who = [name for name in rank if rank[name] == max(rank.values())]
            if len(who) > 1:
                break
            apart.add(who[0])
            left = {names for names in left if who[0] not in names}
        was = self.apart, self.disputed
        self.apart, self.disputed = frozenset(apart), frozenset(left)
        return was != (self.apart, self.disputed)

    def _gauge(self) -> None:
        """What is sure of everybody's scale; nothing of those kept apart, for their maps are theirs."""
        kept_apart = self.apart.union(*self.disputed)
        for agent, (log, sigma) in self._scales().items():
            was = self.scale.get(agent, 0.0)
            told = abs(log) > (_TELLS_STILL if was else _TELLS) * sigma and agent not in kept_apart
            now = log if told else 0.0
            if abs(now - was) > _SCALE_STEP:
                self.scale[agent] = now

    def _scales(self) -> Mapping[str, tuple[float, float]]:
        """Log scale of every agent's depths against the median of those that are not apart, by least squares
        over all pairs; and its sigma."""
        known = [(names, pair.gauge) for names, pair in self._pairs.items() if pair.gauge is not None]
        agents = sorted({name for names, _ in known for name in names})
        if not agents:
            return {}
        at = {name: i for i, name in enumerate(agents)}
        J, z = np.zeros((len(known), len(agents))), np.zeros(len(known))
        for row, ((a, b), points) in enumerate(known):
            J[row, at[a]], J[row, at[b]] = -1 / points.sigma, 1 / points.sigma
            z[row] = points.value / points.sigma
        x = np.linalg.pinv(J) @ z
        x -= np.median([x[at[name]] for name in agents if name not in self.apart] or x)
        sigma = np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))
        return {name: (float(x[i]), float(sigma[i])) for name, i in at.items()}


def tilt_between(
    up_a: F64, sigma_a: float, up_b: F64, sigma_b: float, edge: Edge
) -> tuple[float, float] | None:
    """Angle between two ups (3,) across a loop, and its sigma, rad; None if one is not known."""
    if not up_a.any() or not up_b.any():
        return None
    there = edge.T_a_b[:3, :3] @ up_b
    cross = np.linalg.norm(np.cross(up_a, there)) / np.linalg.norm(up_a) / np.linalg.norm(up_b)
    sigma = np.sqrt(sigma_a**2 + sigma_b**2 + np.trace(edge.cov[:3, :3]) / 3)
    return float(np.arcsin(min(1.0, float(cross)))), float(sigma)


def _by_gravity(loops: list[Witness]) -> list[tuple[float, str, str]]:
    known = np.array([w.tilt for w in loops if w.tilt is not None]).reshape(-1, 2)
    if len(known) < _ENOUGH_PATH:
        return []
    angle, sigmas = float(np.median(known[:, 0])), float(np.median(known[:, 0] / known[:, 1]))
    text = f"its up is {np.degrees(angle):.1f} degrees off"
    return [(min(angle / _TILT, sigmas / _SIGMAS), text, text)]


def _compared(loops: list[Witness]) -> Comparison | None:
    """None where absurd numbers leave no solution."""
    try:
        return compare(loops)
    except np.linalg.LinAlgError:
        return None


def _severity(found: Estimate, harmless: float) -> float:
    """1 where it is as large as may be, or as sure as must be, whichever comes later."""
    return min(abs(found.value) / harmless, found.significance / _SIGMAS)


def _told(found: Estimate, harmless: float, text: str, words: Names) -> tuple[float, str, str]:
    """Severity, and the text for either side."""
    size = f"{100 * abs(np.expm1(found.value)):.1f} ± {100 * found.sigma:.1f}"
    more, less = (text.format(size, word) for word in words)
    return (_severity(found, harmless), *((more, less) if found.value > 0 else (less, more)))


def _reason(agent: str, bad: list[tuple[Names, _Pair]]) -> str:
    """From the pairs in which it disagrees."""
    said = []
    for (first, second), pair in bad:
        other, what = (first, pair.what) if agent == second else (second, pair.turned)
        said.append(f"against {other} {what}")
    return "; ".join(said)


def _least_telling(loops: list[Witness]) -> int:
    """Of the two loops that are most alike by where they end, the older."""
    at = np.array([(w.a.k, w.b.k) for w in loops])
    apart = np.abs(at[:, None] - at[None]).sum(2).astype(float)
    np.fill_diagonal(apart, np.inf)
    first, second = np.unravel_index(int(apart.argmin()), apart.shape)
    return int(min(first, second))
