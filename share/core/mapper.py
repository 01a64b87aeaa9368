"""A keyframe's way through the edge's map: place query -> verify -> believe? -> solve -> correct.

Each slow step is a frozen job that somebody else runs, one at a time; the mapper decides what comes
next. A solution that is due goes first, since somebody waits for its correction; but where keyframes
queue, one solution serves several of them. Where they queue still, the oldest are stored but no longer
looked up (policy `skip_oldest_query`).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from share.config import Config, GraphConfig, PlaceConfig
from share.merge.atlas import Atlas
from share.merge.join import Key, Loop
from share.merge.solving import SolveJob, SolveResult, run_job
from share.metrics.latency import summary
from share.place.index import Candidate, PlaceIndex
from share.place.verify import Refusal, Sight, Verified, verify
from share.types import Correction, Keyframe
from share.wire.messages import Hello


@dataclass(frozen=True, eq=False)
class Query:
    """Which stored keyframes look like this one? Then store it too."""

    index: PlaceIndex
    number: int
    sight: Sight
    limit: int
    exclude: tuple[int, ...]
    look: bool
    kind: str = "place"

    def run(self) -> list[Candidate]:
        found = self.index.query(self.sight.view.descriptors, self.limit, self.exclude) if self.look else []
        self.index.add(self.number, self.sight.view.descriptors)
        return found


@dataclass(frozen=True, eq=False)
class Verify:
    """Are they the same place? Best candidates first; enough of them that are make the rest needless."""

    number: int
    sight: Sight
    candidates: Mapping[int, Sight]
    config: PlaceConfig
    kind: str = "verify"

    def run(self) -> dict[int, Verified | Refusal]:
        outcomes: dict[int, Verified | Refusal] = {}
        for number, sight in self.candidates.items():
            outcomes[number] = verify(self.sight, sight, self.config)
            if sum(isinstance(outcome, Verified) for outcome in outcomes.values()) >= self.config.enough:
                break
        return outcomes


@dataclass(frozen=True, eq=False)
class Solve:
    """Where was everybody?"""

    job: SolveJob
    config: GraphConfig
    kind: str = "solve"

    def run(self) -> SolveResult:
        return run_job(self.job, self.config)


Job = Query | Verify | Solve


@dataclass(frozen=True, eq=False)
class Finding:
    """Something decided about an agent, why, and the correction that follows, if one does."""

    agent: str
    what: str
    reason: str
    correction: Correction | None = None


@dataclass
class _Account:
    """Of one agent."""

    loops_tried: int = 0
    loops_accepted: int = 0
    merges: int = 0
    queries_skipped: int = 0


@dataclass
class Mapper:
    """The maps of all agents. `agent` names one run of an agent everywhere here."""

    config: Config
    _atlas: Atlas = field(init=False)
    _index: PlaceIndex = field(init=False)

    def __post_init__(self) -> None:
        place = self.config.place
        self._atlas = Atlas(self.config.merge)
        self._index = PlaceIndex(place.index_seed, place.tables, place.hash_bits)
        self._keys: list[Key] = []  # by the number that the place index knows a keyframe by
        self._sights: list[Sight] = []
        self._waiting: deque[int] = deque()
        self._unlooked: deque[int] = deque()
        self._since_solution = 0  # keyframes looked up
        self._verify: Verify | None = None
        self._accounts: dict[str, _Account] = {}
        self._ms: dict[str, list[float]] = {"place": [], "verify": [], "solve": []}
        self._counts: Counter[str] = Counter()

    def add(self, agent: str, hello: Hello, keyframe: Keyframe) -> list[Finding]:
        """A keyframe, in order, each once."""
        account = self._accounts.setdefault(agent, _Account())
        map_id = self._atlas.add_keyframe(agent, keyframe)
        self._waiting.append(len(self._keys))
        self._keys.append(Key(agent, keyframe.id))
        self._sights.append(Sight(keyframe.view, hello.focal, hello.T_body_cam0, keyframe.up))
        if len(self._waiting) > self.config.edge.max_waiting:
            self._unlooked.append(self._waiting.popleft())
            account.queries_skipped += 1
        if keyframe.reference >= 0:
            return []
        T = self._atlas.T_map_odom(agent)
        assert T is not None
        founding = Correction(T, np.zeros((6, 6)), map_id, 0)
        return [Finding(agent, "correction", f"founds map {map_id}", founding)]

    def next_job(self) -> Job | None:
        """What to work on now; None if there is nothing to do."""
        if self._verify is not None:
            job, self._verify = self._verify, None
            return job
        due = self._atlas.due()
        if due and (not self._waiting or self._since_solution >= self.config.edge.solve_every):
            self._since_solution = 0
            return Solve(self._atlas.snapshot(due[0]), self.config.graph)
        if self._unlooked:
            return self._query(self._unlooked.popleft(), look=False)
        if self._waiting:
            self._since_solution += 1
            return self._query(self._waiting.popleft(), look=True)
        return None

    def done(self, job: Job, result: Any, ms: float) -> list[Finding]:
        """What follows from a job's result; an exception as the result costs that job only."""
        self._ms[job.kind].append(ms)
        match job:
            case Query() if isinstance(result, list):
                candidates = {c.id: self._sights[c.id] for c in result}
                if candidates:
                    self._verify = Verify(job.number, job.sight, candidates, self.config.place)
                return []
            case Verify() if isinstance(result, dict):
                return [f for n, outcome in result.items() for f in self._judge(job.number, n, outcome)]
            case Solve() if isinstance(result, SolveResult):
                return self._solved(result)
        self._counts["failed_jobs"] += 1
        agent = self._keys[job.number].agent if isinstance(job, (Query, Verify)) else self._keys[0].agent
        return [Finding(agent, "job failed", f"{job.kind}: {type(result).__name__}: {result}")]

    def report_of(self, agent: str) -> dict[str, Any]:
        """edge.json's fields of one agent."""
        account = self._accounts.get(agent, _Account())
        newest = next((key for key in reversed(self._keys) if key.agent == agent), None)
        return {
            "loops": {"tried": account.loops_tried, "accepted": account.loops_accepted},
            "merges": {"requested": account.merges, "skipped": 0, "done": account.merges},
            "queries_skipped": account.queries_skipped,
            "map_id": None if newest is None else self._atlas.map_of(newest),
        }

    def report(self) -> dict[str, Any]:
        """edge.json's fields of the whole."""
        accounts = self._accounts.values()
        merges = sum(a.merges for a in accounts)
        return {
            "loops": {
                "tried": sum(a.loops_tried for a in accounts),
                "accepted": sum(a.loops_accepted for a in accounts),
                "waiting": len(self._atlas.pending),
                "in_map": len(self._atlas.loops),
            },
            "merges": {"requested": merges, "skipped": 0, "done": merges},
            "maps": {map_id: len(keys) for map_id, keys in self._atlas.maps().items()},
            "failed_jobs": self._counts["failed_jobs"],
            **{f"{kind}_ms": summary(ms).report() for kind, ms in self._ms.items()},
        }

    # ------------------------------------------------------------------ steps

    def _query(self, number: int, look: bool) -> Query:
        agent, id = self._keys[number]
        recent = range(max(0, number - 8 * self.config.merge.min_loop_gap), number)
        near = (
            n
            for n in recent
            if self._keys[n].agent == agent and id - self._keys[n].id < self.config.merge.min_loop_gap
        )
        sight = self._sights[number]
        return Query(self._index, number, sight, self.config.place.candidates, tuple(near), look)

    def _judge(self, query: int, candidate: int, outcome: Verified | Refusal) -> list[Finding]:
        a, b = self._keys[candidate], self._keys[query]
        account = self._accounts[b.agent]
        account.loops_tried += 1
        if isinstance(outcome, Refusal):
            return [Finding(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        decision = self._atlas.propose(Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers))
        reason = f"{decision.reason} ({outcome.reason})"
        if not decision.accepted:
            return [Finding(b.agent, "loop not taken", reason)]
        account.loops_accepted += 1
        account.merges += 1
        what = "maps joined" if decision.joined else "loop accepted"
        return [Finding(b.agent, what, reason)]

    def _solved(self, result: SolveResult) -> list[Finding]:
        applied = self._atlas.apply(result)
        return [
            Finding(agent, "correction", applied.reason, correction)
            for agent, correction in applied.corrections.items()
        ]
