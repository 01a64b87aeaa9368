"""The command line `share`. A command's module is imported when it is called, so that `--help` is quick."""

from __future__ import annotations

from share import startup

startup.prepare_process()  # before anything below can import numpy

import contextlib  # noqa: E402
import difflib  # noqa: E402
import importlib  # noqa: E402
import sys  # noqa: E402
from typing import Any  # noqa: E402

import click  # noqa: E402

from share import __version__  # noqa: E402
from share.cli.stderr import flush_all  # noqa: E402
from share.errors import ShareError, UsageError, one_line  # noqa: E402
from share.runtime.signals import unwind_on_signal  # noqa: E402

# name: (module, attribute, one line of help). A literal table, so that a freezer sees every module.
COMMANDS = {
    "demo": ("share.cli.demo", "demo", "Try the whole system on this machine; nothing else is needed."),
    "capture": ("share.cli.capture", "capture", "Record the camera and IMU of a headset or robot."),
    "track": ("share.cli.track", "track", "Track one agent over a recording or camera, without an edge."),
    "agent": ("share.cli.agent", "agent", "Run one agent: track at sensor rate, send keyframes to an edge."),
    "edge": ("share.cli.edge", "edge", "Run the server: merge all agents' maps, send corrections."),
    "dataset": (
        "share.cli.dataset",
        "dataset",
        "Inspect, convert, recover and align recordings; export maps.",
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
    "train": ("share.cli.train", "train", "Train the model that estimates the tracking error."),
    "calibrate": (
        "share.cli.calibrate",
        "calibrate",
        "Calibrate a device's cameras, IMU and motion-capture body.",
    ),
    "keys": ("share.cli.keys", "keys", "Manage the keys with which other machines connect to an edge."),
}


class _LazyGroup(click.Group):
    """A click group that imports a command's module when that command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, attribute, _ = COMMANDS[cmd_name]
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in COMMANDS and not args[0].startswith("-"):
            raise UsageError(f"no command '{args[0]}'; {_suggestion(args[0])} (see `share --help`)")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with unwind_on_signal():
                return super().invoke(ctx)
        except KeyboardInterrupt:  # click would print an empty line first
            raise _InterruptedError("interrupted") from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, _, text) in COMMANDS.items()])


@click.group(
    cls=_LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
)
@click.version_option(__version__, prog_name="share")
def cli() -> None:
    """SHARE: AR headsets and robots localise themselves in one shared map.

    Each agent tracks its own pose from camera and IMU and sends keyframes to one edge server. The edge
    merges the agents' maps and sends each agent corrections.

    \b
    Try it:   share demo
    A run:    share edge &
              share agent RECORDING --name ann --kind ar --edge tcp://127.0.0.1:5555 --out out/ann
    """


class _InterruptedError(ShareError):
    """Ctrl-C. Exit code 130, as shells give for SIGINT."""

    exit_code = 130


def _suggestion(name: str) -> str:
    near = difflib.get_close_matches(name, COMMANDS, n=1)
    return f"did you mean '{near[0]}'?" if near else f"commands: {', '.join(COMMANDS)}"


def main(arguments: list[str] | None = None) -> None:
    """Run a command; turn every error into one line on stderr and an exit code, here and nowhere else.

    arguments: those of the process if None.
    """
    try:
        code = cli.main(arguments, prog_name="share", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except ShareError as error:
        _exit_with(str(error), error.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.ctx.get_help() if error.ctx else "", err=True)
        sys.exit(2)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see `{context.command_path} --help`)" if context else ""
        message = error.format_message().replace("\n", " ")
        if context and isinstance(context.command, click.Group) and message.startswith("No such command"):
            message += (
                "" if "Did you mean" in message else f" Commands: {', '.join(context.command.commands)}."
            )
        _exit_with(message + hint, error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        _exit_with("interrupted", 130)
    except BrokenPipeError:  # the reader of our output is gone
        sys.stderr.close()
        sys.exit(1)
    except OSError as error:  # files were checked before, so most likely stdout
        with contextlib.suppress(OSError):  # or Python flushes it again at exit, with a message of its own
            sys.stdout.close()
        _exit_with(f"{error.filename or 'cannot write the output'}: {error.strerror or error}", 1)


def _exit_with(text: str, code: int) -> None:
    flush_all()
    with contextlib.suppress(OSError):  # the terminal may be gone
        click.echo(f"share: {one_line(text)}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
