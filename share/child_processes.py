"""Child processes that end with their parent, however it ends: killed, crashed or in good order.

Every process that SHARE starts is started through here: one of its own commands with `child_environment()`, a
worker of multiprocessing by `share.spawning.SPAWN`, a fork that calls `exit_with_parent` itself. The first
thing that
the child does, before it imports anything heavy, is to ask the kernel to be killed when its parent dies
(PR_SET_PDEATHSIG), and then to look whether the parent has died meanwhile. The kernel takes the *thread*
that started the child for its parent. So a child that was started by another than the main thread, which
may end long before its process, and one on a system without that request, looks at its parent's number
every 0.2 s instead.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

_PARENT_VARIABLE = "SHARE_PARENT"  # PID:1 if the main thread of that process is the parent, else PID:0
_PR_SET_PDEATHSIG = 1
_POLL_S = 0.2


def child_environment() -> dict[str, str]:
    """For `subprocess.Popen` of one of SHARE's own commands."""
    return {**os.environ, _PARENT_VARIABLE: f"{os.getpid()}:{is_main_thread():d}"}


def exit_with_starter() -> None:
    """The first thing that a SHARE command does: it ends with the SHARE process that started it, if any."""
    parent, _, from_main_thread = os.environ.pop(_PARENT_VARIABLE, "").partition(":")
    if parent.isdecimal():
        exit_with_parent(int(parent), from_main_thread == "1")


def exit_with_parent(parent: int, from_main_thread: bool = True) -> None:
    """This process ends with its parent. parent: its process id. kernel: its main thread started this one."""
    has_death_signal = from_main_thread and _request_death_signal()
    if os.getppid() != parent:
        os._exit(1)
    if not has_death_signal:
        threading.Thread(target=_poll_parent, args=(parent,), daemon=True).start()


def is_main_thread() -> bool:
    """Whether the main thread asks: what it starts has this process for its parent, to the kernel too."""
    return threading.current_thread() is threading.main_thread()


def _request_death_signal() -> bool:
    """Whether the kernel has agreed to kill this process when its parent ends."""
    if sys.platform != "linux":
        return False
    import ctypes

    return bool(ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) == 0)


def _poll_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os._exit(1)
