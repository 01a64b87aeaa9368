"""The camera: is it there, on which link, with which firmware, and may one open it?"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from share.devices.checks import CheckResult, fail, ok, skipped, warn

_USB3_MBIT_S = 5000
_D435I = 'ATTRS{idVendor}=="8086", ATTRS{idProduct}=="0b3a"'
# The SDK starts the IMU by writing files in /sys, which MODE and GROUP do not reach.
_IMU_RULE = (
    f'{_D435I}, RUN+="/bin/chgrp -R plugdev /sys/%p /dev/%k", RUN+="/bin/chmod -R g+rwX /sys/%p /dev/%k"'
)
UDEV_RULES = (
    f'SUBSYSTEMS=="usb", {_D435I}, MODE:="0660", GROUP:="plugdev"',
    f'KERNEL=="iio*", {_IMU_RULE}',
    f'DRIVER=="hid_sensor_custom", {_IMU_RULE}',
    'SUBSYSTEM=="usb", ATTR{idVendor}=="8086", ATTR{idProduct}=="0b3a", ATTR{power/control}="on"',
)
_RULE_FILE = "/etc/udev/rules.d/99-share-realsense.rules"


@dataclass(frozen=True)
class UsbCamera:
    """As the kernel sees it. path: its name in /sys/bus/usb/devices. speed_mbit_s: of the link. control:
    power/control, "on" where it is never put to sleep; None where unknown. may_open: whether we may read and
    write its node in /dev. may_start_imu: whether we may write what starts its IMU; None where the kernel
    shows no IMU."""

    path: str
    speed_mbit_s: float
    control: str | None = None
    may_open: bool = True
    may_start_imu: bool | None = True


@dataclass(frozen=True)
class SdkReport:
    """What librealsense says. trouble: why it could not be asked, None where it was. firmware, serials: of
    each camera."""

    trouble: str | None = None
    firmware: tuple[str, ...] = ()
    serials: tuple[str, ...] = ()


def check_link(cameras: Sequence[UsbCamera] | None) -> CheckResult:
    """cameras: None where this machine shows no USB at all."""
    if cameras is None:
        return fail(
            "camera", "this system shows no USB devices (a container?)", "run it on the device itself"
        )
    if not cameras:
        return fail("camera", "no D435i (8086:0b3a) at any port", "plug it in; then: lsusb -d 8086:0b3a")
    slow = [camera for camera in cameras if camera.speed_mbit_s < _USB3_MBIT_S]
    if slow:
        what = (
            f"{slow[0].path}: USB 2 link, {slow[0].speed_mbit_s:g} Mbit/s: too slow for two images and an IMU"
        )
        return fail("camera", what, "take a USB 3 port and cable, push the plug in fast; then: lsusb -t")
    return ok("camera", ", ".join(f"{c.path}: USB 3, {c.speed_mbit_s:g} Mbit/s" for c in cameras))


def check_firmware(sdk: SdkReport, known_good: Sequence[str], oldest: str | None) -> CheckResult:
    """good: known to be good, and what is newer than all of them will do; oldest: what is below it is not to
    be trusted."""
    if sdk.trouble or not sdk.firmware:
        return skipped("firmware", "no camera told it")
    oldest_found = min(sdk.firmware, key=parse_version)
    known = sorted(map(parse_version, known_good))
    if oldest and parse_version(oldest_found) < parse_version(oldest):
        return fail("firmware", f"{oldest_found} is older than {oldest}", *_update_fix(known_good))
    if parse_version(oldest_found) in known:
        return ok("firmware", oldest_found)
    if known and parse_version(oldest_found) > known[-1]:
        return ok("firmware", f"{oldest_found}, newer than those tried: {', '.join(known_good)}")
    return warn(
        "firmware",
        f"{oldest_found} is not among those tried: {', '.join(known_good)}",
        *_update_fix(known_good),
    )


def _update_fix(known_good: Sequence[str]) -> tuple[str, ...]:
    return (
        f"rs-fw-update -l  # then: rs-fw-update -f FILE, with a file of one of {', '.join(known_good)}",
        "FILE: https://dev.realsenseai.com/docs/firmware-releases-d400",
        "rs-fw-update: in the maker's package librealsense2-utils, for any computer with the camera at it, "
        "https://github.com/realsenseai/librealsense/blob/master/doc/distribution_linux.md",
    )


def check_sdk(report: SdkReport, cameras: Sequence[UsbCamera], frozen: bool = False) -> CheckResult:
    """cameras: those that are plugged in, of which it must see every one. frozen: as `host.libraries`."""
    if report.trouble is not None:
        fix = "pip install pyrealsense2"
        if "libusb-1.0.so" in report.trouble:
            fix = "sudo apt install libusb-1.0-0"
        elif frozen:
            fix = "put a program here that was frozen beside pyrealsense2: make freeze, then tools/deploy"
        return fail("librealsense", report.trouble, fix)
    if len(cameras) > len(report.firmware):
        closed = [camera.path for camera in cameras if not camera.may_open]
        why = f"this user may not open {', '.join(closed)}" if closed else "not permitted, or in use"
        what = f"loads, but sees {len(report.firmware)} of {len(cameras)} cameras: {why}"
        return fail("librealsense", what, *_OPEN_FIX)
    return ok("librealsense", f"loads; cameras it sees: {len(report.firmware)}")


_OPEN_FIX = (
    "id  # must show plugdev; if not: sudo usermod -aG plugdev $USER, and log in again",
    "unplug the camera and plug it in again, so that the udev rule is followed",
    "sudo systemctl stop 'share-agent@*'  # a service that has the camera",
)


def parse_version(text: str) -> tuple[int, ...]:
    """Of the dotted numbers in it; zeros at the end do not count."""
    numbers = [int(part) for part in re.findall(r"\d+", text)]
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)


def check_udev(rules: Sequence[str], is_root: bool) -> CheckResult:
    """rules: files that name the camera and its IMU."""
    if rules:
        return ok("udev rule", ", ".join(rules))
    fix = (*_write_rules_fix(), "sudo usermod -aG plugdev $USER  # then log in again")
    if is_root:
        return warn("udev rule", "none for 8086 and its IMU (iio), but root needs none", *fix)
    return fail("udev rule", "none for 8086 and its IMU (iio): only root may open the camera", *fix)


def check_imu(cameras: Sequence[UsbCamera]) -> CheckResult:
    """Whether we may start it."""
    if not cameras:
        return skipped("IMU", "no camera to look at")
    unseen = [camera.path for camera in cameras if camera.may_start_imu is None]
    if unseen:
        what = f"{', '.join(unseen)}: the kernel shows no IMU (iio) of the camera"
        return warn("IMU", what, *_SHOW_IMU_FIX)
    closed = [camera.path for camera in cameras if not camera.may_start_imu]
    if closed:
        what = f"{', '.join(closed)}: its files in /sys (iio:device*) cannot be written"
        fix = "sudo usermod -aG plugdev $USER  # then log in again, and replug the camera"
        return fail("IMU", what, *_write_rules_fix(), fix)
    return ok("IMU", "may be started")


_SHOW_IMU_FIX = (
    "sudo modprobe -a hid_sensor_accel_3d hid_sensor_gyro_3d  # then replug the camera",
    "grep HID_SENSOR /boot/config-$(uname -r)  # nothing with =m or =y: this kernel, often a Raspberry Pi's, "
    "has no driver for it; take one that has",
)


def _write_rules_fix() -> tuple[str, ...]:
    first, *others = UDEV_RULES
    return (
        f"echo '{first}' | sudo tee {_RULE_FILE}",
        *(f"echo '{rule}' | sudo tee -a {_RULE_FILE}" for rule in others),
        "sudo udevadm control --reload-rules && sudo udevadm trigger",
    )


def check_autosuspend(cameras: Sequence[UsbCamera], allowed: bool) -> CheckResult:
    """allowed: whether the profile lets the kernel put the camera to sleep."""
    if allowed:
        return skipped("USB power saving", "the profile leaves it")
    known = [camera for camera in cameras if camera.control is not None]
    if not known:
        return skipped("USB power saving", "no camera to look at")
    suspended = [camera for camera in known if camera.control != "on"]
    if not suspended:
        return ok("USB power saving", "off for the camera")
    return warn("USB power saving", "the kernel may put the camera to sleep", *_write_rules_fix())


def check_usb_memory(found_mb: int | None, required_mb: int, fix: Sequence[str] = ()) -> CheckResult:
    """mend: what sets it, see `boot.fix`."""
    if not required_mb:
        return skipped("USB memory", "the profile leaves it")
    if found_mb is None:
        return skipped("USB memory", "usbfs_memory_mb is not to be seen here")
    if found_mb == 0 or found_mb >= required_mb:  # 0: no limit
        return ok("USB memory", f"{found_mb} MB" if found_mb else "no limit")
    return warn("USB memory", f"{found_mb} MB, the profile wants {required_mb}", *fix)
