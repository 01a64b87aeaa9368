"""A keyframe's way through the edge's map: place query -> verify -> believe? -> solve -> correct.

The mapper decides what comes next; each slow step is a frozen value that somebody else runs. Looking
keyframes up and solving go on side by side, one of each at a time; what comes while a map is solved is
solved together, once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from share.config import Config
from share.core.finding import Finding
from share.core.keeping import Change, DropLoop, KeepLoop
from share.core.lookups import Lookups
from share.core.steps import Look, Query, Solve, Step, Verify
from share.graph.change import Solution
from share.merge.atlas import Atlas
from share.merge.join import Key, Loop
from share.metrics.latency import summary
from share.place.index import PlaceIndex
from share.place.verify import Refusal, Sight, Verified
from share.types import Correction, Keyframe
from share.wire.messages import Hello


@dataclass
class _Account:
    """Of one agent."""

    loops_tried: int = 0
    loops_accepted: int = 0
    merges: int = 0


class Mapper:
    """The maps of all agents. `agent` names one run of an agent everywhere here."""

    def __init__(self, config: Config) -> None:
        place = config.place
        self._config = config
        self._atlas = Atlas(config.merge)
        self._index = PlaceIndex(place.index_seed, place.tables, place.hash_bits)
        self._hellos: dict[str, Hello] = {}
        self._keys: list[Key] = []  # by the number that the place index knows a keyframe by
        self._sights: list[Sight] = []
        self._lookups = Lookups(config.edge.max_waiting)
        self._verify: Verify | None = None
        self._looking = self._solving = False
        self._changes: list[Change] = []
        self._accounts: dict[str, _Account] = {}
        self._ms: dict[str, list[float]] = {"place": [], "verify": [], "solve": []}
        self._counts: Counter[str] = Counter()

    def join(self, agent: str, hello: Hello) -> None:
        """A run of an agent, before its first keyframe."""
        self._hellos[agent] = hello
        self._accounts[agent] = _Account()

    def add(self, agent: str, keyframe: Keyframe) -> list[Finding]:
        """A keyframe, in order, each once."""
        hello, number = self._hellos[agent], len(self._keys)
        map_id = self._atlas.add_keyframe(agent, keyframe)
        self._keys.append(Key(agent, keyframe.id))
        self._sights.append(Sight(keyframe.view, hello.focal, hello.T_body_cam0, keyframe.up))
        self._index.add(number, keyframe.view.descriptors)
        self._lookups.add(agent, hello.kind, number)
        if keyframe.reference >= 0:
            return []
        T = self._atlas.T_map_odom(agent)
        assert T is not None
        founding = Correction(T, np.zeros((6, 6)), map_id, 0)
        return [Finding(agent, "correction", f"founds map {map_id}", founding)]

    # ------------------------------------------------------------------ what to work on

    def next_look(self) -> Look | None:
        """The next step of looking a keyframe up; None if there is none, or one is under way."""
        if self._looking:
            return None
        step: Look | None = self._verify
        self._verify = None
        if step is None and (number := self._lookups.next()) is not None:
            step = self._query(number)
        self._looking = step is not None
        return step

    def next_solve(self) -> Solve | None:
        """The next map to be solved; None if there is none, or one is under way."""
        due = [] if self._solving else self._atlas.due()
        if not due:
            return None
        self._solving = True
        return Solve(self._atlas.snapshot(due[0]))

    def done(self, step: Step, result: Any, ms: float) -> list[Finding]:
        """What follows from a step's result; an exception as the result costs that step only."""
        self._ms[step.kind].append(ms)
        match step:
            case Solve():
                self._solving = False
            case _:
                self._looking = False
        match step:
            case Query() if isinstance(result, list):
                candidates = {c.id: self._sights[c.id] for c in result}
                if candidates:
                    place = self._config.place
                    self._verify = Verify(step.number, step.sight, candidates, place.enough, place)
                return []
            case Verify() if isinstance(result, dict):
                return [f for n, outcome in result.items() for f in self._judge(step.number, n, outcome)]
            case Solve() if isinstance(result, Solution):
                return self._solved(step, result)
            case Solve():
                self._atlas.solver_lost()
        self._counts["failed_jobs"] += 1
        agent = self._keys[0 if isinstance(step, Solve) else step.number].agent
        return [Finding(agent, "job failed", f"{step.kind}: {type(result).__name__}: {result}")]

    def solver_lost(self) -> None:
        """The solver knows nothing any more."""
        self._atlas.solver_lost()

    def take_changes(self) -> tuple[Change, ...]:
        """What has to be kept since the last call."""
        taken, self._changes = tuple(self._changes), []
        return taken

    # ------------------------------------------------------------------ steps

    def _query(self, number: int) -> Query:
        agent, id = self._keys[number]
        gap = self._config.merge.min_loop_gap
        recent = range(max(0, number - 8 * gap), len(self._keys))
        near = (n for n in recent if self._keys[n].agent == agent and abs(id - self._keys[n].id) < gap)
        return Query(self._index, number, self._sights[number], self._config.place.candidates, tuple(near))

    def _judge(self, query: int, candidate: int, outcome: Verified | Refusal) -> list[Finding]:
        a, b = self._keys[candidate], self._keys[query]
        account = self._accounts[b.agent]
        account.loops_tried += 1
        if isinstance(outcome, Refusal):
            return [Finding(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        decision = self._atlas.propose(Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers))
        reason = f"{decision.reason} ({outcome.reason})"
        self._changes += [DropLoop(loop.a, loop.b) for loop in decision.dropped]
        self._changes += [KeepLoop(loop) for loop in decision.tied]
        if not decision.accepted:
            return [Finding(b.agent, "loop not taken", reason)]
        account.loops_accepted += 1
        account.merges += 1
        what = "maps joined" if decision.joined else "loop accepted"
        return [Finding(b.agent, what, reason)]

    def _solved(self, step: Solve, solution: Solution) -> list[Finding]:
        applied = self._atlas.apply(step.job, solution)
        self._changes += [DropLoop(loop.a, loop.b) for loop in applied.dropped]
        self._changes += [KeepLoop(loop) for loop in applied.tied]
        return [
            Finding(agent, "correction", applied.reason, correction)
            for agent, correction in applied.corrections.items()
        ]

    # ------------------------------------------------------------------ report

    def report(self) -> dict[str, Any]:
        """edge.json's fields of the whole, and under `agents` those of each run."""
        accounts = self._accounts.values()
        merges = sum(a.merges for a in accounts)
        return {
            "agents": {agent: self._report_of(agent) for agent in self._accounts},
            "loops": {
                "tried": sum(a.loops_tried for a in accounts),
                "accepted": sum(a.loops_accepted for a in accounts),
                "waiting": len(self._atlas.pending),
                "in_map": len(self._atlas.loops),
            },
            "merges": {"requested": merges, "skipped": 0, "done": merges},
            "maps": self._atlas.sizes(),
            "waiting": len(self._lookups),
            "failed_jobs": self._counts["failed_jobs"],
            **{f"{kind}_ms": summary(ms).report() for kind, ms in self._ms.items()},
        }

    def _report_of(self, agent: str) -> dict[str, Any]:
        account = self._accounts[agent]
        return {
            "loops": {"tried": account.loops_tried, "accepted": account.loops_accepted},
            "merges": {"requested": account.merges, "skipped": 0, "done": account.merges},
            "queries_skipped": self._lookups.skipped[agent],
            "map_id": self._atlas.current_map(agent),
        }
