"""The joint map of all agents: stretches of odometry, and the loops that tie them together.

A map is a set of stretches that loops connect; it is named after the first of them to have come,
its founder, whose first keyframe stays where the founder's odometry says: that is the gauge. Maps
are derived from the accepted loops alone, so taking a loop back takes its join back.

Plain sequential calls without clock or thread. Slow work is handed out as a frozen `SolveJob`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.graph.path import Roads, covariance_between
from share.graph.posegraph import Edge
from share.merge.join import Disagreement, Key, Known, Loop, disagreement, witness_disagreement
from share.merge.solving import SolveJob, SolveResult
from share.merge.trails import Trails
from share.types import F64, Correction, Keyframe


@dataclass(frozen=True)
class Decision:
    """What became of a loop, and why, for a person. joined: maps that became one, the survivor first.
    tied: all loops that are believed since, this one and those that waited."""

    accepted: bool
    reason: str
    joined: tuple[str, str] | None = None
    tied: tuple[Loop, ...] = ()


@dataclass(frozen=True, eq=False)
class Applied:
    """What a solution changed. corrections: by agent. reason: for events.jsonl. tied, dropped: loops that
    are believed since, and those that are no longer."""

    corrections: dict[str, Correction]
    reason: str
    tied: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()


class Atlas:
    """All keyframes of all agents, in maps."""

    def __init__(self, config: MergeConfig) -> None:
        self._config = config
        self._trails = Trails(config)
        self._poses: list[F64] = []  # T_map_body of every node
        self._roads = Roads()
        self._loops: dict[int, tuple[Loop, Edge]] = {}
        self._pending: list[Loop] = []
        self._founder: list[int] = []  # of the map that each stretch belongs to
        self._unsolved: set[int] = set()  # founders of maps with news for the solver
        self._answers: dict[str, int] = {}  # agent -> its newest keyframe that a loop came from
        self._revisions: dict[str, int] = {}
        self._loops_seen = 0

    # ------------------------------------------------------------ what is known

    def __len__(self) -> int:
        return len(self._poses)

    def pose(self, key: Key) -> F64:
        """T_map_body (4, 4), in the map that `map_of` names. Raises ValueError if unknown."""
        return self._poses[self._trails.number(key)]

    def map_of(self, key: Key) -> str:
        """Raises ValueError if no such keyframe was added."""
        return self._map_name(self._trails.number(key))

    def current_map(self, agent: str) -> str | None:
        """The map that the agent's present stretch is in; None before its first keyframe."""
        stretch = self._trails.current(agent)
        return None if stretch is None else self._trails.name(self._founder[stretch])

    def maps(self) -> dict[str, list[Key]]:
        """All keyframes by map, in the order of arrival."""
        out: dict[str, list[Key]] = {}
        for number, node in enumerate(self._trails.nodes):
            out.setdefault(self._map_name(number), []).append(node.key)
        return out

    def T_map_odom(self, agent: str) -> F64 | None:
        """Where the agent's present odometry lies in its map; None before its first keyframe."""
        stretch = self._trails.current(agent)
        return None if stretch is None else self._placement(self._trails.stretches[stretch][-1])

    @property
    def pending(self) -> tuple[Loop, ...]:
        """Loops that wait for a witness, oldest first."""
        return tuple(self._pending)

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Accepted loops, oldest first."""
        return tuple(loop for loop, _ in self._loops.values())

    # ------------------------------------------------------------ what arrives

    def add_keyframe(self, agent: str, keyframe: Keyframe) -> str:
        """The map that it is in. A keyframe without a reference founds a map of its own.

        Raises ValueError for a keyframe known already or whose reference is unknown.
        """
        number = self._trails.add(agent, keyframe)
        node = self._trails.nodes[number]
        if node.reference < 0:
            self._founder.append(node.stretch)
            self._poses.append(node.T_odom_body)
        else:
            self._roads.add(self._trails.edges[-1])
            self._poses.append(se3.orthonormal(self._poses[node.reference] @ node.T_ref_body))
        return self._map_name(number)

    def propose(self, loop: Loop) -> Decision:
        """A verified loop from candidate a to query b: accepted, waiting, or refused, with the reason.

        Raises ValueError if either keyframe is unknown.
        """
        a, b = self._ends(loop)
        if any({known.a, known.b} == {loop.a, loop.b} for known in self.loops):
            return Decision(False, f"loop {loop}: joined already")
        if self._trails.is_neighbour(a, b):
            return Decision(
                False,
                f"loop {loop}: neighbours by odometry, at least "
                f"{self._config.min_loop_gap} keyframes apart needed",
            )
        if self._same_map(a, b):
            return self._close(loop)
        return self._join(loop)

    # ------------------------------------------------------------ the solver's side

    def due(self) -> list[str]:
        """Maps with accepted loops that no job has seen yet."""
        return sorted(self._trails.name(founder) for founder in self._unsolved)

    def snapshot(self, map_id: str) -> SolveJob:
        """The map as a frozen job for `share.merge.solving.run_job`. ValueError if there is none."""
        founder = self._named(map_id)
        stretches = self._stretches_of(founder)
        nodes = sorted(n for s in stretches for n in self._trails.stretches[s])
        local = {number: i for i, number in enumerate(nodes)}
        loops = {i: edge for i, (_, edge) in self._loops.items() if edge.a in local}
        agents = {self._trails.nodes[self._trails.stretches[s][0]].key.agent for s in stretches}
        self._unsolved.discard(founder)
        return SolveJob(
            map_id,
            tuple(stretches),
            tuple(nodes),
            np.array([self._poses[n] for n in nodes]),
            tuple(e for e in self._trails.edges if e.a in local),
            tuple(loops.values()),
            tuple(loops),
            tuple(local[self._trails.stretches[s][-1]] for s in stretches),
            tuple((agent, self._answers.pop(agent)) for agent in sorted(agents & self._answers.keys())),
        )

    def apply(self, result: SolveResult) -> Applied:
        """Take a solution in; keyframes and loops that came meanwhile are kept.

        If the map was joined or split meanwhile the solution no longer speaks of it: it is left
        aside and the map is due again.
        """
        job, solved = result.job, result.solved
        founder = job.stretches[0]
        if tuple(self._stretches_of(founder)) != job.stretches:
            self._unsolved.add(self._founder[founder])
            self._answers = dict(job.answers) | self._answers
            return Applied({}, f"map {job.map_id}: joined or split while it was solved, due again")
        for number, T in zip(job.nodes, solved.poses, strict=True):
            self._poses[number] = T
        self._extend(job.stretches, after=job.nodes[-1])
        dropped = self._drop_contradicted(job, solved.loop_chi2)
        tied = self._settle_pending()
        corrections = self._corrections(result)
        moved = ", ".join(corrections) or "nobody"
        reason = f"map {job.map_id}: {len(job.nodes)} poses, {len(job.loops)} loops solved, corrects {moved}"
        if dropped:
            reason += f"; dropped loops at odds with it: {', '.join(map(str, dropped))}"
        return Applied(corrections, reason + _that_waited(tied), tied, dropped)

    # ------------------------------------------------------------ judging loops

    def _close(self, loop: Loop) -> Decision:
        gap = disagreement(self._between(*self._ends(loop)), Known(loop.T_a_b, loop.cov))
        if gap.chi2 <= self._config.agree_chi2:
            return self._accept([loop], f"loop {loop}: fits the map, {gap}")
        if gap.chi2 > self._config.surprise_chi2:
            return Decision(False, f"loop {loop}: contradicts the map, {gap}")
        return self._seek_witness(loop, f"fits the map badly ({gap})")

    def _join(self, loop: Loop) -> Decision:
        alone = self._config.sole_witness_inliers
        if 0 < alone <= loop.inliers:
            return self._accept([loop], f"loop {loop}: {loop.inliers} inliers, {alone} join alone")
        return self._seek_witness(loop, "would join two maps")

    def _seek_witness(self, loop: Loop, why: str) -> Decision:
        heard = [
            (self._against(loop, other), other) for other in self._pending if self._may_witness(loop, other)
        ]
        self._pending = [*self._pending, loop][-self._config.max_pending :]
        if not heard:
            return Decision(False, f"loop {loop}: {why}: first witness, waits for a second")
        gap, other = min(heard, key=lambda pair: pair[0].chi2)
        if gap.chi2 > self._config.agree_chi2:
            return Decision(
                False, f"loop {loop}: {why}: none of {len(heard)} witnesses agrees, best {gap}; waits"
            )
        return self._accept([other, loop], f"loop {loop}: {why}: agrees with {other}, {gap}")

    def _may_witness(self, loop: Loop, other: Loop) -> bool:
        """It ties the same two maps, by other keyframes on either side."""
        maps = [{self._founder_of(n) for n in self._ends(x)} for x in (loop, other)]
        return maps[0] == maps[1] and not {loop.a, loop.b} & {other.a, other.b}

    def _against(self, loop: Loop, other: Loop) -> Disagreement:
        a1, b1 = self._ends(loop)
        if self._place(other.a) != self._place(loop.a) and self._place(other.b) == self._place(loop.a):
            other = other.reverse()
        if not self._same_map(a1, self._trails.number(other.a)):
            other = other.reverse()
        a2, b2 = self._ends(other)
        return witness_disagreement(loop, self._between(a1, a2), other, self._between(b2, b1))

    # ------------------------------------------------------------ changing the map

    def _accept(self, loops: list[Loop], reason: str) -> Decision:
        ends = self._ends(loops[-1])
        before = sorted({self._founder_of(n) for n in ends})
        if len(before) > 1:
            self._lay_beside(min(loops, key=lambda loop: float(loop.cov.trace())))
        for loop in loops:
            self._tie(loop)
        self._pending = [loop for loop in self._pending if loop not in loops]
        waited = self._settle_pending()
        reason, tied = reason + _that_waited(waited), (*loops, *waited)
        if len(before) == 1:
            return Decision(True, reason, tied=tied)
        survivor, gone = (self._trails.name(s) for s in before)
        return Decision(True, f"{reason}: map {gone} joins {survivor}", (survivor, gone), tied)

    def _lay_beside(self, loop: Loop) -> None:
        """Move the younger of two maps rigidly to where the loop says."""
        a, b = self._ends(loop)
        if self._founder_of(a) > self._founder_of(b):
            loop, a, b = loop.reverse(), b, a
        self._move(self._founder_of(b), self._poses[a] @ loop.T_a_b @ se3.inverse(self._poses[b]))

    def _move(self, founder: int, T: F64) -> None:
        for stretch in self._stretches_of(founder):
            for number in self._trails.stretches[stretch]:
                self._poses[number] = se3.orthonormal(T @ self._poses[number])

    def _tie(self, loop: Loop) -> None:
        edge = Edge(*self._ends(loop), loop.T_a_b, loop.cov)
        self._loops[self._loops_seen] = loop, edge
        self._loops_seen += 1
        self._roads.add(edge)
        self._find_maps()
        self._unsolved = {self._founder[f] for f in self._unsolved} | {self._founder_of(edge.a)}
        self._answers[loop.b.agent] = loop.b.id

    def _settle_pending(self) -> tuple[Loop, ...]:
        """Loops that waited between maps which are one by now are judged by it."""
        inside = [loop for loop in self._pending if self._same_map(*self._ends(loop))]
        fitting = [x for x in inside if self._fits(x)]
        self._pending = [loop for loop in self._pending if loop not in fitting]
        for loop in fitting:
            self._tie(loop)
        return tuple(fitting)

    def _fits(self, loop: Loop) -> bool:
        known = self._between(*self._ends(loop))
        return disagreement(known, Known(loop.T_a_b, loop.cov)).chi2 <= self._config.agree_chi2

    def _extend(self, stretches: Iterable[int], after: int) -> None:
        """Keyframes younger than a solution follow their references."""
        for number in sorted(n for s in stretches for n in self._trails.stretches[s] if n > after):
            node = self._trails.nodes[number]
            self._poses[number] = se3.orthonormal(self._poses[node.reference] @ node.T_ref_body)

    def _drop_contradicted(self, job: SolveJob, chi2: F64) -> tuple[Loop, ...]:
        """Loops that the whole map speaks against are taken back, and the joins that hung on them."""
        gone = [i for i, x in zip(job.loop_ids, chi2, strict=True) if x > self._config.drop_chi2]
        gone = [i for i in gone if i in self._loops]
        if not gone:
            return ()
        dropped = tuple(self._loops[i][0] for i in gone)
        for i in gone:
            self._roads.remove(self._loops.pop(i)[1])
        self._find_maps()
        for founder in {self._founder[s] for s in job.stretches}:
            first = self._trails.stretches[founder][0]
            self._move(founder, self._trails.nodes[first].T_odom_body @ se3.inverse(self._poses[first]))
            self._unsolved.add(founder)
        return dropped

    def _corrections(self, result: SolveResult) -> dict[str, Correction]:
        out = {}
        answers = dict(result.job.answers)
        for stretch, cov in zip(result.job.stretches, result.solved.covariances, strict=True):
            node = self._trails.nodes[self._trails.stretches[stretch][-1]]
            agent = node.key.agent
            if self._trails.current(agent) != stretch:
                continue  # that odometry has ended: nothing is left to correct
            self._revisions[agent] = self._revisions.get(agent, 0) + 1
            # cov is that of the newest solved pose; those after it hang on it rigidly.
            newest = self._trails.nodes[
                result.job.nodes[result.job.last[result.job.stretches.index(stretch)]]
            ]
            out[agent] = Correction(
                self._placement(self._trails.number(newest.key)),
                se3.inverse_cov(newest.T_odom_body, cov),
                self._trails.name(self._founder[stretch]),
                self._revisions[agent],
                answers.get(agent, -1),
            )
        return out

    # ------------------------------------------------------------ looking things up

    def _ends(self, loop: Loop) -> tuple[int, int]:
        return self._trails.number(loop.a), self._trails.number(loop.b)

    def _place(self, key: Key) -> int:
        return self._trails.nodes[self._trails.number(key)].stretch

    def _founder_of(self, number: int) -> int:
        return self._founder[self._trails.nodes[number].stretch]

    def _same_map(self, a: int, b: int) -> bool:
        return self._founder_of(a) == self._founder_of(b)

    def _map_name(self, number: int) -> str:
        return self._trails.name(self._founder_of(number))

    def _named(self, map_id: str) -> int:
        for founder in set(self._founder):
            if self._trails.name(founder) == map_id:
                return founder
        raise ValueError(f"there is no map {map_id}")

    def _stretches_of(self, founder: int) -> list[int]:
        return [s for s, f in enumerate(self._founder) if f == founder]

    def _placement(self, number: int) -> F64:
        """T_map_odom as this node has it."""
        return se3.orthonormal(self._poses[number] @ se3.inverse(self._trails.nodes[number].T_odom_body))

    def _between(self, a: int, b: int) -> Known:
        """Pose of node b in node a of the same map, as the map has it now."""
        path = self._roads.surest(a, b)
        if path is None:
            raise ValueError(f"nodes {a} and {b} are not in one map")
        return Known(se3.inverse(self._poses[a]) @ self._poses[b], covariance_between(path, a, self._poses))

    def _find_maps(self) -> None:
        """Every stretch's founder, from the accepted loops: the connected parts."""
        root = list(range(len(self._founder)))

        def find(i: int) -> int:
            while root[i] != i:
                i = root[i]
            return i

        for _, edge in self._loops.values():
            low, high = sorted(find(self._trails.nodes[n].stretch) for n in (edge.a, edge.b))
            root[high] = low
        self._founder = [find(i) for i in range(len(root))]


def _that_waited(loops: tuple[Loop, ...]) -> str:
    return f", {len(loops)} that waited fit too" if loops else ""
