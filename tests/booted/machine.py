"""A Debian that boots on this machine: systemd as its first process, sshd, sudo and a network of its own, and
neither Python nor a compiler. A container of systemd-nspawn over a root that debootstrap made once."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers.shell import Done

BASE = Path(__file__).resolve().parents[2] / "build" / "device-root"  # made once, read from then on
SUITE = "bookworm"  # as old as the oldest device: glibc 2.36
PACKAGES = "systemd,systemd-sysv,udev,dbus,openssh-server,sudo,iproute2"  # a bare Debian's, and ssh
NEEDED = ("debootstrap", "systemd-nspawn", "ip", "ssh", "ssh-keygen")
REBOOT = 133  # how systemd-nspawn --keep-unit ends when that is what is wanted
NAME = "sharedev"  # names the network's end here, too: ve-sharedev
HERE, THERE = "10.213.77.1", "10.213.77.2"

_NETWORK = f"[Match]\nName=host0\n[Network]\nAddress={THERE}/30\nLinkLocalAddressing=no\n"
_SET_UP = """
set -e
useradd --shell /bin/bash pi
echo 'pi ALL=(ALL) NOPASSWD: ALL' >/etc/sudoers.d/pi
systemctl --quiet enable systemd-networkd ssh
echo headset1 >/etc/hostname
echo '127.0.1.1 headset1' >>/etc/hosts
chown -R pi: /home/pi
"""


class Container:
    """A root that is booted, and this machine's end of its network. console: file for what it says."""

    def __init__(self, root: Path, console: Path) -> None:
        self._command = ["systemd-nspawn", "--quiet", "--boot", f"--directory={root}", f"--machine={NAME}"]
        self._command += ["--register=no", "--keep-unit", "--network-veth", "--console=pipe"]
        self._command += ["--resolv-conf=off", "--timezone=off"]
        self._console = console
        self._start()

    def start_anew(self) -> None:
        """When it has gone down to be started again."""
        assert self._process.wait(60) == REBOOT, self._said()
        self._start()

    def stop(self) -> None:
        self._process.terminate()  # an orderly end
        self._process.wait(60)

    def _start(self) -> None:
        with self._console.open("ab") as said:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=said, stderr=said
            )
        deadline = time.monotonic() + 60
        address = ["ip", "addr", "add", f"{HERE}/30", "dev", f"ve-{NAME}"]
        while subprocess.run(address, capture_output=True).returncode:
            assert self._process.poll() is None, self._said()
            assert time.monotonic() < deadline, "no network"
            time.sleep(0.2)
        subprocess.run(["ip", "link", "set", f"ve-{NAME}", "up"], check=True)

    def _said(self) -> str:
        return self._console.read_text(errors="replace")


@dataclass(frozen=True)
class Machine:
    """ssh: the command that gets in as `host`. root: its file system, as seen from here."""

    ssh: str
    host: str
    root: Path
    container: Container

    def run(self, command: str, timeout: float = 120) -> Done:
        """`command` in a shell there, as root."""
        words = [*self.ssh.split(), self.host, "sudo", "sh"]
        done = subprocess.run(words, input=command, capture_output=True, text=True, timeout=timeout)
        return Done(done.returncode, done.stdout, done.stderr)

    def reboot(self) -> None:
        before = self.run("cat /proc/sys/kernel/random/boot_id").out
        self.run("systemctl reboot")
        self.container.start_anew()
        self.wait(other_than=before)

    def wait(self, other_than: str = "") -> None:
        """Until one gets in, and all that starts on boot has been started."""
        deadline = time.monotonic() + 180
        while time.monotonic() < deadline:
            done = self.run("cat /proc/sys/kernel/random/boot_id")
            if done.code == 0 and done.out != other_than:
                self.run("systemctl is-system-running --wait")
                return
            time.sleep(0.5)
        raise AssertionError(f"nobody gets in at {self.host}: {done.err}")


@contextmanager
def machine(folder: Path) -> Iterator[Machine]:
    """One that has just been set up, until the end of the block. Skips the test where none can be made."""
    missing = [name for name in NEEDED if shutil.which(name) is None]
    if os.geteuid() or missing:
        pytest.skip(f"wants root and debootstrap, systemd-container, iproute2; missing: {missing or 'root'}")
    base = _base()
    with ExitStack() as stack:
        root = stack.enter_context(_over(base, folder))
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / "key"], check=True)
        _set_up(root, (folder / "key.pub").read_text())
        container = Container(root, folder / "console")
        stack.callback(container.stop)
        ssh = f"ssh -i {folder}/key -o IdentitiesOnly=yes -o UserKnownHostsFile={folder}/known"
        ssh += " -o StrictHostKeyChecking=accept-new -o ConnectTimeout=5 -o ServerAliveInterval=5"
        ssh += " -o LogLevel=ERROR -F none"
        made = Machine(ssh, f"pi@{THERE}", root, container)
        made.wait()
        yield made


def _base() -> Path:
    """Skips the test where Debian's packages are out of reach."""
    if not BASE.is_dir():
        begun = BASE.with_suffix(".begun")
        shutil.rmtree(begun, ignore_errors=True)
        begun.parent.mkdir(exist_ok=True)
        made = subprocess.run(
            ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", SUITE, begun],
            capture_output=True,
            text=True,
        )
        if made.returncode:
            pytest.skip(f"debootstrap cannot make a Debian here: {made.stdout.splitlines()[-1:]}")
        begun.rename(BASE)
    return BASE


@contextmanager
def _over(base: Path, folder: Path) -> Iterator[Path]:
    """A file system that begins as `base` and leaves it as it is."""
    for name in ("upper", "work", "root"):
        (folder / name).mkdir(parents=True)
    options = f"lowerdir={base},upperdir={folder / 'upper'},workdir={folder / 'work'}"
    subprocess.run(["mount", "-t", "overlay", "overlay", "-o", options, folder / "root"], check=True)
    try:
        yield folder / "root"
    finally:
        subprocess.run(["umount", folder / "root"], check=True)


def _set_up(root: Path, public_key: str) -> None:
    (root / "etc/systemd/network/10-host0.network").write_text(_NETWORK)
    (root / "home/pi/.ssh").mkdir(parents=True)
    (root / "home/pi/.ssh/authorized_keys").write_text(public_key)
    subprocess.run(["chroot", root, "sh"], input=_SET_UP, text=True, check=True)
