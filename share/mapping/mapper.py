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
from share.errors import describe_exception
from share.mapping.agents.quarantine import QuarantineChange
from share.mapping.atlas import AppliedSolution, Atlas
from share.mapping.corrections import CorrectionFilter
from share.mapping.graph.updates import GraphSolution
from share.mapping.loop_acceptance import LoopDecision
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import MapChange, RemoveLoops, SaveLoop, SavePoses, StoredKeyframe, StoredMap
from share.mapping.map_news import removal_changes, restored_keyframe, stored_link
from share.mapping.query_queue import CandidateSearch, QueryQueue, SearchBudget, qoe_form, service_kind
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.verification import CameraView, Refusal, Verification
from share.mapping.steps import LookupStep, MapEvent, QueryStep, SolveStep, Step, VerifyStep, map_assignment
from share.metrics.frame_log import summary
from share.scheduling.merge_gate import MergeGate
from share.types import AgentKind, Keyframe
from share.wire.messages import Hello

_MAX_STEP_TIMES = 5000  # of each kind of step that a report is about: the newest
_CULL_MARGIN = 1.05  # so much above the bound before it is asked which keyframes may go
_REMOVED_PER_KEYFRAME = 2
_RETRY_INTERVAL = 4
_QUARANTINE_EVENTS = {
    "set apart": "agent quarantined",
    "disputed": "agents disputed",
}  # by `AgentStanding.state`


@dataclass
class _RunCounters:
    """Of one agent."""

    loops_tried: int = 0
    merges: Counter[str] = field(default_factory=Counter)  # requested, skipped, done
    newest_id: int = -1  # keyframe that came


