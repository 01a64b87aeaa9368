"""The table of commands. A command's module is imported when it is called, so that `--help` is quick."""

from __future__ import annotations

import difflib
import importlib
from typing import Any

import click

from share.cli.verbosity import with_verbose
from share.errors import UsageError

# name: (module, attribute, one line of help). A literal table, so that a freezer sees every module.
COMMANDS = {
    "demo": ("share.cli.demo", "demo", "Try the whole system on this machine; nothing else is needed."),
    "capture": ("share.cli.capture", "capture", "Record the camera and IMU of a headset or robot."),
    "track": ("share.cli.track", "track", "Track one agent over a recording or camera, without an edge."),
    "agent": ("share.cli.agent", "agent", "Run one agent: track at sensor rate, send keyframes to an edge."),
    "edge": ("share.cli.edge", "edge", "Run the server: merge all agents' maps, send corrections."),
    "site": ("share.cli.site", "site", "Run the server of several rooms; agents walk between them."),
    "watch": ("share.cli.watch", "watch", "Look at the room of a running edge from a terminal."),
    "dataset": (
        "share.cli.dataset",
        "dataset",
        "Inspect, convert, recover, align recordings; export and prune maps.",
    ),
    "dataset align": (
        "share.cli.dataset_align",
        "align",
        "Make a session of field recordings and a motion capture.",
    ),
    "dataset forget": (
        "share.cli.dataset_forget",
        "forget",
        "Delete agents or old keyframes from a map for good.",
    ),
    "sync": ("share.cli.sync", "sync", "Give all machines of a room one clock, and check it."),
    "doctor": ("share.cli.doctor", "doctor", "Check this device, and say how to fix what is missing."),
    "emulate": (
        "share.cli.emulate",
        "emulate",
        "Make recordings of agents that move through a virtual room.",
    ),
    "evaluate": (
        "share.cli.evaluate",
        "evaluate",
        "Play sessions, score them, compare policies and trackers.",
    ),
    "evaluate ablation": ("share.cli.evaluate_many", "ablation", "Compare policies on sessions."),
    "evaluate sweep": ("share.cli.evaluate_many", "sweep", "Compare settings on sessions."),
    "evaluate paper": (
        "share.cli.evaluate_paper",
        "paper",
        "Report each table and figure of the paper beside the measured ones.",
    ),
    "evaluate compare": ("share.cli.evaluate_compare", "compare", "Compare SHARE's tracker with others."),
    "train": ("share.cli.train", "train", "Train the model that estimates the tracking error."),
    "calibrate": (
        "share.cli.calibrate",
        "calibrate",
        "Calibrate a device's cameras, IMU and motion-capture body.",
    ),
    "calibrate camera": (
        "share.cli.calibrate_camera",
        "camera",
        "Calibrate one or two cameras from views of a board.",
    ),
    "calibrate camera-imu": (
        "share.cli.calibrate_camera_imu",
        "camera_imu",
        "Calibrate camera-IMU extrinsics and time offset.",
    ),
    "calibrate headset": (
        "share.cli.calibrate_headset",
        "headset",
        "Calibrate where a headset's own tracking sits on the device.",
    ),
    "calibrate imu": (
        "share.cli.calibrate_imu",
        "imu",
        "Estimate IMU noise and bias from a recording at rest.",
    ),
    "calibrate mocap": (
        "share.cli.calibrate_mocap",
        "mocap",
        "Calibrate a motion capture's body and clock to a device.",
    ),
    "robot": (
        "share.cli.robot",
        "robot",
        "Let a ROS 2 robot drive by the shared map, and send it to places.",
    ),
    "robot simulate": (
        "share.cli.robot_simulate",
        "simulate",
        "Send an emulated robot about in the room of a session.",
    ),
    "study": ("share.cli.study", "study", "Plan a blind study with people, and compute its statistics."),
    "study simulate": (
        "share.cli.study_simulate",
        "simulate",
        "Carry out a study with simulated participants.",
    ),
    "marker": ("share.cli.marker", "marker", "Place, list and remove objects of the shared room."),
    "keys": ("share.cli.keys", "keys", "Manage the keys with which other machines connect to an edge."),
}


def _completed(command: click.Command) -> click.Command:
    """Return the command with `-v`; its help has N and X for numbers, where click has INTEGER RANGE."""
    for option in command.params:
        if isinstance(option, click.Option) and option.metavar is None:
            if isinstance(option.type, click.types.IntParamType):
                option.metavar = "N"
            elif isinstance(option.type, click.types.FloatParamType):
                option.metavar = "X"
    return with_verbose(command)


class CommandGroup(click.Group):
    """A click group: the commands added to it, then the rows of `COMMANDS` that begin with `prefix`."""

    def __init__(self, *arguments: Any, prefix: str, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._rows = {
            name.removeprefix(prefix): row
            for name, row in COMMANDS.items()
            if name.startswith(prefix) and " " not in name.removeprefix(prefix)
        }

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self.commands, *self._rows]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self._rows:
            added = super().get_command(ctx, cmd_name)
            return None if added is None else _completed(added)
        module, attribute, _ = self._rows[cmd_name]
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return _completed(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        known = self.list_commands(ctx)
        if args[0] not in known and not args[0].startswith("-"):
            near = difflib.get_close_matches(args[0], known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"commands: {', '.join(known)}"
            raise UsageError(f"no command '{args[0]}'; {hint} (see `{ctx.command_path} --help`)")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows = [(name, command.get_short_help_str(100)) for name, command in self.commands.items()]
        rows += [(name, text) for name, (_, _, text) in self._rows.items()]
        with formatter.section("Commands"):
            formatter.write_dl(rows)
