"""Which RealSense cameras librealsense sees, asked in a process of its own: it can hang or crash."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.connection import Connection

from share import children
from share.cameras.realsense.devices import attached, load_sdk
from share.devices.camera_check import Sdk
from share.errors import ShareError

_PATIENCE_S = 10.0


def ask(patience_s: float = _PATIENCE_S) -> Sdk:
    """Never raises: what went wrong is in `trouble`."""
    context = multiprocessing.get_context("fork")  # a frozen program has no Python to start
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_tell, args=(there, os.getpid(), children.is_main()), daemon=True)
    child.start()
    there.close()
    try:
        if not here.poll(patience_s):
            return Sdk(
                f"librealsense said nothing for {patience_s:g} s; unplug the camera and plug it in again"
            )
        answer: Sdk = here.recv()
        return answer
    except EOFError:
        return Sdk("librealsense crashed; unplug the camera and plug it in again")
    finally:
        child.kill()
        child.join()
        here.close()


def _tell(to: Connection, parent: int, from_main: bool) -> None:
    children.follow(parent, from_main)
    to.send(_query())


def _query() -> Sdk:
    try:
        rs = load_sdk()
        found = attached(rs, rs.context())
        return Sdk(firmware=tuple(d.firmware for d in found), serials=tuple(d.serial for d in found))
    except (ShareError, RuntimeError) as error:
        return Sdk(str(error).splitlines()[0])
