"""`share robot`: let a ROS 2 robot drive by the shared map, and send it to places."""

from __future__ import annotations

import json
from dataclasses import replace
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

_domain = click.option(
    "--domain",
    type=click.IntRange(0, 232),
    envvar="ROS_DOMAIN_ID",
    show_envvar=True,
    default=0,
    help="The robot's DDS domain.",
)
_namespace = click.option(
    "--namespace", default="", metavar="NAME", help="The robot's namespace, such as tb1.  [default: none]"
)


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
@click.option(
    "--robot",
    "robot_file",
    metavar="FILE",
    required=True,
    type=options.PATH,
    help="YAML file: where the camera sits, where and how fast the robot may drive (docs/do/robot.md).",
)
@click.option(
    "--poses",
    default="udp://127.0.0.1:5570",
    metavar="udp://H:P",
    help="Address to which the agent sends its poses, on this machine.",
)
@click.option("--agent", metavar="NAME", help="The robot's agent.  [default: the first that sends poses]")
@click.option("--allow-goals", is_flag=True, help="Let the robot move. Without this no goal is passed on.")
@_domain
@_namespace
@click.option(
    "--peer",
    "peers",
    metavar="HOST",
    multiple=True,
    help="The robot's address, for a network without multicast. May be repeated.",
)
@room_options.edge("Take goals from this edge too, as the robot of --name.")
@click.option("--name", help="Name of the robot at the edge: that of its agent.")
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
    address: str | None,
    name: str | None,
    keys: Path | None,
    server_key: str | None,
) -> None:
    """Publish map → odom and /map for the robot's Nav2, and pass goals on to it, until Ctrl-C.

    The robot moves only with --allow-goals, within the area and the speed of --robot, and while its place
    in the map is known: a pose that is lost, older than 0.5 s or unsure cancels the goal and ends map → odom.
    With --edge it also takes goals of all whom the edge lets command robots.

    \b
    Example:  share robot bridge --robot robot.yaml --allow-goals
    """
    from contextlib import ExitStack, closing

    from share.net.udp import StampedSocket
    from share.robot.robot_file import read_robot
    from share.robot.ros_node import RosNode
    from share.runtime.robot_bridge import RobotBridgeRun
    from share.runtime.robot_commands import CommandServer, command_path
    from share.runtime.signals import stop_on_signal

    description = read_robot(robot_file)
    settings = replace(description.settings, allow_goals=allow_goals, agent=agent)
    live = LiveLine()

    def print_line(text: str) -> None:
        live.print_line(f"share robot: {text}")

    with ExitStack() as stack:
        room = None
        if address is not None:
            wants = {"drives_robot": True, "print_line": print_line}
            room = stack.enter_context(
                closing(room_options.open_room(address, name or agent, keys, server_key, **wants))
            )
        link = stack.enter_context(closing(StampedSocket.bind(_poses_address(poses))))
        commands = stack.enter_context(closing(CommandServer(command_path(domain, namespace))))
        node = stack.enter_context(closing(RosNode(domain, namespace, peers)))
        run = RobotBridgeRun(replace(description, settings=settings), node, link, commands, print_line, room)
        with stop_on_signal(run.stop):
            moving = "goals are allowed" if allow_goals else "no goals (--allow-goals)"
            print_line(f"domain {domain}, poses at {poses}, {moving}, at most {settings.max_speed_m_s:g} m/s")
            run.run()
    live.end()


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
def cancel(**robot_options: Any) -> None:
    """Cancel the robot's goal, whoever gave it.

    \b
    Example:  share robot cancel
    """
    *_, last = (_BRIDGE_ENDED, *_reach(**robot_options).cancel())
    if not last.is_reached:
        raise ShareError(f"the robot was not stopped: {last.text}")
    click.echo(last.text)


@robot.command(short_help="Show where the robot is and what it does.")
@_domain
@_namespace
@_over_wire
@options.as_json
def watch(as_json: bool, **robot_options: Any) -> None:
    """Show where the robot is and what it does, twice a second, until Ctrl-C. With --json, a line of JSON
    each time.

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
