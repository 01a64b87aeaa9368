"""Checks of a device: calibration, CPU governor, throttling, disk, clock, libraries, keys, port.

Each judges plain facts, read by `share.devices.host`, and says how to fix what is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from share.geometry.camera import Rig
from share.geometry.se3 import inverse, rotation_angle
from share.types import F64

TMPFILES_PATH = "/etc/tmpfiles.d/share.conf"
_GOVERNOR = "/sys/devices/system/cpu/cpufreq/policy*/scaling_governor"
_USB_MEMORY = "/sys/module/usbcore/parameters/usbfs_memory_mb"
CLOCK_LIMIT_MS = 1.0  # as `share sync check`
_MIN_MINUTES = 5.0  # of recording until the disk is full; less fails
_ENOUGH_MINUTES = 60.0  # the same; less warns

# Calibration. Units of one model differ by millimetres and a degree or two.
_MAX_AGE_DAYS = 365.0
_MAX_OFFSET_M = 0.01
_MAX_OFFSET_RAD = np.deg2rad(5.0)
_MAX_BASELINE_ERROR = 0.05  # relative
_SERIAL_CHECK = "serial number"
_CALIBRATE_FIX = "calibrate again: docs/lookup/data.md says which files; give the folder with --calib"

# Raspberry Pi's get_throttled.
_UNDERVOLTAGE_BIT, _THROTTLED_BITS, _HOT_BIT = 0x1, 0xE, 0x8  # current state
_SINCE_START_SHIFT = 16  # to the bits that are kept since the start
_COOL_FIX = "cool it better (fan, dust, air), or reduce its load: a lower image rate"
_SUPPLY_FIX = (
    "supply 5.1 V and 3 A through a short, thick cable, or connect the camera to a powered USB 3 hub"
)


class CheckState(Enum):
    OK = "OK"
    WARN = "WARN"  # works, but not as well as it could
    FAIL = "FAIL"  # does not work
    SKIPPED = "SKIPPED"  # not visible, or not required


@dataclass(frozen=True)
class CheckResult:
    """Result of one check. name: of the check. what: the finding. fix: commands or advice, empty if none is
    needed."""

    name: str
    state: CheckState
    what: str
    fix: tuple[str, ...] = ()


def ok(name: str, what: str) -> CheckResult:
    return CheckResult(name, CheckState.OK, what)


def warn(name: str, what: str, *fix: str) -> CheckResult:
    return CheckResult(name, CheckState.WARN, what, fix)


def fail(name: str, what: str, *fix: str) -> CheckResult:
    return CheckResult(name, CheckState.FAIL, what, fix)


def skipped(name: str, why: str) -> CheckResult:
    return CheckResult(name, CheckState.SKIPPED, why)


def failures(findings: Iterable[CheckResult]) -> list[CheckResult]:
    return [finding for finding in findings if finding.state is CheckState.FAIL]


# ---- Settings at boot, by systemd-tmpfiles (tmpfiles.d(5))


def tmpfiles_lines(cpu_governor: str, usbfs_mb: int) -> tuple[str, ...]:
    """Return the lines that set both; none for "" or 0."""
    settings = {_GOVERNOR: cpu_governor, _USB_MEMORY: str(usbfs_mb or "")}
    return tuple(f"w {path} - - - - {value}" for path, value in settings.items() if value)


def boot_settings_fix(cpu_governor: str, usbfs_mb: int) -> tuple[str, ...]:
    """Return the commands that set both, now and at every boot. `tools/deploy` writes the same file."""
    quoted = " ".join(f"'{line}'" for line in tmpfiles_lines(cpu_governor, usbfs_mb))
    return (
        f"printf '%s\\n' {quoted} | sudo tee {TMPFILES_PATH}",
        f"sudo systemd-tmpfiles --create {TMPFILES_PATH}",
    )


# ---- Calibration


def check_calibration(
    rig: Rig, age_days: float, T_imu_cam0: F64, baseline_m: float, size: tuple[int, int]
) -> CheckResult:
    """Compare a calibration with the profile's nominal T_imu_cam0 (4, 4), baseline_m and default image
    size."""
    if rig.imu is None:
        return fail("calibration", "has no IMU chain, kalibr_imu_chain.yaml", _CALIBRATE_FIX)
    if rig.T_cam1_cam0 is not None and (wrong := _baseline_problem(rig.T_cam1_cam0, baseline_m)):
        return fail("calibration", wrong, _CALIBRATE_FIX)
    if not _is_near(rig.T_body_cam0, T_imu_cam0):
        return _misplaced_result(rig.T_body_cam0, T_imu_cam0)
    size_found = (rig.cam0.width, rig.cam0.height)
    words = f"{size_found[0]}x{size_found[1]}"
    mode = "" if size_found == size else f"; valid only with --mode {words}"
    what = f"cameras ({words}) and IMU, {age_days:.0f} days old{mode}"
    return ok("calibration", what) if age_days <= _MAX_AGE_DAYS else warn("calibration", what, _CALIBRATE_FIX)


def check_serial(calibrated: Sequence[str], attached: Sequence[str]) -> CheckResult:
    """Check that the calibration belongs to an attached camera. Both: serial numbers, each once."""
    if not calibrated:
        return skipped(_SERIAL_CHECK, "the calibration names no serial number")
    if len(calibrated) > 1:
        return warn(
            _SERIAL_CHECK,
            f"its files belong to different devices: {', '.join(calibrated)}",
            *_factory_calibration_fix(attached),
        )
    if not attached:
        return skipped(
            _SERIAL_CHECK, f"the calibration belongs to {calibrated[0]}; no camera reports its serial number"
        )
    if calibrated[0] in attached:
        return ok(_SERIAL_CHECK, f"{calibrated[0]}, as the calibration says")
    return warn(
        _SERIAL_CHECK,
        f"the calibration belongs to {calibrated[0]}; attached is {', '.join(attached)}",
        *_factory_calibration_fix(attached),
    )


def _factory_calibration_fix(attached: Sequence[str]) -> tuple[str, ...]:
    what = "the factory calibration; then give that folder with --calib"
    return tuple(f"share calibrate realsense {one} --out calib/{one}  # {what}" for one in attached)


def _baseline_problem(T_cam1_cam0: F64, baseline_m: float) -> str | None:
    """Return what is wrong with cam1's position, None if nothing. cam1 is right of cam0, so x is negative."""
    found_m = float(np.linalg.norm(T_cam1_cam0[:3, 3]))
    if abs(found_m - baseline_m) > _MAX_BASELINE_ERROR * baseline_m:
        return f"baseline {found_m * 1e3:.1f} mm, the device has {baseline_m * 1e3:.1f} mm"
    if T_cam1_cam0[0, 3] > 0:
        return "cam1 is left of cam0: T_cn_cnm1 is inverted, or the cameras are swapped"
    return None


