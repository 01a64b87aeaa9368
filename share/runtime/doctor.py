"""Looks at this device as a profile wants it: facts read by `share.devices.host`,
judged by `share.devices.checks`."""

from __future__ import annotations

import os
import secrets
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from share.cameras.realsense import asked
from share.devices import camera_check, checks
from share.devices import host as facts
from share.devices.camera_check import Sdk
from share.devices.checks import Finding, calibration, device, fail, ok, skipped
from share.devices.clocks import of_chrony
from share.errors import ShareError, VersionError, WireError
from share.net.keys import AgentKeys, agent_keys, default_folder, edge_keys, has_pair, load
from share.net.transport import AgentLink, connect, parse_address
from share.protocol.versions import EdgeVersion
from share.recordings.calibration import read_calibration
from share.sensors.profile import HostProfile
from share.sensors.profile_types import HostFacts, Profile
from share.wire.codec import Bytes, decode, encode
from share.wire.messages import Message, Ping, Pong

_REALSENSE = "RealSense"
_PORT = 5555  # of `share edge`
_PPD = "sudo systemctl mask --now power-profiles-daemon  # or it sets powersave again at the next start"


def of_host(profile: HostProfile, out: Path) -> list[Finding]:
    wanted = profile.host
    where, free = facts.free_bytes(out)
    return [
        checks.libraries(facts.native_libraries(), _frozen()),
        checks.governor(facts.governors(), wanted.cpu_governor, _governor_mend(wanted)),
        checks.throttling(facts.throttles(), facts.pi_throttled()),
        checks.disk(str(where), free, _bytes_s(profile.sensor), os.access(where, os.W_OK)),
        checks.clock_of_edge() if profile.role == "edge" else _clock(),
    ]


def ask(profile: HostProfile) -> Sdk | None:
    """What librealsense sees; None where the profile's device is no RealSense."""
    if profile.sensor is None or _REALSENSE not in profile.sensor.device.model:
        return None
    return asked.ask()


def of_camera(profile: HostProfile, sdk: Sdk | None) -> list[Finding]:
    """sdk: as `ask` found it."""
    if profile.sensor is None or sdk is None:
        return [skipped("camera", f"profile '{profile.name}' has none that can be asked")]
    wanted, found = profile.host, facts.cameras()
    good, oldest = profile.sensor.device.firmware, profile.sensor.device.firmware_oldest
    return [
        camera_check.link(found),
        camera_check.sdk(sdk, found or (), _frozen()),
        camera_check.firmware(sdk, good, oldest),
        camera_check.udev(facts.camera_rules(), os.geteuid() == 0),
        camera_check.imu(found or ()),
        camera_check.autosuspend(found or (), wanted.usb_autosuspend),
        camera_check.usb_memory(facts.usb_memory_mb(), wanted.usbfs_mb, _boot(wanted)),
    ]


def of_calibration(profile: HostProfile, folder: Path | None, sdk: Sdk | None) -> list[Finding]:
    """sdk: as `ask` found it."""
    if profile.sensor is None:
        return [skipped("calibration", f"profile '{profile.name}' has no device")]
    if folder is None:
        return [skipped("calibration", "none given: --calib DIR")]
    try:
        found = read_calibration(folder)
        age_days = (time.time() - Path(found.where).stat().st_mtime) / 86400
    except (ShareError, OSError) as error:
        return [fail("calibration", str(error))]
    sensor = profile.sensor
    size = (sensor.mode.width, sensor.mode.height)
    whole = calibration(found.rig, age_days, sensor.device.T_imu_cam0, sensor.baseline_m, size)
    return [whole, device(found.serials, () if sdk is None else sdk.serials)]


def of_port(profile: HostProfile) -> list[Finding]:
    """Only of a computer that is to be an edge."""
    return [checks.port(_PORT, facts.port_free(_PORT))] if profile.role == "edge" else []


def of_edge(
    profile: HostProfile, address: str | None, keys: Path | None, server_key: str | None
) -> list[Finding]:
    """This machine's keys, and the edge by them. Raises UsageError for an address that is none."""
    if address is not None:
        parse_address(address)
    pair, with_keys = _keys(keys or default_folder(), server_key, profile.role == "edge")
    if address is None:
        return [pair, skipped("edge", "none given: --edge tcp://HOST:PORT")]
    if server_key is not None and with_keys is None:
        return [pair, skipped("edge", "not without keys that can be used")]
    try:
        return [pair, probe(address, with_keys)]
    except ShareError as error:
        return [pair, fail("edge", str(error))]


