"""Install the frozen program on a device, as services that start on boot. See docs/do/deploy.md."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
from deploy_device import Device, Facts, check
from deploy_release import Release, read_release, write_tar

from share.cli.terminal import progress
from share.devices import checks
from share.errors import ShareError, UsageError
from share.net.keys import public_key
from share.net.transport import parse_address

DIST = Path(__file__).resolve().parents[1] / "dist" / "share"
PROFILES = {"ar": "d435i-n100-headset", "robot": "d435i-turtlebot4", "": "laptop-edge"}  # by KIND
_SETTING = re.compile(r"([A-Z_]+)=(.*)")
_PLAIN_VALUE = re.compile(r"[\w@%+=:,./ -]*", re.ASCII)  # systemd quotes and expands nothing of it
NO_SETTINGS = "# Settings of SHARE on this device: docs/lookup/configuration.md\n{}\n"


@dataclass(frozen=True)
class Service:
    """unit: systemd's name; "" for the program alone. name: of its files in /etc/share. given: settings from
    the command line, None if not given. defaults: empty for a service without settings. more: further files.
    """

    unit: str
    name: str
    given: Mapping[str, str | None]
    defaults: Mapping[str, str]
    more: Mapping[str, str]


_OPTIONS = (
    click.argument("host", metavar="[USER@]HOST"),
    click.option("--ssh", default="ssh", show_default=True, help='With options: "ssh -p 2222 -i key".'),
    click.option("--dist", type=click.Path(path_type=Path), default=DIST, help="The frozen program."),
    click.option(
        "--root", default="", metavar="DIR", help="A folder on the device in place of /, for a trial."
    ),
    click.option("--settle", default=10.0, show_default=True, help="Seconds that the service must stay up."),
    click.option("--keep", type=click.IntRange(2), default=3, show_default=True, help="Releases to keep."),
    click.option("--rollback", is_flag=True, help="Go back to the release before; copy nothing."),
    click.option("--dry-run", is_flag=True, help="Print what would be done; change nothing."),
)


def common(command: Callable[..., None]) -> Callable[..., None]:
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
def cli() -> None:
    """Install SHARE on a device, as a service that starts on boot, or the program alone: docs/do/deploy.md.

    \b
    Example:  tools/deploy program pi@headset1
              tools/deploy edge me@laptop
              tools/deploy agent pi@headset1 --name ann --edge tcp://192.168.1.10:5555 --server-key e.public
    """


@cli.command()
@click.option("--name", required=True, help="Name of the agent.")
@click.option("--edge", metavar="tcp://H:P", help="Address of the edge; required the first time.")
@click.option("--kind", type=click.Choice(["ar", "robot"]), help="ar (headset) or robot; initially ar.")
@click.option("--source", help="As for `share agent`; initially realsense.")
@click.option(
    "--server-key",
    metavar="FILE|KEY",
    help="Public key of the edge; required the first time, unless it is on the same machine.",
)
@common
def agent(name: str, edge: str | None, kind: str | None, source: str | None, **others: Any) -> None:
    """An agent: the service share-agent@NAME.

    \b
    Example:  tools/deploy agent pi@headset1 --name ann --edge tcp://192.168.1.10:5555 --server-key e.public
    """
    if not re.fullmatch(r"[A-Za-z0-9_][\w.-]{0,63}", name, re.ASCII):
        raise UsageError(f"--name '{name}': use 1 to 64 letters, digits, '_', '-' or '.'")
    key = others.pop("server_key")
    keys = "--keys /etc/share/keys --server-key /etc/share/edge.public" if key else None
    given = {"SOURCE": source, "KIND": kind, "EDGE": edge, "KEYS": keys}
    defaults = {"SOURCE": "realsense", "KIND": "ar", "KEYS": "", "OPTIONS": ""}
    more = {"edge.public": f"share-public-key edge {public_key(key)}\n"} if key else {}
    deploy(Service(f"share-agent@{name}", f"agent-{name}", given, defaults, more), **others)


@cli.command()
@click.option("--bind", metavar="tcp://H:P", help="Initially tcp://0.0.0.0:5555.")
@click.option("--http", metavar="[H:]P", help="Initially 127.0.0.1:8080.")
@common
def edge(bind: str | None, http: str | None, **others: Any) -> None:
    """An edge: the service share-edge.

    \b
    Example:  tools/deploy edge me@laptop
    """
    defaults = {"BIND": "tcp://0.0.0.0:5555", "HTTP": "127.0.0.1:8080", "OPTIONS": ""}
    deploy(Service("share-edge", "edge", {"BIND": bind, "HTTP": http}, defaults, {}), **others)


@cli.command()
@common
def sync(**others: Any) -> None:
    """The time server of a room: the service share-sync, on the edge's machine (docs/do/sync.md).

    \b
    Example:  tools/deploy sync me@laptop
    """
    deploy(Service("share-sync", "sync", {}, {}, {}), **others)


@cli.command()
@common
def program(**others: Any) -> None:
    """The program alone, for use by hand; services on the device continue with it.

    \b
    Example:  tools/deploy program pi@headset1
    """
    deploy(Service("", "program", {}, {}, {}), **others)


def deploy(
    service: Service,
    host: str,
    ssh: str,
    dist: Path,
    root: str,
    settle: float,
    keep: int,
    rollback: bool,
    dry_run: bool,
) -> None:
    """Install a release and a service. Raises ShareError in one line; the device has undone what failed."""
    device = Device(host, ssh, root, settle, keep)
    if rollback:
        _roll_back(device, service, dry_run)
        return
    release = read_release(dist)
    there = device.probe(service.name)
    check(host, release, there)
    files = settings_files(service, there)
    if dry_run:
        click.echo("\n".join(plan(device, release, there, service, files)))
        return
    if release.name not in there.releases:
        with progress(release.size, f"copying {release.size / 1e6:.0f} MB") as done:
            device.send(release, partial(write_tar, release, wrote=done))
    for name, text in files.items():
        device.do("settings", name, data=text.encode())
    verb = ("activate", release.name, service.unit, profile(service, files))
    click.echo(device.do(*(verb if service.unit else ("place", release.name))), nl=False)


def settings_files(service: Service, there: Facts) -> dict[str, str]:
    """Return files for /etc/share: given settings merged into those on the device. Raises UsageError."""
    if not service.defaults:
        return {}
    text = merge_settings(there.settings, service.given, service.defaults)
    if "EDGE" in service.given:
        check_edge(dict(line.partition("=")[::2] for line in text.splitlines()))
    first = {} if there.settings else {f"{service.name}.yaml": NO_SETTINGS}
    return {f"{service.name}.env": text, **first, **service.more}


def check_edge(settings: Mapping[str, str]) -> None:
    """Check that an agent's settings name an edge, and its key if it is remote. Raises UsageError."""
    if not settings.get("EDGE"):
        raise UsageError("--edge is required the first time: tcp://HOST:5555, where the edge listens")
    keys = f"{settings.get('KEYS', '')} {settings.get('OPTIONS', '')}"
    if not parse_address(settings["EDGE"]).local and "--server-key" not in keys:
        raise UsageError(
            f"--server-key: {settings['EDGE']} is on another machine, so the edge's public key is required: "
            "the last line of `tools/deploy edge`; `share edge` prints it at its start"
        )


