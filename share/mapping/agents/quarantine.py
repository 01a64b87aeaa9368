"""Agents that disagree with the others are kept out of their map, or taken out if the evidence is late;
metres that are a little too long or too short are put right, and variances that are too small widened."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from share.geometry import se3
from share.mapping.agents.agreement import Agreement, Standing
from share.mapping.agents.subjects import tilt_between
from share.mapping.culling import TakenOut
from share.mapping.graph.edges import Edge
from share.mapping.loop_acceptance import Decision, Judge
from share.mapping.loops import Loop
from share.mapping.map_graph import Chart, shortened
from share.mapping.recognition.scale import Scale
from share.mapping.recognition.verification import Sight
from share.types import F64

_WEAK = 12  # loops between two stretches: fewer may be there only because a map was bent
_MOST_BACK = 2000  # loops that were taken back: the newest are kept in mind


@dataclass(frozen=True, eq=False)
class Parted:
    """Agents whose standing with the others has changed, and how it is now; dropped: loops that are taken
    back because of it; tied: loops that had been, and are believed again."""

    standing: dict[str, Standing] = field(default_factory=dict)
    dropped: tuple[Loop, ...] = ()
    tied: tuple[Loop, ...] = ()


class Parting:
    """Of one chart. sights: what each node saw."""

    def __init__(self, tolerance: float, chart: Chart, judge: Judge, sights: Mapping[int, Sight]) -> None:
        self.agreement = Agreement(tolerance)
        self._chart, self._judge, self._sights = chart, judge, sights
        self._taken_back: list[Loop] = []

    def enter(self, run: str, name: str, voice: str | None = "") -> None:
        """A run of the agent of this name comes: what is known of the name holds for it."""
        self.agreement.enter(run, name, voice)

    def forget(self, run: str) -> None:
        """Nothing is left of it, and it will not come back."""
        self.agreement.leave(run)
        self._chart.scale.pop(run, None)
        self._chart.width.pop(run, None)

    def walked(self, number: int, T_ref_body: F64, cov: F64) -> None:
        """A new node, by odometry from the one before on its stretch."""
        trails = self._chart.trails
        agent = trails.nodes[number].key.agent
        self.agreement.walk(agent, number, trails.before(number), T_ref_body, cov)
        self._put_right()

    def witness(self, loop: Loop, scale: Scale | None) -> Parted:
        """A verified loop says how its agents agree; scale: of b's depths over a's. Those who do no longer
        are parted."""
        agents = loop.a.agent, loop.b.agent
        if agents[0] == agents[1]:
            return Parted()
        a, b = self._chart.ends(loop)
        edge = Edge(a, b, loop.T_a_b, loop.cov)
        stretches = self._chart.stretch_of(loop.a), self._chart.stretch_of(loop.b)
        before, unproven = (self.agreement.apart, self.agreement.disputed), self.agreement.subjects.unproven
        to_compare = len(unproven)
        changed = self.agreement.witness(agents, stretches, edge, scale, self._tilt(edge))
        self._put_right()
        if not changed and len(unproven) == to_compare:
            return Parted()
        now = self.agreement.apart, self.agreement.disputed
        who = map(self.agreement.subjects.newest, (before[0] ^ now[0]).union(*(before[1] ^ now[1])))
        standing = {name: self.agreement.standing(name) for name in sorted(who)}
        dropped = self._part()
        tied, undone = self._give_back()
        return Parted(standing, (*dropped, *undone), tied)

    def kept_apart(self, agent: str) -> tuple[int, ...]:
        """Nodes of agents that must not come into one map with this one."""
        trails = self._chart.trails
        stretches = [trails.stretches[number] for number in sorted(trails.live)]
        apart = {s.agent for s in stretches if self.agreement.forbids([agent], [s.agent])}
        return tuple(n for s in stretches if s.agent in apart for n in s.nodes) if apart else ()

    def forbids(self, loop: Loop) -> str:
        """Why it must not be believed: it would tie agents that are kept apart; empty if it would not."""
        founders = self._chart.founder_of(loop.a), self._chart.founder_of(loop.b)
        if founders[0] == founders[1]:
            return ""
        ones, others = (self._agents_of(founder) for founder in founders)
        return self.agreement.yet_to_compare(ones, others) or self.agreement.forbids(ones, others)

    def put_right(self, loop: Loop, scale: Scale | None) -> Loop:
        """As it is in true metres, so far as they are known. scale: of b's depths over a's, by which T_a_b
        leans."""
        a, b = (self._scale_of(key.agent) for key in (loop.a, loop.b))
        if scale is None or scale.lean is None or not (a or b):
            return loop
        T = shortened(se3.exp(scale.lean * (b - a)) @ loop.T_a_b, a)
        return replace(loop, T_a_b=se3.orthonormal(T))

    def as_told(self, out: TakenOut) -> TakenOut:
        """What is kept of an agent's odometry is in its own metres, and not widened."""
        link = out.link
        if link is None or link.reference is None:
            return out
        T = shortened(link.T_ref_body, -self._scale_of(out.key.agent))
        cov = link.cov / self._chart.width.get(out.key.agent, 1.0)
        return replace(out, link=replace(link, T_ref_body=T, cov=cov))

    def _scale_of(self, agent: str) -> float:
        return self._chart.scale.get(agent, 0.0)

    def _put_right(self) -> None:
        agreement, chart = self.agreement, self._chart
        for agent in sorted({chart.trails.stretches[stretch].agent for stretch in chart.trails.live}):
            told = agreement.scale_of(agent), agreement.widened(agent)
            if told != (self._scale_of(agent), chart.width.get(agent, 1.0)):
                chart.rescale(agent, *told)

    def restored(self) -> None:
        """An earlier life's map. Who was set apart is not known, but he was not in the map of most agents."""
        subjects = self.agreement.subjects
        maps = [self._agents_of(founder) for founder in sorted(set(self._chart.founder))]
        names = [set(map(subjects.name, agents)) for agents in maps]
        most = max(range(len(maps)), key=lambda i: len(names[i]), default=0)
        trusted = maps[most] if maps and len(names[most]) > 1 else set[str]()
        subjects.doubt(set[str]().union(*maps) - trusted)

    def _part(self) -> tuple[Loop, ...]:
        """Take back what ties agents that are kept apart: first the loops between them, then the fewest
        others, until no map has two of them."""
        chart, stretches = self._chart, self._chart.trails.stretches
        before = list(chart.founder)
        between = [n for n, loop in chart.ties.loops.items() if self._keeps_apart(loop.a.agent, loop.b.agent)]
        dropped = chart.drop(between) if between else ()
        for a, b in itertools.combinations(sorted(chart.trails.live), 2):
            if chart.founder[a] == chart.founder[b] and self._keeps_apart(
                stretches[a].agent, stretches[b].agent
            ):
                dropped += self._judge.part(a, b)
        dropped += chart.drop(self._weak(before, {before[chart.stretch_of(x.a)] for x in dropped}))
        self._taken_back = [*self._taken_back, *dropped][-_MOST_BACK:]
        return dropped

    def _weak(self, founder: Sequence[int], maps: Collection[int]) -> list[int]:
        """Loops of other agents of the maps that were parted, by their edges' numbers, where they are few:
        what fitted a bent map has to stand without it."""
        chart, stretches = self._chart, self._chart.trails.stretches
        out = []
        for number in chart.ties.loops:
            a, b = chart.bond(chart.ties.edges[number])
            strange = stretches[a].agent != stretches[b].agent and founder[a] in maps
            if strange and chart.bonds[(a, b)] < _WEAK:
                out.append(number)
        return out

    def _give_back(self) -> tuple[tuple[Loop, ...], tuple[Loop, ...]]:
        """Loops that were taken back and that nothing forbids any more are judged anew: those that are
        believed, and those that are not because of them. The others wait on, as long as their keyframes are
        there."""
        trails, decisions, left = self._chart.trails, list[Decision](), list[Loop]()
        for loop in self._taken_back:
            if not (trails.has(loop.a) and trails.has(loop.b)):
                continue
            if self._keeps_apart(loop.a.agent, loop.b.agent) or self.forbids(loop):
                left.append(loop)
            else:
                decisions.append(self._judge.decide(loop))
        self._taken_back = left
        undone = tuple(x for d in decisions for x in d.dropped)
        return tuple(x for d in decisions for x in d.tied if x not in undone), undone

    def _keeps_apart(self, one: str, other: str) -> bool:
        return bool(self.agreement.forbids([one], [other]))

    def _agents_of(self, founder: int) -> set[str]:
        return {self._chart.trails.stretches[s].agent for s in self._chart.stretches_of(founder)}

    def _tilt(self, edge: Edge) -> tuple[float, float] | None:
        if not {edge.a, edge.b} <= self._sights.keys():
            return None
        a, b = (self._sights[n].up for n in (edge.a, edge.b))
        return tilt_between(a, self._up_sigma(edge.a), b, self._up_sigma(edge.b), edge)

    def _up_sigma(self, number: int) -> float:
        """rad, as it is believed; large where up is not known."""
        line = self._chart.plumb.get(number)
        return float(np.pi) if line is None else 1 / float(np.linalg.norm(line))
