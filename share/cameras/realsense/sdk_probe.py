"""Query the cameras that librealsense sees, in a child process, since it can hang or crash."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.connection import Connection

from share import child_processes
from share.cameras.realsense.devices import list_devices, load_sdk
from share.devices.camera_check import SdkReport
from share.errors import ShareError

_TIMEOUT_S = 10.0


def probe_sdk(timeout_s: float = _TIMEOUT_S) -> SdkReport:
    """Return the SDK's view of the cameras. Errors are reported in `trouble`, never raised."""
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
