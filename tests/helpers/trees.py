"""Process trees: those whose environment has a marker, and what is left of them."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import time
from pathlib import Path


class Tree:
    """A command whose processes, however deep, are known by a marker in their environment."""

    def __init__(self, command: list[str], log: Path) -> None:
        self._marker = f"SHARE_TEST_TREE={secrets.token_hex(12)}"
        name, _, value = self._marker.partition("=")
        self.log = log
        with log.open("wb") as sink:
            self.parent = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=sink,
                env={**os.environ, name: value},
                start_new_session=True,
            )

    def alive(self) -> dict[int, str]:
        """Command lines, by process id."""
        found = {}
        for entry in Path("/proc").iterdir():
            try:
                if entry.name.isdecimal() and self._marker.encode() in (entry / "environ").read_bytes():
                    state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                    if state not in "ZX":
                        found[int(entry.name)] = (entry / "cmdline").read_bytes().decode().replace("\0", " ")
            except OSError:  # it has just ended, or is not ours
                continue
        return found

    def until(self, count: int, seconds: float = 30) -> None:
        """So many are there."""
        deadline = time.monotonic() + seconds
        while len(self.alive()) < count:
            assert time.monotonic() < deadline, (self.alive(), self.log.read_text())
            time.sleep(0.02)

    def left(self, seconds: float) -> dict[int, str]:
        """Those that are alive after so long, which are killed then."""
        deadline = time.monotonic() + seconds
        while (alive := self.alive()) and time.monotonic() < deadline:
            time.sleep(0.02)
        for pid in alive:
            os.kill(pid, signal.SIGKILL)
        self.parent.wait()
        return alive
