"""A device over ssh: what it is, and the verbs of device/device.sh there. It needs nothing installed."""

from __future__ import annotations

import contextlib
import shlex
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

from deploy_release import HERE, Release

from share.errors import ShareError, UsageError

_SCRIPT = (HERE / "device.sh").read_text()
_OPTIONS = ("-o", "BatchMode=yes", "-o", "ConnectTimeout=10")
_MARGIN = 1.1  # of the program's size that must be free
_UNREACHABLE = 255  # ssh's own exit code
_AS_ROOT = 'test "$(id -u)" = 0 || set -- sudo -n "$@"; exec "$@"'


@dataclass(frozen=True)
class Facts:
    """What `probe` tells. glibc: minor version of 2.x. current: the release in force, "" for none.
    settings: text of the service's .env, "" for none."""

    machine: str
    glibc: int
    free: int
    systemd: bool
    current: str
    previous: str
    releases: tuple[str, ...]
    settings: str


@dataclass(frozen=True)
class Device:
    """ssh: the command, with options of its own. root: a folder in place of / (then no sudo is asked for)."""

    host: str
    ssh: str = "ssh"
    root: str = ""
    settle_s: float = 10.0
    keep: int = 3

    def probe(self, service: str) -> Facts:
        """Raises UsageError where it cannot be reached, or nobody can become root there."""
        text = self._run(self._shell("probe", service), None)
        if not self.root:
            self._check_root()
        return facts(text)

    def do(self, *verb: str, data: bytes = b"") -> str:
        """One verb of device.sh as root. Its stdout. Raises ShareError with its last line."""
        return self._run(self._sudo() + self._shell(*verb), data)

    def send(self, release: Release, write: Callable[[IO[bytes]], None]) -> None:
        """Raises UsageError where the line broke, else ShareError; then the device is as it was."""
        command = self._command(self._sudo() + self._shell("receive", release.name))
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as there:
            assert there.stdin is not None and there.stderr is not None
            with contextlib.suppress(BrokenPipeError):  # then it says why, below
                write(there.stdin)
            with contextlib.suppress(BrokenPipeError):  # what was still to be written
                there.stdin.close()
            said = there.stderr.read().decode(errors="replace")
        if there.returncode == _UNREACHABLE:
            raise self._unreachable(said)
        if there.returncode:
            raise ShareError(f"{self.host}: the program was not copied: {_told(said)}")

    def _check_root(self) -> None:
        try:
            self._run('test "$(id -u)" = 0 || sudo -n true', None)
        except ShareError:
            raise UsageError(
                f"{self.host}: nobody can become root there without a password; give root@HOST, or let this "
                'user: echo "$USER ALL=(ALL) NOPASSWD: ALL" | sudo tee /etc/sudoers.d/share'
            ) from None

    def _run(self, text: str, data: bytes | None) -> str:
        done = subprocess.run(self._command(text), input=data or b"", capture_output=True, check=False)
        said = done.stderr.decode(errors="replace")
        if done.returncode == _UNREACHABLE:
            raise self._unreachable(said)
        if done.returncode:
            raise ShareError("\n".join([*done.stdout.decode(errors="replace").splitlines(), _told(said)]))
        return done.stdout.decode(errors="replace")

    def _unreachable(self, said: str) -> UsageError:
        return UsageError(f"{self.host}: cannot be reached: {_told(said)}; try `{self.ssh} {self.host}`")

    def _command(self, text: str) -> list[str]:
        return [*shlex.split(self.ssh), *_OPTIONS, self.host, text]

    def _sudo(self) -> str:
        return "" if self.root else f"sh -c {shlex.quote(_AS_ROOT)} sh "

    def _shell(self, *verb: str) -> str:
        given = {"SHARE_ROOT": self.root, "SHARE_SETTLE": f"{self.settle_s:g}", "SHARE_KEEP": str(self.keep)}
        names = " ".join(f"{name}={shlex.quote(value)}" for name, value in given.items())
        return f"env {names} sh -c {shlex.quote(_SCRIPT)} device.sh {shlex.join(verb)}"


def facts(text: str) -> Facts:
    """Of what `probe` printed."""
    lines = text.splitlines()
    told = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("env:"))
    settings = "".join(f"{line[4:]}\n" for line in lines if line.startswith("env:"))
    return Facts(
        told["machine"],
        int(told["glibc"].partition(".")[2] or 0),
        int(told["free_kb"]) * 1024,
        told["systemd"] == "yes",
        told["current"],
        told["previous"],
        tuple(told["releases"].split()),
        settings,
    )


def check(host: str, release: Release, there: Facts) -> None:
    """Whether it can run there. Raises ShareError."""
    if not there.systemd:
        raise ShareError(f"{host}: has no systemd; only the program itself (dist/share) can be copied there")
    if release.machine and release.machine != there.machine:
        raise ShareError(
            f"{host}: is {there.machine}, the program was built for {release.machine}; "
            "run `make freeze` on a machine of that kind"
        )
    if release.glibc > there.glibc:
        raise ShareError(
            f"{host}: has glibc 2.{there.glibc}, the program needs 2.{release.glibc}; "
            "run `make freeze` on a system as old as the device's"
        )
    if release.name not in there.releases and there.free < _MARGIN * release.size:
        need = _MARGIN * release.size / 1e6
        raise ShareError(f"{host}: {there.free / 1e6:.0f} MB free at /opt/share, {need:.0f} MB are needed")


def _told(stderr: str) -> str:
    """The last line of it."""
    lines = [line for line in stderr.splitlines() if line.strip()]
    return lines[-1].strip() if lines else "it said nothing"