def profile(service: Service, files: Mapping[str, str]) -> str:
    """Return the computer's profile for `share doctor`."""
    found = re.search(r"^KIND=(ar|robot)$", files.get(f"{service.name}.env", ""), re.MULTILINE)
    return PROFILES[found[1] if found else ""]


def plan(
    device: Device, release: Release, there: Facts, service: Service, files: Mapping[str, str]
) -> list[str]:
    where = f"{device.host}:{device.root}"
    copied = release.name in there.releases
    size = "is there already" if copied else f"copy {release.size / 1e6:.0f} MB"
    begin = [
        f"{where}/etc/share/keys: a key pair, if there is none",
        f"start {service.unit}, now and on boot; it must stay up for {device.settle_s:g} s, "
        f"else back to {there.current or 'none'}",
    ]
    return [
        f"{where}/opt/share/releases/{release.name}: {size}",
        *(
            f"{where}/etc/share/{name}:\n" + "".join(f"    {line}\n" for line in text.splitlines())[:-1]
            for name, text in files.items()
        ),
        f"{where}/etc/systemd/system/share-*.service, /etc/udev/rules.d/99-share-realsense.rules",
        f"{where}{checks.TMPFILES_PATH}: CPU governor and USB memory, as the profile wants them",
        f"{where}/opt/share/current: {there.current or 'none'} -> {release.name}",
        *(begin if service.unit else []),
    ]


def _roll_back(device: Device, service: Service, dry_run: bool) -> None:
    there = device.probe(service.name)
    if dry_run:
        click.echo(f"{device.host}: {there.current or 'none'} -> {there.previous or 'none'}")
        return
    click.echo(device.do("rollback"), nl=False)


def merge_settings(text: str, given: Mapping[str, str | None], defaults: Mapping[str, str]) -> str:
    """Return the settings `text` of a service, as systemd reads them (systemd.exec(5)), with all `given`
    values that are not None, and `defaults` for missing ones.

    Other lines stay as they are. Raises UsageError for a value that is not plain text.
    """
    wanted = {key: value for key, value in given.items() if value is not None}
    for key, value in wanted.items():
        if not _PLAIN_VALUE.fullmatch(value):
            raise UsageError(
                f"{key.lower()} '{value}': has characters that are not allowed in a settings file"
            )
    lines = [_put(line, wanted) for line in text.splitlines()]
    there = {match[1] for line in lines if (match := _SETTING.fullmatch(line))}
    missing = {key: value for key, value in {**defaults, **wanted}.items() if key not in there}
    return "".join(f"{line}\n" for line in [*lines, *(f"{k}={v}" for k, v in missing.items())])


def _put(line: str, wanted: Mapping[str, str]) -> str:
    match = _SETTING.fullmatch(line)
    return f"{match[1]}={wanted[match[1]]}" if match and match[1] in wanted else line


if __name__ == "__main__":
    try:
        cli()
    except ShareError as error:
        print(f"deploy: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
