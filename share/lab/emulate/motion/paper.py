"""`paper:1` .. `paper:5`: the three agents of the paper's five experiments, 60 s in 9 x 6 x 4 m.

Path lengths: SHARE (IMWUT 10(3) 97, 2026). The recordings are not public; these are other paths of the
same lengths.
"""

from __future__ import annotations

from share.lab.emulate.motion.crowd import Member
from share.lab.emulate.motion.robot import STILL_S
from share.lab.emulate.motion.together import Wish

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
_STROLL, _DRIVE = 0.80, 0.32  # m/s; who has less far to go stands more, not slower
_BENDS = {"person": 1.1, "robot": 1.3}  # times the mean speed: what bends cost must be made good
_BEGIN_S = 2.4


def members(number: int) -> list[Member]:
    """The three agents of one experiment. Raises KeyError for another number than 1 .. 5."""
    return [
        _member(name, length, height)
        for name, length, height in zip(NAMES, LENGTHS_M[number], _HEIGHTS_M, strict=True)
    ]


def _member(name: str, length: float, height: float) -> Member:
    look = "robot" if name == "robot" else "person"
    mean = _BENDS[look] * length / (SECONDS - STILL_S - _BEGIN_S)
    wish = Wish(look, max(mean, _DRIVE if look == "robot" else _STROLL), 0.0)
    return Member(name, wish, height, length=length)
