"""A study's folder with trials, as `share study run` is to leave it behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from share.lab.study.plan import (
    ANSWERS,
    PAPER_POLICIES,
    PlanWishes,
    StudyPlan,
    SuccessRule,
    draw_plan,
    plan_text,
)
from share.lab.study.trials import EVENTS, trial_folder

CUBE = (1.0, 1.0)


def small_plan(
    participants: int = 4,
    policies: tuple[str, ...] = PAPER_POLICIES,
    seed: int = 5,
    salt: str = "ab" * 16,
) -> Any:
    """A plan of two spots and its key."""
    spots = np.array([[1.0, 1.0], [2.0, 2.0]])
    return draw_plan(PlanWishes(participants, policies, spots, spots, SuccessRule()), seed, salt)


def begin(of: StudyPlan, who: str, at: int, **changes: Any) -> dict[str, Any]:
    """The first line of the trial of a participant at a place, with changes."""
    (trial,) = [one.trials[at - 1] for one in of.participants if one.name == who]
    line = {"event": "begin", "t_s": 0.0, "participant": who, "place": at}
    return line | {"condition": trial.condition, "plan": of.digest, "judge": "mocap"} | changes


def goal_events(
    goal: int, spot: int, took_s: float | None, at_s: float, off_m: float = 0.1
) -> list[dict[str, Any]]:
    """A call from 3 m away; took_s: until the robot stood, off_m from the cube; None: it never did."""
    lines: list[dict[str, Any]] = [
        {"event": "call", "t_s": at_s, "goal": goal, "spot": spot, "cube_m": [1, 1], "robot_m": [4, 1]},
        {"event": "moves", "t_s": at_s + 0.5, "goal": goal},
    ]
    if took_s is not None:
        robot = [1 + off_m, 1]
        lines.append({"event": "stands", "t_s": at_s + took_s, "goal": goal, "robot_m": robot, "path_m": 3.3})
        lines.append({"event": "status", "t_s": at_s + took_s, "goal": goal, "status": "succeeded"})
    return lines


def write_lines(path: Path, lines: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def fill(folder: Path, plan: StudyPlan, policies: dict[str, str], participants: int | None = None) -> None:
    """Carry out the trials of all participants, or of the first: `share` reaches most."""
    rng = np.random.default_rng(8)
    answers: list[dict[str, Any]] = []
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "plan.json").exists():
        (folder / "plan.json").write_text(plan_text(plan))
    for person in plan.participants[:participants]:
        for place, trial in enumerate(person.trials, 1):
            is_best = policies[trial.condition] == "share"
            lines = [begin(plan, person.name, place)]
            for goal, spot in enumerate(trial.spots, 1):
                took_s = float(rng.uniform(8, 34 if is_best else 60))
                lines += goal_events(goal, spot, took_s, 100.0 * goal)
            lines.append({"event": "end", "t_s": 2000.0})
            write_lines(trial_folder(folder, person.name, place) / EVENTS, lines)
            rated = {one.name: int(rng.integers(5 + 2 * is_best, 10)) for one in plan.questions}
            answers.append({"participant": person.name, "condition": trial.condition, "answers": rated})
        best = next(letter for letter, policy in policies.items() if policy == "share")
        others = [letter for letter in plan.letters if letter != best]
        answers.append({"participant": person.name, "most": best, "least": str(rng.choice(others))})
    write_lines(folder / ANSWERS, answers)
