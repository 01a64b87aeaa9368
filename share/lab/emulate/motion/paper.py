"""`paper:1` .. `paper:5`: the three agents of the paper's five experiments, 60 s in 9 x 6 x 4 m.

Path lengths: SHARE (IMWUT 10(3) 97, 2026). The recordings are not public; these are other paths of the same
lengths.
"""

from __future__ import annotations

from share.lab.emulate.motion.crowd import SimulatedAgent
from share.lab.emulate.motion.planned_motion import MotionPreferences
from share.lab.emulate.motion.robot import INITIAL_STILL_S

SECONDS = 60.0
NAMES = ("user1", "user2", "robot")
LENGTHS_M: dict[int, tuple[float, float, float]] = {
    1: (82.56, 17.21, 10.06),
    2: (33.39, 43.87, 10.88),
    3: (28.48, 35.66, 8.16),
    4: (54.02, 40.77, 23.91),
    5: (37.67, 34.17, 23.09),
}
_HEIGHTS_M = (1.70, 1.62, 0.35)
_MIN_WALK_SPEED, _MIN_DRIVE_SPEED = 0.80, 0.32  # m/s; agents with shorter paths pause more instead
# times the mean speed, which makes up for slowing down in bends
_BEND_FACTORS = {"person": 1.1, "robot": 1.3}
_START_DELAY_S = 2.4


def paper_agents(number: int) -> list[SimulatedAgent]:
    """Return the three agents of one experiment. Raises KeyError for a number outside 1 .. 5."""
    return [
        _paper_agent(name, length, height)
        for name, length, height in zip(NAMES, LENGTHS_M[number], _HEIGHTS_M, strict=True)
    ]


def _paper_agent(name: str, length: float, height: float) -> SimulatedAgent:
    body_kind = "robot" if name == "robot" else "person"
    mean = _BEND_FACTORS[body_kind] * length / (SECONDS - INITIAL_STILL_S - _START_DELAY_S)
    preferences = MotionPreferences(
        body_kind, max(mean, _MIN_DRIVE_SPEED if body_kind == "robot" else _MIN_WALK_SPEED), 0.0
    )
    return SimulatedAgent(name, preferences, height, length=length)
