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
    """Return the command line that runs `share ARGUMENTS` with this program, frozen or not."""
    if getattr(sys, "frozen", False):
        return [sys.executable, *arguments]
    return [
        sys.executable,
        "-P",
        "-m",
        "share",
        *arguments,
    ]  # -P: ignore a folder `share` in the working directory


@contextlib.contextmanager
def running_child(log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run `share ARGUMENTS` with its output in `log`; stop it when the block is left.

    The child ends with this process, however this one ends.
    """
    with open_new(log) as sink:
        process = _start(sink, arguments)
        try:
            yield process
        finally:
            stop_child(process)


def _start(sink: IO[bytes], arguments: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """Start it in a new process group: Ctrl-C in a terminal reaches only the parent, which stops it."""
    return subprocess.Popen(
        share_command(*arguments),
        stdin=subprocess.DEVNULL,
        stdout=sink,
        stderr=subprocess.STDOUT,
        env=child_processes.child_environment(),
        process_group=0,
    )


def stop_child(process: subprocess.Popen[bytes], timeout_s: float = 10.0) -> int:
    """Send SIGINT, kill after `timeout_s`, and return the exit code."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
