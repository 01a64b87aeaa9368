"""A mapper that draws recognition and solved poses from the ground truth. Several times as fast as the real
one.

In virtual time (`share.lab.evaluate.simulation`) it takes the place of `share.mapping.mapper.Mapper`. The
same code as there decides which keyframe is looked up next, which loops are skipped and which map is solved.
Whether two views are verified is drawn from their overlap; the pose of an agent in a solved map is the truth
plus a drawn error.

Not modelled: views that never match, walls between views, wrong loops, and a map that improves as it grows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from share.config import Config
from share.geometry import se3
from share.geometry.camera import Rig
from share.mapping.candidates import CandidateSearch
from share.mapping.corrections import MapEvent, map_assignment
from share.mapping.map_changes import MapChange
from share.mapping.query_queue import QueryQueue, service_kind
from share.mapping.recognition.verification import Refusal, Verification
from share.mapping.segments import MIN_LOOP_GAP
from share.scheduling.merge_gate import Frustum, MergeGate, SampledFrustum, overlap_volumes
from share.types import F64, Correction, Keyframe
from share.wire.messages import Hello

_COARSE_M = 1.0  # sampling interval of the overlap
_COV = np.diag([1e-5] * 3 + [1e-4] * 3)
_USUAL_QUANTUM = 16  # of JPEG quality 50
_CACHE_SIZE = 50_000  # pairs of a keyframe and an agent: some 100 MB


@dataclass(frozen=True)
class RecognitionModel:
    """Parameters of the drawn recognition and of a solved map. Defaults: docs/understand/scheduling.md.

    Overlaps are fractions of a view's volume. Two views that share `half_overlap` are verified with
    probability 1/2, by a logistic curve of width `logistic_width`. `overlap_noise`: sigma of the overlap by
    which candidates are ranked. `false_match_rate`: fraction of all keyframes that look alike by chance.
    `sigma_m`, `sigma_rad`: error of a solved pose on each axis, and about the vertical. `supporting_loops`:
    verified pairs of keyframes that merge two maps. `small_recall`, `small_error`: factors of the probability
    and of the error where a picture is small.
    """

    half_overlap: float = 0.5
    logistic_width: float = 0.09
    overlap_noise: float = 0.12
    false_match_rate: float = 0.04
    sigma_m: float = 0.006
    sigma_rad: float = 0.001
    supporting_loops: int = 2
    small_recall: float = 0.95
    small_error: float = 1.1


class GroundTruth:
    """True poses of all agents' keyframes, sent or not, and their overlaps.

    Equal in all runs in a room: pass one instance from run to run, it caches the overlaps.
    """

    def __init__(
        self, near_m: float, far_m: float, rigs: Mapping[str, Rig], T_world_body: Mapping[str, F64]
    ) -> None:
        """Take T_world_body (N, 4, 4) by agent; cameras see from near_m to far_m."""
        self.T_world_body = T_world_body
        self._T_world_cam = {name: T @ rigs[name].T_body_cam0 for name, T in T_world_body.items()}
        self._view_volumes = {
            name: SampledFrustum(Frustum.from_camera(rig.cam0, near_m, far_m), _COARSE_M)
            for name, rig in rigs.items()
        }
        self.overlap = lru_cache(_CACHE_SIZE)(self._overlap)

    def _overlap(self, agent: str, k: int, other: str) -> F64:
        """Return the overlap (N,) of the agent's keyframe k with each of `other`'s, as fractions of its
        view's volume."""
        one, two, T = self._view_volumes[agent], self._view_volumes[other], self._T_world_cam
        return overlap_volumes(one, T[agent][k], two, T[other]) / one.frustum.volume


@dataclass(frozen=True)
class ModelledStep:
    """A step that the keeper of the clock runs. `candidate`: of kind `verify` only."""

    kind: str
    number: int
    action: Callable[[], object]
    candidate: int = -1

    def run(self, _solver: object = None) -> object:
        return self.action()


def has_small_picture(keyframe: Keyframe) -> bool:
    """Return whether its JPEG has a quality below 50, by the first number of its quantisation table."""
    jpeg = keyframe.image.jpeg.tobytes()
    start = jpeg.find(b"\xff\xdb")  # marker, length (2), table's number, table: ITU-T T.81, B.2.4.1
    return start >= 0 and jpeg[start + 5] > _USUAL_QUANTUM


@dataclass
class _StoredKeyframe:
    """A keyframe in the map. `truth_index`: its row in the agent's ground truth."""

    agent: str
    keyframe: Keyframe
    truth_index: int
    T_world_body: F64


