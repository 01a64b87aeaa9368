"""Attached RealSense cameras: list them, choose one, check that it is usable; load and probe the SDK."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from share import child_processes
from share.devices.camera_check import SdkReport, parse_version
from share.errors import NotAttachedError, ShareError, UsageError, install_hint
from share.sensors.profile_types import DeviceFacts

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

KIND = "realsense"
_PROBE_TIMEOUT_S = 10.0


def is_camera(spec: str) -> bool:
    """Return whether a SOURCE is a live camera."""
    return spec == KIND or spec.startswith(f"{KIND}:")


def parse_serial(spec: str) -> str | None:
    """Return the serial number in realsense[:SERIAL], None without one. Raises UsageError."""
    if not is_camera(spec):
        raise UsageError(f"{spec}: is not a camera; give {KIND} or {KIND}:SERIAL")
    return spec.partition(":")[2] or None


@dataclass(frozen=True, eq=False)
class AttachedDevice:
    """A device as the SDK lists it. usb: version of the link, such as 3.2; empty if unknown."""

    serial: str
    name: str
    firmware: str
    usb: str
    handle: Any


def list_devices(rs: Any, context: Any) -> list[AttachedDevice]:
    """Return all devices with a serial number, in the SDK's order."""
    kinds = rs.camera_info
    info_keys = (kinds.serial_number, kinds.name, kinds.firmware_version, kinds.usb_type_descriptor)
    devices = []
    for handle in context.query_devices():
        values = (handle.get_info(kind) if handle.supports(kind) else "" for kind in info_keys)
        serial, name, firmware, usb = values
        devices.append(AttachedDevice(serial, name, firmware, usb, handle))
    return [device for device in devices if device.serial]


def choose_device(devices: list[AttachedDevice], serial: str | None, facts: DeviceFacts) -> AttachedDevice:
    """Return the device `serial`, or the only one. Raises NotAttachedError, or UsageError if not usable."""
    listed = ", ".join(f"{device.serial} ({device.name})" for device in devices)
    if not devices:
        raise NotAttachedError(
            "no RealSense camera is attached, or none may be opened; if `lsusb` shows one: `id` must show "
            "plugdev (log in again, replug), and no other program may use it: sudo systemctl stop "
            "'share-agent@*'"
        )
    if serial is None:
        if len(devices) > 1:
            raise UsageError(f"several RealSense cameras are attached; name one, realsense:SERIAL: {listed}")
        return _check_usable(devices[0], facts)
    for device in devices:
        if device.serial == serial:
            return _check_usable(device, facts)
    raise NotAttachedError(f"no RealSense camera with serial number {serial} is attached; there is {listed}")


def _check_usable(device: AttachedDevice, facts: DeviceFacts) -> AttachedDevice:
    label = f"{device.name} {device.serial}"
    if device.usb.startswith("2"):
        raise UsageError(
            f"{label}: is on USB {device.usb}, which is too slow; use a USB 3 port and a USB 3 cable"
        )
    oldest = facts.firmware_oldest
    if oldest and device.firmware and parse_version(device.firmware) < parse_version(oldest):
        raise UsageError(
            f"{label}: its firmware {device.firmware} is older than {oldest}; update it with rs-fw-update "
            f"(known to be good: {', '.join(facts.firmware)})"
        )
    return device


# ---- The SDK, an extra of SHARE, imported only for a camera


def load_sdk() -> Any:
    """Import pyrealsense2. Raises UsageError with instructions to install it."""
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise UsageError(f"a RealSense camera: {install_hint('pyrealsense2', 'realsense')}") from None
    except ImportError as error:
        hint = " (apt install libusb-1.0-0)" if "libusb" in str(error) else ""
        raise UsageError(f"a RealSense camera: pyrealsense2 cannot be loaded: {error}{hint}") from None
    return pyrealsense2


@contextlib.contextmanager
def sdk_errors(label: str) -> Iterator[None]:
    """Turn the SDK's RuntimeErrors in the block, which any call to a camera that comes or goes may raise,
    into a one-line ShareError with `label`."""
    try:
        yield
    except RuntimeError as error:
        reason, fix = str(error).partition("\n")[0], "replug it, or run `share doctor`"
        raise ShareError(f"{label}: cannot be opened: {reason}; {fix}") from None


def probe_sdk(timeout_s: float = _PROBE_TIMEOUT_S) -> SdkReport:
    """Return the SDK's view of the cameras, from a child process, since the SDK can hang or crash.

    Errors are reported in `trouble`, never raised.
    """
    import multiprocessing

    context = multiprocessing.get_context("fork")  # a frozen program has no Python to spawn
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(
        target=_send_result, args=(sender, os.getpid(), child_processes.is_main_thread()), daemon=True
    )
    child.start()
    sender.close()
    try:
        if not receiver.poll(timeout_s):
            return SdkReport(
                f"librealsense did not answer for {timeout_s:g} s; unplug the camera and plug it in again"
            )
        answer: SdkReport = receiver.recv()
        return answer
    except EOFError:
        return SdkReport("librealsense crashed; unplug the camera and plug it in again")
    finally:
        child.kill()
        child.join()
        receiver.close()


def _send_result(connection: Connection, parent: int, from_main: bool) -> None:
    child_processes.exit_with_parent(parent, from_main)
    connection.send(_query_sdk())


def _query_sdk() -> SdkReport:
    try:
        rs = load_sdk()
        devices = list_devices(rs, rs.context())
        return SdkReport(
            firmware=tuple(d.firmware for d in devices), serials=tuple(d.serial for d in devices)
        )
    except (ShareError, RuntimeError) as error:
        return SdkReport(str(error).splitlines()[0])
