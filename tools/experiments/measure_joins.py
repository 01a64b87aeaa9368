"""Time and correctness of merges between agents: replay sets of keyframes through the edge's mapper.

    python tools/experiments/measure_joins.py --scene corridor-twins --motion walk: --motion walk: \\
        --seeds 0:200 --spacing-m 0.3 --spacing-rad 0.35 [--set merge.join_places=4] [--json FILE]

Takes the options of `make_keyframe_sets.py`; sets that it has not made are left out. Prints a Markdown table.

Protocol: keyframes of all agents in the order of their stamps; after each, all pending work is done at once,
in one process, so a time here is that of a keyframe. Common view: keyframes of two agents nearer than 1 m and
30 degrees. Two agents are wrongly in one map while the relative pose of their newest keyframes there errs by
more than 0.5 m or 10 degrees. Joint ATE: of the keyframes of the largest map at the end, one alignment (SE3)
for all agents.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_set import KeyframeSet, Spacing, keyframe_set, place  # noqa: E402
from make_keyframe_sets import parser as set_parser  # noqa: E402
from make_keyframe_sets import recipe_of  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.mapping.graph.solver import PoseGraphSolver  # noqa: E402
from share.mapping.loops import KeyframeKey  # noqa: E402
from share.mapping.mapper import Mapper  # noqa: E402
from share.mapping.steps import SolveStep  # noqa: E402
from share.metrics.ate import joint_ate  # noqa: E402
from share.plain_data import from_mapping, to_mapping  # noqa: E402
from share.types import F64  # noqa: E402

SEEN_M, SEEN_RAD = 1.0, float(np.radians(30))
WRONG_M, WRONG_RAD = 0.5, float(np.radians(10))


@dataclass
class JoiningPair:
    """Two agents, in seconds since the first keyframe. joined: the first correct merge."""

    common: float | None = None
    joined: float | None = None
    wrong: float | None = None
    seconds_wrong: float = 0.0
    end: str = "apart"

    @property
    def after(self) -> float | None:
        """Return the time from the first common view to the merge."""
        if self.common is None or self.joined is None:
            return None
        return max(0.0, self.joined - self.common)


@dataclass
class JoinRun:
    """pairs: by the names of both. joint_ate_cm: None if no agents were merged."""

    seed: int
    pairs: dict[str, JoiningPair] = field(default_factory=dict)
    joint_ate_cm: float | None = None
    agents_in_map: int = 1


class Replay:
    """Replays one set, keyframe by keyframe."""

    def __init__(self, made: KeyframeSet, config: Config) -> None:
        self._made, self._mapper, self._solver = made, Mapper(config), PoseGraphSolver()
        self._seen: dict[str, int] = {}  # keyframes of each agent so far
        self._before = 0.0
        self.run = JoinRun(made.recipe.seed)
        for name, agent in made.agents.items():
            self._mapper.add_run(name, agent.hello)
        for x, y in itertools.combinations(made.agents, 2):
            self.run.pairs[f"{x} {y}"] = JoiningPair()

    def whole(self) -> JoinRun:
        for t, name, k in order(self._made):
            self._mapper.add_keyframe(name, self._made.agents[name].keyframes[k])
            self._seen[name] = k + 1
            self._work()
            self._look(t, name)
            self._before = t
        self._end()
        return self.run

    def _work(self) -> None:
        mapper = self._mapper
        while (step := mapper.next_lookup() or mapper.next_solve()) is not None:
            result = step.run(self._solver) if isinstance(step, SolveStep) else step.run()
            mapper.finish_step(step, result, 0.0)

    def _look(self, t: float, name: str) -> None:
        """Update the state of all pairs; a wrong one counts until the next keyframe."""
        found = self._mapper.current_poses()
        at = {
            key: (T, map_id)
            for key, T, map_id in zip(found.keys, found.T_map_body, found.map_ids, strict=True)
        }
        for pair_name, pair in self.run.pairs.items():
            x, y = pair_name.split(" ")
            if not {x, y} <= self._seen.keys():
                continue
            if pair.end == "wrong":
                pair.seconds_wrong += t - self._before
            if pair.common is None and name in (x, y) and self._common(name, y if name == x else x):
                pair.common = t
            pair.end = self._state(at[self._newest(x)], at[self._newest(y)], x, y)
            if pair.end == "right" and pair.joined is None:
                pair.joined = t
            if pair.end == "wrong" and pair.wrong is None:
                pair.wrong = t

    def _newest(self, name: str) -> KeyframeKey:
        return KeyframeKey(name, self._made.agents[name].keyframes[self._seen[name] - 1].id)

    def _common(self, name: str, other: str) -> bool:
        """Return whether the newest keyframe shows what the other agent has seen."""
        T = self._made.agents[name].T_world_body[self._seen[name] - 1]
        step = se3.inverse(T) @ self._made.agents[other].T_world_body[: self._seen[other]]
        near = np.linalg.norm(step[:, :3, 3], axis=1) < SEEN_M
        return bool((near & (se3.rotation_angle(step) < SEEN_RAD)).any())

    def _state(self, a: tuple[F64, str], b: tuple[F64, str], x: str, y: str) -> str:
        if a[1] != b[1]:
            return "apart"
        true_x, true_y = (self._made.agents[name].T_world_body[self._seen[name] - 1] for name in (x, y))
        off = se3.inverse(se3.inverse(true_x) @ true_y) @ se3.inverse(a[0]) @ b[0]
        wrong = np.linalg.norm(off[:3, 3]) > WRONG_M or se3.rotation_angle(off) > WRONG_RAD
        return "wrong" if wrong else "right"

    def _end(self) -> None:
        found = self._mapper.current_poses()
        largest = max(set(found.map_ids), key=found.map_ids.count)
        pairs = {}
        for name, agent in self._made.agents.items():
            number = {KeyframeKey(name, keyframe.id): k for k, keyframe in enumerate(agent.keyframes)}
            inside = [
                (number[key], T)
                for key, T, map_id in zip(found.keys, found.T_map_body, found.map_ids, strict=True)
                if key in number and map_id == largest
            ]
            if inside:
                ks = [k for k, _ in inside]
                stamps = np.array([agent.keyframes[k].stamp_ns for k in ks])
                estimate = (stamps, np.array([T for _, T in inside]))
                pairs[name] = (estimate, (stamps, agent.T_world_body[ks]))
        self.run.agents_in_map = len(pairs)
        if len(pairs) > 1:
            self.run.joint_ate_cm = 100 * joint_ate(pairs).joint.rmse


def order(made: KeyframeSet) -> list[tuple[float, str, int]]:
    """Return (seconds since the first, agent, index of the keyframe), in order."""
    stamps = [(kf.stamp_ns, name, k) for name, a in made.agents.items() for k, kf in enumerate(a.keyframes)]
    first = min(stamps)[0]
    return [((stamp - first) * 1e-9, name, k) for stamp, name, k in sorted(stamps)]


# ---------------------------------------------------------------- the table


def main(arguments: Sequence[str] | None = None) -> int:
    made = set_parser()
    made.description = __doc__
    made.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="of Config")
    made.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    options = made.parse_args(arguments)
    return exit_code("measure_joins", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    """Raises UsageError where there is no set."""
    runs = []
    for run in replayed(options, configured(options.set)):
        runs.append(run)
        print(line(run), file=sys.stderr, flush=True)
    if not runs:
        raise UsageError("there are no sets; make them with make_keyframe_sets.py first")
    print(table(options.scene, runs))
    if options.json:
        options.json.write_text(json.dumps([asdict(run) for run in runs], indent=1))


def configured(settings: Sequence[str]) -> Config:
    """Return the shipped settings with these changes. Raises ConfigError for an unknown setting."""
    mapping = to_mapping(Config())
    for setting in settings:
        name, _, value = setting.partition("=")
        section, _, key = name.partition(".")
        mapping.setdefault(section, {})[key] = json.loads(value)
    return from_mapping(Config, mapping, "--set")


def replayed(options: argparse.Namespace, config: Config) -> Iterator[JoinRun]:
    every = Spacing(options.spacing_m, options.spacing_rad)
    for seed in options.seeds:
        recipe = recipe_of(options, seed)
        if place(recipe, every, options.cache).exists():
            yield Replay(keyframe_set(recipe, every, options.cache), config).whole()


def line(run: JoinRun) -> str:
    pairs = "; ".join(
        f"{name}: common {_s(p.common)}, joined {_s(p.joined)}, wrong {_s(p.wrong)} "
        f"for {p.seconds_wrong:.1f} s, {p.end}"
        for name, p in run.pairs.items()
    )
    return f"{run.seed}: {pairs}; joint ATE {_s(run.joint_ate_cm)} cm of {run.agents_in_map} agents"


def table(scene: str, runs: Sequence[JoinRun]) -> str:
    """Return a Markdown table with one row."""
    pairs = [pair for run in runs for pair in run.pairs.values()]
    seen = [pair for pair in pairs if pair.common is not None]
    after = [pair.after for pair in seen if pair.after is not None]
    ate = [run.joint_ate_cm for run in runs if run.joint_ate_cm is not None]
    seeds = f"{runs[0].seed} to {runs[-1].seed} ({len(runs)})"
    wrong = [pair for pair in pairs if pair.wrong is not None]
    cells = [
        f"{scene}, {seeds}",
        f"{len(seen)} of {len(pairs)}",
        f"{len(after)}, after {_spread(after, 's')}",
        f"{sum(seconds <= 10 for seconds in after)}",
        f"{len(wrong)}",
        f"{sum(pair.seconds_wrong for pair in pairs):.0f} s",
        f"{sum(pair.end == 'wrong' for pair in pairs)}",
        _spread(ate, "cm"),
    ]
    head = "scene, seeds|pairs with common view|of them joined|within 10 s|ever wrong|in all|wrong at the end"
    columns = [*head.split("|"), "joint ATE"]
    return "\n".join(f"| {' | '.join(row)} |" for row in (columns, ["---"] * len(columns), cells))


def _s(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f}"


def _spread(values: Sequence[float], unit: str) -> str:
    if not values:
        return "-"
    return f"{statistics.median(values):.1f} {unit} (most {max(values):.1f})"


if __name__ == "__main__":
    sys.exit(main())
