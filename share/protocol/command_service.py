"""The edge's part in commanding robots: it checks rights and forwards. The bridge decides what is safe."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from share.errors import printable
from share.geometry import se3
from share.protocol.client_registry import Client, ClientRegistry, permission_objection
from share.protocol.edge_events import PeerMessageReceived
from share.protocol.edge_records import EdgeOutput
from share.protocol.known_maps import KnownMaps
from share.wire.room_messages import (
    MAX_ANSWER_LENGTH,
    Cancel,
    CommandState,
    Goto,
    Permission,
    RobotPlace,
)

GONE_S = 10.0  # without a bridge of its robot for so long a goal ends
_MAX_PASSED = 4096  # commands; those under way are repeated twice a second


class CommandService:
    """Forwards commands to the bridges of robots, and their states to commanders and all that want robots.

    places: last position of each robot. A bridge reports only on commands that were forwarded to it."""

    def __init__(self, out: EdgeOutput, clients: ClientRegistry, maps: KnownMaps) -> None:
        self._out, self._clients, self._maps = out, clients, maps
        self.places: dict[str, RobotPlace] = {}
        self._passed: dict[tuple[str, int], str] = {}  # commander and number to robot; newest repeated last

    def on_command(self, event: PeerMessageReceived, client: Client, command: Goto | Cancel) -> None:
        """Pass a command on, or answer why not."""
        now_ns = self._out.now_ns
        if not self._clients.commands.bucket(client.name, now_ns).take(now_ns):
            client.count("over_rate", "more commands than 10 a second", now_ns)
            return
        known = client.commands.get(command.command)
        if known is not None and known.final is not None:
            self._clients.send(client, known.final)
            return
        if known is None and command.command < client.newest_command:
            self._end(client, command, "overtaken by a later command")
            return
        # that of its first passing: it goes on where another robot has come since
        robot = command.robot or (known and known.robot) or self._only_robot()
        bridge = None if robot is None else self._clients.bridge(robot)
        objection = self._objection(event, client, command, bridge)
        client.remember_command(command.command, None if bridge is None else bridge.name)
        gone_s = client.mark_robot(command.command, bridge is not None, now_ns)
        if objection is not None:
            self._end(client, command, self._clients.refuse(client, "refused", objection))
        elif bridge is None:  # the repetition finds it when it is back; the robot stops by itself meanwhile
            text = f"robot '{robot or '?'}' is not connected"
            if gone_s < GONE_S:
                state = CommandState(command.command, command.robot, client.name, text)
                self._clients.send(client, state)
            else:
                gone = f"robot '{robot or '?'}' has not been connected for {gone_s:.0f} s"
                self._end(client, command, f"{gone}; give the goal again", "given up")
        else:
            if known is None:
                self._record(client, command, bridge.name)
            self._remember_passed((client.name, command.command), bridge.name)
            passed = replace(command, robot=bridge.name, commander=client.name)
            self._clients.send(bridge, self._in_present_map(passed))

    def _remember_passed(self, command: tuple[str, int], robot: str) -> None:
        self._passed.pop(command, None)
        self._passed[command] = robot
        if len(self._passed) > _MAX_PASSED:
            del self._passed[next(iter(self._passed))]

    def _objection(
        self, event: PeerMessageReceived, client: Client, command: Goto | Cancel, bridge: Client | None
    ) -> str | None:
        """Return why a command is not passed on; None if it is, or may be as soon as the robot is back."""
        if isinstance(command, Goto):
            objection = permission_objection(client.name, Permission.COMMANDS, event)
            if objection is not None or command.has_begun:
                return objection
        if bridge is not None:
            return None
        robots = self._clients.robots()
        if command.robot is None and len(robots) > 1:
            return f"there are {len(robots)} robots; name one of {', '.join(robots)}"
        named = "no robot" if command.robot is None else f"no robot '{command.robot}'"
        others = f"; there is {', '.join(robots)}" if robots else ""
        return f"{named} is connected: start its bridge with --edge{others}"

    def _only_robot(self) -> str | None:
        robots = self._clients.robots()
        return robots[0] if len(robots) == 1 else None

    def _in_present_map(self, command: Goto | Cancel) -> Goto | Cancel:
        """Return a goal in the map that stands in the place of its own; else as it is: the bridge refuses."""
        if not isinstance(command, Goto) or command.map_id is None or command.map_id in self._maps:
            return command
        R = se3.so3_exp(np.array([0.0, 0.0, command.yaw or 0.0]))
        placed = self._maps.place(command.map_id, se3.from_rt(R, np.array([command.x, command.y, 0.0])))
        if placed is None:
            return command
        map_id, T = placed
        yaw = None if command.yaw is None else math.atan2(float(T[1, 0]), float(T[0, 0]))
        try:
            return replace(command, map_id=map_id, x=float(T[0, 3]), y=float(T[1, 3]), yaw=yaw)
        except ValueError:
            return command

    def _record(self, client: Client, command: Goto | Cancel, robot: str) -> None:
        where = "stops" if isinstance(command, Cancel) else f"to x {command.x:.2f} y {command.y:.2f} m"
        said = f"'{client.name}' sends robot '{robot}': {where}"
        self._out.record("robot commanded", None, said, client=client.name)

    def _end(self, client: Client, command: Goto | Cancel, reason: str, kind: str = "refused") -> None:
        text = printable(f"{kind}: {reason}")[:MAX_ANSWER_LENGTH]
        final = CommandState(command.command, command.robot, client.name, text, is_final=True)
        client.remember_command(command.command, final=final)
        self._clients.send(client, final)

    # ------------------------------------------------------------ from bridges

    def on_state(self, bridge: Client, state: CommandState) -> None:
        """Pass on what becomes of a command, from the robot that it was passed to and no other."""
        if not self._may_say(bridge):
            return
        if self._passed.get((state.commander, state.command)) != bridge.name:
            reason = "states of commands that were not passed to it"
            bridge.count("unexpected", reason, self._out.now_ns)
            return
        state = replace(state, robot=bridge.name)
        for client in self._clients:
            known = client.commands.get(state.command) if client.name == state.commander else None
            if known is not None and known.robot == bridge.name:
                if state.is_final and known.final is None:
                    said = f"robot '{bridge.name}', sent by '{client.name}': {state.text}"
                    self._out.record("robot answered", None, said, client=client.name)
                client.remember_command(state.command, final=state if state.is_final else None)
                self._clients.send(client, state)
            elif client.hello.wants_robots:
                self._clients.send(client, state)

    def on_place(self, bridge: Client, place: RobotPlace) -> None:
        """Remember where a robot is, and tell all that want it."""
        if not self._may_say(bridge):
            return
        self.places[bridge.name] = place = replace(place, robot=bridge.name)
        self._clients.send_all([one for one in self._clients if one.hello.wants_robots], place)

    def _may_say(self, bridge: Client) -> bool:
        now_ns = self._out.now_ns
        if not bridge.hello.drives_robot:
            bridge.count("unexpected", "states of a robot from a client that drives none", now_ns)
            return False
        if self._clients.states.bucket(bridge.name, now_ns).take(now_ns):
            return True
        bridge.count("over_rate", "more states of a robot than 20 a second", now_ns)
        return False

    def report(self) -> Mapping[str, object]:
        """Return where the robots with a bridge are, as plain data."""
        self.places = {name: one for name, one in self.places.items() if name in self._clients.robots()}
        return {
            name: {
                "map_id": one.map_id,
                "pose": None if one.map_id is None else [one.x, one.y, one.yaw],
                "text": one.text,
            }
            for name, one in self.places.items()
        }
