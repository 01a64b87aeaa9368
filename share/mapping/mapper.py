"""The mapper: keyframes in, corrections out. Query -> verify -> accept loop -> solve -> correct.

The mapper decides what comes next; each slow step is a frozen value that the caller runs. Look-ups and
solving run side by side, one step of each at a time. Changes that arrive while a map is being solved are
solved together afterwards.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from share.config import Config
from share.errors import describe_exception
from share.mapping.agents.quarantine import QuarantineChange
from share.mapping.atlas import Atlas
from share.mapping.corrections import CorrectionFilter
from share.mapping.graph.updates import GraphSolution
from share.mapping.loop_acceptance import LoopDecision
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import MapChange, RemoveLoops, SaveLoop, SavePoses, StoredKeyframe, StoredMap
from share.mapping.map_news import removal_changes, restored_keyframe, stored_link
from share.mapping.map_solving import AppliedSolution
from share.mapping.mapper_counters import MapperCounters
from share.mapping.query_queue import CandidateSearch, QueryQueue, SearchBudget, qoe_form, service_kind
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.verification import CameraView, Refusal, Verification
from share.mapping.steps import LookupStep, MapEvent, QueryStep, SolveStep, Step, VerifyStep, map_assignment
from share.scheduling.merge_gate import MergeGate
from share.types import AgentKind, Keyframe
from share.wire.messages import Hello

_CULL_MARGIN = 1.05  # share of `max_keyframes` at which keyframes to remove are chosen
_REMOVED_PER_KEYFRAME = 2
_RETRY_INTERVAL = 4  # every fourth look-up includes keyframes of agents that are kept apart
_QUARANTINE_EVENTS = {"set apart": "agent quarantined", "disputed": "agents disputed"}  # by their state


class Mapper:
    """The maps of all agents. `agent` always names one run of an agent."""

    def __init__(self, config: Config) -> None:
        place = config.place
        self._config = config
        self._index = PlaceIndex(place.index_seed, place.tables, place.hash_bits)
        self._hellos: dict[str, Hello] = {}
        self._camera_views: dict[int, CameraView] = {}  # by node id
        self._atlas = Atlas(config.merge, self._camera_views)
        self._unindexed: list[tuple[int, StoredKeyframe]] = []  # restored keyframes
        self._queries = QueryQueue(config.edge)
        self._merge_gate = MergeGate(config.control, config.edge.policy)
        self._correction_filter = CorrectionFilter()
        self._reported_waits: set[tuple[str, str]] = set()  # (run, map) of corrections reported as held back
        self._search_budget = SearchBudget.from_config(config)
        self._search: CandidateSearch | None = None
        self._is_looking_up = self._is_solving = False
        self._to_remove: list[int] = []  # nodes
        self._cull_threshold = 0.0  # number of keyframes at which removable ones are chosen again
        self._changes: list[MapChange] = []
        self._counters = MapperCounters()
        self._empty_runs: list[KeyframeKey] = []

    def add_run(self, agent: str, hello: Hello, credential: str | None = "") -> None:
        """Register a run of an agent, before its first keyframe. credential: see `SaveRun`."""
        self._hellos[agent] = hello
        self._counters.add_run(agent)
        self._atlas.add_run(agent, hello.name, credential)

    def set_credential(self, agent: str, credential: str) -> None:
        """Replace the credential of a run: see `SaveCredential`."""
        self._atlas.add_run(agent, self.agent_name(agent), credential)

    def agent_name(self, agent: str) -> str:
        """Name of the agent whose run it is."""
        return self._hellos[agent].name if agent in self._hellos else agent

    def set_present(self, agent: str, is_present: bool) -> None:
        """Set whether the run's agent is connected."""
        self._atlas.set_present(agent, is_present)

    def remove_run(self, agent: str) -> None:
        """Forget a run without keyframes that will not return."""
        self._atlas.remove_run(agent)
        self._queries.remove_agent(agent)
        self._correction_filter.remove_agent(agent)
        self._reported_waits = {(run, map_id) for run, map_id in self._reported_waits if run != agent}
        del self._hellos[agent]
        self._counters.remove_run(agent)

    def add_keyframe(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[MapEvent]:
        """Add a keyframe; each once, in order. is_extra: looked up only when nothing else waits."""
        self._counters.runs[agent].newest_id = keyframe.id
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
        """Restore the map of an earlier session, before anything else is added.

        Restored maps keep their reference segments, also before headsets that come now. Their views are
        indexed at the first look-up.
        """
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
            counters = self._counters.runs.get(stored.run_key)  # None: missing in a damaged file
            if counters is not None:
                counters.newest_id = max(counters.newest_id, stored.keyframe.id)

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
        """Rank of a new segment: lower ranks keep their map in a merge.

        Headsets' maps stay, as their wearers would notice a jump; restored maps come first.
        """
        hello = self._hellos.get(agent)  # None: missing in a damaged file
        is_headset = hello is not None and qoe_form(self._config, hello) is AgentKind.AR
        return (0 if is_headset else 1) + (0 if is_reference else 2)

    def _new_map_event(self, agent: str, keyframe: Keyframe) -> MapEvent:
        T, map_id = self._atlas.T_map_odom(agent), self._atlas.current_map_id(agent)
        assert T is not None and map_id is not None
        return map_assignment(agent, map_id, T, keyframe.id)

    # Steps: what to do next, and what follows from the result

    def next_lookup(self) -> LookupStep | None:
        """Next step of looking up a keyframe; None if there is none or one is running."""
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
        """Next keyframe to look up. Skipped ones, too late for an answer, only serve to merge maps."""
        node_id = self._queries.next_query()
        return (
            self._queries.next_skipped() if node_id is None and len(self._atlas.map_sizes()) > 1 else node_id
        )

    def next_solve(self) -> SolveStep | None:
        """Next map to solve; None if there is none or one is running."""
        for map_id in [] if self._is_solving else self._atlas.due_maps():
            try:
                job = self._atlas.make_job(map_id)
            except Exception:  # only this map stays unsolved
                self._counters.failed_steps += 1
                continue
            self._is_solving = True
            return SolveStep(job)
        return None

    def finish_step(self, step: Step, result: Any, ms: float) -> list[MapEvent]:
        """Apply a step's result. An exception as the result fails that step only."""
        self._counters.add_step(step.kind, ms)
        if isinstance(step, SolveStep):
            self._is_solving = False
        else:
            self._is_looking_up = False
        try:
            return self._handle_result(step, result)
        except Exception as error:
            return self._step_failed(step, error)

    def _handle_result(self, step: Step, result: Any) -> list[MapEvent]:
        """Apply the result, or raise it if it is an exception."""
        match step:
            case QueryStep() if isinstance(result, list):
                self._begin_search(step.node_id, [c.id for c in result])
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
        """Count and report an error; the map goes on without the step. agent: the run concerned."""
        self._counters.failed_steps += 1
        agent = next(iter(self._hellos), None) if agent is None else agent
        return (
            [] if agent is None else [MapEvent(agent, "step failed", f"{what}: {describe_exception(error)}")]
        )

    def reset_solver(self) -> None:
        """The solver process lost its state."""
        self._atlas.reset_solver()

    @property
    def removed_count(self) -> int:
        """Keyframes removed since the start."""
        return self._counters.removed_keyframes

    def take_changes(self) -> tuple[MapChange, ...]:
        """Return the changes to store since the last call."""
        changes, self._changes = tuple(self._changes), []
        return changes

    def take_empty_runs(self) -> tuple[KeyframeKey, ...]:
        """Return the runs without keyframes since the last call, each with its newest keyframe."""
        empty_runs, self._empty_runs = tuple(self._empty_runs), []
        return empty_runs

    def current_poses(self) -> SavePoses:
        """Return the current poses of all keyframes."""
        keys, T_map_body, maps = self._atlas.all_poses()
        return SavePoses(keys, T_map_body, maps)

    # Place queries and verification

    def _make_query(self, node_id: int) -> QueryStep:
        excluded = self._atlas.neighbours(node_id)
        if node_id % _RETRY_INTERVAL:  # agents kept apart are compared now and then: they may agree by now
            excluded += self._atlas.separated_keyframes(node_id)
        return QueryStep(
            self._index, node_id, self._camera_views[node_id], self._config.place.candidates, excluded
        )

    def _begin_search(self, node_id: int, candidates: list[int]) -> None:
        if self._queries.is_hurried:
            known = [n for n in candidates if n in self._camera_views]
            candidates = self._atlas.rank_candidates(node_id, known)
        self._search = CandidateSearch(node_id, candidates, self._search_budget)

    def _next_verify(self) -> VerifyStep | None:
        """Next candidate of the current search whose keyframe still exists."""
        search, views = self._search, self._camera_views
        while search and (candidate := search.next_candidate(self._queries.is_hurried)) is not None:
            if {search.node_id, candidate} <= views.keys():
                query_view, candidate_view = views[search.node_id], views[candidate]
                return VerifyStep(search.node_id, query_view, candidate, candidate_view, self._config.place)
        self._search = None
        return None

    def _handle_verification(self, step: VerifyStep, outcome: Verification | Refusal) -> list[MapEvent]:
        if not {step.node_id, step.candidate_id} <= self._camera_views.keys():
            return []  # removed meanwhile
        a, b = self._atlas.key(step.candidate_id), self._atlas.key(step.node_id)
        counters = self._counters.runs[b.agent]
        counters.loops_tried += 1
        if isinstance(outcome, Refusal):
            return [MapEvent(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        if self._search is not None and not self._atlas.are_separated(a.agent, b.agent):
            self._search.count_verified()
        loop = Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers)
        counters.merges["requested"] += 1
        volume = self._merge_gate.overlap_volume(
            self._hellos[a.agent].rig, self._hellos[b.agent].rig, loop.T_a_b
        )
        if objection := self._merge_gate.skip_reason(volume, self._atlas.map_id(a) == self._atlas.map_id(b)):
            counters.merges["skipped"] += 1
            return [MapEvent(b.agent, "merge skipped", f"loop {loop}: {objection}")]
        change = self._atlas.compare_agents(loop, outcome.depth_scale)
        events = self._quarantine_events(change)
        decision = self._atlas.propose(self._atlas.rescale_loop(loop, outcome.depth_scale))
        reason = f"{decision.reason} ({outcome.reason})"
        self._record_loops(decision)
        if not decision.accepted:
            return [*events, MapEvent(b.agent, "loop not accepted", reason)]
        counters.merges["done"] += 1
        self._merge_gate.record_merge(volume)
        undone_events = [MapEvent(b.agent, "merge undone", reason)] if decision.dropped else []
        accepted = MapEvent(b.agent, "maps merged" if decision.joined_maps else "loop accepted", reason)
        return [*events, *undone_events, accepted]

    def _quarantine_events(self, change: QuarantineChange) -> list[MapEvent]:
        """Events for agents whose standing changed; records the loops removed or added by it."""
        removals = (RemoveLoops(loop.a, loop.b) for loop in change.dropped)
        self._changes += [*removals, *map(SaveLoop, change.added)]
        return [
            MapEvent(agent, _QUARANTINE_EVENTS[standing.state], standing.reason)
            if standing.state in _QUARANTINE_EVENTS
            else MapEvent(agent, "quarantine lifted", "consistent with the others again")
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
            MapEvent(
                agent,
                "correction held back",
                f"its position in map {map_id} is known to {100 * sigma_m:.0f} cm",
            )
            for agent, sigma_m in applied.waiting_sigma_m.items()
            if (agent, map_id) not in self._reported_waits
        ]
        self._reported_waits |= {(agent, map_id) for agent in applied.waiting_sigma_m}
        return sent + waiting

    # Bookkeeping

    def _record_loops(self, outcome: LoopDecision | AppliedSolution) -> None:
        """Record accepted and removed loops as changes to store."""
        self._changes += [RemoveLoops(loop.a, loop.b) for loop in outcome.dropped]
        self._changes += [SaveLoop(loop) for loop in outcome.added]

    def _cull_keyframes(self) -> None:
        """Remove two keyframes for each that arrives: all at once would delay the others."""
        max_keyframes = self._config.edge.max_keyframes
        if not self._to_remove and len(self._atlas) > max(max_keyframes * _CULL_MARGIN, self._cull_threshold):
            self._to_remove = self._atlas.choose_redundant(len(self._atlas) - max_keyframes)
            # Where no keyframe is removable, do not search for one each time.
            self._cull_threshold = 0.0 if self._to_remove else len(self._atlas) * _CULL_MARGIN
        if not self._to_remove:
            return
        self._index_restored()
        removed = self._atlas.remove_keyframes(self._to_remove[:_REMOVED_PER_KEYFRAME])
        del self._to_remove[:_REMOVED_PER_KEYFRAME]
        for keyframe in removed:
            self._index.remove(keyframe.node_id)
            del self._camera_views[keyframe.node_id]
        self._counters.removed_keyframes += len(removed)
        self._changes += removal_changes(removed)
        empty_runs = {
            keyframe.key.agent for keyframe in removed if self._atlas.is_run_gone(keyframe.key.agent)
        }
        self._empty_runs += [
            KeyframeKey(agent, self._counters.runs[agent].newest_id) for agent in sorted(empty_runs)
        ]

    def report(self) -> dict[str, Any]:
        """Return the mapper's fields of edge.json, and under `agents` those of each run."""
        counters, merges = self._counters, self._counters.merges
        return {
            "agents": {agent: self._run_report(agent) for agent in counters.runs},
            "loops": {
                "tried": counters.loops_tried,
                "accepted": merges["done"],
                "waiting": len(self._atlas.pending),
                "in_map": len(self._atlas.loops),
            },
            "merges": merges,
            "maps": self._atlas.map_sizes(),
            "removed_keyframes": counters.removed_keyframes,
            "waiting": len(self._queries),
            "failed_steps": counters.failed_steps,
            **counters.step_report(),
        }

    def _run_report(self, agent: str) -> dict[str, Any]:
        return {
            **self._counters.runs[agent].report(),
            "queries_skipped": self._queries.skipped[agent],
            "map_id": self._atlas.current_map_id(agent),
            "consistency": asdict(self._atlas.standing(agent)),
        }