def _misplaced_result(calibrated: F64, expected: F64) -> CheckResult:
    if _is_near(inverse(calibrated), expected):
        fix = "swap the names T_cam_imu and T_imu_cam in the file, or invert the matrix"
        return fail("calibration", "the extrinsics to the IMU are inverted", fix)
    offset_mm = 1e3 * float(np.linalg.norm(calibrated[:3, 3] - expected[:3, 3]))
    angle_deg = np.rad2deg(rotation_angle(inverse(calibrated) @ expected))
    what = f"cam0 is {offset_mm:.0f} mm and {angle_deg:.0f}° from its nominal pose at the IMU"
    return warn("calibration", what, _CALIBRATE_FIX)


def _is_near(a: F64, b: F64) -> bool:
    return bool(
        np.linalg.norm(a[:3, 3] - b[:3, 3]) <= _MAX_OFFSET_M
        and rotation_angle(inverse(a) @ b) <= _MAX_OFFSET_RAD
    )


# ---- Processor, disk, clock, libraries


def check_governor(current: Sequence[str], required: str, fix: Sequence[str] = ()) -> CheckResult:
    """current: of each core. required: "" if the profile sets none. fix: see `boot_settings_fix`."""
    if not required:
        return skipped("CPU governor", "not required by the profile")
    if not current:
        return skipped("CPU governor", "the cores show none (a container or virtual machine?)")
    others = sorted(set(current) - {required})
    if not others:
        return ok("CPU governor", f"{required} on {len(current)} cores")
    count = sum(one != required for one in current)
    what = f"{', '.join(others)} on {count} of {len(current)} cores, the profile requires {required}"
    return warn("CPU governor", what, *fix)


def check_throttling(counts: Sequence[int], pi: int | None = None) -> CheckResult:
    """counts: how often heat slowed each core since the start. pi: a Raspberry Pi's get_throttled."""
    if pi is not None:
        return _check_pi_throttling(pi)
    if not counts:
        return skipped("throttling", "no counters (neither Intel nor a Raspberry Pi, or a virtual machine)")
    if not any(counts):
        return ok("throttling", "none since the start")
    what = f"slowed by heat, {max(counts)} times on one core since the start"
    return warn("throttling", what, _COOL_FIX)


