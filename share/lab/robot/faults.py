"""Faults of a simulated robot's room, each at a time: --fault KIND@TIME[:SECONDS]."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from share.errors import UsageError
from share.lab.robot.loop import ROBOT, RobotLoop
from share.robot import robot_events as ev
from share.robot.goal_control import GOAL_PREFIX
from share.timing import seconds_to_ns

RIVAL = "another commander"
FAULTS = {
    "edge": "the edge is killed, and restarted with an empty map",
    "agent": "the robot's agent is killed, and restarted",
    "network": "nothing goes between robot and edge",
    "bare-wall": "the robot's cameras see nothing but a bare wall",
    "bridge": "the bridge is killed, and restarted",
    "rival": "a second commander sends the robot to its start",
}
_USUAL_S = 3.0


@dataclass(frozen=True)
class LoopFault:
    """A fault of a kind of `FAULTS`, from at_s on for `seconds`."""

    kind: str
    at_s: float
    seconds: float = _USUAL_S


def parse_fault(text: str) -> LoopFault:
    """Return the fault. Raises UsageError that lists the kinds."""
    found = re.fullmatch(r"([a-z-]+)@(\d+(?:\.\d+)?)(?::(\d+(?:\.\d+)?))?", text)
    if found is None or found[1] not in FAULTS:
        kinds = ", ".join(FAULTS)
        raise UsageError(f"--fault {text}: expected KIND@TIME[:SECONDS] such as edge@20:5; kinds: {kinds}")
    return LoopFault(found[1], float(found[2]), float(found[3] or _USUAL_S))


def schedule_faults(loop: RobotLoop, faults: Sequence[LoopFault]) -> None:
    """Let faults happen in a loop that has not begun."""
    for fault in faults:
        begin, end = _actions(loop, fault)
        loop.schedule(seconds_to_ns(fault.at_s), begin)
        loop.schedule(seconds_to_ns(fault.at_s + fault.seconds), end)


def _actions(loop: RobotLoop, fault: LoopFault) -> tuple[Callable[[], None], Callable[[], None]]:
    match fault.kind:
        case "edge":
            return loop.kill_edge, loop.start_edge
        case "agent":
            return loop.kill_robot_agent, loop.start_robot_agent
        case "network":
            return lambda: loop.cut_network(ROBOT, fault.seconds), _nothing
        case "bare-wall":
            return lambda: loop.show_bare_wall(True), lambda: loop.show_bare_wall(False)
        case "bridge":
            return loop.kill_bridge, loop.start_bridge
        case _:
            goal = ev.GotoRequested(RIVAL, GOAL_PREFIX + b"rival  \x00", 0.0, 0.0)
            return lambda: loop.to_bridge(goal), _nothing


def _nothing() -> None:
    """A fault that ends by itself."""
