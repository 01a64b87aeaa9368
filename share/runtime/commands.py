"""SHARE's own commands as child processes, frozen or not."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from share import children
from share.files.writing import fresh


def command(*arguments: str) -> list[str]:
    """The command line that runs `share ARGUMENTS` with this very program."""
    if getattr(sys, "frozen", False):
        return [sys.executable, *arguments]
    return [sys.executable, "-P", "-m", "share", *arguments]  # -P: not a folder `share` of whoever calls


@contextlib.contextmanager
def child(log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """`share ARGUMENTS` with its output in `log`; asked to end, then made to, when the block is left.

    It ends with this process, however this one ends."""
    with fresh(log) as sink:
        process = _start(sink, arguments)
        try:
            yield process
        finally:
            end(process)


def _start(sink: IO[bytes], arguments: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """In a group of its own: Ctrl-C in a terminal is for the parent, which ends its children in order."""
    return subprocess.Popen(
        command(*arguments),
        stdin=subprocess.DEVNULL,
        stdout=sink,
        stderr=subprocess.STDOUT,
        env=children.environment(),
        process_group=0,
    )


def end(process: subprocess.Popen[bytes], patience_s: float = 10.0) -> int:
    """Ask a child to stop, and kill it if it does not. Its exit code."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()