def _check_pi_throttling(bits: int) -> CheckResult:
    """bits: of the firmware: 0 undervoltage, 1 frequency capped, 2 throttled, 3 soft temperature limit
    (Raspberry Pi documentation, vcgencmd get_throttled)."""
    now, since_start = bits, bits | bits >> _SINCE_START_SHIFT
    if not since_start & (_UNDERVOLTAGE_BIT | _THROTTLED_BITS):
        return ok("throttling", "none since the start")
    what = []
    if since_start & _UNDERVOLTAGE_BIT:
        what.append(f"the supply voltage {'is' if now & _UNDERVOLTAGE_BIT else 'was'} too low")
    if since_start & _THROTTLED_BITS:
        what.append("it is slowed" if now & _THROTTLED_BITS else "it was slowed since the start")
    needed = (
        (_SUPPLY_FIX, since_start & _UNDERVOLTAGE_BIT),
        (_COOL_FIX, since_start & _HOT_BIT or not since_start & _UNDERVOLTAGE_BIT),
    )
    fixes = [fix for fix, is_needed in needed if is_needed]
    return warn("throttling", f"{' and '.join(what)} (get_throttled 0x{bits:x})", *fixes)


def check_disk(where: str, free_bytes: int, bytes_s: float, may_write: bool = True) -> CheckResult:
    """bytes_s: highest recording rate, 0 if nothing is recorded. may_write: this user may write there."""
    what = f"{where}: {free_bytes / 1e9:.1f} GB free"
    if not may_write:
        return fail("disk", f"{where}: this user may not write there", "choose another --out")
    if not bytes_s:
        return ok("disk", what) if free_bytes > 1e9 else fail("disk", what, f"df -h {where}; make room")
    minutes = free_bytes / bytes_s / 60
    what += f", {minutes:.0f} min at {bytes_s / 1e6:.0f} MB/s of uncompressed images"
    fix = f"make room (df -h {where}), or choose another --out"
    if minutes < _MIN_MINUTES:
        return fail("disk", what, fix)
    return ok("disk", what) if minutes >= _ENOUGH_MINUTES else warn("disk", what, fix)


def check_clock(known: tuple[float, float] | None, trouble: str | None) -> CheckResult:
    """known: offset and its largest error, ms. trouble: why it is unknown. Both None if no chronyd runs."""
    if trouble is not None:
        return warn("clock", trouble, "chronyc sources")
    if known is None:
        fix = (
            "sudo apt install chrony",
            "share sync check HOST  # the edge's machine: prints the lines for chrony.conf",
        )
        return warn("clock", "no chronyd runs here: this clock is not synchronised with the others", *fix)
    offset_ms, uncertainty_ms = known
    what = f"{offset_ms:+.3f} ± {uncertainty_ms:.3f} ms"
    if abs(offset_ms) + uncertainty_ms <= CLOCK_LIMIT_MS:
        return ok("clock", what)
    return warn(
        "clock", f"{what}, should be within {CLOCK_LIMIT_MS:g} ms", "chronyc sources; share sync check HOST"
    )


def check_edge_clock() -> CheckResult:
    """Return OK: the other devices follow an edge's clock, which needs no reference."""
    return ok("clock", "with `share sync server` all devices follow this clock, which may be off")


def check_libraries(load_errors: Mapping[str, str | None], frozen: bool = False) -> CheckResult:
    """load_errors: by library, None if it loads. frozen: this is a frozen program, into which nothing can be
    installed."""
    broken = {name: why for name, why in load_errors.items() if why is not None}
    if not broken:
        slower = "" if "poselib" in load_errors else "; without poselib, the slower OpenCV estimates poses"
        return ok("libraries", f"{', '.join(load_errors)} load{slower}")
    what = "; ".join(f"{name}: {why}" for name, why in broken.items())
    fix = "pip install --force-reinstall share-slam, for this Python and processor"
    if frozen:
        fix = "deploy a program that was frozen on a machine of this kind: make freeze, then tools/deploy"
    return fail("libraries", what, fix)


def check_edge_keys(own: str, allowed: Sequence[str]) -> CheckResult:
    """own: name of the edge's pair. allowed: names on its list."""
    if allowed:
        return ok("keys", f"{own}; authorized: {', '.join(allowed)}")
    return warn(
        "keys",
        f"{own}; no other machine is authorized",
        "share keys authorize NAME 'PUBLIC KEY OF THE AGENT'",
    )


def missing_edge_keys(folder: str) -> CheckResult:
    what = f"{folder}: none; without keys the edge serves this machine alone"
    return warn("keys", what, "share keys generate")


def check_port(number: int, is_free: bool) -> CheckResult:
    """Check the edge's default port."""
    if is_free:
        return ok("port", f"{number} is free for the edge")
    command = f"ss -ltnp 'sport = :{number}'  # if not an edge: share edge --bind tcp://0.0.0.0:PORT"
    return warn("port", f"{number} is in use", command)
