"""SHARE's own commands as processes, for tests."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from share.child_processes import child_environment

SHARE = [sys.executable, "-m", "share"]


class Child:
    """A running `share …`, which ends with this process at the latest; its stderr goes to a file."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self.log = log
        with log.open("ab") as sink:
            self.process = subprocess.Popen(
                [*SHARE, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=sink,
                env=child_environment(),
            )

    @property
    def said(self) -> str:
        return self.log.read_text()

    def wait(self, seconds: float) -> int:
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise AssertionError(f"still running after {seconds} s; said:\n{self.said}") from None

    def wait_for(self, pattern: str, seconds: float = 30) -> re.Match[str]:
        """Until it has said something that matches."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if found := re.search(pattern, self.said):
                return found
            if self.process.poll() is not None:
                break
            time.sleep(0.02)
        raise AssertionError(f"never said {pattern!r}:\n{self.said}")

    def interrupt(self, seconds: float = 20) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.wait(seconds)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


def start_edge(folder: Path, bind: str = "tcp://127.0.0.1:0") -> tuple[Child, str]:
    """A listening edge with --out FOLDER/edge, and its address."""
    folder.mkdir(parents=True, exist_ok=True)
    edge = Child(folder / "edge.log", "edge", "--bind", bind, "--out", str(folder / "edge"))
    return edge, edge.wait_for(r"listening on (tcp://\S+?),")[1]


def start_agent(folder: Path, name: str, source: Path, address: str, *more: str, kind: str = "ar") -> Child:
    """Without a configuration in `more` it tracks every frame, also on a busy machine."""
    where = ("--edge", address, "--out", str(folder / name))
    if "--config" not in more:
        every_frame = folder / "every-frame.yaml"
        every_frame.write_text("agent: {late_ms: 0}\n")
        more = ("--config", str(every_frame), *more)
    return Child(folder / f"{name}.log", "agent", str(source), "--name", name, "--kind", kind, *where, *more)
