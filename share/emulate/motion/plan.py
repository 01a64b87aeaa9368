"""Who moves where in a room: from what a user asks for to paths that touch neither it nor each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from share.emulate.motion.spec import parse
from share.emulate.types import Path
from share.emulate.world.layout import Layout
from share.errors import UsageError
from share.geometry.camera import ImuNoise
from share.types import F64, I64, AgentKind


@dataclass(frozen=True, eq=False)
class Agent:
    """One who moves. look: what the others see of it, `person`, `robot` or `drone`.

    T_body_cam0 (4, 4): how the camera sits on the body, where a recorded motion brings its own rig, else
    None: the sensor's profile says (a simulated body is the profile's IMU). imu: noise of its recorded IMU. images_ns (M,): stamps of
    the recorded images, where there are any. spec: what the user asked for. notes: for a person.
    """

    name: str
    kind: AgentKind
    look: str
    path: Path
    spec: str
    T_body_cam0: F64 | None = None
    images_ns: I64 | None = None
    imu: ImuNoise | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Plan:
    """layout: the room, less what stood in the way of recorded flights. Paths begin together: each
    one's start_ns is the session's first instant, in a clock of its own. notes: for a person."""

    layout: Layout
    agents: tuple[Agent, ...]
    notes: tuple[str, ...] = ()


def plan(specs: Sequence[str], layout: Layout, seconds: float, seed: int) -> Plan:
    """The agents of `specs` (`[NAME=]SPEC`) in the room, for `seconds`; the same every time for a seed.

    Raises UsageError for a spec that cannot be understood, a name given twice, or paths for which the
    room has no place, DataError for a recording that is damaged.
    """
    parsed = [parse(text) for text in specs]
    if not parsed:
        raise UsageError("nobody moves; give at least one --motion, for example walk:")
    raise NotImplementedError  # until the planners are in
