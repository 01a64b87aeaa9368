"""The computer: its processor, disk, clock and libraries."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from share.geometry.camera import Rig
from share.geometry.se3 import angle, inverse
from share.types import F64

# ---- What a device must have for SHARE, judged from plain facts: what was found, and how to mend it.
#
# Nothing here looks at the machine: `share.devices.host` reads the facts.


class State(Enum):
    OK = "OK"
    WARN = "WARN"  # it works, but not as well as it could
    FAIL = "FAIL"  # it does not work
    SKIPPED = "SKIPPED"  # it could not be seen, or is not asked for


@dataclass(frozen=True)
class Finding:
    """name: what was looked at. what: what was found, for a person. mend: lines to paste or to read, none
    where nothing is to be done."""

    name: str
    state: State
    what: str
    mend: tuple[str, ...] = ()


def ok(name: str, what: str) -> Finding:
    return Finding(name, State.OK, what)


def warn(name: str, what: str, *mend: str) -> Finding:
    return Finding(name, State.WARN, what, mend)


def fail(name: str, what: str, *mend: str) -> Finding:
    return Finding(name, State.FAIL, what, mend)


def skipped(name: str, why: str) -> Finding:
    return Finding(name, State.SKIPPED, why)


def failures(findings: Iterable[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.state is State.FAIL]


# ---- What a computer is set to at every start: lines of systemd-tmpfiles, tmpfiles.d(5).

FILE = "/etc/tmpfiles.d/share.conf"
_GOVERNOR = "/sys/devices/system/cpu/cpufreq/policy*/scaling_governor"
_USB_MEMORY = "/sys/module/usbcore/parameters/usbfs_memory_mb"


def lines(cpu_governor: str, usbfs_mb: int) -> tuple[str, ...]:
    """None of what is "" or 0, which is left as it is."""
    wanted = {_GOVERNOR: cpu_governor, _USB_MEMORY: str(usbfs_mb or "")}
    return tuple(f"w {path} - - - - {value}" for path, value in wanted.items() if value)


def mend(cpu_governor: str, usbfs_mb: int) -> tuple[str, ...]:
    """What sets both, now and at every start: `tools/deploy` writes the same file."""
    quoted = " ".join(f"'{line}'" for line in lines(cpu_governor, usbfs_mb))
    return f"printf '%s\\n' {quoted} | sudo tee {FILE}", f"sudo systemd-tmpfiles --create {FILE}"


# ---- The calibration: is it of this device, and the right way round?

_OLD_DAYS = 365.0
_NEAR_M, _NEAR_RAD = 0.01, np.deg2rad(5.0)  # units of one model differ by millimetres and a degree or two
_BASELINE = 0.05  # relative
_DEVICE = "serial number"
_CALIBRATE = "calibrate again: docs/data.md says which files; give the folder with --calib"


def calibration(
    rig: Rig, age_days: float, T_imu_cam0: F64, baseline_m: float, size: tuple[int, int]
) -> Finding:
    """Against what the profile says of such devices: T_imu_cam0 (4, 4), baseline_m, size of images where no
    --mode is given."""
    if rig.imu is None:
        return fail("calibration", "has no IMU chain, kalibr_imu_chain.yaml", _CALIBRATE)
    if rig.T_cam1_cam0 is not None and (wrong := _baseline(rig.T_cam1_cam0, baseline_m)):
        return fail("calibration", wrong, _CALIBRATE)
    if not _near(rig.T_body_cam0, T_imu_cam0):
        return _elsewhere(rig.T_body_cam0, T_imu_cam0)
    found = (rig.cam0.width, rig.cam0.height)
    words = f"{found[0]}x{found[1]}"
    mode = "" if found == size else f"; goes with --mode {words} only"
    what = f"cameras ({words}) and IMU, {age_days:.0f} days old{mode}"
    return ok("calibration", what) if age_days <= _OLD_DAYS else warn("calibration", what, _CALIBRATE)


def device(said: Sequence[str], there: Sequence[str]) -> Finding:
    """Whether it is of a camera that is plugged in. said, there: serial numbers, each once."""
    if not said:
        return skipped(_DEVICE, "the calibration names no serial number")
    if len(said) > 1:
        return warn(_DEVICE, f"its files are of different devices: {', '.join(said)}", *_own(there))
    if not there:
        return skipped(_DEVICE, f"the calibration is of {said[0]}; no camera told its serial number")
    if said[0] in there:
        return ok(_DEVICE, f"{said[0]}, as the calibration says")
    return warn(_DEVICE, f"the calibration is of {said[0]}, plugged in is {', '.join(there)}", *_own(there))


def _own(there: Sequence[str]) -> tuple[str, ...]:
    what = "what the factory measured; then --calib with that folder"
    return tuple(f"share calibrate realsense {one} --out calib/{one}  # {what}" for one in there)


def _baseline(T_cam1_cam0: F64, baseline_m: float) -> str | None:
    """What is wrong with where cam1 is; None: nothing. Right of cam0, so x of cam0's origin is negative."""
    found = float(np.linalg.norm(T_cam1_cam0[:3, 3]))
    if abs(found - baseline_m) > _BASELINE * baseline_m:
        return f"baseline {found * 1e3:.1f} mm, the device has {baseline_m * 1e3:.1f} mm"
    return (
        "cam1 lies left of cam0: T_cn_cnm1 is inverted, or they are swapped"
        if T_cam1_cam0[0, 3] > 0
        else None
    )


