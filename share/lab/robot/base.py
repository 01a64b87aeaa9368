"""The emulated robot in its room: its drive, bumped by what stands there, and the path of its camera."""

from __future__ import annotations

import math

import numpy as np

from share.lab.emulate.motion.robot import RADIUS
from share.lab.robot.body import BodyPath
from share.lab.robot.drive import STEP_NS, DifferentialDrive, DriveModel, DriveStep
from share.lab.robot.planner import RoomGrid
from share.robot.planar import PlanarPose
from share.timing import seconds_to_ns
from share.types import F64

_BUMPER_M = RADIUS - 0.03  # a Create 3 is 34 cm wide
_AHEAD_M = 0.03
_PERSON_M, _PERSON_RAD = (
    0.55,
    1.2,
)  # nearer and ahead: it waits (Nav2's collision monitor); less than plans keep off


class RobotBase:
    """steps: the base each STEP_NS from time 0, as far as it is decided."""

    def __init__(
        self,
        model: DriveModel,
        grid: RoomGrid,
        T_world_base: PlanarPose,
        T_base_body: F64,
        seconds: float,
        rng: np.random.Generator,
    ) -> None:
        drive_rng, body_rng = rng.spawn(2)
        self._latency_ns, self._grid = seconds_to_ns(model.latency_s), grid
        self._drive = DifferentialDrive(model, T_world_base, drive_rng)
        self.body = BodyPath(T_base_body, seconds + 1.0, body_rng)
        self.steps: list[DriveStep] = [self._drive.last]
        self.body.add(self._drive.last)
        self.bumps = 0
        self._was_blocked = False

    def advance(self, now_ns: int) -> None:
        """Go on as far as commands until now decide."""
        while self._drive.now_ns + STEP_NS < now_ns + self._latency_ns:
            is_blocked = self._is_blocked()
            self.bumps += is_blocked and not self._was_blocked
            self._was_blocked = is_blocked
            self.steps.append(self._drive.step(is_blocked))
            self.body.add(self.steps[-1])

    def command(self, now_ns: int, speed_m_s: float, turn_rad_s: float) -> None:
        self.advance(now_ns)
        self._drive.command(now_ns, speed_m_s, turn_rad_s)

    def at(self, now_ns: int) -> DriveStep:
        """Return the base at a time up to now."""
        self.advance(now_ns)
        return self.steps[now_ns // STEP_NS]

    def driven_m(self, first_ns: int, last_ns: int) -> float:
        """Return the way between two times, m."""
        part = self.steps[first_ns // STEP_NS : last_ns // STEP_NS + 1]
        return sum(abs(step.speed_m_s) for step in part) * STEP_NS / 1e9

    def _is_blocked(self) -> bool:
        here = self._drive.last.T_world_base
        ahead_m = self._grid.clearance(here @ PlanarPose(_AHEAD_M, 0.0, 0.0))
        return ahead_m < _BUMPER_M and ahead_m < self._grid.clearance(here)


def is_person_ahead(T_world_base: PlanarPose, people: F64) -> bool:
    """Return whether one of people (P, 2) is near and ahead."""
    for x, y in people.tolist():
        seen = T_world_base.inverse() @ PlanarPose(x, y, 0.0)
        if math.hypot(seen.x, seen.y) < _PERSON_M and abs(math.atan2(seen.y, seen.x)) < _PERSON_RAD:
            return True
    return False
