"""`share dataset align`: make a session of recordings of several devices and a motion capture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.terminal import Column, Stages, column_table, print_note
from share.errors import DataError, UsageError

if TYPE_CHECKING:
    from share.lab.mocap.session import AlignedRecording
    from share.lab.mocap.state import MocapFitOptions
    from share.lab.mocap.trajectory import MocapTrajectory


@click.command()
@click.argument("recordings", nargs=-1, required=True, metavar="NAME=RECORDING...")
@click.option(
    "--mocap",
    "mocaps",
    multiple=True,
    required=True,
    metavar="[NAME=]FILE",
    help="Motion capture file: Vicon's or Motive's CSV, TUM, or CSV with t[ns], x y z, qw qx qy qz.",
)
@click.option(
    "--body",
    "bodies",
    multiple=True,
    metavar="[NAME=]BODY",
    help="Rigid body of a device.  [default: the one with the device's name, or the only one]",
)
@click.option(
    "--kind", "kinds", multiple=True, metavar="[NAME=]ar|robot", help="Kind of a device.  [default: ar]"
)
@click.option(
    "--calib",
    "calibs",
    multiple=True,
    metavar="[NAME=]FILE",
    help="Calibration of a device, or of all, as for share track; the recording is then rewritten with it.",
)
@click.option(
    "--mounting",
    "mountings",
    multiple=True,
    metavar="[NAME=]DIR",
    help="Folder by share calibrate mocap, needed for a device that turns about one axis only.",
)
@options.rotations
@click.option(
    "--within",
    type=click.FloatRange(min=0.01),
    metavar="S",
    help="Largest clock offset to search, s.  [default: no limit]",
)
@options.sigma_mm
@click.option(
    "--bridge",
    type=click.FloatRange(0.1, 2),
    default=0.5,
    metavar="S",
    help="Fill gaps of the motion capture up to this long by the IMU, s; longer gaps get no truth.",
)
@click.option("--out", required=True, metavar="SESSION", type=options.PATH, help="A new folder.")
@options.as_json
def align(
    recordings: tuple[str, ...],
    mocaps: tuple[str, ...],
    bodies: tuple[str, ...],
    kinds: tuple[str, ...],
    calibs: tuple[str, ...],
    mountings: tuple[str, ...],
    out: Path,
    as_json: bool,
    **fitting: Any,
) -> None:
    """Make one session for `share evaluate` from recordings of several devices and a motion capture of them.

    Options with [NAME=] may be repeated, once a device.

    The clocks need not agree: the offset of each device is estimated from the rotation rates of device and
    body, and refused where it is ambiguous.

    The ground truth of a device is the trajectory of its IMU that fits both motion capture and IMU; where the
    motion capture has a gap longer than --bridge, there is none.

    \b
    Example:  share dataset align ann=ann.mcap bob=bob.mcap --mocap vicon.csv \\
                  --body ann=Headset1 --kind bob=robot --mounting bob=calib/bob --out room1
              share evaluate run room1 --virtual --out runs/room1
    """
    from share.files.writing import new_folder
    from share.lab.mocap.session import write_session
    from share.lab.mocap.state import MocapFitOptions

    names = _recordings_by_device(recordings)
    by_option = {
        option: _values_by_device(names, option, words)
        for option, words in (
            ("--mocap", mocaps),
            ("--body", bodies),
            ("--kind", kinds),
            ("--calib", calibs),
            ("--mounting", mountings),
        )
    }
    fit_options = MocapFitOptions(
        sigma_position=fitting["sigma_mm"] * 1e-3, within_s=fitting["within"], max_bridged_s=fitting["bridge"]
    )
    with new_folder(out) as work, Stages() as stages:
        trajectories = _trajectories(names, by_option["--mocap"], by_option["--body"], fitting["rotations"])
        devices = {
            name: _fit_device(name, path, by_option, trajectories[name], fit_options, stages)
            for name, path in names.items()
        }
        results = write_session(work, devices, _fit_settings(**fitting), stages)
    click.echo(json.dumps(results) if as_json else _result_table(results))
    for name, one in results.items():
        for line in (*_axis_warnings(one), *one["warnings"]):
            print_note(name, line)
    if not as_json:
        click.echo(f"{out}: ready; play it: share evaluate run {out} --virtual --out RUN")


def _fit_settings(rotations: str, within: float | None, sigma_mm: float, bridge: float) -> dict[str, Any]:
    """Return the settings of the fit, for the session's provenance."""
    return {"rotations": rotations, "within_s": within, "sigma_mm": sigma_mm, "bridge_s": bridge}


def _recordings_by_device(recordings: tuple[str, ...]) -> dict[str, str]:
    """Return the recording of each device, by its name. Raises UsageError."""
    for text in recordings:
        if "=" not in text:
            raise UsageError(f"{text}: give NAME=RECORDING, such as ann={text}")
    out = options.values_by_name("RECORDING", recordings)
    for name in out:
        options.agent_name(name)
        if name == "truth":
            raise UsageError("truth is the name of a folder of the session; give the device another name")
    return out


def _values_by_device(names: dict[str, str], option: str, values: tuple[str, ...]) -> dict[str, str]:
    """Return an option's value by device; the value for all others under "". Raises UsageError."""
    out = options.values_by_name(option, values)
    for name in out:
        if name and name not in names:
            raise UsageError(f"{option} {name}=: no device '{name}'; devices: {', '.join(names)}")
    return out


