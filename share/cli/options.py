"""Options that several commands share, and the parsing of their values."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import click

from share.cli.terminal import print_note
from share.cli.verbosity import remember
from share.config import BASE_POLICY, POLICY_NAMES, STREAMED
from share.errors import UsageError, one_line

if TYPE_CHECKING:
    from share.config import Config
    from share.recordings.calibration import Calibration
    from share.recordings.session import Session
    from share.runtime.source import Source

Command = Callable[..., Any]

PATH = click.Path(path_type=Path)
EXISTING_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)

calib = click.option(
    "--calib",
    metavar="FILE",
    help="Kalibr camchain file, or a folder with kalibr_imucam_chain.yaml and kalibr_imu_chain.yaml; "
    "overrides the calibration in the source.",
)
config = click.option(
    "--config",
    "config_file",
    metavar="FILE",
    type=PATH,
    help="YAML file with settings (docs/lookup/configuration.md).",
)
verbose = click.option("-v", "--verbose", is_flag=True, help="Print more.", callback=remember)
keys = click.option(
    "--keys", metavar="DIR", type=PATH, help="Folder of this machine's keys.  [default: ~/.config/share/keys]"
)
out_folder = click.option("--out", required=True, metavar="DIR", type=PATH, help="Output folder.")
target = click.option(
    "--target",
    "target_name",
    required=True,
    metavar="T",
    help="The board: aprilgrid or charuco in the usual size, or its YAML file.",
)


def _cores() -> int:
    from share.devices.host import core_count

    return core_count()


workers = click.option(
    "--workers",
    type=click.IntRange(1, 64),
    default=_cores,
    show_default="one per core",
    help="Processes to use.",
)
sigma_mm = click.option(
    "--sigma-mm",
    type=click.FloatRange(min=0.01),
    default=2.0,
    help="Position noise of the motion capture, 1 sigma, mm.",
)
rotations = click.option(
    "--rotations",
    type=click.Choice(["helical", "xyz"]),
    default="helical",
    help="Meaning of RX, RY, RZ in a Vicon CSV without RW: rotation vector (helical) or Euler angles (xyz).",
)
DISTANCE = "Largest distance from the cube at which the robot counts as there, m."
TIMEOUT = "Longest time after the call in which the robot may come, s."
POLICY_TEXTS = {
    "share": "rate of each agent by its quality of experience; merges with a small gain are skipped",
    "share-paper": "the paper's algorithm to the letter: no budget of the room, low QoE raises the rate",
    BASE_POLICY: "every keyframe is sent, every verified loop is merged",
    "linear": "rate falls with the delay; every verified loop is merged",
    "equal": "as share, robots rated like headsets",
    "random": "as share, with control gains drawn from control.random_seed",
    "fixed": "every agent sends control.fixed_rate_hz",
    STREAMED: "agents send raw frames; the edge tracks each alone, without a shared map",
}
_policy_option = click.option(
    "--policy",
    type=click.Choice(POLICY_NAMES),
    help="How keyframe rates are set, see above.  [default: edge.policy of --config, else share]",
)
link = click.option(
    "--link",
    metavar="LINK[,AGENT=LINK…]",
    help="Emulated network: wifi5 (an access point alone), wifi-busy (shared with many devices), with "
    "--virtual shared-5, shared-8, shared-15, shared-150 (one access point of so many Mbit/s for all), or a "
    "YAML file (docs/do/network.md); one for all agents, or one per agent.",
)
true_error = click.option(
    "--true-error", is_flag=True, help="Agents report their error against ground truth to the edge."
)
as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")


class NumberRange(click.FloatRange):
    """A range that also refuses NaN, which compares with neither bound. noun: of what it takes."""

    def __init__(self, low: float, high: float, noun: str = "a number") -> None:
        super().__init__(low, high)
        self._noun = noun

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail(f"'{value}' is not {self._noun}", param, ctx)
        return number


class _Frames(click.ParamType[slice]):
    name = "A:B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> slice:
        if isinstance(value, slice):
            return value
        match = re.fullmatch(r"(\d*):(\d*)", value)
        start, stop = (int(v) if v else None for v in match.groups()) if match else (None, None)
        if not match or (stop is not None and stop <= (start or 0)):
            self.fail(f"'{value}' is not a range of frames such as 0:250, 250: or :100", param, ctx)
        return slice(start, stop)


frames = click.option("--frames", type=_Frames(), help="Use only camera frames A to B-1, such as 0:250.")


def explain_policies(command: Command) -> Command:
    """Add a line about each policy to the help of a command, before its example."""
    about, example, rest = cleandoc(command.__doc__ or "").partition("\b\nExample:")
    width = max(map(len, POLICY_TEXTS))
    rows = "\n".join(f"  {name:{width}}  {text}" for name, text in POLICY_TEXTS.items())
    command.__doc__ = f"{about}\b\nPolicies:\n{rows}\n\n{example}{rest}"
    return command


def policy(command: Command) -> Command:
    """Add --policy, whose choices are explained in the command's help."""
    return _policy_option(explain_policies(command))


