"""Child processes that end with their parent, however it ends: killed, crashed or in good order.

Every process that SHARE starts uses this module: SHARE commands by `child_environment`, multiprocessing
workers by `share.spawning.SPAWN_CONTEXT`, forks by calling `exit_with_parent`. Before it imports anything
heavy, the child asks the kernel to kill it when its parent dies (PR_SET_PDEATHSIG), then checks that the
parent is still alive. The kernel takes the *thread* that started the child for its parent. So a child
started by another than the main thread, which may end long before its process, polls its parent's process
id every 0.2 s instead, and so does one on a system without PR_SET_PDEATHSIG.
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
    """Return the environment for `subprocess.Popen` of a SHARE command."""
    return {**os.environ, _PARENT_VARIABLE: f"{os.getpid()}:{is_main_thread():d}"}


def exit_with_starter() -> None:
    """Make this process end with the SHARE process that started it, if any. Called first by every command."""
    parent, _, from_main_thread = os.environ.pop(_PARENT_VARIABLE, "").partition(":")
    if parent.isdecimal():
        exit_with_parent(int(parent), from_main_thread == "1")


def exit_with_parent(parent: int, from_main_thread: bool = True) -> None:
    """Make this process end with its parent.

    parent: its process id. from_main_thread: its main thread started this process."""
    has_death_signal = from_main_thread and _request_death_signal()
    if os.getppid() != parent:
        os._exit(1)
    if not has_death_signal:
        threading.Thread(target=_poll_parent, args=(parent,), daemon=True).start()


def is_main_thread() -> bool:
    """Return whether this is the main thread: the kernel kills its children only when the process ends."""
    return threading.current_thread() is threading.main_thread()


def _request_death_signal() -> bool:
    """Ask the kernel to kill this process when its parent ends. Return whether it agreed."""
    if sys.platform != "linux":
        return False
    import ctypes

    return bool(ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) == 0)


def _poll_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os._exit(1)
