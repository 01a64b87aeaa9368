"""Which agents agree on scale, calibration and how sure they are, and which must not move others.

Every two agents are compared by the loops between them (`share.mapping.agents.consistency`), by all of them
and by the newest, for who is right at first may be wrong later. What differs both significantly and by more
than does no harm is a disagreement. Of several agents the one that disagrees with most is set apart, as in
pairwise consistency (Mangelson et al., ICRA 2018), with agents for loops; of two, nobody can say which is
wrong, and they keep a map each. An agent is a subject here, all runs of a name
(`share.mapping.agents.subjects`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Container, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from share.mapping.agents.consistency import (
    Comparison,
    Equations,
    Estimate,
    Walked,
    Witness,
    compare,
    equations,
    points_scale,
    solved,
)
from share.mapping.agents.covariance_scale import Claims, Meeting, Sureness
from share.mapping.agents.subjects import Subjects, by_gravity, outvoted, severity_of, told, worst
from share.mapping.graph.edges import Edge
from share.mapping.recognition.scale import Scale
from share.types import F64

_MOST = 32  # loops kept of two stretches
_MOST_SCALES = 160
_TURN = np.radians(1.5)  # rad, less does no harm
_NIS = 3.0  # beyond what honest agents are too sure
_ENOUGH_POINTS, _ENOUGH_PATH = 3, 8  # loops before a comparison by points, or by ways, says anything
_NEW_POINTS, _NEW_PATH = 6, 12  # newest loops that are looked at on their own
_INSIDE = 0.6  # of the loops must fit, or they are of more than one place
_CALM = 0.6  # a disagreement ends below this part of what began it
_TELLS, _TELLS_STILL = 2.5, 1.25  # sigmas from which on, and down to which, a scale is taken into account
_SCALE_STEP = 0.001  # log scale that it has to change by
_PAST: Meeting = (-1, -1)  # newest loops of stretches that are gone


@dataclass(frozen=True)
class Standing:
    """Of an agent, for people. state: `agrees`, `set apart`, `disputed` or `unknown`. log_scale, sigma: of
    its depths against the others'; put_right: what of it is taken out; nis: see
    `share.mapping.agents.consistency`; None where not known. doubt: the most that is held against it and
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
class _Met:
    """Loops of two stretches. ways, newest: as all of them say, and the newest. news: since then."""

    loops: list[Witness] = field(default_factory=list)
    ways: Comparison | None = None
    newest: Comparison | None = None
    news: int = 0


@dataclass(eq=False)
class _Pair:
    """Of two agents, the lesser first. met: by stretches, those that are gone as one. scales: of more loops,
    by which what does no harm is put right."""

    met: dict[Meeting, _Met] = field(default_factory=dict)
    scales: deque[Scale] = field(default_factory=lambda: deque(maxlen=_MOST_SCALES))
    points: Estimate | None = None
    newest: Estimate | None = None  # of the newest of `scales`
    gauge: Estimate | None = None  # of all of them
    doubt: float = 0.0  # 1 begins a disagreement
    disagrees: bool = False
    what: str = ""  # of the second, against the first
    turned: str = ""  # of the first, against the second

    @property
    def nis(self) -> float | None:
        """The most that loops of two stretches say; None where they are too few."""
        return max((met.ways.nis for met in self.met.values() if met.ways is not None), default=None)


Names = tuple[str, str]


