"""Options that several commands share, and the parsing of what they hold."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import click

from share.errors import UsageError, one_line

if TYPE_CHECKING:
    from share.config import Config
    from share.recordings.calibration import Calibration
    from share.runtime.source import Source

calib = click.option(
    "--calib",
    metavar="FILE",
    help="Kalibr camchain file, or a folder with kalibr_imucam_chain.yaml and kalibr_imu_chain.yaml; "
    "overrides what the source carries.",
)
config = click.option("--config", "config_file", metavar="FILE", help="YAML file of settings.")
verbose = click.option("-v", "--verbose", is_flag=True, help="Say more.")
keys = click.option(
    "--keys", metavar="DIR", help="Folder of this machine's keys (default: ~/.config/share/keys)."
)
out_folder = click.option(
    "--out", required=True, metavar="DIR", type=click.Path(path_type=Path), help="Where the files go."
)
target = click.option(
    "--target", "target_name", required=True, metavar="T",
    help="The board: aprilgrid or charuco of the usual sizes, or its YAML file.",
)  # fmt: skip


def _cores() -> int:
    from share.runtime.machine import core_count

    return core_count()


workers = click.option(
    "--workers", type=click.IntRange(1, 64), default=_cores, show_default="one a core", help="Processes."
)
sigma_mm = click.option(
    "--sigma-mm",
    type=click.FloatRange(min=0.01),
    default=2.0,
    show_default=True,
    help="Noise of the motion capture.",
)
rotations = click.option(
    "--rotations",
    type=click.Choice(["helical", "xyz"]),
    default="helical",
    show_default=True,
    help="What RX, RY, RZ of Vicon's CSV are, where there is no RW.",
)
as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")


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


frames = click.option(
    "--frames", type=_Frames(), help="Only frames A to B-1, counted by camera images (0:250)."
)


def load_config(path: str | None) -> Config:
    """The settings of a YAML file, or the defaults. Raises ConfigError or UsageError."""
    from share.config import Config
    from share.files.yaml_file import read_settings

    return Config() if path is None else read_settings(Path(path))


def agent_name(value: str) -> str:
    """A name that can be a file's, as Unicode composes it (NFC). Raises UsageError."""
    from share.recordings.session import AGENT_NAME_RULE, is_agent_name

    name = normalize("NFC", value)
    if not is_agent_name(name):
        raise UsageError(f"--name {value[:80]!r}: use {AGENT_NAME_RULE}")
    return name


def values_by_name(option: str, values: tuple[str, ...]) -> dict[str, str]:
    """`NAME=VALUE` by its name, a bare VALUE, which is for everybody, by ""."""
    out: dict[str, str] = {}
    for word in values:
        name, _, value = word.partition("=") if "=" in word else ("", "", word)
        if name in out:
            raise UsageError(f"{option} is given twice for {name or 'everybody'}; give one of them")
        out[name] = value
    return out


def print_notes(source: Source) -> None:
    """What a person should know of a recording, such as streams that are not used: a line each on stderr."""
    for note in source.notes:
        click.echo(f"share: {source.name}: {note}", err=True)


def print_losses(source: Source) -> None:
    """What of a recording could not be read: a line a kind on stderr."""
    for line in source.losses.lines():
        click.echo(f"share: {source.name}: {one_line(line)}", err=True)


def warn_other_device(name: str, given_calibration: Calibration | None, serial: str | None) -> None:
    """That a calibration which was given is of another device, on stderr, if it is."""
    from share.recordings.device_match import device_mismatch

    if given_calibration is not None and (wrong := device_mismatch(given_calibration.serials, serial)):
        click.echo(f"share: {name}: {wrong}", err=True)


def print_counters(counters: dict[str, int]) -> None:
    """What the sequencer met, on stderr: one line, without what never happened."""
    counts_text = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counters.items() if count)
    click.echo(f"sequencer: {counts_text or 'nothing'}", err=True)
