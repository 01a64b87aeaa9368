"""The robot's topics by way of a node on the robot (`share_robot_node`), in place of DDS.

The node connects here. With keys the link is encrypted (CURVE, RFC 26) and only the holder of the robot's key
is let in (ZAP, RFC 27); without, only this machine: forged odometry steers the robot as a forged pose does.
"""

from __future__ import annotations

import base64
import math
import secrets
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq
from zmq.utils import z85

from share.errors import printable
from share.files.json_file import parse_json
from share.geometry.se3 import quat_from_matrix
from share.net.backlog import BacklogLimits, wire_bytes
from share.net.connection_gate import Blocklist
from share.net.connection_guard import ConnectionGuard
from share.net.keys import KeyPair
from share.net.transport import bind_error, check_keys, parse_address
from share.net.zeromq_socket import MAX_PARTS, ZmqSocket, make_curve_server
from share.robot import robot_events as ev
from share.robot.grid import FloorMap
from share.robot.planar import PlanarPose
from share.robot.share_robot_node import HEARTBEAT_NS, SILENT_NS, VERSION, Freshness
from share.timing import LineLimiter, PeriodicTimer
from share.types import F64

_ZAP_DOMAIN = b"share-node"
_MAX_MESSAGE_BYTES = 1 << 16
_OPTIONS: dict[int, int] = {zmq.ROUTER_MANDATORY: 1, zmq.SNDHWM: 50, zmq.MAXMSGSIZE: _MAX_MESSAGE_BYTES}
_MAX_MESSAGES = 200  # in one poll
_MAX_NODES = 8
_FIXED_S = 2.0  # between two attempts to give the node the map


@dataclass(frozen=True)
class NodeKeys:
    """The bridge's own pair, and the public key of the robot's node."""

    own: KeyPair
    node: str


