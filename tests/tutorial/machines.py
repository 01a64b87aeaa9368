"""The machines of the tutorial: a shell each, in a folder that is its home, with `share` and `scp`."""

from __future__ import annotations

import os
import queue
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

HERE = Path(__file__).parent
_SHARE = '#!/bin/sh\nexec {python} {script} "$@"\n'
_SCP = r"""#!/bin/sh
# scp, to and from the folders that stand for machines
set -e
flags=; for word do
    shift
    case $word in
    -r) flags=-r; continue ;;
    laptop:* | headset:* | robot:*) word={home}/${{word%%:*}}/${{word#*:}} ;;
    esac
    set -- "$@" "$word"
done
exec cp $flags "$@"
"""
_DONE = re.compile(r"@@done (\d+)$")


class Machine:
    """A shell that runs what is typed as at a terminal: jobs have numbers, `&` and `kill %1` work."""

    def __init__(self, name: str, folder: Path) -> None:
        home, tools = folder / name, folder / "bin" / name
        home.mkdir(parents=True, exist_ok=True)
        tools.mkdir(parents=True, exist_ok=True)
        words = "-m share" if name == "laptop" else f"{HERE / 'device_share.py'} {name}"
        _program(tools / "share", _SHARE.format(python=sys.executable, script=words))
        _program(tools / "scp", _SCP.format(home=folder))
        paths = (HERE, HERE.parent, HERE.parents[1])
        self.name = name
        self._shell = subprocess.Popen(
            ["bash", "--noprofile", "--norc"],
            cwd=home,
            env={
                "HOME": str(home),
                "PATH": f"{tools}:{os.environ['PATH']}",
                "PYTHONPATH": os.pathsep.join(map(str, paths)),
                "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")),
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._type("set -m")

    def run(self, command: str, limit_s: float) -> tuple[int, list[str]]:
        """Exit code and what was shown meanwhile. Raises TimeoutError."""
        self._type(f"{command}\ncame_to=$?; echo; echo @@done $came_to")
        shown, end = [], time.monotonic() + limit_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(f"{self.name}$ {command}: not done after {limit_s:g} s; {shown}") from None
            if done := _DONE.match(line):
                return int(done[1]), shown[: -1 if shown and not shown[-1] else None]
            shown.append(line)

    def close(self) -> None:
        """With all that still runs there."""
        self._type("kill $(jobs -p) 2>/dev/null; wait; exit")
        try:
            self._shell.wait(20)
        finally:
            self._shell.kill()
            self._reader.join(5)
            for pipe in (self._shell.stdin, self._shell.stdout):
                assert pipe is not None
                pipe.close()

    def _type(self, text: str) -> None:
        assert self._shell.stdin is not None
        self._shell.stdin.write(f"{text}\n")
        self._shell.stdin.flush()

    def _read(self) -> None:
        assert self._shell.stdout is not None
        for line in self._shell.stdout:
            self._lines.put(line.rstrip("\n"))


def _program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)