@dataclass
class _AgentState:
    """State of one run. `published_map`: the map of its last correction. `newest_looped_keyframe`: id of
    its newest keyframe with an accepted loop that no correction answers yet, -1 without one."""

    hello: Hello
    keyframe_numbers: list[int] = field(default_factory=list)
    truth_indices: list[int] = field(default_factory=list)
    map_id: str = ""
    published_map: str = ""
    newest_looped_keyframe: int = -1
    merges: Counter[str] = field(default_factory=Counter)


class ModelledMapper:
    """Answer as `Mapper` does, from the ground truth.

    `truth_index(name, stamp_ns)` gives the row of an agent's keyframe in its ground truth.
    """

    def __init__(
        self,
        config: Config,
        truth: GroundTruth,
        truth_index: Callable[[str, int], int],
        model: RecognitionModel,
        seed: int,
    ) -> None:
        self._config, self._truth, self._truth_index, self._model = config, truth, truth_index, model
        self._rng = np.random.default_rng(seed)
        self._stored: list[_StoredKeyframe] = []
        self._agents: dict[str, _AgentState] = {}
        self._T_map_world: dict[str, F64] = {}
        self._lookups = QueryQueue(config.edge)
        self._gating = MergeGate(config.control, config.edge.policy)
        self._search: tuple[int, CandidateSearch] | None = None  # of a keyframe, by number
        self._is_searching = self._is_solving = False
        self._maps_to_solve: dict[str, None] = {}
        self._verified_pairs: dict[frozenset[str], int] = {}  # verified loops between two maps

    # The interface of share.mapping.mapper.Mapper.

    def add_run(self, agent: str, hello: Hello) -> None:
        self._agents[agent] = _AgentState(hello)

    def set_present(self, agent: str, is_present: bool) -> None:
        """Do nothing: presence does not matter here, all agents get corrections at once."""

    def add_keyframe(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[MapEvent]:
        run, number = self._agents[agent], len(self._stored)
        k = self._truth_index(run.hello.name, keyframe.stamp_ns)
        T = self._truth.T_world_body[run.hello.name][k]
        self._stored.append(_StoredKeyframe(agent, keyframe, k, T))
        run.keyframe_numbers.append(number)
        run.truth_indices.append(k)
        self._lookups.add(agent, service_kind(self._config, run.hello), number, is_extra)
        if keyframe.reference >= 0:
            return []
        run.map_id = run.published_map = f"{agent}/{keyframe.id}"
        self._T_map_world[run.map_id] = keyframe.T_odom_body @ se3.inverse(T)
        return [map_assignment(agent, run.map_id, np.eye(4), keyframe.id)]

    def next_lookup(self) -> ModelledStep | None:
        if self._is_searching:
            return None
        step = self._next_verify()
        if step is None and (number := self._lookups.next_query()) is not None:
            step = ModelledStep("place", number, lambda: self._candidates(number))
        self._is_searching = step is not None
        return step

    def next_solve(self) -> ModelledStep | None:
        """Return the solve of the next map to be solved, None while one runs or without one."""
        if self._is_solving or not self._maps_to_solve:
            return None
        name = next(iter(self._maps_to_solve))
        del self._maps_to_solve[name]
        self._is_solving = True
        answered = {}
        for agent, run in self._agents.items():
            if run.map_id == name and run.newest_looped_keyframe >= 0:
                answered[agent], run.newest_looped_keyframe = run.newest_looped_keyframe, -1
        return ModelledStep("solve", -1, lambda: (name, answered))

    def finish_step(self, step: Any, result: Any, ms: float) -> list[MapEvent]:
        if isinstance(result, Exception):
            raise result
        if step.kind == "solve":
            self._is_solving = False
            return self._corrections(*result)
        self._is_searching = False
        if step.kind == "place":
            self._search = step.number, CandidateSearch(result)
            return []
        return self._accept_verified(step, result.T_c_q) if isinstance(result, Verification) else []

    def take_events(self) -> list[MapEvent]:
        return []

    def take_changes(self) -> tuple[MapChange, ...]:
        return ()

    def report(self) -> dict[str, Any]:
        merges = sum((run.merges for run in self._agents.values()), Counter[str]())
        return {
            "agents": {
                agent: {"map_id": run.map_id, "queries_skipped": self._lookups.skipped[agent]}
                for agent, run in self._agents.items()
            },
            "merges": {what: merges[what] for what in ("requested", "skipped", "done")},
            "maps": dict(Counter(self._agents[stored.agent].map_id for stored in self._stored)),
        }

    # The drawn recognition and solution.

    def _overlap(self, number: int, run: _AgentState) -> F64:
        """Return the overlap (N,) of a keyframe's view with each true keyframe of an agent, as fractions
        of that view."""
        mine = self._stored[number]
        return self._truth.overlap(self._agents[mine.agent].hello.name, mine.truth_index, run.hello.name)

    def _candidates(self, number: int) -> list[int]:
        """Return candidates for a keyframe, best first."""
        agent = self._stored[number].agent
        ranked: list[tuple[float, int]] = []
        for other, run in self._agents.items():
            if not (numbers := run.keyframe_numbers):
                continue
            overlaps = self._overlap(number, run)[run.truth_indices]
            overlaps += self._model.overlap_noise * self._rng.standard_normal(len(numbers))
            overlaps[self._rng.random(len(overlaps)) < self._model.false_match_rate] += 0.5
            end = len(numbers)
            if other == agent:  # keyframes this close are joined by odometry
                end = max(0, self._stored[number].keyframe.id - MIN_LOOP_GAP)
            best = np.argsort(-overlaps[:end])[: self._config.place.candidates]
            ranked += [(float(overlaps[i]), numbers[i]) for i in best if numbers[i] != number]
        ranked.sort(reverse=True)
        return [n for _, n in ranked[: self._config.place.candidates]]

    def _next_verify(self) -> ModelledStep | None:
        if self._search is None:
            return None
        number, search = self._search
        if (candidate := search.next_candidate(self._lookups.has_backlog)) is None:
            self._search = None
            return None
        return ModelledStep("verify", number, lambda: self._verify(number, candidate), candidate)

    def _verify(self, number: int, candidate: int) -> Verification | Refusal:
        a, b = self._stored[candidate], self._stored[number]
        shared = float(self._overlap(number, self._agents[a.agent])[a.truth_index])
        chance = (1 + math.tanh((shared - self._model.half_overlap) / (2 * self._model.logistic_width))) / 2
        if has_small_picture(a.keyframe) or has_small_picture(b.keyframe):
            chance *= self._model.small_recall
        if self._rng.random() >= chance or not shared:
            return Refusal("drawn")
        return Verification(se3.inverse(a.T_world_body) @ b.T_world_body, _COV, 40, 30)

    def _accept_verified(self, step: ModelledStep, T_a_b: F64) -> list[MapEvent]:
        a, b = self._stored[step.candidate], self._stored[step.number]
        one, other = self._agents[a.agent], self._agents[b.agent]
        if self._search is not None:
            self._search[1].count_verified()
        other.merges["requested"] += 1
        volume = self._gating.overlap_volume(one.hello.rig, other.hello.rig, T_a_b)
        if self._gating.skip_reason(volume, one.map_id == other.map_id):
            other.merges["skipped"] += 1
            return []
        if one.map_id != other.map_id and not self._try_join_maps(one, other):
            return []
        other.merges["done"] += 1
        self._gating.record_merge(volume)
        other.newest_looped_keyframe = max(other.newest_looped_keyframe, b.keyframe.id)
        self._maps_to_solve[other.map_id] = None
        return [MapEvent(b.agent, "loop accepted", "drawn")]

    def _try_join_maps(self, one: _AgentState, other: _AgentState) -> bool:
        """Merge the maps of two agents if enough loops support it; the younger map is absorbed."""
        pair = frozenset((one.map_id, other.map_id))
        self._verified_pairs[pair] = self._verified_pairs.get(pair, 0) + 1
        if self._verified_pairs[pair] < self._model.supporting_loops:
            return False
        surviving, absorbed = sorted(pair, key=list(self._T_map_world).index)
        for run in self._agents.values():
            run.map_id = surviving if run.map_id == absorbed else run.map_id
        self._maps_to_solve.pop(absorbed, None)
        return True

    def _corrections(self, name: str, answered: Mapping[str, int]) -> list[MapEvent]:
        """Return corrections for agents that have an answer due or whose map was absorbed."""
        return [
            MapEvent(agent, "correction", "solved", self._correction(run, answered.get(agent, -1)))
            for agent, run in self._agents.items()
            if run.map_id == name and (agent in answered or run.published_map != name)
        ]

    def _correction(self, run: _AgentState, answer: int) -> Correction:
        run.published_map = run.map_id
        keyframe = self._stored[run.keyframe_numbers[answer]]  # -1: the newest
        sigma = np.array([0.0, 0.0, self._model.sigma_rad] + [self._model.sigma_m] * 3)
        sigma *= self._model.small_error if has_small_picture(keyframe.keyframe) else 1.0
        xi = self._rng.standard_normal(6) * sigma
        T_map_body = self._T_map_world[run.map_id] @ keyframe.T_world_body @ se3.exp(xi)
        T_odom_body = keyframe.keyframe.T_odom_body
        T_map_odom = se3.orthonormal(T_map_body @ se3.inverse(T_odom_body))
        cov = se3.inverse_cov(T_odom_body, np.diag(sigma**2))
        return Correction(T_map_odom, cov, run.map_id, 0, keyframe.keyframe.id, answer)
