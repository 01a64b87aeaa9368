"""A mapper that knows the truth, in place of one that recognises it: several times as quick.

In virtual time (`share.lab.evaluate.world`) it answers as `share.mapping.mapper.Mapper` does: whose turn it
is, what is skipped and what is solved are decided by the same code, but whether two views are verified is
drawn by how much they overlap, and where a solved map has an agent is the truth and an error that is drawn.
What it leaves out: views that never match, walls between views, loops that are wrong, and how a map gets
better with what it knows."""

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
from share.mapping.candidates import Effort, Lookups, Search, served_as
from share.mapping.changes import Change
from share.mapping.recognition.verification import Refusal, Verified
from share.mapping.steps import Finding, in_map
from share.scheduling.gate import Gating
from share.scheduling.overlap import Frustum, Seen, volumes
from share.types import F64, Correction, Keyframe
from share.wire.messages import Hello

_COARSE_M = 1.0  # between the points by which overlap is found here
_COV = np.diag([1e-5] * 3 + [1e-4] * 3)
_REMEMBERED = 50_000  # keyframes, each with all of one agent: some 100 MB


@dataclass(frozen=True)
class Odds:
    """Of recognition, in parts of a view's volume, and of a solved map. Defaults: docs/scheduling.md.

    half, width: two views that share `half` are verified every second time, by a logistic curve `width`
    wide. blur: error of the overlap by which candidates are ranked; strange: so many of all keyframes look
    alike by chance. sigma_m: error of a solved pose on each axis, sigma_rad: about the vertical. witnesses:
    verified pairs of keyframes that join two maps.
    """

    half: float = 0.5
    width: float = 0.09
    blur: float = 0.12
    strange: float = 0.04
    sigma_m: float = 0.006
    sigma_rad: float = 0.001
    witnesses: int = 2


class Truth:
    """Where everybody's keyframes are, sent or not, and what they have in common. It is the same in all runs
    in a room, and best passed from one to the next: what was worked out once is remembered.
    """

    def __init__(
        self, near_m: float, far_m: float, rigs: Mapping[str, Rig], T_world_body: Mapping[str, F64]
    ) -> None:
        """By agent, T_world_body (N, 4, 4). near_m, far_m: of what cameras see."""
        self.T_world_body = T_world_body
        self._T_world_cam = {name: T @ rigs[name].T_body_cam0 for name, T in T_world_body.items()}
        self._seen = {
            name: Seen(Frustum.of(rig.cam0, near_m, far_m), _COARSE_M) for name, rig in rigs.items()
        }
        self.shared = lru_cache(_REMEMBERED)(self._shared)

    def _shared(self, agent: str, k: int, other: str) -> F64:
        """Overlap of the agent's keyframe k with each of another's (N,), in parts of its view's volume."""
        one, two, T = self._seen[agent], self._seen[other], self._T_world_cam
        return volumes(one, T[agent][k], two, T[other]) / one.frustum.volume


@dataclass(frozen=True)
class Step:
    """To be run by whoever keeps the time. candidate: for kind `verify`."""

    kind: str
    number: int
    act: Callable[[], object]
    candidate: int = -1

    def run(self, _solver: object = None) -> object:
        return self.act()


@dataclass
class _Stored:
    """k: which of the agent's keyframes in truth."""

    agent: str
    keyframe: Keyframe
    k: int
    T_world_body: F64


@dataclass
class _Run:
    """Of one agent. numbers, ks: of its keyframes. told: the map that it was last corrected into. answer: its
    newest keyframe that a loop came from, -1 none."""

    hello: Hello
    numbers: list[int] = field(default_factory=list)
    ks: list[int] = field(default_factory=list)
    map_of: str = ""
    told: str = ""
    answer: int = -1
    merges: Counter[str] = field(default_factory=Counter)