class NodeLink:
    """Listens at `address` for the robot's node. print_line: takes lines for a person.

    Raises UsageError for an address that other machines can reach without keys, TransportError if it cannot
    be bound.
    """

    def __init__(self, address: str, keys: NodeKeys | None, print_line: Callable[[str], None]) -> None:
        target = check_keys(parse_address(address, bind=True), keys)
        self._print_line, self._line_limiter = print_line, LineLimiter()
        self._nodes: dict[bytes, Freshness] = {}  # by the socket's name of each; only the first is heard
        self._first_since_ns = 0
        self._heard_ns: dict[bytes, int] = {}
        self._sent_ns = 0
        self._fixed: dict[str, Any] = {"name": secrets.token_hex(4)}
        self._fixed_timer = PeriodicTimer(_FIXED_S)
        self._link = ZmqSocket(zmq.ROUTER, _OPTIONS, target)
        self._gate = None if keys is None else _NodeGate(self._link, keys)
        self._guard = _PortGuard(self._link) if keys is None else None  # any program here may connect
        try:
            self._link.socket.bind(str(target))
        except zmq.ZMQError as error:
            self.close()
            raise bind_error(target, error.errno, error.strerror, other="bridge") from None
        self.endpoint = self._link.socket.get_string(zmq.LAST_ENDPOINT).rstrip("\0")

    # ------------------------------------------------------------ in

    def poll(self, now_ns: int) -> list[ev.RobotEvent]:
        """Return what has come; never waits."""
        if self._gate is not None and self._gate.serve():
            self._say(f"a node was refused: its key is not that of --node-key ({self.endpoint})")
        receive = self._link.receive_now if self._guard is None else self._guard.receive_now
        events: list[ev.RobotEvent] = []
        for _ in range(_MAX_MESSAGES):
            if (parts := receive()) is None:
                break
            events += self._take(parts, now_ns)
        for line in [] if self._guard is None else self._guard.take_reports():
            self._say(f"a program at the node's port: {line}", "guard")
        for name in [one for one, heard_ns in self._heard_ns.items() if now_ns - heard_ns > SILENT_NS]:
            self._forget(name, now_ns)
        if len(self._nodes) > 1 and self._is_first_mute(now_ns):
            self._put_last(next(iter(self._nodes)), now_ns)
        if now_ns - self._sent_ns > HEARTBEAT_NS:
            self._send({})
        return events

    def _forget(self, name: bytes, now_ns: int) -> None:
        is_first = name == next(iter(self._nodes))
        del self._heard_ns[name], self._nodes[name]
        if is_first:
            self._first_since_ns = now_ns
        if not self._nodes:
            self._print_line("the robot's node is gone")

    def _is_first_mute(self, now_ns: int) -> bool:
        """Return whether the first node answers nothing that is sent to it, so is none of ours."""
        first = next(iter(self._nodes.values()))
        return now_ns - max(self._first_since_ns, first.heard_ns or 0) > SILENT_NS

    def _put_last(self, name: bytes, now_ns: int) -> None:
        self._nodes[name] = self._nodes.pop(name)
        self._first_since_ns = now_ns

    def _add(self, name: bytes, now_ns: int) -> None:
        self._nodes[name] = Freshness(secrets.randbits(61))
        if len(self._nodes) == 1:
            self._first_since_ns = now_ns
            self._print_line("the robot's node has connected")
        else:
            self._say(
                f"{len(self._nodes)} programs speak as the robot's node at {self.endpoint}; one is heard, "
                "so end the others, or use keys",
                "more nodes",
            )

    def _take(self, parts: list[zmq.Frame], now_ns: int) -> list[ev.RobotEvent]:
        if len(parts) != 2:
            return []
        name = parts[0].bytes
        if name not in self._nodes and len(self._nodes) >= _MAX_NODES:
            return []
        try:
            message = parse_json(parts[1].bytes)
            if message["version"] != VERSION:
                self._say("the robot's node is of another release; write it anew with `share robot node`")
                return []
            if name not in self._nodes:
                self._add(name, now_ns)
            fresh = self._nodes[name]
            self._heard_ns[name] = now_ns
            if not fresh.take(message, now_ns) or name != next(iter(self._nodes)):
                return []
            return self._events(message)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            text = f"what comes from the robot's node is not understood: {printable(str(error))[:80]}"
            self._say(text, "nonsense")
            return []

    def _events(self, message: dict[str, Any]) -> list[ev.RobotEvent]:
        if "found" in message and message["found"]["has"] != self._fixed["name"]:
            self._offer_fixed()
        return node_events(message, time.time_ns(), len(self._nodes))

    # ------------------------------------------------------------ out

    def publish_map_odom(self, stamp_ns: int, T_map_odom: PlanarPose) -> None:
        self._send({"tf": [stamp_ns, *_numbers(T_map_odom)]})

    def publish_body(self, T_base_body: F64) -> None:
        quat = quat_from_matrix(T_base_body[:3, :3])
        self._fixed["body"] = [*T_base_body[:3, 3].tolist(), *quat.tolist()]

    def publish_grid(self, grid: FloorMap) -> None:
        self._fixed |= {
            "size": list(grid.cells.shape),
            "resolution": grid.resolution_m,
            "origin": _numbers(grid.origin),
            "cells": base64.b64encode(zlib.compress(grid.cells.tobytes(), 9)).decode(),
        }

    def _offer_fixed(self) -> None:
        """Give the node the map and the body's place, until it says that it has them."""
        if {"body", "size"} <= self._fixed.keys() and self._fixed_timer.fire_if_due(time.monotonic_ns()):
            self._send({"fixed": self._fixed})

    def limit_speed(self, speed_m_s: float) -> None:
        self._send({"speed": speed_m_s})

    def send_goal(self, goal: ev.SendGoal) -> None:
        self._send({"goal": [goal.goal_id.hex(), goal.stamp_ns, *_numbers(goal.T_map_base)]})

    def cancel_goal(self, goal_id: bytes) -> None:
        self._send({"cancel": goal_id.hex()})

    def ask_result(self, goal_id: bytes) -> None:
        self._send({"ask": goal_id.hex()})

    def _send(self, message: dict[str, Any]) -> None:
        """Send to the node; nothing waits for one that is not there."""
        self._sent_ns = time.monotonic_ns()
        for name, fresh in list(self._nodes.items())[:1]:
            self._link.send([name, fresh.stamped({"version": VERSION, **message}, self._sent_ns)])

    def close(self) -> None:
        if self._gate is not None:
            self._gate.close()
        if self._guard is not None:
            self._guard.close()
        self._link.close()

    def _say(self, text: str, kind: str | None = None) -> None:
        if (line := self._line_limiter.admit_new(text, time.monotonic_ns(), kind)) is not None:
            self._print_line(line)


