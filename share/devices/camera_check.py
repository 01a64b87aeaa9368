"""Checks of the RealSense camera: presence, USB link, firmware, SDK, permissions, power saving."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from share.devices.checks import CheckResult, fail, ok, skipped, warn

_USB3_MBIT_S = 5000
_D435I = 'ATTRS{idVendor}=="8086", ATTRS{idProduct}=="0b3a"'
# The SDK starts the IMU by writing files in /sys, which MODE and GROUP do not affect.
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
    """A camera as the kernel shows it. path: its name in /sys/bus/usb/devices. speed_mbit_s: of the link.
    control: power/control, "on" if never suspended; None if unknown. may_open: this user may read and write
    its node in /dev. may_start_imu: this user may write the files that start its IMU; None if the kernel
    shows no IMU."""

    path: str
    speed_mbit_s: float
    control: str | None = None
    may_open: bool = True
    may_start_imu: bool | None = True


@dataclass(frozen=True)
class SdkReport:
    """The cameras that librealsense sees. trouble: why it cannot be used, None if it can. firmware, serials:
    of each camera."""

    trouble: str | None = None
    firmware: tuple[str, ...] = ()
    serials: tuple[str, ...] = ()


def check_link(cameras: Sequence[UsbCamera] | None) -> CheckResult:
    """Check presence and USB speed. cameras: None if this system shows no USB devices."""
    if cameras is None:
        return fail(
            "camera", "this system shows no USB devices (a container?)", "run this on the device itself"
        )
    if not cameras:
        return fail("camera", "no D435i (8086:0b3a) is attached", "plug it in; then: lsusb -d 8086:0b3a")
    slow = [camera for camera in cameras if camera.speed_mbit_s < _USB3_MBIT_S]
    if slow:
        what = (
            f"{slow[0].path}: USB 2 link, {slow[0].speed_mbit_s:g} Mbit/s: too slow for two images and an IMU"
        )
        return fail("camera", what, "use a USB 3 port and cable and push the plug in quickly; then: lsusb -t")
    return ok("camera", ", ".join(f"{c.path}: USB 3, {c.speed_mbit_s:g} Mbit/s" for c in cameras))


def check_firmware(sdk: SdkReport, known_good: Sequence[str], oldest: str | None) -> CheckResult:
    """Check the oldest firmware of all cameras. known_good: tested versions; newer ones than all of these
    also pass. oldest: lowest version accepted."""
    if sdk.trouble or not sdk.firmware:
        return skipped("firmware", "no camera reports it")
    oldest_found = min(sdk.firmware, key=parse_version)
    known = sorted(map(parse_version, known_good))
    if oldest and parse_version(oldest_found) < parse_version(oldest):
        return fail("firmware", f"{oldest_found} is older than {oldest}", *_update_fix(known_good))
    if parse_version(oldest_found) in known:
        return ok("firmware", oldest_found)
    if known and parse_version(oldest_found) > known[-1]:
        return ok("firmware", f"{oldest_found}, newer than those tested: {', '.join(known_good)}")
    return warn(
        "firmware",
        f"{oldest_found} is not among those tested: {', '.join(known_good)}",
        *_update_fix(known_good),
    )


def _update_fix(known_good: Sequence[str]) -> tuple[str, ...]:
    return (
        f"rs-fw-update -l  # then: rs-fw-update -f FILE, with a file of one of {', '.join(known_good)}",
        "FILE: https://dev.realsenseai.com/docs/firmware-releases-d400",
        "rs-fw-update: in the vendor's package librealsense2-utils, for any computer with the camera, "
        "https://github.com/realsenseai/librealsense/blob/master/doc/distribution_linux.md",
    )


def check_sdk(report: SdkReport, cameras: Sequence[UsbCamera], frozen: bool = False) -> CheckResult:
    """Check that the SDK loads and sees all attached `cameras`. frozen: this is a frozen program."""
    if report.trouble is not None:
        fix = "pip install pyrealsense2"
        if "libusb-1.0.so" in report.trouble:
            fix = "sudo apt install libusb-1.0-0"
        elif frozen:
            fix = "deploy a program that was frozen with pyrealsense2: make freeze, then tools/deploy"
        return fail("librealsense", report.trouble, fix)
    if len(cameras) > len(report.firmware):
        closed = [camera.path for camera in cameras if not camera.may_open]
        why = f"this user may not open {', '.join(closed)}" if closed else "not permitted, or in use"
        what = f"loads, but sees {len(report.firmware)} of {len(cameras)} cameras: {why}"
        return fail("librealsense", what, *_OPEN_FIX)
    return ok("librealsense", f"loads and sees {len(report.firmware)} cameras")


_OPEN_FIX = (
    "id  # must show plugdev; if not: sudo usermod -aG plugdev $USER, and log in again",
    "unplug the camera and plug it in again, so that the udev rule is applied",
    "sudo systemctl stop 'share-agent@*'  # a service that may use the camera",
)


def parse_version(text: str) -> tuple[int, ...]:
    """Return the dotted numbers in `text`, without trailing zeros."""
    numbers = [int(part) for part in re.findall(r"\d+", text)]
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)


def check_udev(rules: Sequence[str], is_root: bool) -> CheckResult:
    """rules: rule files that match the camera and its IMU."""
    if rules:
        return ok("udev rule", ", ".join(rules))
    fix = (*_write_rules_fix(), "sudo usermod -aG plugdev $USER  # then log in again")
    if is_root:
        return warn("udev rule", "none for 8086 and its IMU (iio); root does not need one", *fix)
    return fail("udev rule", "none for 8086 and its IMU (iio): only root may open the camera", *fix)


def check_imu(cameras: Sequence[UsbCamera]) -> CheckResult:
    """Check that this user may start the cameras' IMUs."""
    if not cameras:
        return skipped("IMU", "no camera attached")
    unseen = [camera.path for camera in cameras if camera.may_start_imu is None]
    if unseen:
        what = f"{', '.join(unseen)}: the kernel shows no IMU (iio) of the camera"
        return warn("IMU", what, *_SHOW_IMU_FIX)
    closed = [camera.path for camera in cameras if not camera.may_start_imu]
    if closed:
        what = f"{', '.join(closed)}: its files in /sys (iio:device*) cannot be written"
        fix = "sudo usermod -aG plugdev $USER  # then log in again, and replug the camera"
        return fail("IMU", what, *_write_rules_fix(), fix)
    return ok("IMU", "can be started")


