"""`share doctor`: read facts of this device (`share.devices.host`) and judge them by a profile
(`share.devices.checks`)."""

from __future__ import annotations

import os
import secrets
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from share.cameras.realsense import devices
from share.devices import camera_check, checks
from share.devices import host as facts
from share.devices.camera_check import SdkReport
from share.devices.checks import CheckResult, check_calibration, check_serial, fail, ok, skipped
from share.devices.clocks import check_chrony
from share.errors import ShareError, VersionError, WireError
from share.net.keys import AgentKeys, agent_keys, default_folder, edge_keys, has_pair, load_pair
from share.net.transport import AgentLink, connect, parse_address
from share.protocol.versions import EdgeVersionProbe
from share.recordings.calibration import read_calibration
from share.sensors.profile import HostProfile
from share.sensors.profile_types import HostFacts, Profile
from share.wire.codec import decode, encode
from share.wire.layouts import Bytes
from share.wire.messages import Message, Ping, Pong

_REALSENSE_MODEL = "RealSense"
_PORT = 5555  # of `share edge`
_EDGE_TIMEOUT_S = 4.0
_DISABLE_PPD_COMMAND = (
    "sudo systemctl mask --now power-profiles-daemon  # or it sets powersave again at the next start"
)


def inspect_device(profile: HostProfile, calib: Path | None, out: Path) -> list[CheckResult]:
    """Check camera, calibration, computer and port. calib: folder. out: folder on the disk to check."""
    sdk = _query_sdk(profile)
    return [
        *_inspect_camera(profile, sdk),
        *_inspect_calibration(profile, calib, sdk),
        *_inspect_host(profile, out),
        *_inspect_port(profile),
    ]


def _inspect_host(profile: HostProfile, out: Path) -> list[CheckResult]:
    required = profile.host
    where, free = facts.free_disk_bytes(out)
    return [
        checks.check_libraries(facts.native_libraries(), _is_frozen()),
        checks.check_governor(facts.governors(), required.cpu_governor, _governor_fix(required)),
        checks.check_throttling(facts.throttle_counts(), facts.pi_throttled_bits()),
        checks.check_disk(str(where), free, _bytes_per_s(profile.sensor), os.access(where, os.W_OK)),
        checks.check_edge_clock() if profile.role == "edge" else _inspect_clock(),
    ]


def _query_sdk(profile: HostProfile) -> SdkReport | None:
    """Return librealsense's view of the cameras; None if the profile's device is no RealSense."""
    if profile.sensor is None or _REALSENSE_MODEL not in profile.sensor.device.model:
        return None
    return devices.probe_sdk()


def _inspect_camera(profile: HostProfile, sdk: SdkReport | None) -> list[CheckResult]:
    """sdk: from `_query_sdk`."""
    if profile.sensor is None or sdk is None:
        return [skipped("camera", f"profile '{profile.name}' has no RealSense camera")]
    required, cameras = profile.host, facts.cameras()
    known_good, oldest = profile.sensor.device.firmware, profile.sensor.device.firmware_oldest
    return [
        camera_check.check_link(cameras),
        camera_check.check_sdk(sdk, cameras or (), _is_frozen()),
        camera_check.check_firmware(sdk, known_good, oldest),
        camera_check.check_udev(facts.camera_rules(), os.geteuid() == 0),
        camera_check.check_imu(cameras or ()),
        camera_check.check_autosuspend(cameras or (), required.usb_autosuspend),
        camera_check.check_usb_memory(facts.usb_memory_mb(), required.usbfs_mb, _boot_fix(required)),
    ]


def _inspect_calibration(
    profile: HostProfile, folder: Path | None, sdk: SdkReport | None
) -> list[CheckResult]:
    """sdk: from `_query_sdk`."""
    if profile.sensor is None:
        return [skipped("calibration", f"profile '{profile.name}' has no device")]
    if folder is None:
        return [skipped("calibration", "none given: --calib DIR")]
    try:
        loaded = read_calibration(folder)
        age_days = (time.time() - Path(loaded.where).stat().st_mtime) / 86400
    except (ShareError, OSError) as error:
        return [fail("calibration", str(error))]
    sensor = profile.sensor
    size = (sensor.mode.width, sensor.mode.height)
    result = check_calibration(loaded.rig, age_days, sensor.device.T_imu_cam0, sensor.baseline_m, size)
    return [result, check_serial(loaded.serials, () if sdk is None else sdk.serials)]


def _inspect_port(profile: HostProfile) -> list[CheckResult]:
    """Check the edge's port, only for an edge profile."""
    return [checks.check_port(_PORT, facts.is_port_free(_PORT))] if profile.role == "edge" else []