class _NodeGate:
    """Makes a socket a CURVE server that one key may enter. Must be created before the socket is bound."""

    def __init__(self, link: ZmqSocket, keys: NodeKeys) -> None:
        self._key = keys.node
        self._requests = make_curve_server(link.context, link.socket, keys.own, _ZAP_DOMAIN)

    def serve(self) -> int:
        """Answer the handshakes that wait. Return how many were refused."""
        refused = 0
        while self._requests.poll(0):
            version, number, _domain, _address, _identity, _mechanism, *credentials = (
                self._requests.recv_multipart()
            )
            is_right = len(credentials) == 1 and z85.encode(credentials[0]).decode() == self._key
            # 300: temporary, so that libzmq tries again: --node-key may be mended
            answer = [b"200", b"", b"node"] if is_right else [b"300", b"another key", b""]
            self._requests.send_multipart([version, number, *answer, b""])
            refused += not is_right
        return refused

    def close(self) -> None:
        self._requests.close(0)


class _PortGuard:
    """Bounds what libzmq holds of each connection. Must be created before the socket is bound."""

    def __init__(self, link: ZmqSocket) -> None:
        self._link = link
        limits = BacklogLimits.for_frame_size(_MAX_MESSAGE_BYTES)
        self._guard = ConnectionGuard(link.socket, limits, Blocklist(), link.wake)

    def receive_now(self) -> list[zmq.Frame] | None:
        """Return the next message; empty: one to be discarded; None: there is none."""
        self._guard.check()
        if (parts := self._link.receive_now()) is None:
            self._guard.record_empty(self._link.last_empty_s)
            return None
        try:
            descriptor = int(parts[0].get(zmq.SRCFD))
        except zmq.ZMQError:  # a ZMTP 1.0 peer has none
            return []
        if self._guard.is_discarding(descriptor):
            return []
        size = sum(wire_bytes(len(part), is_encrypted=False) for part in parts[1:])
        self._guard.deliver(descriptor, size, len(parts) - 1, "")
        if len(parts) > MAX_PARTS:
            self._guard.report_offence(descriptor, "a message of too many parts")
        return parts

    def take_reports(self) -> list[str]:
        """Return a line for each disconnection since the last call."""
        return self._guard.take_reports()

    def close(self) -> None:
        self._guard.close()


def node_events(message: dict[str, Any], unix_ns: int, nodes: int) -> list[ev.RobotEvent]:
    """Return the events of a node's message. unix_ns: when it came. nodes: how many are connected. Raises
    LookupError, TypeError or ValueError for what no node sends."""
    events: list[ev.RobotEvent] = []
    if "odometry" in message:
        stamp_ns, *values = message["odometry"]
        x, y, yaw, speed = (math.nan if one is None else float(one) for one in values)
        events.append(ev.OdometryReceived(int(stamp_ns), unix_ns, PlanarPose(x, y, yaw), speed))
    if "foreign" in message:
        events.append(ev.ForeignMapFrame(str(message["foreign"])))
    if "status" in message:
        goals = ((bytes.fromhex(goal), status) for goal, status in message["status"])
        known = tuple((goal, ev.GoalStatus.of_ros(status)) for goal, status in goals)
        events.append(ev.StatusReceived(known))
    if "feedback" in message:
        goal, distance_m = message["feedback"]
        events.append(ev.FeedbackReceived(bytes.fromhex(goal), float(distance_m)))
    if "accepted" in message:
        events.append(ev.GoalAnswered(bool(message["accepted"])))
    if "result" in message:
        code, text = message["result"]
        events.append(ev.ResultReceived(int(code), str(text)))
    if "found" in message:
        found = message["found"]
        others = tuple(printable(str(one))[:64] for one in found["others"][:8])
        events.append(
            ev.RobotDiscovered(
                int(found["servers"]),
                int(found["odometry"]) if nodes == 1 else nodes,
                others,
                printable(str(found["release"]))[:16],
                has_participants=bool(found["participants"]),
            )
        )
    return events


def _numbers(pose: PlanarPose) -> list[float]:
    return [pose.x, pose.y, pose.yaw]