def _elsewhere(found: F64, expected: F64) -> Finding:
    if _near(inverse(found), expected):
        mend = "swap the names T_cam_imu and T_imu_cam in the file, or invert the matrix"
        return fail("calibration", "the extrinsics to the IMU are inverted", mend)
    away = 1e3 * float(np.linalg.norm(found[:3, 3] - expected[:3, 3]))
    turned = np.rad2deg(angle(inverse(found) @ expected))
    what = f"cam0 is {away:.0f} mm and {turned:.0f}° from where such devices have it, by the IMU"
    return warn("calibration", what, _CALIBRATE)


def _near(a: F64, b: F64) -> bool:
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) <= _NEAR_M and angle(inverse(a) @ b) <= _NEAR_RAD)


_LEAST_MINUTES, _ENOUGH_MINUTES = 5.0, 60.0
CLOCK_LIMIT_MS = 1.0  # as `share sync check`


def governor(found: Sequence[str], wanted: str, mend: Sequence[str] = ()) -> Finding:
    """found: of each core. wanted: "" where the profile leaves it. mend: what sets it, see `boot.mend`."""
    if not wanted:
        return skipped("CPU governor", "the profile leaves it")
    if not found:
        return skipped("CPU governor", "the cores show none (a container, a virtual machine?)")
    others = sorted(set(found) - {wanted})
    if not others:
        return ok("CPU governor", f"{wanted} on {len(found)} cores")
    count = sum(one != wanted for one in found)
    what = f"{', '.join(others)} on {count} of {len(found)} cores, the profile wants {wanted}"
    return warn("CPU governor", what, *mend)


def throttling(counts: Sequence[int], pi: int | None = None) -> Finding:
    """counts: how often each core was slowed by heat since it was started. pi: a Raspberry Pi's own bits."""
    if pi is not None:
        return _pi_throttling(pi)
    if not counts:
        return skipped(
            "throttling", "nobody counts it (neither Intel nor a Raspberry Pi, or a virtual machine)"
        )
    if not any(counts):
        return ok("throttling", "none since the start")
    what = f"slowed by heat, {max(counts)} times on one core since the start"
    return warn("throttling", what, _COOL)


_COOL = "cool it better (fan, dust, air), or ask less of it: a lower image rate"
_SUPPLY = "give it 5.1 V and 3 A by a short, thick cable, or the camera a USB 3 hub with a supply of its own"
_VOLTAGE, _SLOWED, _HOT = 0x1, 0xE, 0x8  # bits of now
_EVER = 16  # by so many they are shifted for "since the start"