class Mapper:
    """The maps of all agents. `agent` names one run of an agent everywhere here."""

    def __init__(self, config: Config) -> None:
        place = config.place
        self._config = config
        self._index = PlaceIndex(place.index_seed, place.tables, place.hash_bits)
        self._hellos: dict[str, Hello] = {}
        self._camera_views: dict[int, CameraView] = {}  # by the number of a keyframe in atlas and index
        self._atlas = Atlas(config.merge, self._camera_views)
        self._unindexed: list[tuple[int, StoredKeyframe]] = []  # restored
        self._queries = QueryQueue(config.edge)
        self._merge_gate = MergeGate(config.control, config.edge.policy)
        self._correction_filter = CorrectionFilter()
        self._reported_waits: set[tuple[str, str]] = set()  # who has been said to wait to hear of which map
        self._search_budget = SearchBudget.from_config(config)
        self._search: CandidateSearch | None = None
        self._query: QueryStep | None = None  # that the search is about
        self._is_looking_up = self._is_solving = False
        self._to_remove: list[int] = []  # keyframes that go next
        self._cull_threshold = 0.0  # so many before it is asked again which may go
        self._changes: list[MapChange] = []
        self._counters: dict[str, _RunCounters] = {}
        self._removed_runs_counters = _RunCounters()  # of runs that are forgotten
        self._empty_runs: list[KeyframeKey] = []
        self._step_ms = {kind: deque[float](maxlen=_MAX_STEP_TIMES) for kind in ("place", "verify", "solve")}
        self._counts: Counter[str] = Counter()

    def add_run(self, agent: str, hello: Hello, credential: str | None = "") -> None:
        """A run of an agent, before its first keyframe. voice: see `KeepRun`."""
        self._hellos[agent] = hello
        self._counters[agent] = _RunCounters()
        self._atlas.add_run(agent, hello.name, credential)

    def set_credential(self, agent: str, credential: str) -> None:
        """See `Speaks`."""
        self._atlas.add_run(agent, self.agent_name(agent), credential)

    def agent_name(self, agent: str) -> str:
        """Of the agent whose run it is."""
        return self._hellos[agent].name if agent in self._hellos else agent

    def set_present(self, agent: str, is_present: bool) -> None:
        """Nobody waits for a run that is not heard."""
        self._atlas.set_present(agent, is_present)

    def remove_run(self, agent: str) -> None:
        """A run of which nothing is left, and that will not come back."""
        self._atlas.remove_run(agent)
        self._queries.remove_agent(agent)
        self._correction_filter.remove_agent(agent)
        self._reported_waits = {(run, map_id) for run, map_id in self._reported_waits if run != agent}
        del self._hellos[agent]
        counters = self._counters.pop(agent)
        self._removed_runs_counters.loops_tried += counters.loops_tried
        self._removed_runs_counters.merges += counters.merges

    def add_keyframe(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[MapEvent]:
        """A keyframe, in order, each once. is_extra: see `Add`."""
        self._counters[agent].newest_id = keyframe.id
        keyframe, link = self._atlas.reconnect(agent, keyframe)
        self._changes += [] if link is None else [stored_link(link)]
        node_id = self._atlas.add_keyframe(agent, keyframe, rank=self._map_rank(agent))
        self._index_keyframe(node_id, agent, keyframe)
        self._queries.add(agent, service_kind(self._config, self._hellos[agent]), node_id, is_extra)
        begins_map = keyframe.reference < 0 or (link is not None and link.reference is None)
        events = [self._new_map_event(agent, keyframe)] if begins_map else []
        self._cull_keyframes()
        return events

    def restore(self, kept: StoredMap) -> None:
        """What an earlier life of the edge knew, before anything else comes. Maps keep their founders, also
        before headsets that come now. The views are gone through when one is first looked up."""
        for run in kept.runs:
            self.add_run(run.run_key, run.hello, run.credential)
            self.set_present(run.run_key, False)
        poses = {} if kept.poses is None else dict(zip(kept.poses.keys, kept.poses.T_map_body, strict=True))
        reference_segments = set[str]() if kept.poses is None else set(kept.poses.map_ids)
        agents = [name.rpartition("/")[0] for name in kept.segments]
        ranks = [
            self._map_rank(a, name in reference_segments)
            for a, name in zip(agents, kept.segments, strict=True)
        ]
        segments = list(zip(agents, ranks, strict=True))
        restored = [restored_keyframe(stored, kept.links) for stored in kept.keyframes]
        node_ids = self._atlas.restore(segments, restored, kept.loops, poses)
        self._unindexed = list(zip(node_ids, kept.keyframes, strict=True))
        for stored in kept.keyframes:
            account = self._counters.get(stored.run_key)  # a damaged file may have lost its run
            if account is not None:
                account.newest_id = max(account.newest_id, stored.keyframe.id)

    def _index_restored(self) -> None:
        for node_id, stored in self._unindexed:
            self._index_keyframe(node_id, stored.run_key, stored.keyframe)
        self._unindexed = []

    def _index_keyframe(self, node_id: int, agent: str, keyframe: Keyframe) -> None:
        hello = self._hellos[agent]
        self._camera_views[node_id] = CameraView(
            keyframe.view, hello.rig.cam0.focal, hello.rig.T_body_cam0, keyframe.up
        )
        self._index.add(node_id, keyframe.view.descriptors)

    def _map_rank(self, agent: str, is_reference: bool = False) -> int:
        """Who wears a headset sees a map move, so it is the others' maps that come to his; all come to one
        that an earlier life had."""
        hello = self._hellos.get(agent)  # a damaged file may have lost it
        is_headset = hello is not None and qoe_form(self._config, hello) is AgentKind.AR
        return (0 if is_headset else 1) + (0 if is_reference else 2)

    def _new_map_event(self, agent: str, keyframe: Keyframe) -> MapEvent:
        T, map_id = self._atlas.T_map_odom(agent), self._atlas.current_map_id(agent)
        assert T is not None and map_id is not None
        return map_assignment(agent, map_id, T, keyframe.id)

    # ------------------------------------------------------------------ what to work on

    def next_lookup(self) -> LookupStep | None:
        """The next step of looking a keyframe up; None if there is none, or one is under way."""
        if self._is_looking_up:
            return None
        self._index_restored()
        step: LookupStep | None = self._next_verify()
        while step is None and (node_id := self._next_query_id()) is not None:
            if node_id in self._camera_views:
                step = self._make_query(node_id)
        self._is_looking_up = step is not None
        return step

    def _next_query_id(self) -> int | None:
        """One that was passed over is looked up only where it may join maps: it is late for an answer."""
        node_id = self._queries.next_query()
        return (
            self._queries.next_skipped() if node_id is None and len(self._atlas.map_sizes()) > 1 else node_id
        )

    def next_solve(self) -> SolveStep | None:
        """The next map to be solved; None if there is none, or one is under way."""
        for map_id in [] if self._is_solving else self._atlas.due_maps():
            try:
                job = self._atlas.make_job(map_id)
            except Exception:  # it costs this map its solution, not the others theirs
                self._counts["failed_steps"] += 1
                continue
            self._is_solving = True
            return SolveStep(job)
        return None

    def finish_step(self, step: Step, result: Any, ms: float) -> list[MapEvent]:
        """What follows from a step's result; an exception as the result costs that step only."""
        self._step_ms[step.kind].append(ms)
        self._counts[step.kind] += 1
        if isinstance(step, SolveStep):
            self._is_solving = False
        else:
            self._is_looking_up = False
        try:
            return self._handle_result(step, result)
        except Exception as error:
            return self._step_failed(step, error)

    def _handle_result(self, step: Step, result: Any) -> list[MapEvent]:
        """What the result leads to. Raises what the step raised."""
        match step:
            case QueryStep() if isinstance(result, list):
                self._begin_search(step, [c.id for c in result])
                return self._review_joins(step.node_id)
            case VerifyStep() if isinstance(result, Verification | Refusal):
                return self._handle_verification(step, result)
            case SolveStep() if isinstance(result, GraphSolution):
                return self._handle_solution(step, result)
            case SolveStep():
                self._atlas.reset_solver()
        raise result

    def _step_failed(self, step: Step, error: Exception) -> list[MapEvent]:
        agent = None if isinstance(step, SolveStep) else self._atlas.key(step.node_id).agent
        return self.report_failure(step.kind, error, agent)

    def report_failure(self, what: str, error: Exception, agent: str | None = None) -> list[MapEvent]:
        """It is counted and said; the map goes on without what raised `error`. agent: that it is about."""
        self._counts["failed_steps"] += 1
        agent = next(iter(self._hellos), None) if agent is None else agent
        return (
            [] if agent is None else [MapEvent(agent, "step failed", f"{what}: {describe_exception(error)}")]
        )

    def reset_solver(self) -> None:
        """The solver knows nothing any more."""
        self._atlas.reset_solver()

    @property
    def removed_count(self) -> int:
        """Keyframes, since the beginning."""
        return self._counts["removed_keyframes"]

    def take_changes(self) -> tuple[MapChange, ...]:
        """What has to be kept since the last call."""
        changes, self._changes = tuple(self._changes), []
        return changes

    def take_empty_runs(self) -> tuple[KeyframeKey, ...]:
        """Runs of which nothing is left since the last call, each with the newest keyframe that came."""
        empty_runs, self._empty_runs = tuple(self._empty_runs), []
        return empty_runs

    def current_poses(self) -> SavePoses:
        """Where everything lies now."""
        keys, T_map_body, maps = self._atlas.all_poses()
        return SavePoses(keys, T_map_body, maps)

    # ------------------------------------------------------------------ steps

    def _make_query(self, node_id: int) -> QueryStep:
        excluded = self._atlas.neighbours(node_id)
        if node_id % _RETRY_INTERVAL:  # what is kept apart is looked up seldom: it may agree by now
            excluded += self._atlas.separated_keyframes(node_id)
        return QueryStep(
            self._index, node_id, self._camera_views[node_id], self._config.place.candidates, excluded
        )

    def _begin_search(self, query: QueryStep, candidates: list[int]) -> None:
        if self._queries.is_hurried:
            candidates = self._atlas.rank_candidates(
                query.node_id, [n for n in candidates if n in self._camera_views]
            )
        self._query, self._search = query, CandidateSearch(query.node_id, candidates, self._search_budget)

    def _next_verify(self) -> VerifyStep | None:
        """Those that have been taken out meanwhile are passed over."""
        search, query = self._search, self._query
        while search is not None and query is not None:
            candidate = search.next_candidate(self._queries.is_hurried)
            if candidate is None:
                break
            if {query.node_id, candidate} <= self._camera_views.keys():
                candidate_view = self._camera_views[candidate]
                return VerifyStep(
                    query.node_id, query.camera_view, candidate, candidate_view, self._config.place
                )
        self._search = self._query = None
        return None

    def _handle_verification(self, step: VerifyStep, outcome: Verification | Refusal) -> list[MapEvent]:
        if not {step.node_id, step.candidate_id} <= self._camera_views.keys():
            return []  # taken out meanwhile
        a, b = self._atlas.key(step.candidate_id), self._atlas.key(step.node_id)
        account = self._counters[b.agent]
        account.loops_tried += 1
        if isinstance(outcome, Refusal):
            return [MapEvent(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        if self._search is not None and not self._atlas.are_separated(a.agent, b.agent):
            self._search.count_verified()
        loop = Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers)
        account.merges["requested"] += 1
        volume = self._merge_gate.overlap_volume(
            self._hellos[a.agent].rig, self._hellos[b.agent].rig, loop.T_a_b
        )
        if objection := self._merge_gate.skip_reason(volume, self._atlas.map_id(a) == self._atlas.map_id(b)):
            account.merges["skipped"] += 1
            return [MapEvent(b.agent, "merge skipped", f"loop {loop}: {objection}")]
        change = self._atlas.compare_agents(loop, outcome.depth_scale)
        events = self._quarantine_events(change)
        decision = self._atlas.propose(self._atlas.rescale_loop(loop, outcome.depth_scale))
        reason = f"{decision.reason} ({outcome.reason})"
        self._record_loops(decision)
        if not decision.accepted:
            return [*events, MapEvent(b.agent, "loop not accepted", reason)]
        account.merges["done"] += 1
        self._merge_gate.record_merge(volume)
        undone_events = [MapEvent(b.agent, "merge undone", reason)] if decision.dropped else []
        accepted = MapEvent(b.agent, "maps merged" if decision.joined_maps else "loop accepted", reason)
        return [*events, *undone_events, accepted]

    def _quarantine_events(self, change: QuarantineChange) -> list[MapEvent]:
        """Who disagrees with the others since now, or no longer."""
        removals = (RemoveLoops(loop.a, loop.b) for loop in change.dropped)
        self._changes += [*removals, *map(SaveLoop, change.added)]
        return [
            MapEvent(agent, _QUARANTINE_EVENTS[standing.state], standing.reason)
            if standing.state in _QUARANTINE_EVENTS
            else MapEvent(agent, "quarantine lifted", "its odometry agrees with the others'")
            for agent, standing in change.standings.items()
        ]

    def _review_joins(self, node_id: int) -> list[MapEvent]:
        decision = self._atlas.review_joins(node_id) if node_id in self._camera_views else None
        if decision is None:
            return []
        self._record_loops(decision)
        return [MapEvent(self._atlas.key(node_id).agent, "merge undone", decision.reason)]

    def _handle_solution(self, step: SolveStep, solution: GraphSolution) -> list[MapEvent]:
        applied = self._atlas.apply_solution(step.job, solution)
        self._record_loops(applied)
        sent = [
            MapEvent(agent, "correction", applied.reason, correction)
            for agent, correction in applied.corrections.items()
            if self._correction_filter.should_send(agent, correction)
        ]
        map_id = step.job.map_id
        waiting = [
            MapEvent(agent, "correction held back", f"map {map_id} locates it to {100 * m:.0f} cm only")
            for agent, m in applied.waiting_sigma_m.items()
            if (agent, map_id) not in self._reported_waits
        ]
        self._reported_waits |= {(agent, map_id) for agent in applied.waiting_sigma_m}
        return sent + waiting

    def _record_loops(self, outcome: LoopDecision | AppliedSolution) -> None:
        """The loops that are believed since, and those that are no longer, are to be kept so."""
        self._changes += [RemoveLoops(loop.a, loop.b) for loop in outcome.dropped]
        self._changes += [SaveLoop(loop) for loop in outcome.added]

    def _cull_keyframes(self) -> None:
        """Two keyframes go while one comes: all at once would hold the others up."""
        max_keyframes = self._config.edge.max_keyframes
        if not self._to_remove and len(self._atlas) > max(max_keyframes * _CULL_MARGIN, self._cull_threshold):
            self._to_remove = self._atlas.choose_redundant(len(self._atlas) - max_keyframes)
            # Where nothing may go, it is not asked each time.
            self._cull_threshold = 0.0 if self._to_remove else len(self._atlas) * _CULL_MARGIN
        if not self._to_remove:
            return
        self._index_restored()
        removed = self._atlas.remove_keyframes(self._to_remove[:_REMOVED_PER_KEYFRAME])
        del self._to_remove[:_REMOVED_PER_KEYFRAME]
        for keyframe in removed:
            self._index.remove(keyframe.node_id)
            del self._camera_views[keyframe.node_id]
        self._counts["removed_keyframes"] += len(removed)
        self._changes += removal_changes(removed)
        empty_runs = {
            keyframe.key.agent for keyframe in removed if self._atlas.is_run_gone(keyframe.key.agent)
        }
        self._empty_runs += [
            KeyframeKey(agent, self._counters[agent].newest_id) for agent in sorted(empty_runs)
        ]

    # ------------------------------------------------------------------ report

    def report(self) -> dict[str, Any]:
        """edge.json's fields of the whole, and under `agents` those of each run."""
        all_counters = [*self._counters.values(), self._removed_runs_counters]
        merges = _merge_counts(sum((counters.merges for counters in all_counters), Counter()))
        return {
            "agents": {agent: self._run_report(agent) for agent in self._counters},
            "loops": {
                "tried": sum(counters.loops_tried for counters in all_counters),
                "accepted": merges["done"],
                "waiting": len(self._atlas.pending),
                "in_map": len(self._atlas.loops),
            },
            "merges": merges,
            "maps": self._atlas.map_sizes(),
            "removed_keyframes": self._counts["removed_keyframes"],
            "waiting": len(self._queries),
            "failed_steps": self._counts["failed_steps"],
            **{
                f"{k}_ms": {**summary(list(ms)).report(), "n": self._counts[k]}
                for k, ms in self._step_ms.items()
            },
        }

    def _run_report(self, agent: str) -> dict[str, Any]:
        counters = self._counters[agent]
        return {
            "loops": {"tried": counters.loops_tried, "accepted": counters.merges["done"]},
            "merges": _merge_counts(counters.merges),
            "queries_skipped": self._queries.skipped[agent],
            "map_id": self._atlas.current_map_id(agent),
            "consistency": asdict(self._atlas.standing(agent)),
        }


def _merge_counts(merges: Counter[str]) -> dict[str, int]:
    return {outcome: merges[outcome] for outcome in ("requested", "skipped", "done")}