_SHOW_IMU_FIX = (
    "sudo modprobe -a hid_sensor_accel_3d hid_sensor_gyro_3d  # then replug the camera",
    "grep HID_SENSOR /boot/config-$(uname -r)  # nothing with =m or =y: this kernel (often a Raspberry Pi's) "
    "has no driver for the IMU; use another",
)


def _write_rules_fix() -> tuple[str, ...]:
    first, *others = UDEV_RULES
    return (
        f"echo '{first}' | sudo tee {_RULE_FILE}",
        *(f"echo '{rule}' | sudo tee -a {_RULE_FILE}" for rule in others),
        "sudo udevadm control --reload-rules && sudo udevadm trigger",
    )


def check_autosuspend(cameras: Sequence[UsbCamera], allowed: bool) -> CheckResult:
    """allowed: the profile lets the kernel suspend the camera."""
    if allowed:
        return skipped("USB power saving", "not required by the profile")
    known = [camera for camera in cameras if camera.control is not None]
    if not known:
        return skipped("USB power saving", "no camera attached")
    suspended = [camera for camera in known if camera.control != "on"]
    if not suspended:
        return ok("USB power saving", "off for the camera")
    return warn("USB power saving", "the kernel may suspend the camera", *_write_rules_fix())


def check_usb_memory(found_mb: int | None, required_mb: int, fix: Sequence[str] = ()) -> CheckResult:
    """fix: commands that set it, see `checks.boot_settings_fix`."""
    if not required_mb:
        return skipped("USB memory", "not required by the profile")
    if found_mb is None:
        return skipped("USB memory", "this system does not show usbfs_memory_mb")
    if found_mb == 0 or found_mb >= required_mb:  # 0: no limit
        return ok("USB memory", f"{found_mb} MB" if found_mb else "no limit")
    return warn("USB memory", f"{found_mb} MB, the profile requires {required_mb}", *fix)
