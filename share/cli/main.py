"""The command line `share`: it runs a command and turns every error into one line and an exit code."""

from __future__ import annotations

from share import startup

startup.prepare_process()  # before anything below can import numpy

import contextlib  # noqa: E402
import sys  # noqa: E402
from typing import Any  # noqa: E402

import click  # noqa: E402

from share import __version__  # noqa: E402
from share.cli.commands import CommandGroup  # noqa: E402
from share.cli.stderr import flush_all  # noqa: E402
from share.cli.verbosity import verbosity  # noqa: E402
from share.errors import ShareError, describe_exception, one_line  # noqa: E402
from share.runtime.signals import unwind_on_signal  # noqa: E402


class _RootGroup(CommandGroup):
    """`share` itself: a signal ends every command alike."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with unwind_on_signal():
                return super().invoke(ctx)
        except KeyboardInterrupt:  # click would print an empty line first
            raise _InterruptedError("interrupted") from None


@click.group(
    cls=_RootGroup,
    prefix="",
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


def main(arguments: list[str] | None = None) -> None:
    """Run a command; turn every error into one line on stderr and an exit code, here and nowhere else.

    arguments: those of the process if None.
    """
    verbosity.begin()
    try:
        code = cli.main(arguments, prog_name="share", standalone_mode=False)
        verbosity.summarise(__version__)
        sys.exit(code if isinstance(code, int) else 0)
    except ShareError as error:
        verbosity.explain(error)
        _exit_with(str(error), error.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.ctx.get_help() if error.ctx else "", err=True)
        sys.exit(2)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see `{context.command_path} --help`)" if context else ""
        message = error.format_message().replace("\n", " ")
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
    except Exception as error:  # a mistake of SHARE's; -v says where
        if "can't start new thread" in str(error):
            _exit_with(
                "this machine lets SHARE start no further thread; raise its limit (ulimit -u, TasksMax)", 1
            )
        verbosity.explain(error)
        hint = "" if verbosity.is_on else "; repeat the command with -v, and report what it prints"
        _exit_with(f"internal error: {describe_exception(error)}{hint}", 1)


def _exit_with(text: str, code: int) -> None:
    flush_all()
    with contextlib.suppress(OSError):  # the terminal may be gone
        click.echo(f"share: {one_line(text)}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
