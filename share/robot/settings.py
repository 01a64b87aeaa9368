"""Settings of a robot bridge: camera extrinsics, speed, accuracy and area limits."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from share.robot.area import DrivingArea
from share.types import F64

CREATE3_SPEED_M_S = 0.306  # a Create 3's own limit


@dataclass(frozen=True, eq=False)
class RobotSettings:
    """T_body_base (4, 4): takes coordinates in base_link to the agent's body. allow_goals: whether anything
    may move. max_sigma_m: a position in the map that is less sure stops the robot. edge_silence_s: so long
    a goal goes on without the edge. agent: whose poses; None: of the first that comes."""

    T_body_base: F64 = field(default_factory=lambda: np.eye(4))
    allow_goals: bool = False
    area: DrivingArea | None = None
    max_speed_m_s: float = 0.2
    max_sigma_m: float = 0.1
    edge_silence_s: float = 5.0
    agent: str | None = None