def _pi_throttling(bits: int) -> Finding:
    """Bits of the firmware: 0 too little voltage, 1 frequency capped, 2 throttled, 3 soft limit of
    temperature (Raspberry Pi documentation, vcgencmd get_throttled)."""
    now, ever = bits, bits | bits >> _EVER
    if not ever & (_VOLTAGE | _SLOWED):
        return ok("throttling", "none since the start")
    what = []
    if ever & _VOLTAGE:
        what.append(f"its supply {'gives' if now & _VOLTAGE else 'gave'} too little voltage")
    if ever & _SLOWED:
        what.append("it is slowed" if now & _SLOWED else "it was slowed since the start")
    needed = ((_SUPPLY, ever & _VOLTAGE), (_COOL, ever & _HOT or not ever & _VOLTAGE))
    mends = [mend for mend, there in needed if there]
    return warn("throttling", f"{' and '.join(what)} (get_throttled 0x{bits:x})", *mends)


def disk(where: str, free_bytes: int, bytes_s: float, may_write: bool = True) -> Finding:
    """bytes_s: what is written at most, 0 where nothing is recorded. may_write: whether this user may."""
    what = f"{where}: {free_bytes / 1e9:.1f} GB free"
    if not may_write:
        return fail("disk", f"{where}: this user may not write there", "give another --out")
    if not bytes_s:
        return ok("disk", what) if free_bytes > 1e9 else fail("disk", what, f"df -h {where}; make room")
    minutes = free_bytes / bytes_s / 60
    what += f", {minutes:.0f} min at {bytes_s / 1e6:.0f} MB/s, the images as they come"
    mend = f"make room (df -h {where}), or give another --out"
    if minutes < _LEAST_MINUTES:
        return fail("disk", what, mend)
    return ok("disk", what) if minutes >= _ENOUGH_MINUTES else warn("disk", what, mend)


def clock(known: tuple[float, float] | None, trouble: str | None) -> Finding:
    """known: offset and the most it is wrong by, ms. trouble: why it is not known, None with `known` None
    where no chronyd runs."""
    if trouble is not None:
        return warn("clock", trouble, "chronyc sources")
    if known is None:
        mend = (
            "sudo apt install chrony",
            "share sync check HOST  # the edge's machine: it says what to tell chrony",
        )
        return warn("clock", "no chronyd runs here: nothing keeps this clock with the others'", *mend)
    offset_ms, uncertainty_ms = known
    what = f"{offset_ms:+.3f} ± {uncertainty_ms:.3f} ms"
    if abs(offset_ms) + uncertainty_ms <= CLOCK_LIMIT_MS:
        return ok("clock", what)
    return warn(
        "clock", f"{what}, should be within {CLOCK_LIMIT_MS:g} ms", "chronyc sources; share sync check HOST"
    )


def clock_of_edge() -> Finding:
    """Others follow it, and it needs to follow none."""
    return ok("clock", "`share sync server` makes it the room's, right or not: devices follow it")


def libraries(found: Mapping[str, str | None], frozen: bool = False) -> Finding:
    """found: by library, why it does not load; None where it does. frozen: whether this is a program that
    brings its own Python, into which nothing can be installed."""
    broken = {name: why for name, why in found.items() if why is not None}
    if not broken:
        slower = "" if "poselib" in found else "; no poselib for this processor: OpenCV finds places, slower"
        return ok("libraries", f"{', '.join(found)} load{slower}")
    what = "; ".join(f"{name}: {why}" for name, why in broken.items())
    mend = "pip install --force-reinstall share-slam, for this Python and processor"
    if frozen:
        mend = "put a program here that was frozen on a machine of this kind: make freeze, then tools/deploy"
    return fail("libraries", what, mend)


def edge_keys(own: str, let_in: Sequence[str]) -> Finding:
    """own: name of its pair. let_in: names on its list."""
    if let_in:
        return ok("keys", f"{own}; lets in: {', '.join(let_in)}")
    return warn(
        "keys",
        f"{own}; lets in nobody from another machine",
        "share keys authorize NAME 'PUBLIC KEY OF THE AGENT'",
    )


def no_edge_keys(folder: str) -> Finding:
    what = f"{folder}: none; without them it serves this machine alone"
    return warn("keys", what, "share keys generate")


def port(number: int, free: bool) -> Finding:
    """Where an edge listens unless it is told otherwise."""
    if free:
        return ok("port", f"{number} is free for the edge")
    look = f"ss -ltnp 'sport = :{number}'  # an edge that runs? else: share edge --bind tcp://0.0.0.0:PORT"
    return warn("port", f"something listens at {number} already", look)
