"""`share calibrate imu`: estimate noise and bias of an IMU from a recording at rest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.completion import complete_profile
from share.cli.terminal import Stages, aligned_table, print_note

if TYPE_CHECKING:
    from share.lab.calibrate.imu import ImuCharacteristics
    from share.lab.calibrate.imu_report import NoiseRow

_WARN_RATIO = 2.0  # a figure beyond this factor of the profile's, up or down, gives a warning
_SYMBOLS = {"density": "N", "instability": "B", "walk": "K"}


@click.command()
@click.argument("source")
@click.option(
    "--profile",
    "profile_name",
    metavar="P",
    shell_complete=complete_profile,
    help="Compare with the data sheet in this profile, such as d435i.",
)
@click.option(
    "--inflate",
    type=click.FloatRange(min=1),
    default=1.0,
    help="Multiply the measured noise by this in the file for the filter.",
)
@options.out_folder
@options.as_json
def imu(source: str, profile_name: str | None, inflate: float, out: Path, as_json: bool) -> None:
    """Estimate white noise, bias instability and bias random walk of an IMU by Allan deviation.

    SOURCE is a recording of the IMU at rest: ten minutes suffice for the white noise, instability and random
    walk need three hours.

    \b
    Example:  share calibrate imu rest.mcap --profile d435i --out calib/mine
    """
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate import imu_report
    from share.lab.calibrate.imu import characterise
    from share.lab.calibrate.imu_table import read_imu
    from share.lab.calibrate.report import to_json
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
    text = to_json(report)
    atomic_write(
        out / "kalibr_imu_chain.yaml",
        imu_report.imu_chain_yaml(characteristics, source, inflate, table.serial),
    )
    atomic_write(out / "imu-report.json", text + "\n")
    title = f"{source}, {characteristics.rest_s:.0f} s at rest"
    imu_report.draw_allan(out / "imu-report.png", characteristics, device_profile, title)
    rows = imu_report.noise_rows(characteristics, device_profile)
    click.echo(text if as_json else _summary(characteristics, rows, table.dropped))
    for warning in _warnings(characteristics, rows):
        print_note(source, warning)


def _summary(characteristics: ImuCharacteristics, rows: list[NoiseRow], dropped: int) -> str:
    from share.lab.calibrate.imu import STANDARD_GRAVITY
    from share.lab.calibrate.imu_report import gravity_norm

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
            f"{characteristics.rest_s:.0f} s at rest of {characteristics.total_s:.0f} s, "
            f"{characteristics.rate_hz:.2f} Hz; {characteristics.missing} samples lost in "
            f"{characteristics.gaps} gaps, {dropped} out of order",
            "",
            aligned_table([heads, *([_row_name(row), row.unit, *_cells(row)][: len(heads)] for row in rows)]),
            "",
            "N: white noise, B: bias instability, K: random walk of the bias",
            "± one sigma; < 95 % upper bound where the recording is too short to measure it",
            f"gyroscope bias: {bias} rad/s",
            f"accelerometer mean: {norm:.4f} m/s^2, {100 * (norm / STANDARD_GRAVITY - 1):+.2f} % off "
            "standard gravity (scale and bias, which one orientation cannot separate)",
        ]
    )


def _row_name(row: NoiseRow) -> str:
    return f"{row.sensor} {_SYMBOLS[row.quantity]}"


def _cells(row: NoiseRow) -> list[str]:
    stated = "" if row.profile_value is None else f"{row.profile_value:.3g}"
    ratio = "" if row.ratio_to_profile is None else f"{row.ratio_to_profile:.2f}"
    return [*(figure.text for figure in (*row.axes, row.combined)), stated, ratio]


def _warnings(characteristics: ImuCharacteristics, rows: list[NoiseRow]) -> list[str]:
    """Return warnings about the result, one per line."""
    out = []
    if characteristics.total_s - characteristics.rest_s > 10:
        out.append(
            f"the IMU was moved; only its rest from {characteristics.start_s:.0f} to "
            f"{characteristics.start_s + characteristics.rest_s:.0f} s is used"
        )
    if characteristics.unbridged_gaps:
        out.append(
            f"{characteristics.unbridged_gaps} gaps are too long to interpolate; no average spans them"
        )
    for row in rows:
        if row.ratio_to_profile is not None and not 1 / _WARN_RATIO <= row.ratio_to_profile <= _WARN_RATIO:
            out.append(
                f"{_row_name(row)} is {row.ratio_to_profile:.2g} times the profile's "
                f"{row.profile_value:.2g} {row.unit}"
            )
        if row.quantity == "walk" and not row.combined.significant:
            out.append(
                f"{_row_name(row)} cannot be measured in {characteristics.rest_s / 60:.0f} min; the file has "
                "an upper bound; record three hours to measure it"
            )
    return out
