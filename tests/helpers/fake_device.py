"""A device in a folder: what stands for ssh, systemd and the users there, and a program small enough to copy.

Only the shell, tar and the file system are real. `systemctl` writes down what it was asked; a service is up
unless the release in force holds a file `broken`, and is started again and again if it holds `flapping`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from helpers.shell import Done

TOOLS = Path(__file__).resolve().parents[2] / "tools"

# ssh OPTIONS HOST COMMAND, on this machine; nobody answers at "nowhere".
_SSH = """#!/bin/sh
while [ "${1#-}" != "$1" ]; do shift 2; done
[ "$1" != nowhere ] || { echo "ssh: connect to host nowhere port 22: No route to host" >&2; exit 255; }
exec sh -c "$2"
"""
_SYSTEMCTL = """#!/bin/sh
echo "systemctl $*" >>{log}
case $1 in
is-active) grep -qs . {started} && [ ! -e {root}/opt/share/current/broken ] ;;
restart) echo "$2" >>{started} ;;
show)
    [ ! -e {root}/opt/share/current/flapping ] || echo . >>{log}.n
    echo "NRestarts=$(cat {log}.n 2>/dev/null | wc -l)" ;;
esac
"""
_LOGGED = '#!/bin/sh\necho "$(basename "$0") $*" >>{log}\n'
_PROGRAM = """#!/bin/sh
case $1 in
--version) echo "share, version {version}" ;;
doctor) cat {doctor} ;;
*) exec {python} -m share "$@" ;;
esac
"""


@dataclass(frozen=True)
class FakeDevice:
    """folder: of the test. path: its $PATH. doctor: what `share doctor --json` says there."""

    folder: Path
    path: str
    doctor: Path

    @property
    def root(self) -> Path:
        return self.folder / "root"

    @property
    def ssh(self) -> Path:
        return self.folder / "bin" / "ssh"

    def program(self, version: str, *marks: str) -> Path:
        """A dist/share of that version. marks: further files in it."""
        folder = self.folder / f"dist-{version}" / "share"
        folder.mkdir(parents=True, exist_ok=True)
        _executable(
            folder / "share", _PROGRAM.format(version=version, python=sys.executable, doctor=self.doctor)
        )
        (folder / "library.so.1").write_bytes(b"code")
        if not (folder / "library.so").is_symlink():
            (folder / "library.so").symlink_to("library.so.1")
        for mark in marks:
            (folder / mark).touch()
        return folder

    def deploy(
        self, *words: object, host: str = "pi@headset1", dist: Path | None = None, ssh: str = ""
    ) -> Done:
        """tools/deploy WORDS. ssh: another than the one that is made up."""
        which = [] if dist is None else ["--dist", dist]
        settings = ["--ssh", ssh or self.ssh, "--root", self.root, "--settle", "0.1", *which]
        command = [TOOLS / "deploy.py", words[0], host, *words[1:], *settings]
        done = subprocess.run(
            [sys.executable, *map(str, command)],
            env={"PATH": self.path, "HOME": str(self.folder), "PYTHONPATH": str(TOOLS.parent)},
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert "Traceback" not in done.stderr, done.stderr
        return Done(done.returncode, done.stdout, done.stderr)

    def unseen(self, *verb: str, leaves: int = 0) -> int:
        """Exit code of a verb of device.sh that nobody listens to. leaves: signal to it once it has started
        services."""
        ear, mouth = os.pipe()
        os.close(ear)
        with subprocess.Popen(
            ["sh", TOOLS / "device" / "device.sh", *verb],
            env={"PATH": self.path, "SHARE_ROOT": str(self.root), "SHARE_SETTLE": "0.5"},
            stdin=subprocess.DEVNULL,
            stdout=mouth,
            stderr=mouth,
            start_new_session=True,
        ) as process:
            os.close(mouth)
            deadline = time.monotonic() + 60
            while leaves and "restart" not in "".join(self.log):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            if leaves:
                os.killpg(process.pid, leaves)
            return process.wait(60)

    def agent(self, dist: Path | None, *words: object) -> Done:
        return self.deploy("agent", "--name", "ann", "--edge", "tcp://127.0.0.1:5555", *words, dist=dist)

    @property
    def current(self) -> str:
        """The version in force."""
        return (self.root / "opt/share/current").readlink().name.partition("-")[0]

    def releases(self) -> set[str]:
        return {path.name.partition("-")[0] for path in (self.root / "opt/share/releases").iterdir()}

    @property
    def log(self) -> list[str]:
        path = self.folder / "log"
        return path.read_text().splitlines() if path.exists() else []

    def asked(self) -> list[str]:
        """What was asked of systemd and of the user data base since the last time."""
        lines = self.log
        (self.folder / "log").unlink(missing_ok=True)
        return lines


def make_device(folder: Path, path: str, doctor: Path) -> FakeDevice:
    """path: $PATH of the test."""
    tools, root = folder / "bin", folder / "root"
    tools.mkdir()
    root.mkdir()
    log, started = folder / "log", folder / "started"
    _executable(tools / "ssh", _SSH)
    _executable(tools / "systemctl", _SYSTEMCTL.format(log=log, started=started, root=root))
    for name in ("useradd", "usermod", "groupadd", "chown", "udevadm", "journalctl", "systemd-tmpfiles"):
        _executable(tools / name, _LOGGED.format(log=log))
    return FakeDevice(folder, f"{tools}:{path}", doctor)


def _executable(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)