def _keys(folder: Path, server_key: str | None, is_edge: bool) -> tuple[Finding, AgentKeys | None]:
    try:
        if server_key is None and is_edge:
            return _keys_of_edge(folder), None
        if server_key is not None:
            both = agent_keys(folder, server_key)
            return ok("keys", f"{both.own.name}, and that of the edge"), both
        if not has_pair(folder):
            return skipped("keys", f"{folder}: none; needed only for an edge on another machine"), None
        return ok("keys", f"{load(folder).name}"), None
    except ShareError as error:
        return fail("keys", str(error)), None


def _keys_of_edge(folder: Path) -> Finding:
    """Raises UsageError."""
    if not has_pair(folder):
        return checks.no_edge_keys(str(folder))
    keys = edge_keys(folder)
    return checks.edge_keys(keys.own.name, sorted(set(keys.allowed.names().values())))


def _clock() -> Finding:
    try:
        found = of_chrony(checks.CLOCK_LIMIT_MS)
    except ShareError as error:
        return checks.clock(None, str(error))
    if found is None:
        return checks.clock(None, None)
    if found.offset_ms is None or found.uncertainty_ms is None:
        return checks.clock(None, f"chronyd {found.wrong}")
    return checks.clock((found.offset_ms, found.uncertainty_ms), None)


def _frozen() -> bool:
    return bool(getattr(sys, "frozen", False))


def _boot(wanted: HostFacts) -> tuple[str, ...]:
    return checks.mend(wanted.cpu_governor, wanted.usbfs_mb)


def _governor_mend(wanted: HostFacts) -> tuple[str, ...]:
    if wanted.cpu_governor != "powersave" and facts.resets_governor():
        return _PPD, *_boot(wanted)
    return _boot(wanted)


def _bytes_s(sensor: Profile | None) -> float:
    """Two gray images, uncompressed; nothing where there is no camera."""
    if sensor is None:
        return 0.0
    return 2.0 * sensor.mode.width * sensor.mode.height * sensor.rate_hz


# ---- Is an edge there, does it take our keys, does it speak our version, and how far is it?

_PATIENCE_S = 4.0


def probe(address: str, keys: AgentKeys | None, patience_s: float = _PATIENCE_S) -> Finding:
    """By pings, which an edge answers to strangers: no agent is made. Raises UsageError for an address."""
    with closing(connect(address, secrets.randbits(63), keys)) as link:
        try:
            took_s = _round_trip(link, time.monotonic() + patience_s)
        except WireError as error:
            return fail("edge", f"{address}: {error}", "install one version of SHARE on both machines")
        trouble = link.trouble()
    if took_s is not None:
        return ok("edge", f"{address}: answers in {took_s * 1e3:.1f} ms")
    if trouble is not None:
        return fail("edge", f"{address}: {trouble}")
    mend = f"start it there: share edge --bind {address}; is the port open?"
    return fail("edge", f"{address}: no answer within {patience_s:g} s", mend)


def _round_trip(link: AgentLink, until_s: float) -> float | None:
    """Of the quickest answer to several pings, s; None where none came."""
    sent, edge = 0, EdgeVersion()
    edge.reached()
    took: list[float] = []
    while time.monotonic() < until_s and len(took) < 5:
        sent += link.send(encode(Ping(sent, time.monotonic_ns())))
        if not took:
            for ping in edge.pings(time.monotonic_ns()):
                link.send(ping)
        frames = link.receive(100)
        message = None if frames is None else _decoded(frames, edge)
        if isinstance(message, Pong):
            took.append((time.monotonic_ns() - message.sent_ns) / 1e9)
    return min(took, default=None)


def _decoded(frames: Sequence[Bytes], edge: EdgeVersion) -> Message | None:
    """Raises WireError, which says of an older edge that it is one."""
    try:
        return decode(frames)
    except VersionError as error:
        if (line := edge.heard(frames, error)) is None:
            return None
        raise WireError(line) from None