def _trajectories(
    names: dict[str, str], files: dict[str, str], bodies: dict[str, str], rotations: str
) -> dict[str, tuple[str, MocapTrajectory]]:
    """Return by device a label (file and body) and its motion-capture trajectory. Raises UsageError."""
    from share.lab.mocap.files import pick_body, read_bodies

    bodies_of = {file: read_bodies(Path(file), rotations) for file in dict.fromkeys(files.values())}
    out: dict[str, tuple[str, MocapTrajectory]] = {}
    device_of_body: dict[tuple[Path, str], str] = {}
    for name in names:
        file = files.get(name, files.get("", ""))
        if not file:
            raise UsageError(
                f"{name} has no motion capture; give --mocap {name}=FILE, or --mocap FILE for all"
            )
        body_wanted = bodies.get(name, bodies.get(""))
        body, trajectory = pick_body(file, bodies_of[file], body_wanted, name, f"--body {name}=BODY")
        if (other := device_of_body.setdefault((Path(file).resolve(), body), name)) != name:
            both = f"body '{body}'" if body else "its only body"
            raise UsageError(
                f"{file}: {both} cannot be both {other} and {name}; give --body {name}=BODY or "
                f"--mocap {name}=FILE"
            )
        out[name] = (f"{file} {body}".strip(), trajectory)
    return out


def _fit_device(
    name: str,
    recording: str,
    by_option: dict[str, dict[str, str]],
    trajectory: tuple[str, MocapTrajectory],
    fit_options: MocapFitOptions,
    stages: Stages,
) -> AlignedRecording:
    from share.lab.calibrate.imu_table import read_imu
    from share.lab.mocap.align import align_device as run
    from share.lab.mocap.session import AlignedRecording
    from share.runtime.source import open_source

    def value_of(option: str) -> str | None:
        return by_option[option].get(name, by_option[option].get(""))

    kind, calib = _agent_kind(value_of("--kind") or "ar"), value_of("--calib")
    source = open_source(recording, calib)
    options.print_notes(source)
    if source.rig.imu is None:
        raise UsageError(
            f"{recording} or its calibration has no IMU; `share dataset align` needs the gyroscope"
        )
    device_options = _with_mounting(fit_options, value_of("--mounting"))
    imu = read_imu(recording, lambda done, total: stages(f"reading {name}", done, total)).imu
    stages(f"fitting {name}", 0, 1)
    try:
        result = run(imu, source.rig.imu, trajectory[1], device_options)
    except DataError as error:
        raise type(error)(f"{name}: {error}") from None
    stages(f"fitting {name}", 1, 1)
    copied_file = Path(recording) if recording.endswith(".mcap") and calib is None else None
    inputs = (("recording", recording), ("calib", calib), ("mounting", value_of("--mounting")))
    return AlignedRecording(
        kind, source, copied_file, trajectory[0], {key: text for key, text in inputs if text}, result
    )


def _agent_kind(text: str) -> Any:
    from share.types import AgentKind

    if text not in list(AgentKind):
        raise UsageError(f"--kind {text} is not known; known: {', '.join(AgentKind)}")
    return AgentKind(text)


def _with_mounting(fit_options: MocapFitOptions, mounting: str | None) -> MocapFitOptions:
    from share.lab.mocap.report import read_mounting

    if mounting is None:
        return fit_options
    T, sigma = read_mounting(Path(mounting))
    return replace(fit_options, T_body_mocap=T, guess_sigma=sigma)


def _axis_warnings(one: dict[str, Any]) -> list[str]:
    return [] if one["up"] == "z" else [f"the motion capture's up axis is {one['up']}; the session's is z"]


def _form(title: str, key: str, form: str, factor: float = 1.0) -> Column:
    """Return a column with a number of a device's result."""
    return title, lambda one: format(factor * one[key], form)


_COLUMNS: tuple[Column, ...] = (
    ("device", lambda one: one["name"]),
    _form("offset s", "offset_ns", "+.6f", 1e-9),
    _form("± ms", "offset_sigma_ms", ".2f"),
    _form("drift ppm", "drift_ppm", "+.1f"),
    _form("corr.", "correlation", ".3f"),
    _form("next corr.", "next_correlation", ".3f"),
    _form("body deg", "mounting_rotation_deg", ".2f"),
    _form("±", "mounting_rotation_sigma_deg", ".2f"),
    _form("body mm", "mounting_translation_mm", ".1f"),
    _form("±", "mounting_translation_sigma_mm", ".1f"),
    ("up", lambda one: one["up"]),
    _form("tilt deg", "tilt_deg", ".3f"),
    _form("rms mm", "residual_mm", ".1f"),
    _form("rms deg", "residual_deg", ".2f"),
    _form("outliers %", "outlier_share", ".1f", 100),
    ("gaps", lambda one: str(len(one["gaps_s"]))),
    _form("truth s", "truth_s", ".1f"),
)


def _result_table(results: dict[str, Any]) -> str:
    """Return a table with a line per device."""
    return column_table(_COLUMNS, [{"name": name, **one} for name, one in results.items()])
