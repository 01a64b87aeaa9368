"""`share doctor`: check this device, and say how to fix what is missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import camera_options, options
from share.cli.completion import complete_profile
from share.cli.terminal import LiveLine
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.devices.checks import CheckResult


@click.command()
@click.option(
    "--profile",
    default="d435i",
    metavar="NAME|FILE",
    shell_complete=complete_profile,
    help="What this device should be: d435i, d435i-n100-headset, d435i-turtlebot4, laptop-edge, or a file.",
)
@click.option("--calib", metavar="DIR", type=options.PATH, help="Calibration of this device to check.")
@click.option("--edge", "address", metavar="tcp://H:P", help="Address of an edge to try.")
@options.keys
@click.option("--server-key", metavar="FILE|KEY", help="Public key of that edge.")
@click.option(
    "--out",
    default=".",
    metavar="DIR",
    type=options.PATH,
    help="Folder for recordings, whose disk is checked, and for the report of --acceptance.",
)
@click.option(
    "--acceptance",
    is_flag=True,
    help="Then lead through ten minutes with the camera, and write a report file to --out.",
)
@click.option(
    "--minutes",
    type=click.FloatRange(0.2, 60),
    default=10.0,
    help="Length of --acceptance, min; a shorter one says less.",
)
@camera_options.mode
@options.as_json
def doctor(
    profile: str,
    calib: Path | None,
    address: str | None,
    keys: Path | None,
    server_key: str | None,
    out: Path,
    acceptance: bool,
    minutes: float,
    mode: str | None,
    as_json: bool,
) -> None:
    """Check camera, calibration, computer, clock, keys and edge, and say what to fix. Changes nothing.

    FAIL will not work (exit code 1); WARN works, but not as well as it could; SKIPPED could not be checked.

    With --acceptance it leads you through a time at rest, a walk back to where it began, and use: streams,
    noise, clock, processor, memory, heat, tracking and the round trip to --edge are judged.

    \b
    Example:  share doctor --profile d435i-n100-headset --calib calib/d435i
              share doctor --acceptance --profile d435i-n100-headset --calib calib/d435i --out report
    """
    if mode is not None and not acceptance:
        raise UsageError("--mode is for --acceptance; give both, or leave it out")
    from share.devices.checks import failures
    from share.runtime.doctor import inspect_device, inspect_edge
    from share.sensors.profile import load_host_profile

    host = load_host_profile(profile)
    inspect_link = partial(inspect_edge, host, address, keys, server_key)
    findings = [*inspect_device(host, calib, out), *inspect_link()]
    if acceptance:
        if host.sensor is None:
            raise UsageError(f"--acceptance needs a camera; profile '{host.name}' has none")
        run = _Acceptance(profile, mode, calib, minutes, out)
        findings += run.play()
        if address is not None:
            findings += [replace(one, name=f"{one.name}, afterwards") for one in inspect_link()[1:]]
        run.write(host.name, findings)
    failed = failures(findings)
    click.echo(json.dumps(_report(host.name, findings)) if as_json else _findings_text(findings))
    if failed:
        names = ", ".join(one.name for one in failed)
        raise ShareError(f"doctor: {len(failed)} check{'s'[: len(failed) != 1]} failed: {names}")


class _Acceptance:
    """The time that a person goes through with the device."""

    def __init__(self, profile: str, mode: str | None, calib: Path | None, minutes: float, out: Path) -> None:
        """Open the camera. Raises UsageError, ShareError without one."""
        from share.files.writing import writable_dir

        self._line, self._out, self._seconds = LiveLine(), out, 60 * minutes
        self._camera = camera_options.CameraOptions(profile, mode, None)
        writable_dir(out)
        calibration = None if calib is None else str(calib)
        self._source = camera_options.open_source("realsense", calibration, None, self._camera, self._tell)
        self._figures: dict[str, Any] = {}
        self._began = datetime.now(UTC).isoformat(timespec="seconds")

    def _tell(self, text: str) -> None:
        self._line.print_line(f"share: {text}")

    def play(self) -> list[CheckResult]:
        """Lead through the steps; return the findings."""
        from share.cameras.live import LiveSource
        from share.config import Config
        from share.runtime.acceptance import AcceptanceRun, accept_device
        from share.runtime.signals import stop_on_signal

        source, sensor = self._source, self._camera.camera_request().profile
        run = AcceptanceRun(
            self._seconds,
            self._line.print_line,
            lambda line: self._line.write(str(line)),
            source.stop,
            source.feed.arrived_ns if isinstance(source, LiveSource) else None,
        )
        with stop_on_signal(source.stop):
            findings, self._figures = accept_device(source, Config(), sensor, run, self._tell)
        self._line.end()
        return findings

    def write(self, profile: str, findings: Sequence[CheckResult]) -> None:
        """Write the report file, without pictures."""
        from share import __version__
        from share.files.json_file import nan_to_none
        from share.files.writing import atomic_write
        from share.lab.evaluate.provenance import describe_machine

        path = self._out / f"acceptance-{self._source.serial or 'camera'}.json"
        document = {
            "version": __version__,
            "began": self._began,
            "seconds": self._seconds,
            "serial": self._source.serial,
            "machine": describe_machine(),
            **_report(profile, findings),
            "measured": self._figures,
        }
        atomic_write(path, json.dumps(nan_to_none(document), indent=2, default=str) + "\n")
        self._line.print_line(f"report to send: {path}")


def _report(profile: str, findings: Sequence[CheckResult]) -> dict[str, Any]:
    from share.devices.checks import failures

    rows = [{"name": f.name, "state": f.state.value, "what": f.what, "mend": list(f.fix)} for f in findings]
    return {"profile": profile, "ok": not failures(findings), "findings": rows}


def _findings_text(findings: Sequence[CheckResult]) -> str:
    width = max(len(one.name) for one in findings)
    lines = [f"{one.state.value:7}  {one.name:{width}}  {one.what}" for one in findings]
    for one in findings:
        if one.fix:
            lines += ["", f"{one.name}:", *(f"    {line}" for line in one.fix)]
    return "\n".join(lines)
