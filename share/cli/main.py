"""`share`: one command line. Commands are imported when they are called, so `--help` is quick."""

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
from share.cli.signals import unwind_on_signal  # noqa: E402
from share.errors import ShareError, UsageError, one_line  # noqa: E402

# name: (module, attribute, one line of help). Literal, so that a freezer sees every module.
COMMANDS = {
    "demo": ("share.cli.demo", "demo", "The whole system on this machine, nothing else needed."),
    "capture": ("share.cli.capture", "capture", "Record a headset or robot."),
    "track": ("share.cli.track", "track", "Track one agent, without an edge, as fast as it goes."),
    "agent": ("share.cli.agent", "agent", "Track one agent at sensor rate and share its map."),
    "edge": ("share.cli.edge", "edge", "Join the maps of all agents and send corrections back."),
    "dataset": ("share.cli.dataset", "dataset", "Look into, convert and recover recordings; export maps."),
    "sync": ("share.cli.sync", "sync", "One clock for all machines of a room, and how well they agree."),
    "doctor": ("share.cli.doctor", "doctor", "What is missing on this device, and how to mend it."),
    "emulate": ("share.cli.emulate", "emulate", "Record agents that move through a virtual room."),
    "evaluate": ("share.cli.evaluate", "evaluate", "Play sessions on stated terms, score and compare them."),
    "train": ("share.cli.train", "train", "Teach the model that estimates a tracker's error."),
    "calibrate": (
        "share.cli.calibrate",
        "calibrate",
        "Find out what a device's cameras and IMU are like.",
    ),
    "keys": ("share.cli.keys", "keys", "Who may connect to an edge from another machine."),
}


class _LazyGroup(click.Group):
    """A group whose commands are modules that are not imported until one is called."""

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
        except KeyboardInterrupt:  # click would put an empty line before ours
            raise _InterruptedError("interrupted") from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, _, text) in COMMANDS.items()])


@click.group(
    cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="share")
def cli() -> None:
    """SHARE: several people in AR headsets and robots track themselves in one shared map.

    \b
    Try it:   share demo
    A run:    share edge &
              share agent RECORDING --name ann --kind ar --edge tcp://127.0.0.1:5555 --out out/ann
    """


class _InterruptedError(ShareError):
    """By Ctrl-C. The exit code is what shells give for SIGINT."""

    exit_code = 130


def _suggestion(name: str) -> str:
    near = difflib.get_close_matches(name, COMMANDS, n=1)
    return f"did you mean '{near[0]}'?" if near else f"there are {', '.join(COMMANDS)}"


def main(arguments: list[str] | None = None) -> None:
    """The one place that turns an error into a line and an exit code. arguments: of the process if None."""
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
        _exit_with(error.format_message().replace("\n", " ") + hint, error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        _exit_with("interrupted", 130)
    except BrokenPipeError:  # the reader of our output went away; nothing is left to tell it
        sys.stderr.close()
        sys.exit(1)
    except OSError as error:  # what nobody foresaw: files have been checked, so most likely stdout
        with contextlib.suppress(OSError):  # or Python would try again at its end, and complain itself
            sys.stdout.close()
        _exit_with(f"{error.filename or 'cannot write the output'}: {error.strerror or error}", 1)


def _exit_with(text: str, code: int) -> None:
    with contextlib.suppress(OSError):  # its terminal may be gone
        click.echo(f"share: {one_line(text)}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
