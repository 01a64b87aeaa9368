"""A device over ssh: its facts, and the verbs of device/device.sh on it. Nothing needs to be installed
there."""

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
_MARGIN = 1.1  # of the program's size, required free space
_UNREACHABLE = 255  # ssh's own exit code
_AS_ROOT = 'test "$(id -u)" = 0 || set -- sudo -n "$@"; exec "$@"'


@dataclass(frozen=True)
class Facts:
    """Facts by `probe`. glibc: minor version of 2.x. current: the active release, "" for none. settings: text
    of the service's .env, "" for none."""

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
    """ssh: the command, with options. root: a folder in place of / (then sudo is not used)."""

    host: str
    ssh: str = "ssh"
    root: str = ""
    settle_s: float = 10.0
    keep: int = 3

    def probe(self, service: str) -> Facts:
        """Return the device's facts. Raises UsageError where it cannot be reached, or gives no root
        access."""
        text = self._run(self._shell("probe", service), None)
        if not self.root:
            self._check_root()
        return facts(text)

    def do(self, *verb: str, data: bytes = b"") -> str:
        """Run one verb of device.sh as root; return its stdout. Raises ShareError with its last line."""
        return self._run(self._sudo() + self._shell(*verb), data)

    def send(self, release: Release, write: Callable[[IO[bytes]], None]) -> None:
        """Send a release. Raises UsageError where the connection breaks, else ShareError; then the device is
        unchanged."""
        command = self._command(self._sudo() + self._shell("receive", release.name))
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as there:
            assert there.stdin is not None and there.stderr is not None
            with contextlib.suppress(BrokenPipeError):  # the error follows below
                write(there.stdin)
            with contextlib.suppress(BrokenPipeError):  # the rest of the data
                there.stdin.close()
            said = there.stderr.read().decode(errors="replace")
        if there.returncode == _UNREACHABLE:
            raise self._unreachable(said)
        if there.returncode:
            raise ShareError(f"{self.host}: the program was not copied: {_last_line(said)}")

    def _check_root(self) -> None:
        try:
            self._run('test "$(id -u)" = 0 || sudo -n true', None)
        except ShareError:
            raise UsageError(
                f"{self.host}: no root access without a password; give root@HOST, or allow it to this "
                'user: echo "$USER ALL=(ALL) NOPASSWD: ALL" | sudo tee /etc/sudoers.d/share'
            ) from None

    def _run(self, text: str, data: bytes | None) -> str:
        done = subprocess.run(self._command(text), input=data or b"", capture_output=True, check=False)
        said = done.stderr.decode(errors="replace")
        if done.returncode == _UNREACHABLE:
            raise self._unreachable(said)
        if done.returncode:
            raise ShareError(
                "\n".join([*done.stdout.decode(errors="replace").splitlines(), _last_line(said)])
            )
        return done.stdout.decode(errors="replace")

    def _unreachable(self, said: str) -> UsageError:
        return UsageError(f"{self.host}: cannot be reached: {_last_line(said)}; try `{self.ssh} {self.host}`")

    def _command(self, text: str) -> list[str]:
        return [*shlex.split(self.ssh), *_OPTIONS, self.host, text]

    def _sudo(self) -> str:
        return "" if self.root else f"sh -c {shlex.quote(_AS_ROOT)} sh "

    def _shell(self, *verb: str) -> str:
        given = {"SHARE_ROOT": self.root, "SHARE_SETTLE": f"{self.settle_s:g}", "SHARE_KEEP": str(self.keep)}
        names = " ".join(f"{name}={shlex.quote(value)}" for name, value in given.items())
        return f"env {names} sh -c {shlex.quote(_SCRIPT)} device.sh {shlex.join(verb)}"


def facts(text: str) -> Facts:
    """Parse what `probe` printed."""
    lines = text.splitlines()
    values = dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("env:"))
    settings = "".join(f"{line[4:]}\n" for line in lines if line.startswith("env:"))
    return Facts(
        values["machine"],
        int(values["glibc"].partition(".")[2] or 0),
        int(values["free_kb"]) * 1024,
        values["systemd"] == "yes",
        values["current"],
        values["previous"],
        tuple(values["releases"].split()),
        settings,
    )


def check(host: str, release: Release, there: Facts) -> None:
    """Raise ShareError if the release cannot run on the device."""
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


def _last_line(stderr: str) -> str:
    """Return the last line of stderr."""
    lines = [line for line in stderr.splitlines() if line.strip()]
    return lines[-1].strip() if lines else "no message"