class ModelledMapper:
    """which: of an agent's keyframes in truth, by its name and the stamp of a keyframe."""

    def __init__(
        self, config: Config, truth: Truth, which: Callable[[str, int], int], odds: Odds, seed: int
    ) -> None:
        self._config, self._truth, self._which, self._odds = config, truth, which, odds
        self._rng = np.random.default_rng(seed)
        self._stored: list[_Stored] = []
        self._runs: dict[str, _Run] = {}
        self._T_map_world: dict[str, F64] = {}
        self._lookups = Lookups(config.edge)
        self._gating = Gating(config.control, config.edge.policy)
        self._effort = Effort.of(config)
        self._search: Search | None = None
        self._looking = self._solving = False
        self._due: dict[str, None] = {}  # maps
        self._pairs: dict[frozenset[str], int] = {}  # verified ones between two maps

    # ------------------------------------------------------------------ as share.mapping.mapper.Mapper

    def join(self, agent: str, hello: Hello) -> None:
        self._runs[agent] = _Run(hello)

    def present(self, agent: str, here: bool) -> None:
        """Everybody is told at once here, so it does not matter."""

    def add(self, agent: str, keyframe: Keyframe, is_extra: bool = False) -> list[Finding]:
        run, number = self._runs[agent], len(self._stored)
        k = self._which(run.hello.name, keyframe.stamp_ns)
        T = self._truth.T_world_body[run.hello.name][k]
        self._stored.append(_Stored(agent, keyframe, k, T))
        run.numbers.append(number)
        run.ks.append(k)
        self._lookups.add(agent, served_as(self._config, run.hello), number, is_extra)
        if keyframe.reference >= 0:
            return []
        run.map_of = run.told = f"{agent}/{keyframe.id}"
        self._T_map_world[run.map_of] = keyframe.T_odom_body @ se3.inverse(T)
        return [in_map(agent, run.map_of, np.eye(4), keyframe.id)]

    def next_look(self) -> Step | None:
        if self._looking:
            return None
        step = self._next_verify()
        if step is None and (number := self._lookups.next()) is not None:
            step = Step("place", number, lambda: self._candidates(number))
        self._looking = step is not None
        return step

    def next_solve(self) -> Step | None:
        if self._solving or not self._due:
            return None
        name = next(iter(self._due))
        del self._due[name]
        self._solving = True
        answered = {}
        for agent, run in self._runs.items():
            if run.map_of == name and run.answer >= 0:
                answered[agent], run.answer = run.answer, -1
        return Step("solve", -1, lambda: (name, answered))

    def done(self, step: Any, result: Any, ms: float) -> list[Finding]:
        if isinstance(result, Exception):
            raise result
        if step.kind == "solve":
            self._solving = False
            return self._solved(*result)
        self._looking = False
        if step.kind == "place":
            self._search = Search(step.number, result, self._effort)
            return []
        return self._verified(step, result.T_c_q) if isinstance(result, Verified) else []

    def take_changes(self) -> tuple[Change, ...]:
        return ()

    def report(self) -> dict[str, Any]:
        merges = sum((run.merges for run in self._runs.values()), Counter[str]())
        return {
            "agents": {
                agent: {"map_id": run.map_of, "queries_skipped": self._lookups.skipped[agent]}
                for agent, run in self._runs.items()
            },
            "merges": {what: merges[what] for what in ("requested", "skipped", "done")},
            "maps": dict(Counter(self._runs[stored.agent].map_of for stored in self._stored)),
        }

    # ------------------------------------------------------------------ what is drawn

    def _shared(self, number: int, run: _Run) -> F64:
        """Overlap, in parts of its view, of a keyframe with each of an agent in truth (N,)."""
        mine = self._stored[number]
        return self._truth.shared(self._runs[mine.agent].hello.name, mine.k, run.hello.name)

    def _candidates(self, number: int) -> list[int]:
        """Best first."""
        agent, gap = self._stored[number].agent, self._config.merge.min_loop_gap
        ranked: list[tuple[float, int]] = []
        for other, run in self._runs.items():
            if not (numbers := run.numbers):
                continue
            looks = self._shared(number, run)[run.ks]
            looks += self._odds.blur * self._rng.standard_normal(len(numbers))
            looks[self._rng.random(len(looks)) < self._odds.strange] += 0.5
            end = len(numbers)
            if other == agent:  # odometry's business
                end = max(0, self._stored[number].keyframe.id - gap)
            best = np.argsort(-looks[:end])[: self._config.place.candidates]
            ranked += [(float(looks[i]), numbers[i]) for i in best if numbers[i] != number]
        ranked.sort(reverse=True)
        return [n for _, n in ranked[: self._config.place.candidates]]

    def _next_verify(self) -> Step | None:
        search = self._search
        candidate = None if search is None else search.next(self._lookups.in_a_hurry)
        if search is None or candidate is None:
            self._search = None
            return None
        number = search.number
        return Step("verify", number, lambda: self._verify(number, candidate), candidate)

    def _verify(self, number: int, candidate: int) -> Verified | Refusal:
        a, b = self._stored[candidate], self._stored[number]
        shared = float(self._shared(number, self._runs[a.agent])[a.k])
        chance = (1 + math.tanh((shared - self._odds.half) / (2 * self._odds.width))) / 2
        if self._rng.random() >= chance or not shared:
            return Refusal("drawn")
        return Verified(se3.inverse(a.T_world_body) @ b.T_world_body, _COV, 40, 30)

    def _verified(self, step: Step, T_a_b: F64) -> list[Finding]:
        a, b = self._stored[step.candidate], self._stored[step.number]
        one, other = self._runs[a.agent], self._runs[b.agent]
        if self._search is not None:
            self._search.verified()
        other.merges["requested"] += 1
        volume = self._gating.volume(one.hello.rig, other.hello.rig, T_a_b)
        if self._gating.refuses(volume, one.map_of == other.map_of):
            other.merges["skipped"] += 1
            return []
        if one.map_of != other.map_of and not self._joins(one, other):
            return []
        other.merges["done"] += 1
        self._gating.completed(volume)
        other.answer = max(other.answer, b.keyframe.id)
        self._due[other.map_of] = None
        return [Finding(b.agent, "loop accepted", "drawn")]

    def _joins(self, one: _Run, other: _Run) -> bool:
        """Whether there are enough that say so; the younger map then goes."""
        pair = frozenset((one.map_of, other.map_of))
        self._pairs[pair] = self._pairs.get(pair, 0) + 1
        if self._pairs[pair] < self._odds.witnesses:
            return False
        kept, gone = sorted(pair, key=list(self._T_map_world).index)
        for run in self._runs.values():
            run.map_of = kept if run.map_of == gone else run.map_of
        self._due.pop(gone, None)
        return True

    def _solved(self, name: str, answered: Mapping[str, int]) -> list[Finding]:
        """Corrections of those that are answered or have come from another map."""
        return [
            Finding(agent, "correction", "solved", self._correction(run, answered.get(agent, -1)))
            for agent, run in self._runs.items()
            if run.map_of == name and (agent in answered or run.told != name)
        ]

    def _correction(self, run: _Run, answer: int) -> Correction:
        run.told = run.map_of
        at = self._stored[run.numbers[answer]]  # -1: the newest
        sigma = np.array([0.0, 0.0, self._odds.sigma_rad] + [self._odds.sigma_m] * 3)
        xi = self._rng.standard_normal(6) * sigma
        T_map_body = self._T_map_world[run.map_of] @ at.T_world_body @ se3.exp(xi)
        T_odom_body = at.keyframe.T_odom_body
        T_map_odom = se3.orthonormal(T_map_body @ se3.inverse(T_odom_body))
        cov = se3.inverse_cov(T_odom_body, np.diag(sigma**2))
        return Correction(T_map_odom, cov, run.map_of, 0, at.keyframe.id, answer)
