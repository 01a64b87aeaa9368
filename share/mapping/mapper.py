"""The mapper: keyframes in, corrections out.

A keyframe's way (`Mapper._look_up`): describe its image -> align it with the images near it in its map ->
query -> review recent merges -> for each candidate verify -> merge gate -> agreement of the agents -> loop
acceptance. A map that has changed (`Mapper._solve_map`): optimise ->
localisation gate -> publish corrections. Both are jobs that yield their slow steps, frozen values that the
caller runs, one of each job at a time. Changes that arrive while a map is being solved are solved together
afterwards.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any, cast

from share.config import Config
from share.errors import describe_exception
from share.mapping.agents.quarantine import QuarantineChange
from share.mapping.atlas import Atlas
from share.mapping.corrections import CorrectionPublisher, MapEvent, map_assignment
from share.mapping.forgetting import Retention, forgetting_changes
from share.mapping.keyframe_removal import RemovedKeyframe
from share.mapping.loop_acceptance import LoopDecision
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import MapChange, RemoveLoops, SaveLoop, SavePoses, SaveView, StoredMap
from share.mapping.map_solving import AppliedSolution
from share.mapping.mapper_counters import MapperCounters
from share.mapping.mapper_report import mapper_report
from share.mapping.query_queue import (
    CandidateSearch,
    QueryQueue,
    map_rank,
    rank_candidates,
    restored_ranks,
    service_kind,
)
from share.mapping.recognition.keyframe_views import IndexEntry, KeyframeArchive, KeyframeViews
from share.mapping.recognition.nearby import nearby_candidates
from share.mapping.recognition.verification import Refusal, Verification
from share.mapping.steps import (
    AlignStep,
    DescribeStep,
    IndexStep,
    Job,
    LookupStep,
    QueryStep,
    SolveStep,
    Step,
    StepRunner,
    VerifyStep,
)
from share.scheduling.merge_gate import MergeGate
from share.types import Keyframe, View
from share.wire.messages import Hello

_RECHECK_INTERVAL = 4  # every fourth keyframe is compared by its looks too where the map seems right
_RETRY_INTERVAL = 4  # nodes of every fourth id are compared with those of agents that are kept apart too


class Mapper:
    """The maps of all agents. `agent` always names one run of an agent."""

    def __init__(self, config: Config, archive: KeyframeArchive | None = None) -> None:
        """archive: images and views of the keyframes, where a map file keeps them."""
        self._config = config
        self._hellos: dict[str, Hello] = {}
        self._views = KeyframeViews(archive)
        self.atlas = Atlas(config.merge, self._views.by_node)
        self._queries = QueryQueue(config.edge)
        self._merge_gate = MergeGate(config.control, config.edge.policy)
        self._publisher = CorrectionPublisher()
        self._lookup, self._solve = StepRunner(), StepRunner()
        self._changes: list[MapChange] = []
        self._empty_runs: list[KeyframeKey] = []
        self._failures: list[MapEvent] = []
        self._counters = MapperCounters()
        self._retention = Retention(config.edge.keep_days)

    # Runs

    def add_run(self, agent: str, hello: Hello, credential: str | None = "") -> None:
        """Register a run of an agent, before its first keyframe. credential: see `SaveRun`."""
        self._hellos[agent] = hello
        self._counters.add_run(agent)
        self.atlas.add_run(agent, hello.name, credential)

    def set_credential(self, agent: str, credential: str) -> None:
        """Replace the credential of a run: see `SaveCredential`."""
        self.atlas.add_run(agent, self.agent_name(agent), credential)

    def agent_name(self, agent: str) -> str:
        return self._hellos[agent].name if agent in self._hellos else agent

    def set_present(self, agent: str, is_present: bool) -> None:
        self.atlas.set_present(agent, is_present)
        if self.atlas.is_run_gone(agent) and self._counters.runs[agent].newest_id >= 0:
            self._note_empty(agent)  # its keyframes expired while it was connected

    def remove_run(self, agent: str) -> None:
        """Forget a run without keyframes that will not return."""
        self.atlas.remove_run(agent)
        self._queries.remove_agent(agent)
        self._publisher.remove_agent(agent)
        del self._hellos[agent]
        self._counters.remove_run(agent)

    # Keyframes

    def add_keyframe(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[MapEvent]:
        """Add a keyframe; each once, in order. is_extra: looked up only when nothing else waits."""
        self._counters.runs[agent].newest_id = keyframe.id
        keyframe, link = self.atlas.reconnect(agent, keyframe)
        self._changes += [] if link is None else [link]
        hello = self._hellos[agent]
        node_id = self.atlas.add_keyframe(agent, keyframe, map_rank(self._config, hello))
        self._views.add(node_id, self.atlas.key(node_id), keyframe, hello.rig)
        self._retention.add(node_id)
        self._queries.add(agent, service_kind(self._config, hello), node_id, is_extra)
        events = []
        if keyframe.reference < 0 or (link is not None and link.reference < 0):
            T_map_odom, map_id = self.atlas.graph.place(node_id)
            events = [map_assignment(agent, map_id, T_map_odom, keyframe.id)]
        if redundant := self.atlas.culling.next_nodes(self._config.edge.max_keyframes):
            self.remove_keyframes(redundant)
        return events

    def remove_keyframes(self, node_ids: Sequence[int]) -> None:
        """Remove redundant keyframes, except those that have to stay."""
        removed = self.atlas.remove_keyframes(node_ids)
        self._changes += [change for keyframe in removed for change in keyframe.changes]
        self._finish_removal(removed)

    def expire(self, now_s: float) -> list[MapEvent]:
        """Forget keyframes that came more than `edge.keep_days` before now_s (unix s), whatever depends on
        them."""
        if not (expired := self._retention.expired(now_s)):
            return []
        removed = self.atlas.forget_keyframes(expired)
        self._changes += forgetting_changes(removed)
        self._finish_removal(removed)
        counts = f"{len(removed)} keyframes forgotten, {len(self.atlas)} stay"
        return [MapEvent(None, "expired", f"{counts}: older than {self._config.edge.keep_days:g} days")]

    def _finish_removal(self, removed: Sequence[RemovedKeyframe]) -> None:
        for keyframe in removed:
            self._views.remove(keyframe.node_id)
            self._retention.remove(keyframe.node_id)
        self._counters.removed_keyframes += len(removed)
        for agent in sorted({keyframe.key.agent for keyframe in removed}):
            if self.atlas.is_run_gone(agent):
                self._note_empty(agent)

    def _note_empty(self, agent: str) -> None:
        self._empty_runs.append(KeyframeKey(agent, self._counters.runs[agent].newest_id))

    def restore(self, kept: StoredMap) -> None:
        """Restore the map of an earlier session, before anything else is added.

        Restored maps keep their reference segments, also before headsets that come now. Their views are
        indexed beside look-ups.
        """
        for run in kept.runs:
            self.add_run(run.run_key, run.hello, run.credential)
            self.set_present(run.run_key, False)
        node_ids = self.atlas.restore(kept, restored_ranks(self._config, kept))
        restored = list(zip(node_ids, kept.keyframes, strict=True))
        self._views.restore(
            [(n, one.keyframe_key, one.keyframe, self._hellos[one.run_key].rig) for n, one in restored]
        )
        for node_id, stored in restored:
            self._retention.add(node_id, stored.came_s)
            self._counters.runs[stored.run_key].newest_id = stored.keyframe.id

    # Steps: what to do next, and what follows from the result

    def next_lookup(self) -> LookupStep | None:
        """Next step of looking up a keyframe; None if there is none or one is running."""
        if self._lookup.is_running:
            return None
        while (step := self._lookup.next_step()) is None:
            if (job := self._next_job()) is None:
                return None
            self._lookup.start(job)
        return cast(LookupStep, step)

    def _next_job(self) -> Job | None:
        """Next keyframe to look up, or to describe for later queries."""
        while (node_id := self._next_query()) is not None:
            if node_id in self._views.by_node:
                return self._look_up(node_id)
        if entries := self._views.next_restored():
            return self._index(entries)
        node_id = self._views.next_undescribed()
        return None if node_id is None else self._describe(node_id)

    def _next_query(self) -> int | None:
        node_id = self._queries.next_query()
        if node_id is None and len(self.atlas.map_sizes()) > 1:
            node_id = self._queries.next_skipped()  # too late for an answer, but it may merge maps
        return node_id

    def next_solve(self) -> SolveStep | None:
        """Next map to solve; None if there is none or one is running."""
        for map_id in [] if self._solve.is_running else self.atlas.solving.due_maps():
            self._solve.start(self._solve_map(map_id))
            try:
                return cast(SolveStep, self._solve.next_step())
            except Exception as error:  # only this map stays unsolved
                self._failures += self.report_failure(SolveStep.kind, error, map_id=map_id)
        return None

    def finish_step(self, step: Step, result: Any, ms: float) -> list[MapEvent]:
        """Apply a step's result. An exception as the result fails that step only."""
        self._counters.add_step(step.kind, ms)
        try:
            return (self._solve if isinstance(step, SolveStep) else self._lookup).finish(result)
        except Exception as error:
            if isinstance(step, SolveStep):
                return self.report_failure(step.kind, error, map_id=step.job.map_id)
            agent = self.atlas.key(step.node_id).agent if step.node_id in self._views.by_node else None
            return self.report_failure(step.kind, error, agent)

    def report_failure(
        self, what: str, error: Exception, agent: str | None = None, map_id: str | None = None
    ) -> list[MapEvent]:
        """Count and report an error; the map goes on without the step. agent, map_id: concerned, if any."""
        self._counters.failed_steps += 1
        where = "" if map_id is None else f"map {map_id}: "
        reason = f"{where}{what}: {describe_exception(error)}"
        return [MapEvent(agent, "step failed", reason, map_id=map_id)]

    def take_failures(self) -> list[MapEvent]:
        """Return the failures since the last call that no other method has returned."""
        failures, self._failures = self._failures, []
        return failures

    # A keyframe's way through the map

    def _look_up(self, node_id: int) -> Job:
        """Find loops of a keyframe: with keyframes near it in its map, then with those that look alike."""
        if entries := self._views.next_restored():
            yield from self._index(entries)
        yield from self._describe(node_id)
        is_aligned = yield from self._align_nearby(node_id)
        if is_aligned and len(self.atlas.map_sizes()) == 1 and node_id % _RECHECK_INTERVAL:
            return  # the map is right here, and there is no other to find
        yield from self._query(node_id)

    def _index(self, entries: Sequence[IndexEntry]) -> Job:
        """Index restored keyframes."""
        self._views.index_words((yield IndexStep(entries[0].node_id, self._views.index, entries)))
        yield []

    def _describe(self, node_id: int) -> Job:
        """Find the ORB features of a keyframe that came as an image only."""
        if (image := self._views.undescribed_image(node_id)) is None:
            return
        try:
            view = yield DescribeStep(node_id, image)
        except Exception:
            self._views.describe(node_id, View.empty())  # else it would be tried for ever
            raise
        if (packed := self._views.describe(node_id, view)) is not None and len(packed):
            self._changes.append(SaveView(self.atlas.key(node_id), packed))
        yield []

    def _align_nearby(self, node_id: int) -> Generator[Any, Any, bool]:
        """Align the images of keyframes near this one by the map's poses. Return whether one did."""
        views, is_aligned = self._views, False
        if views.image(node_id) is None:
            return False
        agent = self.atlas.key(node_id).agent
        for candidate in nearby_candidates(self.atlas.graph, node_id, views.with_image())[
            : 1 if self._queries.is_hurried else None
        ]:
            images = views.image(node_id), views.image(candidate)
            if images[0] is None or images[1] is None:
                continue  # removed meanwhile
            T_c_q = self.atlas.graph.relative_pose(candidate, node_id)
            try:
                outcome = yield AlignStep(node_id, images[0], candidate, images[1], T_c_q)
                is_kept = {node_id, candidate} <= views.by_node.keys()
                events = self._judge_candidate(None, node_id, candidate, outcome) if is_kept else []
                is_aligned |= isinstance(outcome, Verification)
            except Exception as error:  # costs this candidate only
                events = self.report_failure(AlignStep.kind, error, agent)
            yield events
        return is_aligned

    def _query(self, node_id: int) -> Job:
        """Query with a keyframe and verify the candidates; each verified loop is gated, checked and added."""
        views, place = self._views.by_node, self._config.place
        if node_id not in views:
            return  # removed meanwhile
        agent = self.atlas.key(node_id).agent
        excluded = self.atlas.graph.odometry.neighbours(node_id)
        if node_id % _RETRY_INTERVAL:  # agents kept apart are compared now and then: they may agree by now
            excluded += self.atlas.quarantine.quarantined_nodes(agent)
        found = yield QueryStep(self._views.index, node_id, views[node_id], place.candidates, excluded)
        candidates = [candidate.id for candidate in found]
        if self._queries.is_hurried:
            known = [n for n in candidates if n in views]
            candidates = rank_candidates(self.atlas.graph, node_id, known)
        yield self._review_joins(node_id)
        search = CandidateSearch(candidates)
        while (candidate := search.next_candidate(self._queries.is_hurried)) is not None:
            if not {node_id, candidate} <= views.keys():
                continue  # removed meanwhile
            try:
                images = self._views.image(node_id), self._views.image(candidate)
                outcome = yield VerifyStep(node_id, views[node_id], candidate, views[candidate], *images)
                is_kept = {node_id, candidate} <= views.keys()
                events = self._judge_candidate(search, node_id, candidate, outcome) if is_kept else []
            except Exception as error:  # costs this candidate only
                events = self.report_failure(VerifyStep.kind, error, agent)
            yield events

    def _judge_candidate(
        self, search: CandidateSearch | None, node_id: int, candidate: int, outcome: Verification | Refusal
    ) -> list[MapEvent]:
        """Decide on a verified candidate: count, gate, compare the agents, check the loop and add it."""
        atlas, a, b = self.atlas, self.atlas.key(candidate), self.atlas.key(node_id)
        counters = self._counters.runs[b.agent]
        counters.loops_tried += 1
        if isinstance(outcome, Refusal):
            return [MapEvent(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        if search is not None and not atlas.quarantine.agreement.are_separated(a.agent, b.agent):
            search.count_verified()
        loop = Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers)
        counters.merges["requested"] += 1
        volume = self._merge_gate.overlap_volume(
            self._hellos[a.agent].rig, self._hellos[b.agent].rig, loop.T_a_b
        )
        if objection := self._merge_gate.skip_reason(volume, atlas.map_id(a) == atlas.map_id(b)):
            counters.merges["skipped"] += 1
            return [MapEvent(b.agent, "merge skipped", f"loop {loop}: {objection}")]
        change = atlas.quarantine.add_loop(loop, outcome.depth_scale)
        self._record_loops(change)
        events = [MapEvent(agent, *standing.event) for agent, standing in change.standings.items()]
        decision = atlas.propose(atlas.quarantine.rescale_loop(loop, outcome.depth_scale))
        self._record_loops(decision)
        reason = f"{decision.reason} ({outcome.reason})"
        if not decision.accepted:
            return [*events, MapEvent(b.agent, "loop not accepted", reason)]
        counters.merges["done"] += 1
        self._merge_gate.record_merge(volume)
        undone = [MapEvent(b.agent, "merge undone", reason)] if decision.dropped else []
        accepted = MapEvent(b.agent, "maps merged" if decision.joined_maps else "loop accepted", reason)
        return [*events, *undone, accepted]

    def _review_joins(self, node_id: int) -> list[MapEvent]:
        """Undo a recent merge that the view of a new keyframe contradicts."""
        known = node_id in self._views.by_node
        decision = self.atlas.loop_acceptance.review_joins(node_id) if known else None
        if decision is None:
            return []
        self._record_loops(decision)
        return [MapEvent(self.atlas.key(node_id).agent, "merge undone", decision.reason)]

    def _solve_map(self, map_id: str) -> Job:
        """Optimise a map and publish the corrections that follow."""
        job = self.atlas.solving.make_job(map_id)
        try:
            solution = yield SolveStep(job)
        except Exception:
            self.reset_solver()
            raise
        applied = self.atlas.solving.apply(job, solution)
        self._record_loops(applied)
        yield self._publisher.publish(map_id, applied)

    def reset_solver(self) -> None:
        """The solver process lost its state: its next job contains the whole graph."""
        self.atlas.graph.edges.reset()

    # Results

    def _record_loops(self, outcome: LoopDecision | AppliedSolution | QuarantineChange) -> None:
        self._changes += [RemoveLoops(loop.a, loop.b) for loop in outcome.dropped]
        self._changes += [SaveLoop(loop) for loop in outcome.added]

    def take_changes(self) -> tuple[MapChange, ...]:
        """Return the changes to store since the last call."""
        changes, self._changes = tuple(self._changes), []
        return changes

    def take_empty_runs(self) -> tuple[KeyframeKey, ...]:
        """Return the runs without keyframes since the last call, each with its newest keyframe."""
        empty_runs, self._empty_runs = tuple(self._empty_runs), []
        return empty_runs

    def current_poses(self) -> SavePoses:
        return self.atlas.all_poses()

    def report(self) -> dict[str, Any]:
        """Return the mapper's fields of edge.json, and under `agents` those of each run."""
        return mapper_report(self.atlas, self._queries, self._counters)
