"""What a simulated robot's run gives: figures, a table, and a picture from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from share import __version__
from share.lab.emulate.recordings import draw_room
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.lab.evaluate.provenance import code_digest
from share.lab.robot.goals import REACHED_M, GoalOutcome, reached_text
from share.lab.robot.room import EmulatedRoom
from share.lab.robot.simulate import LoopRun
from share.plain_data import to_mapping
from share.robot.planar import PlanarPose
from share.types import F64

SCHEMA = 1
_TRUE_COLOUR, _MAP_COLOUR, _GOAL_COLOUR = "#3a97d4", "#d55e00", "#009e73"
_DIGITS = 4


def run_report(run: LoopRun, session: str) -> dict[str, Any]:
    """Return all figures as plain data. Angles in rad."""
    loop, options, outcomes = run.loop, run.options, run.outcomes
    errors = _place_errors(run)
    return {
        "schema": SCHEMA,
        "version": __version__,
        "code": code_digest(),
        "session": session,
        "localisation": options.localisation,
        "policy": options.policy,
        "seed": options.seed,
        "profile": options.profile,
        "faults": [to_mapping(fault) for fault in options.faults],
        "seconds": round(loop.now_ns / 1e9, 3),
        "reached_m": REACHED_M,
        "reached": sum(one.is_reached for one in outcomes),
        "ended": sum(one.has_ended for one in outcomes),
        "goals": [goal_report(outcome) for outcome in outcomes],
        "first_goals": [goal_report(outcome) for outcome in run.giver.first_goals],
        "place_error_m": None if not errors else round(median(errors), _DIGITS),
        "place_error_p95_m": None if not errors else round(float(np.percentile(errors, 95)), _DIGITS),
        "bumps": loop.base.bumps,
        "nearest_person_m": _number(loop.nearest_person_m),
        "lines": [[round(t, 3), text] for t, text in loop.lines],
    }


def goal_report(outcome: GoalOutcome) -> dict[str, Any]:
    """Return what became of a goal as plain data."""
    return {
        "goal": _pose(outcome.T_world_goal),
        "in_map": None if outcome.in_map is None else _pose(outcome.in_map),
        "map_id": outcome.map_id,
        "reached": outcome.is_reached,
        "says_reached": outcome.says_reached,
        "text": outcome.text,
        "attempts": outcome.attempts,
        "begun_s": _number(outcome.begun_s),
        "seconds": _number(outcome.seconds),
        "error_m": _number(outcome.error_m),
        "error_rad": _number(outcome.error_rad),
        "path_m": _number(outcome.path_m),
    }


def _pose(T: PlanarPose) -> list[float]:
    return [round(value, _DIGITS) for value in (T.x, T.y, T.yaw)]


def _number(value: float) -> float | None:
    return round(value, _DIGITS) if math.isfinite(value) else None


def _place_errors(run: LoopRun) -> list[float]:
    """Return how far the robot was from where it believed to be, by the map as the goals were given in it."""
    T = run.giver.T_map_room
    if T is None:
        return []
    return [
        (T.inverse() @ believed).distance_m(true)
        for _, true, believed, map_id in run.loop.trace
        if believed is not None and (run.giver.map_id is None or map_id == run.giver.map_id)
    ]


def outcome_rows(outcomes: Sequence[GoalOutcome]) -> list[list[str]]:
    """Return the table of goals: titles, and a row each."""
    rows = [["goal", "x m", "y m", "reached", "error m", "error °", "time s", "path m", "tries", "said"]]
    for number, one in enumerate(outcomes, 1):
        figures = [
            f"{one.error_m:.2f}",
            f"{math.degrees(one.error_rad):.0f}",
            f"{one.seconds:.1f}",
            f"{one.path_m:.1f}",
        ]
        known = figures if one.has_ended else ["–"] * len(figures)
        reached = "yes" if one.is_reached else "no" if one.has_ended else "–"
        where = [f"{one.T_world_goal.x:.2f}", f"{one.T_world_goal.y:.2f}"]
        rows.append([str(number), *where, reached, *known, str(one.attempts), one.text[:60]])
    return rows


def summary_text(report: dict[str, Any]) -> str:
    """Return a sentence of a run's figures."""
    goals = [goal for goal in report["goals"] if goal["error_m"] is not None]
    if not goals:
        return "no goal has come to its end"
    errors, seconds = ([goal[key] for goal in goals] for key in ("error_m", "seconds"))
    return (
        f"{report['reached']} of {len(goals)} goals reached within {report['reached_m']:g} m "
        f"by the truth; final error {median(errors):.2f} m (median), {max(errors):.2f} m at most; "
        f"{median(seconds):.1f} s each (median)"
    )


def draw_run(path: Path, room: EmulatedRoom, run: LoopRun) -> None:
    """Write a PNG: the room from above, the robot's true path, its path by the map, and the goals."""
    pyplot = agg_pyplot()
    length, width, _ = room.layout.size
    figure, axes = pyplot.subplots(figsize=(10, 10 * (width + 1.2) / (length + 1)), layout="constrained")
    draw_room(axes, room.layout)
    true = np.array([(T.x, T.y) for _, T, _, _ in run.loop.trace])
    axes.plot(*true.T, color=_TRUE_COLOUR, alpha=0.4, linewidth=5, label="true path")
    axes.plot(*_believed_path(run).T, color=_MAP_COLOUR, linewidth=1.2, label="path by the map")
    axes.plot(*true[0], "o", color=_TRUE_COLOUR, label="start")
    for number, one in enumerate(run.outcomes, 1):
        goal = one.T_world_goal
        style = "-" if one.is_reached else ":"
        axes.add_patch(
            pyplot.Circle((goal.x, goal.y), REACHED_M, fill=False, color=_GOAL_COLOUR, linestyle=style)
        )
        axes.annotate(str(number), (goal.x, goal.y), color=_GOAL_COLOUR, ha="center", va="center")
    for person in room.people:
        stamps = np.arange(person.path.start_ns, person.path.end_ns, 100_000_000)
        p = person.path.poses(stamps)[:, :2, 3]
        axes.plot(*p.T, color="#999999", linewidth=0.8, label=person.name)
    title = f"{run.options.localisation}, seed {run.options.seed}: {reached_text(run.outcomes)} goals reached"
    axes.set_title(f"{title} (circles: {REACHED_M:g} m)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=6, frameon=False)
    save_png(figure, path, 100)


def _believed_path(run: LoopRun) -> F64:
    """Return where the robot believed to be (N, 2), in the room; NaN where it did not know, or in another
    map."""
    T = run.giver.T_map_room
    points = []
    for _, _, believed, map_id in run.loop.trace:
        if T is None or believed is None or (run.giver.map_id is not None and map_id != run.giver.map_id):
            points.append((math.nan, math.nan))
        else:
            place = T.inverse() @ believed
            points.append((place.x, place.y))
    return np.array(points)
