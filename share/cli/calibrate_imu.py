"""`share calibrate imu`: noise and bias of an IMU, from a recording at rest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.progress import Stages
from share.cli.table import aligned

if TYPE_CHECKING:
    from share.lab.calibrate.imu import ImuNature
    from share.lab.calibrate.imu_report import Row

_FAR = 2.0  # times the profile's figure, or part of it: worth a word
_LETTERS = {"density": "N", "instability": "B", "walk": "K"}


@click.command(short_help="Noise and bias of an IMU, from a recording at rest.")
@click.argument("source")
@click.option("--profile", "profile_name", metavar="P", help="Compare with this device's data sheet: d435i.")
@click.option(
    "--inflate",
    type=click.FloatRange(min=1),
    default=1.0,
    show_default=True,
    help="Times the measured noise that is written for a filter to believe.",
)
@options.out_folder
@options.as_json
def imu(source: str, profile_name: str | None, inflate: float, out: Path, as_json: bool) -> None:
    """Measure white noise, bias instability and bias random walk of an IMU (Allan deviation) from a recording
    in which it lay still: ten minutes for the white noise, three hours for the rest.

    \b
    Example:  share calibrate imu rest.mcap --profile d435i --out calib/mine
    """
    from share.files.json_file import known
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate import imu_report
    from share.lab.calibrate.imu import characterise
    from share.lab.calibrate.imu_report import allan_png
    from share.lab.calibrate.imu_table import read_imu
    from share.sensors.profile import profile

    stated = profile(profile_name) if profile_name else None
    writable_dir(out, "kalibr_imu_chain.yaml", "imu-report.json", "imu-report.png")
    with Stages() as stages:
        table = read_imu(source, lambda done, total: stages("reading", done, total))
        stages("Allan deviation", 0, 1)
        nature = characterise(table.imu)
        stages("Allan deviation", 1, 1)
    report = imu_report.to_json(nature, source, stated, inflate) | {"dropped": table.dropped}
    text = json.dumps(known(report), indent=1)
    atomic_write(out / "kalibr_imu_chain.yaml", imu_report.kalibr_text(nature, source, inflate, table.serial))
    atomic_write(out / "imu-report.json", text + "\n")
    atomic_write(
        out / "imu-report.png", allan_png(nature, stated, f"{source}, {nature.rest_s:.0f} s at rest")
    )
    rows = imu_report.rows(nature, stated)
    click.echo(text if as_json else _summary(nature, rows, table.dropped))
    for warning in _warnings(nature, rows):
        click.echo(f"share: {source}: {warning}", err=True)


def _summary(nature: ImuNature, rows: list[Row], dropped: int) -> str:
    from share.lab.calibrate.imu_report import STANDARD_GRAVITY, gravity

    heads = ["", "", "x", "y", "z", "all", *(["profile", "ratio"] if any(r.stated for r in rows) else [])]
    norm, bias = gravity(nature), ", ".join(f"{b:+.5f}" for b in nature.gyro.mean)
    return "\n".join(
        [
            f"{nature.rest_s:.0f} s at rest of {nature.total_s:.0f} s, {nature.rate_hz:.2f} Hz; "
            f"{nature.missing} samples lost in {nature.gaps} gaps, {dropped} out of order",
            "",
            aligned([heads, *([_name(row), row.unit, *_cells(row)][: len(heads)] for row in rows)]),
            "",
            "N: white noise, B: bias instability, K: random walk of the bias",
            "± one sigma; < where the recording does not tell it, by 95 %",
            f"gyroscope's bias: {bias} rad/s",
            f"accelerometer's mean: {norm:.4f} m/s^2, {100 * (norm / STANDARD_GRAVITY - 1):+.2f} % off "
            "standard gravity (scale and bias: one pose does not tell them apart)",
        ]
    )


def _name(row: Row) -> str:
    return f"{row.sensor} {_LETTERS[row.figure]}"


def _cells(row: Row) -> list[str]:
    stated = "" if row.stated is None else f"{row.stated:.3g}"
    ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
    return [*(figure.text for figure in (*row.axes, row.together)), stated, ratio]


def _warnings(nature: ImuNature, rows: list[Row]) -> list[str]:
    """What a person ought to know before believing it: a line each."""
    out = []
    if nature.total_s - nature.rest_s > 10:
        out.append(
            f"it was moved; what is used is the rest from {nature.start_s:.0f} to "
            f"{nature.start_s + nature.rest_s:.0f} s after its start"
        )
    if nature.cuts:
        out.append(f"{nature.cuts} gaps are too long to be bridged: averages do not go across them")
    for row in rows:
        if row.ratio is not None and not 1 / _FAR <= row.ratio <= _FAR:
            out.append(f"{_name(row)} is {row.ratio:.2g} times the profile's {row.stated:.2g} {row.unit}")
        if row.figure == "walk" and not row.together.told:
            out.append(
                f"{_name(row)} is not told by {nature.rest_s / 60:.0f} min; the file has an upper bound, "
                "three hours would tell"
            )
    return out
