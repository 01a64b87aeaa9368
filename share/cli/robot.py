"""`share robot`: let a ROS 2 robot drive by the shared map, and send it to places."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options, room_options
from share.cli.commands import CommandGroup
from share.cli.robot_links import GoalUpdate, LocalRobot, RobotAtEdge, RobotLink
from share.cli.terminal import LiveLine
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.net.udp import HostPort
    from share.robot.node_link import NodeLink
    from share.robot.ros_node import RosNode

_domain = click.option(
    "--domain",
    type=click.IntRange(0, 232),
    envvar="ROS_DOMAIN_ID",
    show_envvar=True,
    default=0,
    help="The robot's DDS domain.",
)
_namespace = click.option(
    "--namespace", default="", show_default="none", metavar="NAME", help="The robot's namespace, such as tb1."
)
_agent = click.option(
    "--agent", metavar="NAME", help="The robot's agent.  [default: the first that sends poses]"
)
_poses = click.option(
    "--poses",
    default="udp://127.0.0.1:5570",
    metavar="udp://H:P",
    help="Address to which the agent sends its poses, on this machine.",
)
_peers = click.option(
    "--peer",
    "peers",
    metavar="HOST",
    multiple=True,
    help="The robot's address, for a network without multicast. May be repeated.",
)
_node = options.option_group(
    click.option(
        "--node",
        "node_address",
        metavar="tcp://H:P",
        help="Listen here for the robot's node (`share robot node`), in place of DDS.",
    ),
    click.option(
        "--node-key",
        metavar="FILE|KEY",
        help="Public key of the robot's node; required where it is on another machine. Turns on encryption.",
    ),
)


def _robot_file(text: str) -> Callable[[Any], Any]:
    return click.option("--robot", "robot_file", metavar="FILE", required=True, type=options.PATH, help=text)


_BRIDGE_ENDED = GoalUpdate("the bridge has ended", is_reached=False)  # what remains without an answer
_over_wire = options.option_group(
    room_options.edge("Reach the robot over this edge.  [default: the bridge on this machine]"),
    room_options.name,
    click.option("--robot", "robot_name", metavar="NAME", help="Robot at the edge.  [default: the only one]"),
    options.keys,
    room_options.server_key,
)


@click.group(cls=CommandGroup, prefix="robot ")
def robot() -> None:
    """Let a ROS 2 robot drive by the shared map, and send it to places.

    The bridge runs beside the robot's agent, on the same machine. It needs the extra share-slam[robot], and
    no ROS (docs/do/robot.md).

    \b
    The agent:  share agent realsense --name bot --kind robot --edge tcp://H:P --poses udp://127.0.0.1:5570
    The bridge: share robot bridge --robot robot.yaml --allow-goals

    \b
    Example:  share robot goto 2.5 0.8
    """


@robot.command(short_help="Publish the robot's place in the map, and pass goals on.")
@_robot_file("YAML file: where the camera sits, where and how fast the robot may drive (docs/do/robot.md).")
@_poses
@_agent
@click.option("--allow-goals", is_flag=True, help="Let the robot move. Without this no goal is passed on.")
@_domain
@_namespace
@_peers
@_node
@room_options.edge("Take goals from this edge too, as the robot of --name.")
@click.option(
    "--name",
    metavar="NAME",
    help="Name of the robot at the edge, which is its agent's.  [default: that of --agent]",
)
@options.keys
@room_options.server_key
def bridge(
    robot_file: Path,
    poses: str,
    agent: str | None,
    allow_goals: bool,
    domain: int,
    namespace: str,
    peers: tuple[str, ...],
    node_address: str | None,
    node_key: str | None,
    address: str | None,
    name: str | None,
    keys: Path | None,
    server_key: str | None,
) -> None:
    """Publish map → odom and /map for the robot's Nav2, and pass goals on to it, until Ctrl-C.

    The robot moves only with --allow-goals, within the area and the speed of --robot, and while its place
    in the map is known: a pose that is lost, older than 0.5 s or unsure cancels the goal and ends map → odom.
    With --edge it also takes goals of all whom the edge lets command robots. With --node it reaches a robot
    that DDS from here does not, by way of a node on it.

    \b
    Example:  share robot bridge --robot robot.yaml --allow-goals
    """
    from contextlib import ExitStack, closing

    from share.net.udp import StampedSocket
    from share.robot.robot_file import read_robot
    from share.runtime.robot_bridge import RobotBridgeRun
    from share.runtime.robot_commands import CommandServer, command_path
    from share.runtime.signals import stop_on_signal

    description = read_robot(robot_file)
    settings = replace(description.settings, allow_goals=allow_goals, agent=agent)
    live = LiveLine()

    def print_line(text: str) -> None:
        live.print_line(f"share robot: {text}")

    room_keys = keys if node_key is None or server_key is not None else None
    with ExitStack() as stack:
        room = None
        if address is not None:
            wants = {"drives_robot": True, "print_line": print_line}
            room = stack.enter_context(
                closing(room_options.open_room(address, name or agent, room_keys, server_key, **wants))
            )
        link = stack.enter_context(closing(StampedSocket.bind(_poses_address(poses))))
        commands = stack.enter_context(closing(CommandServer(command_path(domain, namespace))))
        where = _RobotAt(domain, namespace, peers, node_address, node_key, keys)
        node = stack.enter_context(closing(where.connect(print_line)))
        run = RobotBridgeRun(replace(description, settings=settings), node, link, commands, print_line, room)
        with stop_on_signal(run.stop):
            moving = "goals are allowed" if allow_goals else "no goals (--allow-goals)"
            print_line(f"{where}, poses at {poses}, {moving}, at most {settings.max_speed_m_s:g} m/s")
            run.run()
    live.end()


@dataclass(frozen=True)
class _RobotAt:
    """How the robot is reached: by DDS, or by way of its node."""

    domain: int
    namespace: str
    peers: tuple[str, ...]
    node_address: str | None
    node_key: str | None
    keys: Path | None

    def connect(self, print_line: Callable[[str], None]) -> RosNode | NodeLink:
        """Return the connection. Raises UsageError for what does not go together."""
        if self.node_address is None:
            from share.robot.ros_node import RosNode

            if self.node_key is not None:
                raise UsageError("--node-key needs --node, the address at which the node finds the bridge")
            return RosNode(self.domain, self.namespace, self.peers)
        from share.net.keys import default_folder, load_pair, public_key
        from share.robot.node_link import NodeKeys, NodeLink

        if self.peers:
            raise UsageError("--peer is for DDS: with --node the robot's node looks for the robot")
        node_keys = None
        if self.node_key is not None:
            node_keys = NodeKeys(load_pair(self.keys or default_folder()), public_key(self.node_key))
        return NodeLink(self.node_address, node_keys, print_line)

    def __str__(self) -> str:
        return f"domain {self.domain}" if self.node_address is None else f"node at {self.node_address}"


def _poses_address(text: str) -> HostPort:
    """Return the address to listen on. Raises UsageError for one that others reach: a forged pose steers the
    robot."""
    from share.net.udp import parse_host
    from share.runtime.pose_feed import DEFAULT_PORT, UDP

    host = parse_host(text.removeprefix(UDP), DEFAULT_PORT, bind=True)
    if host.name not in ("127.0.0.1", "::1"):
        raise UsageError(
            f"--poses {text}: poses that come over a network could be forged, and steer the robot; "
            f"run the bridge on the agent's machine, with udp://127.0.0.1:{host.port}"
        )
    return host


@robot.command(short_help="Find where the camera sits, from a drive in eights.")
@_robot_file("The robot's YAML file: gets the result; its height of the camera is kept.")
@_poses
@_agent
@click.option(
    "--seconds", default=90.0, show_default=True, help="Length of the drive, s; Ctrl-C ends it earlier."
)
@_domain
@_namespace
@_peers
@_node
@options.keys
@options.as_json
def calibrate(
    robot_file: Path,
    poses: str,
    agent: str | None,
    seconds: float,
    domain: int,
    namespace: str,
    peers: tuple[str, ...],
    node_address: str | None,
    node_key: str | None,
    keys: Path | None,
    as_json: bool,
) -> None:
    """Find where the camera sits on the robot, while you drive it in figures of eight, and write it to
    --robot.

    Drive by hand (teleop, a gamepad) on a level floor, a loop or two to each side. The bridge must not run
    meanwhile. Exit code 1 if the drive does not show it.

    \b
    Example:  share robot calibrate --robot robot.yaml
    """
    from contextlib import ExitStack, closing

    from share.errors import ShareError
    from share.files.writing import atomic_write
    from share.files.yaml_file import read_yaml_text
    from share.geometry.se3 import inverse
    from share.net.udp import StampedSocket
    from share.robot.mounting import find_mounting
    from share.robot.mounting_text import mounting_line, with_mounting
    from share.robot.robot_file import read_robot
    from share.runtime.robot_drive import record_drive
    from share.runtime.signals import stop_on_signal

    before, live = inverse(read_robot(robot_file).settings.T_body_base), LiveLine()
    where = _RobotAt(domain, namespace, peers, node_address, node_key, keys)
    ended: list[bool] = []
    with ExitStack() as stack:
        link = stack.enter_context(closing(StampedSocket.bind(_poses_address(poses))))
        node = stack.enter_context(closing(where.connect(live.print_line)))
        stack.enter_context(stop_on_signal(lambda: ended.append(True)))
        drive = record_drive(link, node, agent, seconds, lambda: bool(ended), live.write)
    live.end()
    found = find_mounting(drive, float(before[2, 3]))
    try:
        written = with_mounting(read_yaml_text(robot_file), found.T_base_body, str(robot_file))
        atomic_write(robot_file, written.text)
    except ShareError as error:  # the drive is not lost
        raise type(error)(f"{error}; found, to put in by hand: {mounting_line(found.T_base_body)}") from None
    said = f"written to {robot_file}"
    if written.is_rewritten:
        said += " in another form; the old text is in it as comments"
    click.echo(json.dumps(found.report()) if as_json else f"{found.text()}\n{said}")


@robot.command(short_help="Print the node that runs on a robot, for `bridge --node`.")
def node() -> None:
    """Print the node for a robot that `share robot bridge` does not reach by DDS: one file, which runs with
    the robot's own Python, rclpy and pyzmq, without SHARE.

    \b
    Example:  share robot node > share_robot_node.py
    """
    from share.robot import share_robot_node

    click.echo(Path(share_robot_node.__file__).with_suffix(".py").read_text(), nl=False)


@robot.command(short_help="Send the robot to a place.", context_settings={"ignore_unknown_options": True})
@click.argument("x", type=float)
@click.argument("y", type=float)
@click.argument("yaw", type=float, required=False)
@click.option(
    "--map-id", metavar="ID", help="Map in which the place is meant.  [default: the robot's present one]"
)
@_domain
@_namespace
@_over_wire
@options.as_json
def goto(
    x: float, y: float, yaw: float | None, map_id: str | None, as_json: bool, **robot_options: Any
) -> None:
    """Send the robot to X Y, m in the map, and wait until it is there. Exit code 1 if it does not get there.

    YAW is where it then looks, degrees counterclockwise from the map's x; without it, the way it came.
    Ctrl-C stops the robot, as does the end of this command however it comes. It reaches a bridge on this
    machine, or with --edge any robot at that edge (then within 3 s, if this command is killed).

    \b
    Example:  share robot goto 2.5 -0.8 90
              share robot goto 2.5 -0.8 --edge tcp://127.0.0.1:5555 --name ann
    """
    live, last = LiveLine(), _BRIDGE_ENDED
    for last in _reach(**robot_options).goto(x, y, None if yaw is None else radians(yaw), map_id):
        live.write(last.text)
    live.end()
    if as_json:
        click.echo(json.dumps({"reached": last.is_reached, "text": last.text}))
    elif last.is_reached:
        click.echo(last.text)
    if not last.is_reached:
        raise ShareError(f"the robot is not at x {x:g} y {y:g}: {last.text}")


@robot.command(short_help="Stop the robot.")
@_domain
@_namespace
@_over_wire
@options.as_json
def cancel(as_json: bool, **robot_options: Any) -> None:
    """Cancel the robot's goal, whoever gave it, and wait until the robot confirms that it has ended. Exit
    code 1 if it does not within 3 s (5 s, of a goal that it has not taken yet): stop it by hand.

    \b
    Example:  share robot cancel
    """
    *_, last = (_BRIDGE_ENDED, *_reach(**robot_options).cancel())
    if as_json or last.is_reached:
        click.echo(json.dumps({"stopped": last.is_reached, "text": last.text}) if as_json else last.text)
    if not last.is_reached:
        raise ShareError(f"the robot's stop: {last.text}")


@robot.command(short_help="Show the robot's position and state.")
@_domain
@_namespace
@_over_wire
@options.as_json
def watch(as_json: bool, **robot_options: Any) -> None:
    """Show where the robot is and what it does, twice a second, until Ctrl-C; over an edge five times while
    it drives. With --json, a line of JSON each time.

    \b
    Example:  share robot watch
    """
    live = LiveLine()
    try:
        for one in _reach(**robot_options, wants_robots=True).watch():
            if as_json:
                click.echo(json.dumps(one.fields))
            elif one.text is not None:
                show = live.write if one.is_place and live.is_terminal else live.print_line
                show(one.text)
    finally:
        live.end()


def _reach(
    *,
    domain: int,
    namespace: str,
    address: str | None,
    name: str | None,
    robot_name: str | None,
    keys: Path | None,
    server_key: str | None,
    wants_robots: bool = False,
) -> RobotLink:
    """Return the way to the robot: over an edge with --edge, else by the bridge on this machine."""
    from share.runtime.robot_commands import command_path

    if address is None:
        return LocalRobot(command_path(domain, namespace))
    room = room_options.open_room(address, name, keys, server_key, wants_robots=wants_robots)
    return RobotAtEdge(room, robot_name)
