"""`tools/deploy` onto a Debian that boots: real ssh, sudo, systemd and journald, no Python, no compiler."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.frozen_program import frozen_program
from helpers.shell import Done
from helpers.small_session import small_profile
from machine import THERE, Machine, machine

ROOT = Path(__file__).resolve().parents[2]
EDGE = f"tcp://{THERE}:5555"  # not loopback: keys are asked for
UP = "systemctl is-active share-edge share-agent@ann share-sync"

pytestmark = pytest.mark.slow
Deploy = Callable[..., Done]


@pytest.fixture(scope="module")
def device(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with machine(tmp_path_factory.mktemp("machine")) as made:
        yield made


@pytest.fixture(scope="module")
def deploy(device: Machine) -> Deploy:
    """`tools/deploy WORDS[0] the device WORDS[1:]`."""

    def run(*words: object, dist: Path = ROOT / "dist/share", settle: float = 4) -> Done:
        command = [sys.executable, ROOT / "tools/deploy.py", words[0], device.host, *words[1:]]
        settings = ["--ssh", device.ssh, "--dist", dist, "--settle", settle]
        done = subprocess.run(
            [str(word) for word in (*command, *settings)], capture_output=True, text=True, timeout=300
        )
        assert "Traceback" not in done.stderr, done.stderr
        return Done(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="module")
def running(device: Machine, deploy: Deploy, tmp_path_factory: pytest.TempPathFactory) -> Machine:
    """The device with an edge, a time server, and an agent that plays a recording of 40 s."""
    frozen_program()
    session = recording(tmp_path_factory.mktemp("session"))
    assert deploy("program").code == 0
    device.run("mkdir -p /var/lib/share")
    shutil.copytree(session, device.root / "var/lib/share/room")
    assert deploy("edge").code == 0
    assert deploy("sync").code == 0
    (key,) = [path.read_text().split()[-1] for path in (device.root / "etc/share/keys").glob("*.public")]
    device.run(f"sudo -u share share keys authorize ann '{key}' --keys /etc/share/keys")
    agent = ("--name", "ann", "--edge", EDGE, "--source", "/var/lib/share/room/ann", "--server-key", key)
    done = deploy("agent", *agent)
    assert (done.code, done.err) == (0, "")
    return device


def test_the_device_has_neither_python_nor_a_compiler(device):
    found = device.run("for one in systemctl python3 python gcc cc; do command -v $one; done").out
    assert found.split() == ["/usr/bin/systemctl"]


def test_all_are_up_and_the_agent_has_joined(running):
    assert running.run(UP).out.split() == ["active"] * 3
    joined(running)


def test_who_logs_in_may_type_share(running):
    done = subprocess.run([*running.ssh.split(), running.host, "share", "--version"], capture_output=True)
    assert done.stdout.startswith(b"share, version ")


def test_all_of_it_starts_on_boot(running):
    running.reboot()
    assert running.run(UP).out.split() == ["active"] * 3
    joined(running)
    before = running.run("journalctl -b -1 -u share-edge -o cat").out
    assert "agent joined: ann" in before  # what happened before a power cut is not lost


def test_an_edge_that_is_killed_comes_back_with_its_map_and_its_agent(running):
    running.run("systemctl restart share-agent@ann")
    joined(running)
    running.run("systemctl kill -s KILL share-edge")
    wait(lambda: running.run("systemctl show -P NRestarts share-edge").out.strip() == "1")
    joined(running)


def test_the_units_leave_as_little_open_as_the_page_says(running):
    page = " ".join((ROOT / "docs/do/deploy.md").read_text().split())
    for unit, told in (("share-agent@ann", "3.8 of 10 for the agent"), ("share-edge", "3.1 for the edge")):
        said = running.run(f"systemd-analyze security --no-pager {unit} | tail -1").out
        assert told in page
        assert f"{told[:3]} " in said


def test_a_release_that_does_not_start_is_taken_back(running, deploy, tmp_path):
    dist = other_release(tmp_path / "share", "9.0")
    (dist / "share").write_text("#!/bin/sh\necho no luck >&2\nexit 1\n")
    done = deploy("agent", "--name", "ann", "--edge", "tcp://10.0.0.9:1", dist=dist)
    assert done.code == 1
    assert "no luck" in done.err
    assert done.err.rstrip().endswith("is back and runs")
    assert running.run(UP).out.split() == ["active"] * 3
    assert f"EDGE={EDGE}\n" in (running.root / "etc/share/agent-ann.env").read_text()


def test_an_upgrade_and_back_on_the_device_itself(running, deploy, tmp_path):
    first = running.run("readlink /opt/share/current").out
    assert deploy("edge", dist=other_release(tmp_path / "share", "9.1")).code == 0
    assert running.run("readlink /opt/share/current").out.startswith("releases/9.1-")
    done = running.run("sh /opt/share/current/deploy/device.sh rollback")
    assert (done.code, running.run("readlink /opt/share/current").out) == (0, first)
    assert running.run(UP).out.split() == ["active"] * 3


def test_a_camera_that_is_not_there_is_said_and_stops_the_first_deployment(running, deploy):
    key = running.run("cat /etc/share/edge.public").out.split()[-1]
    done = deploy("agent", "--name", "bob", "--edge", EDGE, "--server-key", key, settle=10)
    assert done.code == 1
    assert "share-agent@bob did not stay up for 10 s:\n" in done.err
    assert "share-edge did not" not in done.err
    assert "RealSense camera" in done.err  # what the agent said last, not what systemd says of it
    assert running.run("systemctl is-enabled share-agent@bob").out.strip() != "enabled"


def test_a_sudo_that_asks_for_a_password_is_one_line(running, deploy):
    running.run("mv /etc/sudoers.d/pi /root/pi && echo 'pi ALL=(ALL) ALL' >/etc/sudoers.d/pi")
    done = deploy("edge")
    (running.root / "etc/sudoers.d/pi").write_text((running.root / "root/pi").read_text())
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "no root access without a password" in done.err


def test_taken_away_as_the_page_says_nothing_is_left(running):
    page = (ROOT / "docs/do/deploy.md").read_text()
    section = page.partition("**Take it away**")[2].partition("\n## ")[0]
    running.run("\n".join(re.findall(r"```bash\n(.*?)```", section, flags=re.DOTALL)))
    left = "/opt/share /etc/share /var/lib/share /usr/local/bin/share /etc/*/*share* /etc/systemd/*/share-*"
    assert running.run(f"ls -d {left}").out == ""
    assert running.run("systemctl list-units --all 'share-*' -q").out == ""
    assert running.run("id share").code != 0


def joined(device: Machine) -> None:
    """The edge of this start says that ann is there."""
    since = '--since @$(date -d "$(systemctl show -P ActiveEnterTimestamp share-edge)" +%s)'
    wait(lambda: "agent joined: ann" in device.run(f"journalctl -u share-edge -o cat {since}").out)


def wait(until: Callable[[], bool], seconds: float = 30) -> None:
    deadline = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < deadline
        time.sleep(0.3)


def recording(folder: Path) -> Path:
    """A session of 40 s in the plain room, with small pictures."""
    words = ["emulate", "--scene", "plain", "--motion", "ann=walk:", "--seconds", 40]
    words += ["--profile", small_profile(folder), "--out", folder / "room"]
    subprocess.run([sys.executable, "-m", "share", *map(str, words)], check=True, capture_output=True)
    return folder / "room"


def other_release(folder: Path, version: str) -> Path:
    """The same program, said to be another version."""
    shutil.copytree(ROOT / "dist/share", folder, symlinks=True)
    (folder / "VERSION").write_text(f"{version}\n")
    return folder
