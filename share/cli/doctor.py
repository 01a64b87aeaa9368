"""`share doctor`: check this device, and say how to fix what is missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.completion import complete_profile
from share.errors import ShareError

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
@click.option("--edge", "address", metavar="tcp://H:P", help="Edge to connect to.")
@options.keys
@click.option("--server-key", metavar="FILE|KEY", help="Public key of that edge.")
@click.option(
    "--out",
    default=".",
    metavar="DIR",
    type=options.PATH,
    help="Folder for recordings, whose disk is checked.",
)
@options.as_json
def doctor(
    profile: str,
    calib: Path | None,
    address: str | None,
    keys: Path | None,
    server_key: str | None,
    out: Path,
    as_json: bool,
) -> None:
    """Check camera, calibration, computer, clock, keys and edge, and say what to fix. Changes nothing.

    FAIL will not work (exit code 1); WARN works, but not as well as it could; SKIPPED could not be checked.

    \b
    Example:  share doctor --profile d435i-n100-headset --calib calib/d435i
    """
    from share.devices.checks import failures
    from share.runtime.doctor import (
        inspect_calibration,
        inspect_camera,
        inspect_edge,
        inspect_host,
        inspect_port,
        query_sdk,
    )
    from share.sensors.profile import load_host_profile

    host = load_host_profile(profile)
    sdk = query_sdk(host)
    findings = [
        *inspect_camera(host, sdk),
        *inspect_calibration(host, calib, sdk),
        *inspect_host(host, out),
        *inspect_port(host),
        *inspect_edge(host, address, keys, server_key),
    ]
    failed = failures(findings)
    click.echo(_report_json(host.name, findings, not failed) if as_json else _findings_text(findings))
    if failed:
        names = ", ".join(one.name for one in failed)
        raise ShareError(f"doctor: {len(failed)} check{'s'[: len(failed) != 1]} failed: {names}")


def _report_json(profile: str, findings: Sequence[CheckResult], is_ok: bool) -> str:
    rows = [{"name": f.name, "state": f.state.value, "what": f.what, "mend": list(f.fix)} for f in findings]
    return json.dumps({"profile": profile, "ok": is_ok, "findings": rows})


def _findings_text(findings: Sequence[CheckResult]) -> str:
    width = max(len(one.name) for one in findings)
    lines = [f"{one.state.value:7}  {one.name:{width}}  {one.what}" for one in findings]
    for one in findings:
        if one.fix:
            lines += ["", f"{one.name}:", *(f"    {line}" for line in one.fix)]
    return "\n".join(lines)
