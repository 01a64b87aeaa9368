"""The mapper: keyframes in, corrections out.

A keyframe: look up its loops (`share.mapping.keyframe_lookup`). A map that has changed (`Mapper._solve_map`):
optimise -> localisation gate -> publish corrections. Both are jobs that yield their slow steps, frozen values
that the caller runs, one of each job at a time. Changes that arrive while a map is being solved are solved
together afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from heapq import nlargest
from typing import Any, cast

from share.config import Config
from share.mapping.atlas import Atlas
from share.mapping.corrections import CorrectionPublisher, MapEvent, map_assignment
from share.mapping.forgetting import Retention, forgetting_changes
from share.mapping.keyframe_lookup import KeyframeLookup
from share.mapping.keyframe_removal import RemovedKeyframe
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MapChange, SavePoses, StoredMap
from share.mapping.mapper_log import MapperLog
from share.mapping.places import KeyframeSearch, PlaceNews, PlaceNewsLog
from share.mapping.query_queue import QueryQueue, service_kind
from share.mapping.recognition.keyframe_views import ArchiveReader, KeyframeViews
from share.mapping.segments import restored_ranks, segment_rank
from share.mapping.steps import Job, LookupStep, SolveStep, Step, StepRunner
from share.types import Keyframe
from share.wire.messages import Hello

_MAX_MAPS = 64  # in a report, beside those of the runs that it lists


class Mapper:
    """The maps of all agents. `agent` always names one run of an agent."""

    def __init__(
        self, config: Config, archive: ArchiveReader | None = None, news: PlaceNewsLog | None = None
    ) -> None:
        """archive: images and views of the keyframes, where a map file keeps them. news: for a directory of
        places, where there are other rooms."""
        self._config = config
        self._hellos: dict[str, Hello] = {}
        self._news = news
        self.views = KeyframeViews(archive, None if news is None else news.add)
        self.atlas = Atlas(config.merge, self.views.by_node)
        self.queries = QueryQueue(config.edge)
        self._publisher = CorrectionPublisher()
        self._log = MapperLog()
        self._counters = self._log.counters
        self._lookup = KeyframeLookup(
            config, self.atlas, self.views, self.queries, self._hellos, self._log, news
        )
        self.search = KeyframeSearch(self.atlas, self.views, config.place.candidates)
        self._lookup_job, self._solve_job = StepRunner(), StepRunner()
        self._empty_runs: list[KeyframeKey] = []
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
        self.queries.remove_agent(agent)
        self._publisher.remove_agent(agent)
        del self._hellos[agent]
        self._counters.remove_run(agent)

    # Keyframes

    def add_keyframe(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[MapEvent]:
        """Add a keyframe; each once, in order. is_extra: looked up only when nothing else waits."""
        self._counters.runs[agent].newest_id = keyframe.id
        keyframe, link = self.atlas.reconnect(agent, keyframe)
        self._log.changes += [] if link is None else [link]
        hello = self._hellos[agent]
        node_id = self.atlas.add_keyframe(agent, keyframe, segment_rank(self._config, hello))
        self.views.add(node_id, self.atlas.key(node_id), keyframe, hello.rig)
        self._retention.add(node_id)
        self.queries.add(agent, service_kind(self._config, hello), node_id, is_extra)
        events = []
        if keyframe.reference < 0 or (link is not None and link.reference < 0):
            map_id = self.atlas.map_id(self.atlas.key(node_id))
            events = [map_assignment(agent, map_id, self.atlas.graph.T_map_odom(node_id), keyframe.id)]
        if redundant := self.atlas.culling.next_nodes(self._config.edge.max_keyframes):
            self.remove_keyframes(redundant)
        if outdated := self.atlas.renewal.take_outdated():
            self.remove_keyframes(outdated)
            events.append(MapEvent(agent, "map renewed", f"{len(outdated)} keyframes show what is gone"))
        return events

    def remove_keyframes(self, node_ids: Sequence[int]) -> None:
        """Remove redundant keyframes, except those that have to stay."""
        removed = self.atlas.remove_keyframes(node_ids)
        self._log.changes += [change for keyframe in removed for change in keyframe.changes]
        self._finish_removal(removed)

    def expire(self, now_s: float) -> list[MapEvent]:
        """Forget keyframes that came more than `edge.keep_days` before now_s (unix s), whatever depends on
        them."""
        if not (expired := self._retention.expired(now_s)):
            return []
        removed = self.atlas.forget_keyframes(expired)
        self._log.changes += forgetting_changes(removed)
        self._finish_removal(removed)
        counts = f"{len(removed)} keyframes forgotten, {len(self.atlas)} stay"
        return [MapEvent(None, "expired", f"{counts}: older than {self._config.edge.keep_days:g} days")]

    def _finish_removal(self, removed: Sequence[RemovedKeyframe]) -> None:
        for keyframe in removed:
            self.views.remove(keyframe.node_id)
            if self._news is not None:
                self._news.remove(keyframe.key)
            self._retention.remove(keyframe.node_id)
            self._lookup.revisits.remove(keyframe.node_id)
        self._counters.removed_keyframes += len(removed)
        for agent in sorted({keyframe.key.agent for keyframe in removed}):
            if self.atlas.is_run_gone(agent):
                self._note_empty(agent)

    def _note_empty(self, agent: str) -> None:
        self._empty_runs.append(KeyframeKey(agent, self._counters.runs[agent].newest_id))

    def restore(self, stored_map: StoredMap) -> None:
        """Restore the map of an earlier session, before anything else is added.

        Restored maps keep their reference segments, also before headsets that come now. Their views are
        indexed beside look-ups.
        """
        for run in stored_map.runs:
            self.add_run(run.run_key, run.hello, run.credential)
            self.set_present(run.run_key, False)
        ranks = restored_ranks(self._config, stored_map)
        restored = list(zip(self.atlas.restore(stored_map, ranks), stored_map.keyframes, strict=True))
        self.views.restore(
            [(n, one.keyframe_key, one.keyframe, self._hellos[one.run_key].rig) for n, one in restored]
        )
        for node_id, stored in restored:
            self._retention.add(node_id, stored.arrived_s)
            self._counters.runs[stored.run_key].newest_id = stored.keyframe.id

    # Steps: what to do next, and what follows from the result

    def next_lookup(self) -> LookupStep | None:
        """Next step of looking up a keyframe; None if there is none or one is running."""
        if self._lookup_job.is_running:
            return None
        while (step := self._lookup_job.next_step()) is None:
            if (job := self._next_job()) is None:
                return None
            self._lookup_job.start(job)
        return cast(LookupStep, step)

    def _next_job(self) -> Job | None:
        """Next keyframe to look up, or to describe for later queries."""
        if (search := self.search.next_job()) is not None:
            return search
        while (node_id := self._next_query()) is not None:
            if node_id in self.views.by_node:
                return self._lookup.look_up(node_id)
        if (node_id := self._lookup.revisits.next_node(self.atlas.waiting_segments())) is not None:
            return self._lookup.look_up(node_id)
        if entries := self.views.next_restored():
            return self._lookup.index(entries)
        node_id = self.views.next_undescribed()
        return None if node_id is None else self._lookup.describe(node_id)

    def _next_query(self) -> int | None:
        node_id = self.queries.next_query()
        if node_id is None and len(self.atlas.graph.maps) > 1:
            node_id = self.queries.next_skipped()  # too late for an answer, but it may merge maps
        return node_id

    def next_solve(self) -> SolveStep | None:
        """Next map to solve; None if there is none or one is running."""
        for map_id in [] if self._solve_job.is_running else self.atlas.solving.due_maps():
            self._solve_job.start(self._solve_map(map_id))
            try:
                return cast(SolveStep, self._solve_job.next_step())
            except Exception as error:  # only this map stays unsolved
                self._log.events += self.report_failure(SolveStep.kind, error, map_id=map_id)
        return None

    def finish_step(self, step: Step, result: Any, ms: float) -> list[MapEvent]:
        """Apply a step's result. An exception as the result fails that step only."""
        self._counters.add_step(step.kind, ms)
        try:
            return (self._solve_job if isinstance(step, SolveStep) else self._lookup_job).finish(result)
        except Exception as error:
            if isinstance(step, SolveStep):
                return self.report_failure(step.kind, error, map_id=step.job.map_id)
            agent = self.atlas.key(step.node_id).agent if step.node_id in self.views.by_node else None
            return self.report_failure(step.kind, error, agent)

    def report_failure(
        self, what: str, error: Exception, agent: str | None = None, map_id: str | None = None
    ) -> list[MapEvent]:
        """Count and report an error; the map goes on without the step. agent, map_id: concerned, if any."""
        return self._log.failure(what, error, agent, map_id)

    def take_events(self) -> list[MapEvent]:
        """Return the events since the last call that no other method has returned."""
        return self._log.take_events()

    # A map that has changed

    def _solve_map(self, map_id: str) -> Job:
        """Optimise a map and publish the corrections that follow."""
        job = self.atlas.solving.make_job(map_id)
        try:
            solution = yield SolveStep(job)
        except Exception:
            self.reset_solver()
            raise
        applied = self.atlas.solving.apply(job, solution)
        self._log.record_loops(applied)
        yield self._publisher.publish(map_id, applied)

    def reset_solver(self) -> None:
        """The solver process lost its state: its next job contains the whole graph."""
        self.atlas.graph.edges.reset()

    # Other rooms

    @property
    def has_place_answers(self) -> bool:
        """Whether something for the directory of places waits to be taken."""
        return self.search.has_answers or (self._news is not None and self._news.has_any)

    def take_place_news(self) -> tuple[PlaceNews, ...]:
        """Return what a directory of places needs to know since the last call."""
        return () if self._news is None else self._news.take()

    # Results

    def take_changes(self) -> tuple[MapChange, ...]:
        """Return the changes to store since the last call."""
        return self._log.take_changes()

    def take_empty_runs(self) -> tuple[KeyframeKey, ...]:
        """Return the runs without keyframes since the last call, each with its newest keyframe."""
        empty_runs, self._empty_runs = tuple(self._empty_runs), []
        return empty_runs

    def current_poses(self) -> SavePoses:
        return self.atlas.all_poses()

    def report(self) -> dict[str, Any]:
        """Return the mapper's fields of edge.json, and under `agents` those of the runs that it lists. Listed
        maps are theirs and the largest others."""
        atlas, runs = self.atlas, self.atlas.runs.listed(self._config.edge.max_agents)
        standings, sizes = atlas.quarantine.agreement.standings(runs), atlas.map_sizes()
        agents = {
            agent: {
                **self._counters.runs[agent].report(),
                "queries_skipped": self.queries.skipped[agent],
                "map_id": atlas.current_map_id(agent),
                "consistency": asdict(standings[agent]),
            }
            for agent in runs
        }
        listed = {*nlargest(_MAX_MAPS, sizes, sizes.__getitem__)}
        listed.update(one["map_id"] for one in agents.values())
        maps = {map_id: size for map_id, size in sizes.items() if map_id in listed}
        return {
            "agents": agents,
            "maps": maps,
            "unlisted_maps": len(sizes) - len(maps),
            "unlisted_keyframes": len(atlas) - sum(maps.values()),
            "waiting": len(self.queries),
            **self._counters.report(len(atlas.loop_acceptance.pending), len(atlas.graph.edges.loops)),
        }
