"""A keyframe's way through the map: the jobs that find its loops.

Align its image with those near it in its map -> describe it -> query -> review recent merges -> align or
verify each candidate -> agreement of the agents -> loop acceptance. Within a map the merge gate
stands before these checks. Jobs yield their slow steps, which the caller runs (`share.mapping.steps`).
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from typing import Any

from share.config import Config
from share.mapping.atlas import Atlas
from share.mapping.candidates import CandidateSearch, choose_checks, larger_maps_first, nearby_candidates
from share.mapping.corrections import MapEvent, MapsJoined
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import SaveView
from share.mapping.mapper_log import MapperLog
from share.mapping.places import PlaceNewsLog
from share.mapping.query_queue import QueryQueue
from share.mapping.recognition.keyframe_views import IndexEntry, KeyframeViews
from share.mapping.recognition.verification import Refusal, Verification
from share.mapping.revisits import Revisits
from share.mapping.steps import AlignStep, DescribeStep, IndexStep, Job, QueryStep, VerifyStep
from share.scheduling.merge_gate import MergeGate
from share.types import F64, View
from share.wire.messages import Hello

_RECHECK_INTERVAL = 4  # every fourth keyframe is compared by its looks too where the map seems right
_RETRY_INTERVAL = 4  # nodes of every fourth id are compared with those of agents that are kept apart too


class KeyframeLookup:
    """Finds the loops of keyframes and adds them to the maps of `atlas`. hellos: by run."""

    def __init__(
        self,
        config: Config,
        atlas: Atlas,
        views: KeyframeViews,
        queries: QueryQueue,
        hellos: Mapping[str, Hello],
        log: MapperLog,
        news: PlaceNewsLog | None = None,
    ) -> None:
        self._config, self._atlas, self._views, self._queries = config, atlas, views, queries
        self._hellos, self._log, self._counters, self._news = hellos, log, log.counters, news
        self._merge_gate = MergeGate(config.control, config.edge.policy)
        self.revisits = Revisits(atlas.graph)
        self._is_revisit = False  # the keyframe that is looked up was before

    def look_up(self, node_id: int) -> Job:
        """Find loops of a keyframe: with keyframes near it in its map, then with those that look alike."""
        self._is_revisit = self.revisits.note_lookup(node_id)
        if entries := self._views.next_restored():
            yield from self.index(entries)
        is_placed = self._atlas.is_placed(node_id)
        is_aligned = is_placed and (yield from self._align_nearby(node_id))
        seeks_maps = len(self._atlas.graph.maps) > 1 and not self._queries.has_backlog
        if is_aligned and not seeks_maps and node_id % _RECHECK_INTERVAL:
            return  # the map is right here; the keyframe is described when nothing waits
        yield from self.describe(node_id)
        is_recognised = yield from self._query(node_id, is_aligned, is_placed)
        if self._news is not None and not (is_recognised or is_aligned):
            self._news.add_unrecognised(self._atlas.key(node_id))

    def index(self, entries: Sequence[IndexEntry]) -> Job:
        """Index restored keyframes."""
        self._views.index_words((yield IndexStep(entries[0].node_id, self._views.index, entries)))
        yield []

    def describe(self, node_id: int) -> Job:
        """Find the ORB features of a keyframe that came as an image, and review recent merges by them."""
        if (image := self._views.undescribed_image(node_id)) is None:
            return
        key = self._atlas.key(node_id)
        try:
            view = yield DescribeStep(node_id, image)
        except Exception:
            self._views.describe(node_id, View.empty())  # else it would be tried for ever
            raise
        if (packed := self._views.describe(node_id, view)) is not None and len(packed):
            self._log.changes.append(SaveView(key, packed))
        reason = f"keyframe {key.id}: its image is damaged: without it"
        damaged = [] if image.is_intact else [MapEvent(key.agent, "odometry suspect", reason)]
        yield [*damaged, *self._review_joins(node_id)]

    def _align_nearby(self, node_id: int) -> Generator[Any, Any, bool]:
        """Align the images of keyframes near this one by the map's poses. Return whether one did."""
        views, is_aligned = self._views, False
        if views.image(node_id) is None:
            return False
        for candidate in nearby_candidates(self._atlas.graph, node_id, views.with_image()):
            if is_aligned and self._queries.has_backlog:
                break
            if not {node_id, candidate} <= views.by_node.keys():
                continue  # removed meanwhile
            if not self._is_gated(node_id, candidate):
                is_aligned |= yield from self._check(self._align_step(node_id, candidate), None)
        return is_aligned

    def _query(self, node_id: int, is_aligned: bool, is_placed: bool) -> Generator[Any, Any, bool]:
        """Query with a keyframe and check the candidates. Return whether one of another agent's run, or of
        the map that its agent shares with others, is verified. is_aligned: see `choose_checks`.

        is_placed: the agent does not wait to enter another's map. While it waits, only loops with other
        agents localise it, and they must be found without the map's pose: images that are aligned from a
        wrong pose confirm it.
        """
        views, place = self._views.by_node, self._config.place
        if node_id not in views:
            return False  # removed meanwhile
        agent = self._atlas.key(node_id).agent
        excluded = self._not_compared(node_id, is_placed)
        if node_id % _RETRY_INTERVAL:  # agents kept apart are compared now and then: they may agree by now
            excluded += self._atlas.quarantine.quarantined_nodes(agent)
        found = yield QueryStep(self._views.index, node_id, views[node_id], place.candidates, excluded)
        if node_id not in views:
            yield []
            return False
        is_recheck = not is_placed or node_id % _RECHECK_INTERVAL == 0
        known = [candidate.id for candidate in found if candidate.id in views]
        by_map, by_appearance = choose_checks(
            self._atlas.graph, node_id, known, self._views.with_image(), is_aligned, is_recheck
        )
        if self._queries.has_backlog:
            by_appearance = larger_maps_first(self._atlas.graph, by_appearance)
        has_image = self._views.image(node_id) is not None
        yield [] if has_image else self._review_joins(node_id)  # with one, when it was described
        search, is_recognised = CandidateSearch([*by_map, *by_appearance]), False
        while (candidate := search.next_candidate(self._queries.has_backlog)) is not None:
            if not {node_id, candidate} <= views.keys():
                continue  # removed meanwhile
            is_same_map = self._atlas.graph.is_same_map(node_id, candidate)
            if not is_same_map or is_recheck or not self._is_gated(node_id, candidate):
                make_step = self._align_step if candidate in by_map else self._verify_step
                is_verified = yield from self._check(make_step(node_id, candidate), search)
                is_recognised |= is_verified and not self._is_own(node_id, candidate)
        return is_recognised

    def _is_own(self, node_id: int, candidate: int) -> bool:
        """Return whether another keyframe is of the same run and in a map that is named after it."""
        if candidate not in self._views.by_node:
            return False
        key = self._atlas.key(candidate)
        is_same_run = key.agent == self._atlas.key(node_id).agent
        return is_same_run and self._atlas.map_id(key).startswith(f"{key.agent}/")

    def _not_compared(self, node_id: int, is_placed: bool) -> tuple[int, ...]:
        """Return the keyframes that are not compared with this one: those near it on its segment. If its
        agent is not placed, its whole segment, and keyframes with which it has a loop, accepted or pending,
        from an earlier look-up: the same pair is no further evidence."""
        graph = self._atlas.graph
        if is_placed:
            return graph.odometry.neighbours(node_id)
        own = graph.odometry.segments[graph.odometry.nodes[node_id].segment].nodes
        key, edges = self._atlas.key(node_id), graph.edges
        loops = [edges.loops[n] for n in edges.incident(node_id) if n in edges.loops]
        loops += [loop for loop in self._atlas.loop_acceptance.pending if key in loop.keyframes]
        return (*own, *(n for loop in loops for n in graph.loop_nodes(loop)))

    def _is_gated(self, node_id: int, candidate: int) -> bool:
        """Return whether the merge gate leaves out this keyframe of the same map, by the map's poses."""
        a, b = self._atlas.key(candidate), self._atlas.key(node_id)
        T_a_b = self._atlas.graph.relative_pose(candidate, node_id)
        objection = self._merge_gate.skip_reason(self._overlap_volume(a, b, T_a_b), same_map=True)
        if objection:
            self._counters.count_merge(b.agent, "requested")
            self._counters.count_merge(b.agent, "skipped")
            self._log.events.append(MapEvent(b.agent, "merge skipped", f"loop {a} - {b}: {objection}"))
        return bool(objection)

    def _align_step(self, node_id: int, candidate: int) -> AlignStep:
        T_c_q = self._atlas.graph.relative_pose(candidate, node_id)
        images = self._views.image(node_id), self._views.image(candidate)
        assert images[0] is not None and images[1] is not None
        return AlignStep(node_id, images[0], candidate, images[1], T_c_q)

    def _overlap_volume(self, a: KeyframeKey, b: KeyframeKey, T_a_b: F64) -> float:
        rig_a, rig_b = (self._hellos[key.agent].rig for key in (a, b))
        return self._merge_gate.overlap_volume(rig_a, rig_b, T_a_b)

    def _verify_step(self, node_id: int, candidate: int) -> VerifyStep:
        views, images = self._views.by_node, (self._views.image(node_id), self._views.image(candidate))
        return VerifyStep(node_id, views[node_id], candidate, views[candidate], *images)

    def _check(
        self, step: AlignStep | VerifyStep, search: CandidateSearch | None
    ) -> Generator[Any, Any, bool]:
        """Run the step on a candidate and decide on what it finds. Return whether it is verified."""
        node_id, candidate, outcome = step.node_id, step.candidate_id, None
        agent = self._atlas.key(node_id).agent
        try:
            outcome = yield step
            is_kept = {node_id, candidate} <= self._views.by_node.keys()
            events = self._judge_candidate(search, node_id, candidate, outcome) if is_kept else []
        except Exception as error:  # costs this candidate only
            events = self._log.failure(step.kind, error, agent)
        yield events
        return isinstance(outcome, Verification)

    def _judge_candidate(
        self, search: CandidateSearch | None, node_id: int, candidate: int, outcome: Verification | Refusal
    ) -> list[MapEvent]:
        """Decide on a verified candidate: count, compare the agents, check the loop and add it."""
        atlas, a, b = self._atlas, self._atlas.key(candidate), self._atlas.key(node_id)
        self._counters.count_tried(b.agent)
        if isinstance(outcome, Refusal):
            return [MapEvent(b.agent, "loop refused", f"{a} - {b}: {outcome.reason}")]
        loop = Loop(a, b, outcome.T_c_q, outcome.cov, outcome.inliers, is_confirmed=outcome.is_confirmed)
        self._counters.count_merge(b.agent, "requested")
        change = atlas.quarantine.add_loop(loop, outcome.depth_scale)
        self._log.record_loops(change)
        events = [MapEvent(agent, *standing.event) for agent, standing in change.standings.items()]
        decision = atlas.propose(
            atlas.quarantine.rescale_loop(loop, outcome.depth_scale), is_answer=not self._is_revisit
        )
        self._log.record_loops(decision)
        if search is not None and (decision.accepted or atlas.graph.is_same_map(candidate, node_id)):
            search.count_verified()  # not a pending merge: it needs loops of several keyframes
        reason = f"{decision.reason} ({outcome.reason})"
        if not decision.accepted:
            return [*events, MapEvent(b.agent, "loop not accepted", reason)]
        self._counters.count_merge(b.agent, "done")
        self._merge_gate.record_merge(self._overlap_volume(a, b, loop.T_a_b))
        undone = [MapEvent(b.agent, "merge undone", reason)] if decision.dropped else []
        if decision.joined_maps is None or decision.T_join is None:
            return [*events, *undone, MapEvent(b.agent, "loop accepted", reason)]
        joined = MapsJoined(*decision.joined_maps, decision.T_join)
        return [*events, *undone, MapEvent(b.agent, "maps merged", reason, joined=joined)]

    def _review_joins(self, node_id: int) -> list[MapEvent]:
        """Undo a recent merge that the view of a new keyframe contradicts; else see what is gone since an
        earlier session."""
        if node_id not in self._views.by_node:
            return []
        decision = self._atlas.loop_acceptance.review_joins(node_id)
        if decision is None:
            self._atlas.renewal.review(node_id)
            return []
        self._log.record_loops(decision)
        return [MapEvent(self._atlas.key(node_id).agent, "merge undone", decision.reason)]
