"""A keyframe's way through the edge's map: place query -> verify -> believe? -> solve -> correct.

The mapper decides what comes next; each slow step is a frozen value that somebody else runs. Looking
keyframes up and solving go on side by side, one of each at a time; what comes while a map is solved is
solved together, once.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import asdict, dataclass, field
from typing import Any

from share.config import Config
from share.errors import describe
from share.mapping.agents.quarantine import Parted
from share.mapping.atlas import Applied, Atlas
from share.mapping.candidates import Effort, Lookups, Search, form_of, served_as
from share.mapping.changes import Change, DropLoop, KeepLoop, KeepPoses, Kept, KeptKeyframe
from share.mapping.corrections import Concern
from share.mapping.graph.updates import Solution
from share.mapping.loop_acceptance import Decision
from share.mapping.loops import Key, Loop
from share.mapping.map_news import changes_of, kept_link, placed_again
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.verification import Refusal, Sight, Verified
from share.mapping.steps import Finding, Look, Query, Solve, Step, Verify, in_map
from share.metrics.frame_log import summary
from share.scheduling.gate import Gating
from share.types import AgentKind, Keyframe
from share.wire.messages import Hello

_TIMES = 5000  # of each kind of step that a report is about: the newest
_SLACK = 1.05  # so much above the bound before it is asked which keyframes may go
_AT_ONCE = 2
_LOOK_AGAIN = 4


@dataclass
class _Account:
    """Of one agent."""

    loops_tried: int = 0
    merges: Counter[str] = field(default_factory=Counter)  # requested, skipped, done
    newest: int = -1  # keyframe that came


class Mapper:
    """The maps of all agents. `agent` names one run of an agent everywhere here."""

    def __init__(self, config: Config) -> None:
        place = config.place
        self._config = config
        self._index = PlaceIndex(place.index_seed, place.tables, place.hash_bits)
        self._hellos: dict[str, Hello] = {}
        self._sights: dict[int, Sight] = {}  # by the number of a keyframe in atlas and index
        self._atlas = Atlas(config.merge, self._sights)
        self._unseen: list[tuple[int, KeptKeyframe]] = []  # restored
        self._lookups = Lookups(config.edge)
        self._gating = Gating(config.control, config.edge.policy)
        self._concern = Concern()
        self._untold: set[tuple[str, str]] = set()  # who has been said to wait to hear of which map
        self._effort = Effort.of(config)
        self._search: Search | None = None
        self._query: Query | None = None  # that the search is about
        self._looking = self._solving = False
        self._leaving: list[int] = []  # keyframes that go next
        self._crowded = 0.0  # so many before it is asked again which may go
        self._changes: list[Change] = []
        self._accounts: dict[str, _Account] = {}
        self._closed = _Account()  # of runs that are forgotten
        self._emptied: list[Key] = []
        self._ms = {kind: deque[float](maxlen=_TIMES) for kind in ("place", "verify", "solve")}
        self._counts: Counter[str] = Counter()

    def join(self, agent: str, hello: Hello, voice: str | None = "") -> None:
        """A run of an agent, before its first keyframe. voice: see `KeepRun`."""
        self._hellos[agent] = hello
        self._accounts[agent] = _Account()
        self._atlas.enter(agent, hello.name, voice)

    def speaks(self, agent: str, voice: str) -> None:
        """See `Speaks`."""
        self._atlas.enter(agent, self.name(agent), voice)

    def name(self, agent: str) -> str:
        """Of the agent whose run it is."""
        return self._hellos[agent].name if agent in self._hellos else agent

    def present(self, agent: str, here: bool) -> None:
        """Nobody waits for a run that is not heard."""
        self._atlas.present(agent, here)

    def forget(self, agent: str) -> None:
        """A run of which nothing is left, and that will not come back."""
        self._atlas.forget(agent)
        self._lookups.forget(agent)
        self._concern.forget(agent)
        self._untold = {(run, map_id) for run, map_id in self._untold if run != agent}
        del self._hellos[agent]
        closed = self._accounts.pop(agent)
        self._closed.loops_tried += closed.loops_tried
        self._closed.merges += closed.merges

    def add(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[Finding]:
        """A keyframe, in order, each once. is_extra: see `Add`."""
        self._accounts[agent].newest = keyframe.id
        keyframe, link = self._atlas.tied(agent, keyframe)
        self._changes += [] if link is None else [kept_link(link)]
        number = self._atlas.add_keyframe(agent, keyframe, rank=self._rank(agent))
        self._see(number, agent, keyframe)
        self._lookups.add(agent, served_as(self._config, self._hellos[agent]), number, is_extra)
        founds = keyframe.reference < 0 or (link is not None and link.reference is None)
        findings = [self._founding(agent, keyframe)] if founds else []
        self._thin()
        return findings

    def restore(self, kept: Kept) -> None:
        """What an earlier life of the edge knew, before anything else comes. Maps keep their founders, also
        before headsets that come now. The views are gone through when one is first looked up."""
        for run in kept.runs:
            self.join(run.key, run.hello, run.voice)
            self.present(run.key, False)
        poses = {} if kept.poses is None else dict(zip(kept.poses.keys, kept.poses.T_map_body, strict=True))
        founders = set[str]() if kept.poses is None else set(kept.poses.maps)
        agents = [name.rpartition("/")[0] for name in kept.stretches]
        ranks = [self._rank(a, name in founders) for a, name in zip(agents, kept.stretches, strict=True)]
        stretches = list(zip(agents, ranks, strict=True))
        placed = [placed_again(found, kept.links) for found in kept.keyframes]
        numbers = self._atlas.restore(stretches, placed, kept.loops, poses)
        self._unseen = list(zip(numbers, kept.keyframes, strict=True))
        for found in kept.keyframes:
            account = self._accounts.get(found.key)  # a damaged file may have lost its run
            if account is not None:
                account.newest = max(account.newest, found.keyframe.id)

    def _see_restored(self) -> None:
        for number, found in self._unseen:
            self._see(number, found.key, found.keyframe)
        self._unseen = []

    def _see(self, number: int, agent: str, keyframe: Keyframe) -> None:
        hello = self._hellos[agent]
        self._sights[number] = Sight(keyframe.view, hello.rig.cam0.focal, hello.rig.T_body_cam0, keyframe.up)
        self._index.add(number, keyframe.view.descriptors)

    def _rank(self, agent: str, founded: bool = False) -> int:
        """Who wears a headset sees a map move, so it is the others' maps that come to his; all come to one
        that an earlier life had."""
        hello = self._hellos.get(agent)  # a damaged file may have lost it
        wears = hello is not None and form_of(self._config, hello) is AgentKind.AR
        return (0 if wears else 1) + (0 if founded else 2)

    def _founding(self, agent: str, keyframe: Keyframe) -> Finding:
        T, map_id = self._atlas.T_map_odom(agent), self._atlas.current_map(agent)
        assert T is not None and map_id is not None
        return in_map(agent, map_id, T, keyframe.id)

    # ------------------------------------------------------------------ what to work on

    def next_look(self) -> Look | None:
        """The next step of looking a keyframe up; None if there is none, or one is under way."""
        if self._looking:
            return None
        self._see_restored()
        step: Look | None = self._next_verify()
        while step is None and (number := self._next_number()) is not None:
            if number in self._sights:
                step = self._ask(number)
        self._looking = step is not None
        return step

    def _next_number(self) -> int | None:
        """One that was passed over is looked up only where it may join maps: it is late for an answer."""
        number = self._lookups.next()
        return self._lookups.next_late() if number is None and len(self._atlas.sizes()) > 1 else number

    def next_solve(self) -> Solve | None:
        """The next map to be solved; None if there is none, or one is under way."""
        for map_id in [] if self._solving else self._atlas.due():
            try:
                job = self._atlas.snapshot(map_id)
            except Exception:  # it costs this map its solution, not the others theirs
                self._counts["failed_jobs"] += 1
                continue
            self._solving = True
            return Solve(job)
        return None

    def done(self, step: Step, result: Any, ms: float) -> list[Finding]:
        """What follows from a step's result; an exception as the result costs that step only."""
        self._ms[step.kind].append(ms)
        self._counts[step.kind] += 1
        if isinstance(step, Solve):
            self._solving = False
        else:
            self._looking = False
        try:
            return self._follow(step, result)
        except Exception as error:
            return self._failed(step, error)

    def _follow(self, step: Step, result: Any) -> list[Finding]:
        """What the result leads to. Raises what the step raised."""
        match step:
            case Query() if isinstance(result, list):
                self._begin_search(step, [c.id for c in result])
                return self._review(step.number)
            case Verify() if isinstance(result, Verified | Refusal):
                return self._judge(step, result)
            case Solve() if isinstance(result, Solution):
                return self._solved(step, result)
            case Solve():
                self._atlas.solver_lost()
        raise result

    def _failed(self, step: Step, error: Exception) -> list[Finding]:
        agent = None if isinstance(step, Solve) else self._atlas.key(step.number).agent
        return self.failed(step.kind, error, agent)

    def failed(self, what: str, error: Exception, agent: str | None = None) -> list[Finding]:
        """It is counted and said; the map goes on without what raised `error`. agent: that it is about."""
        self._counts["failed_jobs"] += 1
        agent = next(iter(self._hellos), None) if agent is None else agent
        return [] if agent is None else [Finding(agent, "job failed", f"{what}: {describe(error)}")]

    def solver_lost(self) -> None:
        """The solver knows nothing any more."""
        self._atlas.solver_lost()

    @property
    def taken_out(self) -> int:
        """Keyframes, since the beginning."""
        return self._counts["taken_out"]

    def take_changes(self) -> tuple[Change, ...]:
        """What has to be kept since the last call."""
        taken, self._changes = tuple(self._changes), []
        return taken

    def take_emptied(self) -> tuple[Key, ...]:
        """Runs of which nothing is left since the last call, each with the newest keyframe that came."""
        taken, self._emptied = tuple(self._emptied), []
        return taken

    def poses(self) -> KeepPoses:
        """Where everything lies now."""
        keys, T_map_body, maps = self._atlas.everything()
        return KeepPoses(keys, T_map_body, maps)

    # ------------------------------------------------------------------ steps

    def _ask(self, number: int) -> Query:
        near = self._atlas.neighbours(number)
        if number % _LOOK_AGAIN:  # what is kept apart is looked up seldom: it may agree by now
            near += self._atlas.kept_apart(number)
        return Query(self._index, number, self._sights[number], self._config.place.candidates, near)

    def _begin_search(self, query: Query, found: list[int]) -> None:
        if self._lookups.in_a_hurry:
            found = self._atlas.promising_first(query.number, [n for n in found if n in self._sights])
        self._query, self._search = query, Search(query.number, found, self._effort)

    def _next_verify(self) -> Verify | None:
        """Those that have been taken out meanwhile are passed over."""
        search, query = self._search, self._query
        while search is not None and query is not None:
            candidate = search.next(self._lookups.in_a_hurry)
            if candidate is None:
                break
            if {query.number, candidate} <= self._sights.keys():
                seen = self._sights[candidate]
                return Verify(query.number, query.sight, candidate, seen, self._config.place)
        self._search = self._query = None
        return None

    def _judge(self, step: Verify, outcome: Verified | Refusal) -> list[Finding]:
        if not {step.number, step.candidate} <= self._sights.keys():
            return []  # taken out meanwhile
        a, b = self._atlas.key(step.candidate), self._atlas.key(step.number)
        account = self._accounts[b.agent]
        account.loops_tried += 1
        if isinstance(outcome, Refusal):
            return [Finding(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        if self._search is not None and not self._atlas.are_apart(a.agent, b.agent):
            self._search.verified()
        loop = Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers)
        account.merges["requested"] += 1
        volume = self._gating.volume(self._hellos[a.agent].rig, self._hellos[b.agent].rig, loop.T_a_b)
        if objection := self._gating.refuses(volume, self._atlas.map_of(a) == self._atlas.map_of(b)):
            account.merges["skipped"] += 1
            return [Finding(b.agent, "merge skipped", f"loop {loop}: {objection}")]
        parted = self._atlas.witness(loop, outcome.scale)
        findings = self._parted(parted)
        decision = self._atlas.propose(self._atlas.put_right(loop, outcome.scale))
        reason = f"{decision.reason} ({outcome.reason})"
        self._note(decision)
        if not decision.accepted:
            return [*findings, Finding(b.agent, "loop not taken", reason)]
        account.merges["done"] += 1
        self._gating.completed(volume)
        undone = [Finding(b.agent, "merge undone", reason)] if decision.dropped else []
        taken = Finding(b.agent, "maps joined" if decision.joined else "loop accepted", reason)
        return [*findings, *undone, taken]

    def _parted(self, parted: Parted) -> list[Finding]:
        """Who disagrees with the others since now, or no longer."""
        gone = (DropLoop(loop.a, loop.b) for loop in parted.dropped)
        self._changes += [*gone, *map(KeepLoop, parted.tied)]
        return [
            Finding(who, now.state, now.reason)
            if now.state in ("set apart", "disputed")
            else Finding(who, "agrees again", "its claims fit the others'")
            for who, now in parted.standing.items()
        ]

    def _review(self, number: int) -> list[Finding]:
        decision = self._atlas.review(number) if number in self._sights else None
        if decision is None:
            return []
        self._note(decision)
        return [Finding(self._atlas.key(number).agent, "merge undone", decision.reason)]

    def _solved(self, step: Solve, solution: Solution) -> list[Finding]:
        applied = self._atlas.apply(step.job, solution)
        self._note(applied)
        told = [
            Finding(agent, "correction", applied.reason, correction)
            for agent, correction in applied.corrections.items()
            if self._concern.concerns(agent, correction)
        ]
        map_id = step.job.map_id
        untold = [
            Finding(agent, "not told yet", f"map {map_id} knows it to {100 * m:.0f} cm only")
            for agent, m in applied.waiting.items()
            if (agent, map_id) not in self._untold
        ]
        self._untold |= {(agent, map_id) for agent in applied.waiting}
        return told + untold

    def _note(self, made: Decision | Applied) -> None:
        """The loops that are believed since, and those that are no longer, are to be kept so."""
        self._changes += [DropLoop(loop.a, loop.b) for loop in made.dropped]
        self._changes += [KeepLoop(loop) for loop in made.tied]

    def _thin(self) -> None:
        """Two keyframes go while one comes: all at once would hold the others up."""
        most = self._config.edge.max_keyframes
        if not self._leaving and len(self._atlas) > max(most * _SLACK, self._crowded):
            self._leaving = self._atlas.redundant(len(self._atlas) - most)
            # Where nothing may go, it is not asked each time.
            self._crowded = 0.0 if self._leaving else len(self._atlas) * _SLACK
        if not self._leaving:
            return
        self._see_restored()
        taken = self._atlas.take_out(self._leaving[:_AT_ONCE])
        del self._leaving[:_AT_ONCE]
        for out in taken:
            self._index.remove(out.number)
            del self._sights[out.number]
        self._counts["taken_out"] += len(taken)
        self._changes += changes_of(taken)
        empty = {out.key.agent for out in taken if self._atlas.is_forgotten(out.key.agent)}
        self._emptied += [Key(agent, self._accounts[agent].newest) for agent in sorted(empty)]

    # ------------------------------------------------------------------ report

    def report(self) -> dict[str, Any]:
        """edge.json's fields of the whole, and under `agents` those of each run."""
        accounts = [*self._accounts.values(), self._closed]
        merges = _told(sum((a.merges for a in accounts), Counter()))
        return {
            "agents": {agent: self._report_of(agent) for agent in self._accounts},
            "loops": {
                "tried": sum(a.loops_tried for a in accounts),
                "accepted": merges["done"],
                "waiting": len(self._atlas.pending),
                "in_map": len(self._atlas.loops),
            },
            "merges": merges,
            "maps": self._atlas.sizes(),
            "taken_out": self._counts["taken_out"],
            "waiting": len(self._lookups),
            "failed_jobs": self._counts["failed_jobs"],
            **{f"{k}_ms": {**summary(list(ms)).report(), "n": self._counts[k]} for k, ms in self._ms.items()},
        }

    def _report_of(self, agent: str) -> dict[str, Any]:
        account = self._accounts[agent]
        return {
            "loops": {"tried": account.loops_tried, "accepted": account.merges["done"]},
            "merges": _told(account.merges),
            "queries_skipped": self._lookups.skipped[agent],
            "map_id": self._atlas.current_map(agent),
            "consistency": asdict(self._atlas.standing(agent)),
        }


def _told(merges: Counter[str]) -> dict[str, int]:
    return {what: merges[what] for what in ("requested", "skipped", "done")}
