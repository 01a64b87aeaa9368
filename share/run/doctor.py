"""Looks at this device as a profile wants it: facts read by `share.io`, judged by `share.core.checkup`."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from share.core.checkup import Finding, boot, camera, fail, host, ok, skipped
from share.core.checkup.calibration import calibration, device
from share.core.checkup.camera import Sdk
from share.errors import ShareError
from share.io import host as facts
from share.io.calibration import read_calibration
from share.io.keys import AgentKeys, agent_keys, default_folder, edge_keys, has_pair, load
from share.io.profile import HostProfile
from share.io.profile_types import HostFacts, Profile
from share.io.realsense import asked
from share.io.transport import parse_address
from share.run.clocks import of_chrony
from share.run.edge_probe import probe

_REALSENSE = "RealSense"
_PORT = 5555  # of `share edge`
_PPD = "sudo systemctl mask --now power-profiles-daemon  # or it sets powersave again at the next start"


def of_host(profile: HostProfile, out: Path) -> list[Finding]:
    wanted = profile.host
    where, free = facts.free_bytes(out)
    return [
        host.libraries(facts.native_libraries(), _frozen()),
        host.governor(facts.governors(), wanted.cpu_governor, _governor_mend(wanted)),
        host.throttling(facts.throttles(), facts.pi_throttled()),
        host.disk(str(where), free, _bytes_s(profile.sensor), os.access(where, os.W_OK)),
        host.clock_of_edge() if profile.role == "edge" else _clock(),
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
        camera.link(found),
        camera.sdk(sdk, found or (), _frozen()),
        camera.firmware(sdk, good, oldest),
        camera.udev(facts.camera_rules(), os.geteuid() == 0),
        camera.imu(found or ()),
        camera.autosuspend(found or (), wanted.usb_autosuspend),
        camera.usb_memory(facts.usb_memory_mb(), wanted.usbfs_mb, _boot(wanted)),
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
    return [host.port(_PORT, facts.port_free(_PORT))] if profile.role == "edge" else []


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
        return host.no_edge_keys(str(folder))
    keys = edge_keys(folder)
    return host.edge_keys(keys.own.name, sorted(set(keys.allowed.names().values())))


def _clock() -> Finding:
    try:
        found = of_chrony(host.CLOCK_LIMIT_MS)
    except ShareError as error:
        return host.clock(None, str(error))
    if found is None:
        return host.clock(None, None)
    if found.offset_ms is None or found.uncertainty_ms is None:
        return host.clock(None, f"chronyd {found.wrong}")
    return host.clock((found.offset_ms, found.uncertainty_ms), None)


def _frozen() -> bool:
    return bool(getattr(sys, "frozen", False))


def _boot(wanted: HostFacts) -> tuple[str, ...]:
    return boot.mend(wanted.cpu_governor, wanted.usbfs_mb)


def _governor_mend(wanted: HostFacts) -> tuple[str, ...]:
    if wanted.cpu_governor != "powersave" and facts.resets_governor():
        return _PPD, *_boot(wanted)
    return _boot(wanted)


def _bytes_s(sensor: Profile | None) -> float:
    """Two gray images, uncompressed; nothing where there is no camera."""
    if sensor is None:
        return 0.0
    return 2.0 * sensor.mode.width * sensor.mode.height * sensor.rate_hz