def option_group(*group: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return a decorator that adds options to a command, in this order."""

    def add(command: Command) -> Command:
        for option in reversed(group):
            command = option(command)
        return command

    return add


# How `share evaluate` plays a session; their names are fields of `share.lab.evaluate.real_time.RunOptions`.
run_options = option_group(
    link,
    true_error,
    click.option(
        "--virtual", is_flag=True, help="Play in virtual time: track once, draw the durations from a seed."
    ),
    click.option(
        "--costs", metavar="RUN", help="With --virtual: take the durations from this real-time run."
    ),
    click.option(
        "--agents-first",
        is_flag=True,
        help="Run the edge at lower CPU priority, as if agents had machines of their own.",
    ),
)


def load_config(path: Path | None, policies: Sequence[str | None] = ()) -> Config:
    """Read settings from a YAML file; the defaults without one. Raises ConfigError, UsageError.

    policies: those given by --policy; the first replaces `edge.policy`. If the file sets a policy that is
    none of them, a line on stderr says so.
    """
    from share.config import Config, with_policy
    from share.files.yaml_file import read_given_settings

    config, given = (Config(), dict[str, Any]()) if path is None else read_given_settings(path)
    played = [one for one in policies if one is not None]
    if not played:
        return config
    if "policy" in given.get("edge", {}) and config.edge.policy not in played:
        names = f"{'policies' if len(played) > 1 else 'policy'} {', '.join(played)}"
        print_note(str(path), f"edge.policy {config.edge.policy} is overridden by {names}")
    return with_policy(config, played[0])


def agent_name(value: str) -> str:
    """Check that a name can be a file name; return it in Unicode form NFC. Raises UsageError."""
    from share.recordings.session import AGENT_NAME_RULE, is_agent_name

    name = normalize("NFC", value)
    if not is_agent_name(name):
        raise UsageError(f"--name {value[:80]!r}: use {AGENT_NAME_RULE}")
    return name


def values_by_name(option: str, values: tuple[str, ...]) -> dict[str, str]:
    """Return VALUE by NAME for each `NAME=VALUE`; a bare VALUE, which is for all names, under "".

    Raises UsageError for a repeated name.
    """
    out: dict[str, str] = {}
    for word in values:
        name, _, value = word.partition("=") if "=" in word else ("", "", word)
        if name in out:
            raise UsageError(f"{option} is given twice for {name or 'all'}; give it once")
        out[name] = value
    return out


def print_notes(source: Source) -> None:
    """Print the notes on a recording, such as unused streams, on stderr, one per line."""
    for note in source.notes:
        print_note(source.name, note)


def print_losses(source: Source) -> None:
    """Print what could not be read of a recording on stderr, one line per kind of loss."""
    for line in source.losses.lines():
        print_note(source.name, one_line(line))


def warn_other_device(name: str, given_calibration: Calibration | None, serial: str | None) -> None:
    """Warn on stderr if the calibration given belongs to another device."""
    from share.recordings.calibration_match import device_mismatch

    for warning in () if given_calibration is None else device_mismatch(given_calibration.serials, serial):
        print_note(name, warning)


def print_counters(counters: dict[str, int]) -> None:
    """Print the sequencer's non-zero counters on one line on stderr."""
    counts_text = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counters.items() if count)
    click.echo(f"sequencer: {counts_text or 'nothing to report'}", err=True)


def load_run_config(
    config_file: Path | None,
    policies: Sequence[str | None],
    options_given: dict[str, Any],
    sessions: Sequence[Session],
) -> Config:
    """Read the settings (`load_config`) and check them and the run options before anything is played.

    Raises ConfigError, UsageError.
    """
    from share.lab.evaluate.emulated_network import LinkAssignment

    config, links = load_config(config_file, policies), LinkAssignment.parse(options_given["link"])
    for session in sessions:
        links.check(session.agents, options_given["virtual"])
    if options_given["costs"] is not None:
        from share.lab.evaluate.virtual_time import read_delays

        if not options_given["virtual"]:
            raise UsageError("--costs needs --virtual: in real time, durations are as they are")
        read_delays(Path(options_given["costs"]))
    return config
