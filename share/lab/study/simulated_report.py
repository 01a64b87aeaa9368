"""What the trials of a simulated study give by policy: only what is measured."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from share.files.json_file import read_json_lines
from share.lab.study.plan import PAPER_POLICIES
from share.lab.study.simulated_study import OWN_AGENTS, SimulatedStudy
from share.lab.study.trials import EVENTS, CalledGoal, read_trials, trial_folder
from share.lab.tables import format_number

_Z = 1.96
Rows = list[list[str]]


@dataclass(frozen=True, eq=False)
class PolicyGoals:
    """All goals of a policy's trials. by_map_m: last distance to the cube as the map has both, NaN where
    robot and participant were not in one map; presses, place_errors_m: of each trial."""

    policy: str
    trials: int
    goals: list[CalledGoal]
    by_map_m: list[float]
    presses: list[int]
    place_errors_m: list[float]


def goals_by_policy(study: SimulatedStudy) -> list[PolicyGoals]:
    """Read the trials that are done. Raises DataError."""
    found = {name: PolicyGoals(name, 0, [], [], [], []) for name in PAPER_POLICIES}
    counts = dict.fromkeys(found, 0)
    for (person, place), record in read_trials(study.folder, study.plan).items():
        policy = study.key.policies[record.condition]
        lines = read_json_lines(trial_folder(study.folder, person, place) / EVENTS)
        by_map = {line["goal"]: line["by_map_m"] for line in lines if line["event"] == "stands"}
        one = found[policy]
        counts[policy] += 1
        one.goals.extend(record.goals.values())
        one.by_map_m.extend(_number(by_map.get(goal)) for goal in record.goals)
        one.presses.append(lines[-1]["presses"])
        one.place_errors_m.append(_number(lines[-1]["place_error_m"]))
    return [
        PolicyGoals(one.policy, counts[one.policy], one.goals, one.by_map_m, one.presses, one.place_errors_m)
        for one in found.values()
    ]


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def wilson_interval(reached: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of independent trials (Wilson, JASA 22, 1927)."""
    if count == 0:
        return 0.0, 1.0
    share, z2 = reached / count, _Z * _Z / count
    middle = (share + z2 / 2) / (1 + z2)
    half = _Z / (1 + z2) * math.sqrt(share * (1 - share) / count + z2 / (4 * count))
    return max(0.0, middle - half), min(1.0, middle + half)


def result_rows(study: SimulatedStudy) -> Rows:
    """Return a table with its head: a row for each policy that has trials."""
    rule = study.settings.rule
    rows = [
        [
            *("policy", "trials", f"reached in {rule.timeout_s:g} s", "in the longer time", "presses"),
            *("first motion, s", "until it stands there, s", "path ÷ straight", "final distance, m"),
            *("by the map, m", "place error, m"),
        ]
    ]
    for one in goals_by_policy(study):
        if not one.trials:
            continue
        times = [goal.reached_s(rule) for goal in one.goals]
        reached = [goal for goal, s in zip(one.goals, times, strict=True) if not math.isnan(s)]
        ways = [
            (next(stop.path_m for stop in goal.stops if stop.s == goal.reached_s(rule)), goal.straight_m)
            for goal in reached
        ]
        longer = sum(not math.isnan(goal.reached_s(rule, longer=True)) for goal in one.goals)
        straight_m = sum(way[1] for way in ways)
        rows.append(
            [
                *(one.policy, str(one.trials), _share(len(reached), len(one.goals))),
                *(_share(longer, len(one.goals)), f"{sum(one.presses)}"),
                _spread([goal.first_motion_s for goal in one.goals], 1),
                _spread(times, 1),
                format_number(sum(way[0] for way in ways) / straight_m if straight_m else math.nan, ".2f"),
                _spread([goal.stops[-1].distance_m for goal in one.goals if goal.stops], 2),
                *(_spread(one.by_map_m, 2), _spread(one.place_errors_m, 3)),
            ]
        )
    return rows


def about_lines(study: SimulatedStudy) -> Iterator[str]:
    """Yield what the figures are of."""
    settings = study.settings
    planned = len(study.plan.participants) * len(study.plan.letters)
    replayed = settings.agents - OWN_AGENTS
    others = f", {replayed} of them replayed from another room" if replayed else ""
    yield (
        f"{planned - len(study.missing())} of {planned} trials; simulated participants, not people: nobody "
        "rated anything; positions are the simulation's truth"
    )
    yield f"{settings.agents} agents on {settings.network}{others}; seed {settings.seed}, one room"
    yield (
        "shares with Wilson's 95 % interval, as if all calls were independent; others: median (95th "
        "percentile, most)"
    )


def _share(reached: int, count: int) -> str:
    low, high = wilson_interval(reached, count)
    percent = 100 * reached / count if count else math.nan
    return f"{reached} of {count}, {percent:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def _spread(values: Sequence[float], digits: int) -> str:
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return "–"
    middle, high = np.percentile(known, (50, 95))
    return f"{middle:.{digits}f} ({high:.{digits}f}, {max(known):.{digits}f})"
