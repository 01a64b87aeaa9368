"""`share calibrate imu`: noise and bias of an IMU, from a recording at rest."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.table import aligned_table
from share.cli.terminal import Stages

if TYPE_CHECKING:
    from share.lab.calibrate.imu import ImuCharacteristics
    from share.lab.calibrate.imu_report import NoiseRow

_WARN_RATIO = 2.0  # times the profile's figure, or part of it: worth a word
_SYMBOLS = {"density": "N", "instability": "B", "walk": "K"}


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
    from share.files.json_file import nan_to_none
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate import imu_report
    from share.lab.calibrate.imu import characterise
    from share.lab.calibrate.imu_report import allan_chart
    from share.lab.calibrate.imu_table import read_imu
    from share.sensors.profile import load_profile

    device_profile = load_profile(profile_name) if profile_name else None
    writable_dir(out, "kalibr_imu_chain.yaml", "imu-report.json", "imu-report.png")
    with Stages() as stages:
        table = read_imu(source, lambda done, total: stages("reading", done, total))
        stages("Allan deviation", 0, 1)
        characteristics = characterise(table.imu)
        stages("Allan deviation", 1, 1)
    report = imu_report.report_values(characteristics, source, device_profile, inflate) | {
        "dropped": table.dropped
    }
    text = json.dumps(nan_to_none(report), indent=1)
    atomic_write(
        out / "kalibr_imu_chain.yaml",
        imu_report.imu_chain_yaml(characteristics, source, inflate, table.serial),
    )
    atomic_write(out / "imu-report.json", text + "\n")
    atomic_write(
        out / "imu-report.png",
        allan_chart(characteristics, device_profile, f"{source}, {characteristics.rest_s:.0f} s at rest"),
    )
    rows = imu_report.noise_rows(characteristics, device_profile)
    click.echo(text if as_json else _summary(characteristics, rows, table.dropped))
    for warning in _warnings(characteristics, rows):
        click.echo(f"share: {source}: {warning}", err=True)


def _summary(characteristics: ImuCharacteristics, rows: list[NoiseRow], dropped: int) -> str:
    from share.lab.calibrate.imu_report import STANDARD_GRAVITY, gravity_norm

    heads = [
        "",
        "",
        "x",
        "y",
        "z",
        "all",
        *(["profile", "ratio"] if any(r.profile_value for r in rows) else []),
    ]
    norm, bias = gravity_norm(characteristics), ", ".join(f"{b:+.5f}" for b in characteristics.gyro.mean)
    return "\n".join(
        [
            f"{characteristics.rest_s:.0f} s at rest of "
            f"{characteristics.total_s:.0f} s, "
            f"{characteristics.rate_hz:.2f} Hz; "
            f"{characteristics.missing} samples lost in {characteristics.gaps} gaps, {dropped} out of order",
            "",
            aligned_table([heads, *([_row_name(row), row.unit, *_cells(row)][: len(heads)] for row in rows)]),
            "",
            "N: white noise, B: bias instability, K: random walk of the bias",
            "± one sigma; < where the recording does not tell it, by 95 %",
            f"gyroscope's bias: {bias} rad/s",
            f"accelerometer's mean: {norm:.4f} m/s^2, {100 * (norm / STANDARD_GRAVITY - 1):+.2f} % off "
            "standard gravity (scale and bias: one pose does not tell them apart)",
        ]
    )


def _row_name(row: NoiseRow) -> str:
    return f"{row.sensor} {_SYMBOLS[row.quantity]}"


def _cells(row: NoiseRow) -> list[str]:
    stated = "" if row.profile_value is None else f"{row.profile_value:.3g}"
    ratio = "" if row.ratio_to_profile is None else f"{row.ratio_to_profile:.2f}"
    return [*(figure.text for figure in (*row.axes, row.combined)), stated, ratio]


def _warnings(characteristics: ImuCharacteristics, rows: list[NoiseRow]) -> list[str]:
    """What a person ought to know before believing it: a line each."""
    out = []
    if characteristics.total_s - characteristics.rest_s > 10:
        out.append(
            f"it was moved; what is used is the rest from {characteristics.start_s:.0f} to "
            f"{characteristics.start_s + characteristics.rest_s:.0f} s after its start"
        )
    if characteristics.unbridged_gaps:
        out.append(
            f"{characteristics.unbridged_gaps} gaps are too "
            f"long to be bridged: averages "
            f"do not go across them"
        )
    for row in rows:
        if row.ratio_to_profile is not None and not 1 / _WARN_RATIO <= row.ratio_to_profile <= _WARN_RATIO:
            out.append(
                f"{_row_name(row)} is "
                f"{row.ratio_to_profile:.2g} times "
                f"the profile's {row.profile_value:.2g} {row.unit}"
            )
        if row.quantity == "walk" and not row.combined.told:
            out.append(
                f"{_row_name(row)} is not told by "
                f"{characteristics.rest_s / 60:.0f} "
                f"min; the file has an upper bound, "
                "three hours would tell"
            )
    return out
