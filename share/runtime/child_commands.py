"""SHARE's own commands as child processes, frozen or not."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from share import child_processes
from share.files.writing import open_new


def share_command(*arguments: str) -> list[str]:
    """The command line that runs `share ARGUMENTS` with this very program."""
    if getattr(sys, "frozen", False):
        return [sys.executable, *arguments]
    return [sys.executable, "-P", "-m", "share", *arguments]  # -P: not a folder `share` of whoever calls


@contextlib.contextmanager
def running_child(log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """`share ARGUMENTS` with its output in `log`; asked to end, then made to, when the block is left.

    It ends with this process, however this one ends."""
    with open_new(log) as sink:
        process = _start(sink, arguments)
        try:
            yield process
        finally:
            stop_child(process)


def _start(sink: IO[bytes], arguments: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """In a group of its own: Ctrl-C in a terminal is for the parent, which ends its children in order."""
    return subprocess.Popen(
        share_command(*arguments),
        stdin=subprocess.DEVNULL,
        stdout=sink,
        stderr=subprocess.STDOUT,
        env=child_processes.child_environment(),
        process_group=0,
    )


def stop_child(process: subprocess.Popen[bytes], timeout_s: float = 10.0) -> int:
    """Ask a child to stop, and kill it if it does not. Its exit code."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