def inspect_edge(
    profile: HostProfile, address: str | None, keys: Path | None, server_key: str | None
) -> list[CheckResult]:
    """Check this machine's keys, and reach the edge with them. Raises UsageError for a malformed address."""
    if address is not None:
        parse_address(address)
    own_keys, usable_keys = _inspect_keys(keys or default_folder(), server_key, profile.role == "edge")
    if address is None:
        return [own_keys, skipped("edge", "none given: --edge tcp://HOST:PORT")]
    if server_key is not None and usable_keys is None:
        return [own_keys, skipped("edge", "needs usable keys")]
    try:
        return [own_keys, probe_edge(address, usable_keys)]
    except ShareError as error:
        return [own_keys, fail("edge", str(error))]


def _inspect_keys(
    folder: Path, server_key: str | None, is_edge: bool
) -> tuple[CheckResult, AgentKeys | None]:
    try:
        if server_key is None and is_edge:
            return _inspect_edge_keys(folder), None
        if server_key is not None:
            pair = agent_keys(folder, server_key)
            return ok("keys", f"{pair.own.name}, and the edge's public key"), pair
        if not has_pair(folder):
            return skipped("keys", f"{folder}: none; needed only for an edge on another machine"), None
        return ok("keys", f"{load_pair(folder).name}"), None
    except ShareError as error:
        return fail("keys", str(error)), None


def _inspect_edge_keys(folder: Path) -> CheckResult:
    """Raises UsageError."""
    if not has_pair(folder):
        return checks.missing_edge_keys(str(folder))
    keys = edge_keys(folder)
    return checks.check_edge_keys(keys.own.name, sorted(set(keys.allowed.names_by_key().values())))


def _inspect_clock() -> CheckResult:
    try:
        chrony_clock = check_chrony(checks.CLOCK_LIMIT_MS)
    except ShareError as error:
        return checks.check_clock(None, str(error))
    if chrony_clock is None:
        return checks.check_clock(None, None)
    if chrony_clock.offset_ms is None or chrony_clock.uncertainty_ms is None:
        return checks.check_clock(None, f"chronyd {chrony_clock.wrong}")
    return checks.check_clock((chrony_clock.offset_ms, chrony_clock.uncertainty_ms), None)


def _is_frozen() -> bool:
    return bool(getattr(sys, "frozen", False))


def _boot_fix(required: HostFacts) -> tuple[str, ...]:
    return checks.boot_settings_fix(required.cpu_governor, required.usbfs_mb)


def _governor_fix(required: HostFacts) -> tuple[str, ...]:
    if required.cpu_governor != "powersave" and facts.is_governor_reset():
        return _DISABLE_PPD_COMMAND, *_boot_fix(required)
    return _boot_fix(required)


def _bytes_per_s(sensor: Profile | None) -> float:
    """Return the data rate of two uncompressed gray images; 0 without a camera."""
    if sensor is None:
        return 0.0
    return 2.0 * sensor.mode.width * sensor.mode.height * sensor.rate_hz


def probe_edge(address: str, keys: AgentKeys | None) -> CheckResult:
    """Check that an edge answers at `address`, accepts `keys` and speaks our version; measure its round trip.

    Uses pings, which an edge answers without a hello: no agent is created. Raises UsageError for a malformed
    address.
    """
    with closing(connect(address, secrets.randbits(63), keys)) as link:
        try:
            round_trip_s = _measure_round_trip(link, time.monotonic() + _EDGE_TIMEOUT_S)
        except WireError as error:
            return fail("edge", f"{address}: {error}", "install one version of SHARE on both machines")
        trouble = link.trouble()
    if round_trip_s is not None:
        return ok("edge", f"{address}: answers in {round_trip_s * 1e3:.1f} ms")
    if trouble is not None:
        return fail("edge", f"{address}: {trouble}")
    fix = f"start it there: share edge --bind {address}, and check that the port is open"
    return fail("edge", f"{address}: no answer within {_EDGE_TIMEOUT_S:g} s", fix)


def _measure_round_trip(link: AgentLink, deadline_s: float) -> float | None:
    """Return the shortest of up to five round trips, s; None without an answer."""
    sent, edge = 0, EdgeVersionProbe()
    edge.mark_reached()
    round_trips_s: list[float] = []
    while time.monotonic() < deadline_s and len(round_trips_s) < 5:
        sent += link.send(encode(Ping(sent, time.monotonic_ns())))
        if not round_trips_s:
            for ping in edge.pings(time.monotonic_ns()):
                link.send(ping)
        frames = link.receive(100)
        message = None if frames is None else _decode_reply(frames, edge)
        if isinstance(message, Pong):
            round_trips_s.append((time.monotonic_ns() - message.sent_ns) / 1e9)
    return min(round_trips_s, default=None)


def _decode_reply(frames: Sequence[Bytes], edge: EdgeVersionProbe) -> Message | None:
    """Return the message. Raises WireError, with a clear line for an edge of another version."""
    try:
        return decode(frames)
    except VersionError as error:
        if (line := edge.check_message(frames, error)) is None:
            return None
        raise WireError(line) from None
