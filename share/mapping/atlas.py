"""The joint map of all agents: stretches of odometry, and the loops that tie them together.

Plain sequential calls without clock or thread. Solving is somebody else's: `snapshot` hands out what is
new, `apply` takes the solution in.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from share.config import MergeConfig
from share.geometry import se3
from share.mapping.agents.agreement import Standing
from share.mapping.agents.covariance_scale import believed, plumb_line
from share.mapping.agents.quarantine import Parted, Parting
from share.mapping.candidates import promising_first
from share.mapping.corrections import Found, Surety
from share.mapping.culling import Culling, Link, TakenOut, take_out, tied_again
from share.mapping.graph.updates import Change, Solution
from share.mapping.loop_acceptance import Decision, Judge, that_waited
from share.mapping.loops import Key, Loop
from share.mapping.map_graph import Chart
from share.mapping.overlap_check import Survey
from share.mapping.recognition.scale import Scale
from share.mapping.recognition.verification import Sight
from share.mapping.segments import Owners
from share.types import F64, Correction, Keyframe


@dataclass(frozen=True, eq=False)
class Applied:
    """What a solution changed. corrections: by agent. tied, dropped: loops that are believed since, and those
    that are no longer. waiting: agents who do not hear of it yet, since it knows them to so many m only."""

    corrections: dict[str, Correction]
    reason: str
    tied: tuple[Loop, ...] = ()
    dropped: tuple[Loop, ...] = ()
    waiting: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Placed:
    """A keyframe as an earlier life kept it. stretch: by name. T_ref_body (4, 4), cov (6, 6): of the step
    that leads to it, as the agent sent it or as the pose graph had it."""

    key: Key
    stretch: str
    ordinal: int
    keyframe: Keyframe
    T_ref_body: F64
    cov: F64
    as_sent: bool


class Atlas:
    """All keyframes of all agents, in maps."""

    def __init__(self, config: MergeConfig, sights: Mapping[int, Sight] | None = None) -> None:
        """sights: what each keyframe saw, by its number; kept by whoever asks."""
        self._config = config
        seen: Mapping[int, Sight] = {} if sights is None else sights
        self._chart = Chart()
        self._judge = Judge(config, self._chart, Survey(self._chart, seen))
        self._answers: dict[str, int] = {}  # agent -> its newest keyframe that a loop came from
        self._surety = Surety(config.enter_m, config.enter_patience)
        self._owners = Owners()
        self._culling = Culling(config, self._chart, self._owners)
        self._parting = Parting(config.scale_tolerance, self._chart, self._judge, seen)

    # ------------------------------------------------------------ what is known

    def __len__(self) -> int:
        return len(self._chart.poses)

    def pose(self, key: Key) -> F64:
        """T_map_body (4, 4), in the map that `map_of` names. Raises ValueError if unknown."""
        return self._chart.poses[self._chart.trails.number(key)]

    def map_of(self, key: Key) -> str:
        """Raises ValueError if there is no such keyframe."""
        return self._chart.name(self._chart.stretch_of(key))

    def current_map(self, agent: str) -> str | None:
        """The map that the agent's present stretch is in; None before its first keyframe."""
        stretch = self._chart.trails.current(agent)
        return None if stretch is None else self._chart.name(stretch)

    def sizes(self) -> dict[str, int]:
        """How many keyframes each map has."""
        out = Counter[str]()
        for stretch in sorted(self._chart.trails.live):
            out[self._chart.name(stretch)] += len(self._chart.trails.stretches[stretch].nodes)
        return out

    def T_map_odom(self, agent: str) -> F64 | None:
        """Where the agent's present odometry lies in its map; None before its first keyframe."""
        newest = self._chart.trails.newest(agent)
        return None if newest is None else self._chart.placement(newest)

    def key(self, number: int) -> Key:
        """Of the keyframe with this number."""
        return self._chart.trails.nodes[number].key

    def neighbours(self, number: int) -> tuple[int, ...]:
        """The keyframe, and those that odometry ties to it too closely for a loop."""
        trails, gap = self._chart.trails, self._config.min_loop_gap
        nodes = trails.stretches[trails.nodes[number].stretch].nodes
        at = bisect_left(nodes, number)
        beside = nodes[max(0, at - gap) : at + gap]
        return tuple(n for n in beside if trails.are_neighbours(n, number, gap))

    def promising_first(self, number: int, others: Sequence[int]) -> list[int]:
        """Keyframes that look like this one, those whose loop would tell most first."""
        return promising_first(self._chart, number, others)

    def everything(self) -> tuple[tuple[Key, ...], F64, tuple[str, ...]]:
        """Every keyframe, its T_map_body (N, 4, 4), and its map."""
        nodes, poses = self._chart.trails.nodes, self._chart.poses
        keys = tuple(node.key for node in nodes.values())
        maps = tuple(self._chart.name(node.stretch) for node in nodes.values())
        return keys, np.array([poses[n] for n in nodes]).reshape(-1, 4, 4), maps

    @property
    def pending(self) -> tuple[Loop, ...]:
        """Loops that wait for a witness, oldest first."""
        return tuple(self._judge.waiting)

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Accepted loops, oldest first."""
        return tuple(self._chart.ties.loops.values())

    # ------------------------------------------------------------ what arrives

    def enter(self, agent: str, name: str, voice: str | None = "") -> None:
        """A run of the agent of this name comes. voice: see `Subjects.speaks`."""
        self._owners.join(agent, name)
        self._parting.enter(agent, name, voice)

    def present(self, agent: str, here: bool) -> None:
        """Who is not heard need not be told where he is, and nobody waits for him. Once he is heard again, a
        map that he does not know of is due."""
        if self._owners.present(agent, here) and here:
            stretch = self._chart.trails.current(agent)
            if stretch is not None and stretch in self._chart.trails.live:
                self._tell_soon(stretch)

    def is_forgotten(self, agent: str) -> bool:
        """Whether it is not heard, and nothing of it is left."""
        return self._owners.is_absent(agent) and not self._chart.trails.has_any(agent)

    def forget(self, agent: str) -> None:
        """A run of which nothing is left will not come back."""
        self._owners.forget(agent)
        self._parting.forget(agent)
        self._answers.pop(agent, None)
        self._chart.trails.forget(agent)

    def _tell_soon(self, stretch: int) -> None:
        founder = self._chart.founder[stretch]
        if founder != stretch and self._surety.told(stretch, founder) is None:
            self._chart.unsolved[founder] = None

    def tied(self, agent: str, keyframe: Keyframe) -> tuple[Keyframe, Link | None]:
        """Before it is added: a keyframe whose reference was taken out, tied to what is left of its stretch,
        and the odometry edge that leads to it now. None: as it came."""
        chart, reference = self._chart, Key(agent, keyframe.reference)
        current = chart.trails.current(agent)
        if keyframe.reference < 0 or chart.trails.has(reference) or current is None:
            return keyframe, None
        newest = chart.trails.newest(agent)
        link = tied_again(agent, keyframe, None if newest is None else chart.trails.nodes[newest])
        if link.reference is None:
            return keyframe, link
        kept = replace(link, cov=believed(self._config, link.T_ref_body, link.cov))
        return replace(keyframe, reference=link.reference.id, T_ref_body=link.T_ref_body, cov=link.cov), kept

    def add_keyframe(self, agent: str, keyframe: Keyframe, rank: int = 0) -> int:
        """Its number here. A keyframe without a reference founds a map of its own; of maps that are joined,
        the oldest of those of the least rank keeps its name and place.

        Raises ValueError for a keyframe known already or whose reference is unknown.
        """
        c = self._config
        cov, plumb = believed(c, keyframe.T_ref_body, keyframe.cov), plumb_line(c, keyframe)
        number = self._chart.add(agent, keyframe, cov, plumb, rank)
        self._parting.walked(number, keyframe.T_ref_body, cov)
        return number

    def restore(
        self,
        stretches: Sequence[tuple[str, int]],
        keyframes: Iterable[Placed],
        loops: Iterable[Loop],
        T_map_body: Mapping[Key, F64],
    ) -> list[int]:
        """What an earlier life knew; this one must be empty. stretches: of every one there was, in order, the
        agent and its rank.

        Returns the keyframes' numbers. All maps are due.
        """
        chart, at = self._chart, {}
        for agent, rank in stretches:
            stretch = chart.trails.begin(agent, rank)
            at[chart.trails.stretches[stretch].name] = stretch
        numbers = []
        for found in keyframes:
            cov = believed(self._config, found.T_ref_body, found.cov) if found.as_sent else found.cov
            T_odom_body = found.keyframe.T_odom_body
            numbers.append(chart.trails.put(found.key, at[found.stretch], T_odom_body, found.ordinal))
            chart.place(numbers[-1], found.T_ref_body, cov, plumb_line(self._config, found.keyframe))
            self._parting.walked(numbers[-1], found.T_ref_body, cov)
            chart.poses[numbers[-1]] = T_map_body.get(found.key, chart.poses[numbers[-1]])
        for loop in loops:
            chart.tie(loop)
        self._parting.restored()
        for agent in {agent for agent, _ in stretches}:
            current = chart.trails.current(agent)
            if current is not None and chart.trails.stretches[current].nodes:  # a damaged file may lack them
                self._surety.remember(current, chart.founder[current])
        return numbers

    def redundant(self, count: int) -> list[int]:
        """Numbers of so many keyframes, if there are as many that may go: see `Culling`."""
        return self._culling.choose(count)

    def take_out(self, numbers: Iterable[int]) -> list[TakenOut]:
        """These keyframes, but for those that have to stay by now."""
        chart, taken = self._chart, list[TakenOut]()
        for number in numbers:
            if number in chart.poses and self._culling.may_go(number):
                stretch = chart.trails.nodes[number].stretch
                taken.append(self._parting.as_told(take_out(chart, number, self._config.most_loops)))
                chart.find_maps()
                if stretch not in chart.trails.live:
                    self._surety.forget([stretch])
        live = {chart.founder[stretch] for stretch in chart.trails.live}
        chart.unsolved = dict.fromkeys(founder for founder in chart.unsolved if founder in live)
        self._judge.forget({out.key for out in taken})
        self._parting.agreement.forget([out.number for out in taken], chart.trails.live)
        return taken

    def propose(self, loop: Loop) -> Decision:
        """A verified loop from candidate a to query b: accepted, waiting, or refused, with the reason. Raises
        ValueError if either keyframe is unknown."""
        if why := self._parting.forbids(loop):
            return Decision(False, f"loop {loop}: {why}")
        decision = self._judge.decide(loop)
        if decision.accepted:  # loops that waited are believed because of it: it is what is answered
            self._answers[loop.b.agent] = max(loop.b.id, self._answers.get(loop.b.agent, -1))
        return decision

    def witness(self, loop: Loop, scale: Scale | None) -> Parted:
        """A verified loop, before it is proposed, says how its agents agree: see `Parting`."""
        return self._parting.witness(loop, scale)

    def put_right(self, loop: Loop, scale: Scale | None) -> Loop:
        """A loop in true metres, so far as they are known: see `Parting`."""
        return self._parting.put_right(loop, scale)

    def standing(self, agent: str) -> Standing:
        """How the agent agrees with the others."""
        return self._parting.agreement.standing(agent)

    def doubts(self) -> dict[tuple[str, str], float]:
        """See `Agreement`."""
        return self._parting.agreement.doubts()

    def are_apart(self, one: str, other: str) -> bool:
        """Whether these agents must not come into one map."""
        return bool(self._parting.agreement.forbids([one], [other]))

    def kept_apart(self, number: int) -> tuple[int, ...]:
        """Keyframes of agents that must not come into one map with this one's."""
        return self._parting.kept_apart(self.key(number).agent)

    def review(self, number: int) -> Decision | None:
        """Whether what this keyframe saw speaks against a young join of its map: it is undone."""
        return self._judge.review(number)

    # ------------------------------------------------------------ the solver's side

    def due(self) -> list[str]:
        """Maps with news that no job has had yet, the oldest news first."""
        return [self._chart.trails.stretches[founder].name for founder in self._chart.unsolved]

    def snapshot(self, map_id: str) -> SolveJob:
        """What the solver has to know to solve this map. ValueError if there is none."""
        chart = self._chart
        founder = chart.named(map_id)
        stretches = tuple(chart.stretches_of(founder))
        agents = {chart.trails.stretches[s].agent for s in stretches}
        chart.unsolved.pop(founder, None)
        anew = chart.ties.anew
        return SolveJob(
            map_id,
            stretches,
            chart.anchor(founder),
            tuple(chart.trails.stretches[s].nodes[-1] for s in stretches),
            self._asked(founder, stretches),
            chart.ties.news(chart.poses, chart.plumb),
            anew,
            tuple((agent, self._answers.pop(agent)) for agent in sorted(agents & self._answers.keys())),
        )

    def _asked(self, founder: int, stretches: Sequence[int]) -> tuple[int, ...]:
        """Whose covariance is worth its time: who is answered, or never heard how sure he is in this map. Not
        who is away and would come into it; but who was in it before a restart is told with his welcome."""
        trails = self._chart.trails
        return tuple(
            s
            for s in stretches
            if trails.current(agent := trails.stretches[s].agent) == s
            and (not self._owners.is_absent(agent) or self._surety.heard(s, founder))
            and (agent in self._answers or self._surety.told(s, founder) is None)
        )

    def solver_lost(self) -> None:
        """The solver knows nothing any more: the next job tells everything."""
        self._chart.ties.untold()

    def apply(self, job: SolveJob, solution: Solution) -> Applied:
        """Take a solution in; keyframes and loops that came meanwhile are kept.

        If the map was joined or split meanwhile the solution no longer speaks of it: it is left
        aside and the map is due again.
        """
        chart = self._chart
        founder = job.stretches[0]
        if tuple(chart.stretches_of(founder)) != job.stretches:
            if founder in chart.trails.live:
                chart.unsolved[chart.founder[founder]] = None
            self._answers = dict(job.answers) | self._answers
            chart.ties.moved(n for n in solution.numbers.tolist() if n in chart.poses)
            return Applied({}, f"map {job.map_id}: joined or split while it was solved, due again")
        if solution.reason:
            return Applied({}, f"map {job.map_id}: not solved, {solution.reason}")
        self._take_in(job, solution)
        odd = solution.loop_ids[solution.loop_chi2 > self._config.drop_chi2].tolist()
        dropped = chart.drop([n for n in odd if n in chart.ties.loops]) if odd else ()
        tied = self._judge.settle()
        waiting = self._take_surety(job, solution)
        corrections, failed = self._corrections(job)
        counts = f"{len(solution.numbers)} poses, {len(solution.loop_ids)} loops solved"
        reason = f"map {job.map_id}: {counts}, corrects {', '.join(corrections) or 'nobody'}"
        reason += "".join(f"; {agent}: {why}" for agent, why in failed.items())
        if dropped:
            reason += f"; dropped loops at odds with it: {', '.join(map(str, dropped))}"
        return Applied(corrections, reason + that_waited(tied), tied, dropped, waiting)

    def _take_in(self, job: SolveJob, solution: Solution) -> None:
        chart = self._chart
        for number, T in zip(solution.numbers.tolist(), solution.poses, strict=True):
            if number in chart.poses:
                chart.poses[number] = T
        for stretch, last in zip(job.stretches, job.last, strict=True):
            chart.follow(n for n in chart.trails.stretches[stretch].nodes if n > last)

    def _take_surety(self, job: SolveJob, solution: Solution) -> dict[str, float]:
        """Of those who were asked for. Returns which agents wait to hear of this map: their spread, m."""
        trails, told = self._chart.trails, dict(zip(job.wanted, solution.covariances, strict=True))
        nodes, answers = trails.nodes, dict(job.answers)
        found = {
            stretch: Found(
                se3.inverse_cov(nodes[last].T_odom_body, told[last]),
                se3.position_sigma(told[last]),
                answers.get(trails.stretches[stretch].agent),
            )
            for stretch, last in zip(job.stretches, job.last, strict=True)
            if last in told and last in nodes
        }
        self._surety.parted(self._chart.parted)
        self._chart.parted.clear()
        waiting = self._surety.take(job.stretches[0], job.stretches, found)
        return {trails.stretches[s].agent: spread for s, spread in waiting.items()}

    def _corrections(self, job: SolveJob) -> tuple[dict[str, Correction], dict[str, str]]:
        """For whom the map knows surely enough; those after the newest that was solved hang on it rigidly.
        And of whom a correction would be none, with the reason: that costs nobody else."""
        trails, answers = self._chart.trails, dict(job.answers)
        out: dict[str, Correction] = {}
        failed: dict[str, str] = {}
        for stretch, last in zip(job.stretches, job.last, strict=True):
            agent, cov = trails.stretches[stretch].agent, self._surety.told(stretch, job.stretches[0])
            if cov is None or trails.current(agent) != stretch or last not in trails.nodes:
                continue  # he waits, or that odometry has ended: nothing is left to correct
            placement, name = self._chart.placement(last), self._chart.name(stretch)
            about, answer = trails.nodes[last].key.id, answers.get(agent, -1)
            try:
                out[agent] = Correction(placement, cov, name, 0, about, answer)
            except ValueError as error:
                failed[agent] = f"no correction, {error}"
        return out, failed


# ---- The question to the solver about one map.


@dataclass(frozen=True, eq=False)
class SolveJob:
    """Solve what is joined to node `anchor`, which is the gauge, once `change` is known. anew: that is all
    there is; whatever the solver knew before is nothing.

    stretches: of the map, and of each the newest node. asked: those stretches for whose newest nodes
    covariances are asked. answers: per agent, the keyframe whose loop is answered.
    """

    map_id: str
    stretches: tuple[int, ...]
    anchor: int
    last: tuple[int, ...]
    asked: tuple[int, ...]
    change: Change
    anew: bool
    answers: tuple[tuple[str, int], ...]

    @property
    def wanted(self) -> tuple[int, ...]:
        """The nodes whose covariances are asked for."""
        return tuple(last for s, last in zip(self.stretches, self.last, strict=True) if s in self.asked)