class Agreement:
    """Of all agents, which are told by their runs. tolerance: log scale that does no harm. apart: agents
    that must not move others. disputed: pairs of which nobody can say who is wrong. scale: log of how much
    too long the metres of each are, so far as that is sure; 0 where it is not there."""

    def __init__(self, tolerance: float) -> None:
        self.apart: frozenset[str] = frozenset()
        self.disputed: frozenset[frozenset[str]] = frozenset()
        self.scale: dict[str, float] = {}
        self.subjects = Subjects()
        self._sureness = Sureness(Claims())
        self._tolerance = tolerance
        self._walked: dict[int, Walked] = {}
        self._pairs: dict[Names, _Pair] = {}

    def enter(self, run: str, name: str, voice: str | None = "") -> None:
        """A run of the agent of this name comes; what is held against the name is held against the run.
        voice: see `Subjects.speaks`."""
        self.subjects.enter(run, name, self.apart.union(*self.disputed), voice)

    def walk(self, run: str, number: int, before: int | None, T_ref_body: F64, cov: F64) -> None:
        """A new node, by odometry from the one before; None: it begins a stretch."""
        last = None if before is None else self._walked.get(before)
        self._walked[number] = Walked.start() if last is None else last.on(T_ref_body, cov)
        if before is not None:
            self._sureness.claimed(self.subjects.of(run), T_ref_body, cov)

    def scale_of(self, run: str) -> float:
        """See `scale`."""
        return self.scale.get(self.subjects.of(run), 0.0)

    def widened(self, run: str) -> float:
        """By what the variances of its odometry have to be multiplied to be believed."""
        return self._sureness.factor.get(self.subjects.of(run), 1.0)

    def forget(self, numbers: Collection[int], live: Container[int]) -> None:
        """Nodes that are taken out. live: stretches that have others. What loops of those that have not said
        stays only so far as it decides who agrees: a disagreement does not end because its loops went."""
        for number in numbers:
            self._walked.pop(number, None)
        over = set[Meeting]()
        for pair in self._pairs.values():
            if ended := {m for m in pair.met if m != _PAST and not (m[0] in live and m[1] in live)}:
                over |= ended
                past = [pair.met.get(_PAST, _Met()), *(pair.met.pop(meeting) for meeting in sorted(ended))]
                loops = [w for met in past for w in met.loops][-_MOST:]
                worst = max(past, key=self._severity_of) if pair.disagrees else _Met()
                pair.met[_PAST] = _Met(loops, worst.ways, worst.newest)
        self._sureness.leave(sorted(over))

    def leave(self, run: str) -> None:
        """A run of which nothing is left, and that will not come back. With the last of an agent's goes all
        that is known of it, but for what is held against its name."""
        gone = self.subjects.forget(run, self.apart, frozenset[str]().union(*self.disputed))
        if gone is None:
            return
        self._pairs = {names: pair for names, pair in self._pairs.items() if gone not in names}
        self.apart -= {gone}
        self.disputed = frozenset(names for names in self.disputed if gone not in names)
        self.scale.pop(gone, None)
        self._sureness.remove(gone)

    def witness(
        self,
        agents: Names,
        stretches: tuple[int, int],
        edge: Edge,
        scale: Scale | None,
        tilt: tuple[float, float] | None,
    ) -> bool:
        """A verified loop between two agents' runs, `edge` between its nodes; scale, tilt: see `Witness`.
        Returns whether who is apart, or disputed, has changed."""
        one, other = (self.subjects.of(run) for run in agents)
        if self.subjects.name(one) == self.subjects.name(other):
            return False
        if one > other:
            one, other, stretches, edge = other, one, stretches[::-1], edge.reverse()
            scale = None if scale is None else scale.reverse()
        pair = self._pairs.setdefault((one, other), _Pair())
        self._sureness.met(one, other)
        met = pair.met.setdefault(stretches, _Met())
        a, b = self._walked[edge.a], self._walked[edge.b]
        met.loops.append(Witness(a, b, edge.T_a_b, edge.cov, scale, tilt))
        if scale is not None:
            pair.scales.append(scale)
        if len(met.loops) > _MOST:
            del met.loops[_least_telling(met.loops)]
        met.news += 1
        if met.news * 6 < len(met.loops):
            return False
        met.news = 0
        was = pair.disagrees
        self._compare(pair, (one, other), stretches)
        changed = self._decide() if pair.disagrees or was else False
        self._gauge()
        return changed

    def forbids(self, ones: Collection[str], others: Collection[str]) -> str:
        """Why these must not come into one map with those; empty if nothing is known against it."""
        for a in map(self.subjects.of, ones):
            for b in map(self.subjects.of, others):
                if a != b and ({a, b} & self.apart or frozenset((a, b)) in self.disputed):
                    return f"{a} and {b} are kept apart"
        return ""

    def yet_to_compare(self, ones: Collection[str], others: Collection[str]) -> str:
        """Why these must not come into one map with those before one of them was compared; empty if they
        may."""
        every = {self.subjects.of(run) for run in (*ones, *others)}
        unproven = self.subjects.unproven & every if len(every) > 1 else set[str]()
        return f"{min(unproven)} has to be compared first, {self._why(min(unproven))}" if unproven else ""

    def standing(self, run: str) -> Standing:
        """How it stands with the others."""
        agent = self.subjects.of(run)
        pairs = {names: pair for names, pair in self._pairs.items() if agent in names}
        bad = [(names, pair) for names, pair in pairs.items() if pair.disagrees]
        nis = max((pair.nis for pair in pairs.values() if pair.nis is not None), default=None)
        log, sigma = self._scales().get(agent, (None, None))
        state = "agrees" if any(self._agrees(pair) for pair in pairs.values()) else "unknown"
        reason = ""
        if agent in self.apart:
            state, reason = "set apart", _reason(agent, bad) + ": check its calibration"
        elif any(frozenset(names) in self.disputed for names, _ in bad):
            state, reason = "disputed", f"{_reason(agent, bad)}; nobody can say which of the two is wrong"
        elif agent in self.subjects.unproven:
            state, reason = "unknown", f"not compared with the others {self._why(agent)}"
        doubt = max((pair.doubt for pair in pairs.values()), default=0.0)
        return Standing(
            state, reason, log, sigma, self.scale.get(agent, 0.0), nis, doubt, self.widened(agent)
        )

    def _why(self, unproven: str) -> str:
        if unproven in self.subjects.suspected:
            return "since an earlier run of its name was kept apart"
        return "since the edge was started again"

    def doubts(self) -> dict[Names, float]:
        """What is held against every two agents that met, the lesser first; 1 begins a disagreement."""
        return {names: pair.doubt for names, pair in self._pairs.items()}

    # ------------------------------------------------------------ two agents

    def _compare(self, pair: _Pair, names: Names, meeting: Meeting) -> None:
        met = pair.met[meeting]
        every = [w for one in pair.met.values() for w in one.loops]
        scales = [w.scale for w in every if w.scale is not None]
        pair.points = _pooled(scales)
        pair.newest = _pooled(list(pair.scales)[-_NEW_POINTS:]) if len(scales) > _NEW_POINTS else None
        pair.gauge = _pooled(pair.scales)
        ways = _compared_ways(met, (self._sureness.claims(names[0]), self._sureness.claims(names[1])))
        found = [*self._by_points(pair), *by_gravity(every), *by_gravity(met.loops[-_ENOUGH_PATH:])]
        for one in pair.met.values():
            found += [*self._by_ways(one.ways), *self._by_ways(one.newest)]
        pair.doubt = max((severity for severity, _, _ in found), default=0.0)
        pair.disagrees = pair.doubt >= (_CALM if pair.disagrees else 1.0)
        if pair.disagrees:
            self._sureness.leave(pair.met)
        else:
            if _PAST in pair.met:
                pair.met[_PAST].ways = pair.met[_PAST].newest = None
            self._prove(pair, names)
            if ways is not None and met.ways is not None and not self.apart & {*names}:
                with suppress(np.linalg.LinAlgError):  # of absurd numbers, which say nothing
                    self._sureness.take(meeting, names, ways, met.ways.weight)
        said = sorted((f for f in found if f[0] >= _CALM), reverse=True)
        pair.what, pair.turned = worst([t for _, t, _ in said]), worst([t for *_, t in said])

    def _prove(self, pair: _Pair, names: Names) -> None:
        """Who was to be compared has been, if the other is not under suspicion itself. What was wrong with a
        name before may have been its way, so there depths are not enough."""
        ways = any(met.ways is not None for met in pair.met.values())
        for one, other in (names, names[::-1]):
            earlier = one in self.subjects.suspected
            suspect = other in self.apart or (earlier and other in self.subjects.unproven)
            if not suspect and (ways or (self._agrees(pair) and not earlier)):
                self.subjects.prove(one)

    def _by_points(self, pair: _Pair) -> list[tuple[float, str, str]]:
        found = [points for points in (pair.points, pair.newest) if points is not None]
        words = "its depths are {} % {}", ("larger", "smaller")
        return [told(points, self._tolerance, *words) for points in found]

    def _by_ways(self, ways: Comparison | None) -> list[tuple[float, str, str]]:
        if ways is None:
            return []
        out = []
        if ways.inside >= _INSIDE:
            out.append(told(ways.path, self._tolerance, "its way is {} % {}", ("longer", "shorter")))
            turn = f"its camera is turned by {np.degrees(ways.turn.value):.1f} degrees against what it says"
            out.append((severity_of(ways.turn, _TURN), turn, turn))
        sure = f"loops are off by {ways.nis:.1f} times the variance that it claims"
        out.append((ways.nis / _NIS, sure, sure))
        return out

    def _severity_of(self, met: _Met) -> float:
        """By its ways."""
        return max((s for s, _, _ in (*self._by_ways(met.ways), *self._by_ways(met.newest))), default=0.0)

    def _agrees(self, pair: _Pair) -> bool:
        return not pair.disagrees and pair.points is not None and pair.points.sigma < self._tolerance / 2

    # ------------------------------------------------------------ all agents

    def _decide(self) -> bool:
        """Who is apart: whoever is outvoted by every voice that those may have whose voice is not known; one
        of a name that was set apart before is a suspect. Whether that has changed."""
        disagree = {frozenset(names) for names, pair in self._pairs.items() if pair.disagrees}
        agree = [names for names, pair in self._pairs.items() if self._agrees(pair)]
        agents = {name for names in self._pairs for name in names}
        suspects = {name for name in agents if self.subjects.follows_one_apart(name, self.apart)}
        apart = frozenset(agents)
        for voices in self.subjects.voicings(agents):
            if apart:  # else no other way can change that
                apart &= outvoted(disagree, agree, voices, suspects)
        was = self.apart, self.disputed
        self.apart = apart
        self.disputed = frozenset(names for names in disagree if not names & apart)
        self._sureness.forget(apart)
        return was != (self.apart, self.disputed)

    def _gauge(self) -> None:
        """What is sure of everybody's scale; nothing of those kept apart, for their maps are theirs."""
        kept_apart = self.apart.union(*self.disputed)
        known = self._scales(kept_apart)
        for agent in sorted(known.keys() | self.scale.keys()):
            log, sigma = known.get(agent, (0.0, 1.0))
            was = self.scale.get(agent, 0.0)
            now = log if abs(log) > (_TELLS_STILL if was else _TELLS) * sigma else 0.0
            if abs(now - was) > _SCALE_STEP:
                self.scale[agent] = now

    def _scales(self, without: Collection[str] = ()) -> Mapping[str, tuple[float, float]]:
        """Log scale of every agent's depths against the median of those that are not apart, by least squares
        over all pairs but those with somebody who is left out; and its sigma."""
        every = ((names, pair.gauge) for names, pair in self._pairs.items() if not {*names} & {*without})
        known = [(names, gauge) for names, gauge in every if gauge is not None]
        agents = sorted({name for names, _ in known for name in names})
        if not agents:
            return {}
        at = {name: i for i, name in enumerate(agents)}
        J, z = np.zeros((len(known), len(agents))), np.zeros(len(known))
        for row, ((a, b), points) in enumerate(known):
            J[row, at[a]], J[row, at[b]] = -1 / points.sigma, 1 / points.sigma
            z[row] = points.value / points.sigma
        x = np.linalg.pinv(J) @ z
        counts = {self.subjects.voice(agent): x[at[agent]] for agent in agents if agent not in self.apart}
        x -= np.median([*counts.values()] or x)  # a voice counts once
        sigma = np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))
        return {name: (float(x[i]), float(sigma[i])) for name, i in at.items()}


def _compared_ways(met: _Met, widths: tuple[float, float]) -> Equations | None:
    """Of all of its loops; None where they are too few, or absurd numbers leave no solution. widths: by what
    either's claims alone are widened, see `solved`."""
    met.ways = met.newest = None
    if len(met.loops) < _ENOUGH_PATH:
        return None
    with suppress(np.linalg.LinAlgError):
        tell = equations(met.loops)
        met.ways = solved(tell, widths)
        if len(met.loops) > _NEW_PATH:
            met.newest = compare(met.loops[-_NEW_PATH:], widths)
        return tell
    return None


def _pooled(scales: Collection[Scale]) -> Estimate | None:
    return points_scale(list(scales)) if len(scales) >= _ENOUGH_POINTS else None


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
