"""The room of a simulated trial: `share.lab.robot.loop`, with commands that pass the network, and replayed
agents of another room that use the same air and the same edge."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from share.geometry.camera import Rig
from share.lab.emulate.types import START_NS
from share.lab.evaluate.emulated_network import NetworkModel
from share.lab.evaluate.kept_steps import KeptSteps
from share.lab.evaluate.simulation import TrackedFrame
from share.lab.robot.loop import ROBOT, Member, RobotLoop
from share.lab.robot.planner import RoomGrid
from share.robot import robot_events as ev
from share.timing import seconds_to_ns
from share.types import AgentKind
from share.wire.codec import encode, message_bytes
from share.wire.messages import Hello
from share.wire.room_messages import CommandState, Goto

_ACCESS_POINT = ""
_REPLAY_RUN = 2000  # run id of the first replayed agent
_REPLAY_STEP_S = 1.7  # between the beginnings of two


class StudyLoop(RobotLoop):
    """Commands go from a headset to the edge, and on to the robot; answers the way back. Each is one message,
    behind what its device has sent before."""

    kept_steps = KeptSteps()  # of all trials of a process

    def _run_step(self, step: Any) -> object:
        return self.kept_steps.run(step)

    @property
    def grid(self) -> RoomGrid:
        return self._grid

    def command(self, commander: str, request: ev.GotoRequested) -> None:
        """Send a goal from a headset to the robot's bridge."""
        message = Goto(1, ROBOT, commander, request.map_id, request.x, request.y, request.yaw)
        size = message_bytes(encode(message))
        self._pass_on(commander, ROBOT, size, lambda: self.to_bridge(request))

    def answer(self, commander: str, report: ev.GoalReport, heard: Callable[[], None]) -> None:
        """Call `heard` when a report of the bridge has come to the commander's headset."""
        state = CommandState(1, ROBOT, commander, report.text[:200], report.is_final, report.is_reached)
        self._pass_on(ROBOT, commander, message_bytes(encode(state)), heard)

    def _pass_on(self, sender: str, receiver: str, size: int, done: Callable[[], None]) -> None:
        up, down = self.run_of(sender), self.run_of(receiver)

        def at_edge() -> None:
            self._over_the_air(down, _ACCESS_POINT, size, arrive)

        def arrive() -> None:
            self.schedule(down.down.arrival_ns(size, self.now_ns) - self.now_ns, done)

        def leave() -> None:
            delay_ns = up.up.arrival_ns(size, self.now_ns) + self._draw(self._delays.receive) - self.now_ns
            self.schedule(delay_ns, at_edge)

        self._over_the_air(up, up.name, size, leave)


def replayed_members(
    rig: Rig, frames: Sequence[TrackedFrame], count: int, network: NetworkModel
) -> list[Member]:
    """Return `count` agents that replay what one recording of another room gave, each later than the one
    before; every third as a robot, which policies treat otherwise."""
    members: list[Member] = []
    for k in range(count):
        kind = AgentKind.ROBOT if k % 3 == 2 else AgentKind.AR
        hello = Hello(f"other{k + 1}", kind, _REPLAY_RUN + k, rig)
        members.append((hello, _later(frames, seconds_to_ns(_REPLAY_STEP_S * k)), network))
    return members


def _later(frames: Sequence[TrackedFrame], later_ns: int) -> Iterator[TrackedFrame]:
    for frame in frames:
        stamp_ns = None if frame.stamp_ns is None else frame.stamp_ns + later_ns
        yield replace(frame, arrival_ns=frame.arrival_ns - START_NS + later_ns, stamp_ns=stamp_ns)
