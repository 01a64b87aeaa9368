"""Goals of a simulated robot: drawn or from a file, given one after another, and what became of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import UsageError
from share.files.reading import MAX_TABLE_BYTES, read_bytes
from share.lab.emulate.motion.robot import RADIUS
from share.lab.robot.planner import RoomGrid
from share.robot.planar import PlanarPose, wrapped
from share.types import F64

REACHED_M = 0.35  # of the true place; Nav2's own tolerance is 0.25
_WAY_M = (2.0, 6.0)  # of a drawn goal
_GOAL_CLEARANCE_M = RADIUS + 0.25
GIVER = "goal giver"


@dataclass(eq=False)
class GoalOutcome:
    """One goal. T_world_goal: true place meant. in_map: as it was given, last; map_id: in which map.

    text: what the bridge said last; reached: whether the true place is within REACHED_M after the robot said
    so. error_m, error_rad: true, after the last attempt. seconds: from the first attempt. path_m: driven.
    attempts: 1 and more, where the map moved and the goal was given again.
    """

    T_world_goal: PlanarPose
    in_map: PlanarPose | None = None
    map_id: str | None = None
    begun_s: float = math.nan
    text: str = ""
    says_reached: bool = False
    error_m: float = math.nan
    error_rad: float = math.nan
    seconds: float = math.nan
    path_m: float = 0.0
    attempts: int = 0

    @property
    def is_reached(self) -> bool:
        """Whether the robot is where it was sent, by the truth."""
        return self.says_reached and self.error_m <= REACHED_M

    @property
    def has_ended(self) -> bool:
        """Whether the end was measured; not so for a goal under way when the run ended."""
        return math.isfinite(self.error_m)

    def finish(self, T_world_base: PlanarPose, now_s: float) -> None:
        """Measure the end."""
        self.error_m = T_world_base.distance_m(self.T_world_goal)
        self.error_rad = abs(wrapped(T_world_base.yaw - self.T_world_goal.yaw))
        self.seconds = now_s - self.begun_s


def drawn_goals(grid: RoomGrid, rng: np.random.Generator) -> Callable[[PlanarPose], PlanarPose]:
    """Return what draws the next goal from where the robot is: 2 to 6 m of way from there, off obstacles.

    The first that fits of a random order: robots that end a little apart mostly get the same.
    """

    def draw(T_world_base: PlanarPose) -> PlanarPose:
        lengths = grid.lengths_from(np.array([T_world_base.x, T_world_base.y]))
        clear = grid.floor.clearance_at(grid.places) >= _GOAL_CLEARANCE_M
        order = rng.permutation(len(grid.places))
        fits = (clear & (lengths >= _WAY_M[0]) & (lengths <= _WAY_M[1]))[order]
        if not fits.any():
            raise UsageError("the room has no free place 2 to 6 m from the robot; take a larger room")
        x, y = grid.places[order[int(np.argmax(fits))]].tolist()
        return PlanarPose(x, y, float(rng.uniform(-math.pi, math.pi)))

    return draw


def read_goals(path: Path) -> list[PlanarPose]:
    """Read goals in the room, one a line: X Y [YAW], m and degrees. Raises UsageError that names the line."""
    if not path.is_file():
        raise UsageError(f"--goals {path}: is neither a number nor a file")
    goals = []
    for number, line in enumerate(read_bytes(path, MAX_TABLE_BYTES).decode(errors="replace").splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            x, y, yaw = (float(word) for word in (*words, "0")[: max(3, len(words))])
            goal = PlanarPose(x, y, math.radians(yaw))
            if not goal.is_finite:
                raise ValueError
        except ValueError:
            text = line.strip()[:60]
            raise UsageError(f"{path}: line {number}: expected X Y [YAW], found '{text}'") from None
        goals.append(goal)
    if not goals:
        raise UsageError(f"{path}: has no goals; write one a line: X Y [YAW]")
    return goals


def start_pose(grid: RoomGrid, people: F64, rng: np.random.Generator) -> PlanarPose:
    """Return a free place for the robot that is not at people's feet (P, 2), looking along the longest free
    way."""
    component = np.isfinite(grid.lengths_from(grid.places[np.argmax(grid.floor.clearance_at(grid.places))]))
    places = grid.places[component & (grid.floor.clearance_at(grid.places) >= _GOAL_CLEARANCE_M)]
    for person in people:
        places = places[np.linalg.norm(places - person, axis=1) > 1.0]
    if not len(places):
        raise UsageError("the room has no free place for a robot; take a larger room")
    xy = places[int(rng.integers(len(places)))]
    x, y = xy.tolist()
    yaws = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    yaw = max(yaws.tolist(), key=lambda angle: _free_way_m(grid, xy, angle))
    return PlanarPose(x, y, yaw)


def _free_way_m(grid: RoomGrid, xy: F64, yaw: float) -> float:
    steps = 0.1 * np.arange(1, 80)[:, None]
    ahead = grid.floor.clearance_at(xy + steps * (math.cos(yaw), math.sin(yaw))) > 0.05
    return float(np.argmin(ahead)) if not ahead.all() else float(len(ahead))


def reached_text(outcomes: Sequence[GoalOutcome]) -> str:
    """Return how many goals of those that came to an end were reached by the truth."""
    return f"{sum(one.is_reached for one in outcomes)} of {sum(one.has_ended for one in outcomes)}"
