"""`tools/deploy` to a device in a folder: copy, switch, roll back; one line for each error."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import click
import pytest
from helpers.fake_device import TOOLS, FakeDevice, make_device
from helpers.ssh_server import HOST, ssh_server

from share.cli.main import cli
from share.devices import checks
from share.devices.camera_check import UDEV_RULES
from share.errors import ShareError, UsageError
from share.sensors.profile import load_host_profile, shipped_profiles

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def doctor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of the real program on this machine, which takes three seconds."""
    command = [sys.executable, "-m", "share", "doctor", "--json"]
    said = subprocess.run(command, capture_output=True, text=True, cwd=TOOLS.parent, timeout=60).stdout
    path = tmp_path_factory.mktemp("doctor") / "said.json"
    path.write_text(said)
    return path


@pytest.fixture
def device(tmp_path: Path, doctor: Path) -> FakeDevice:
    return make_device(tmp_path, os.environ["PATH"], doctor)


def test_first_agent_is_copied_set_up_and_started(device):
    done = device.agent(device.program("1.0"))
    assert (done.code, done.err) == (0, "")
    assert "share-public-key ann " in done.out  # to be authorized at the edge
    current = device.root / "opt/share/current"
    assert (current / "library.so").readlink() == Path("library.so.1")
    assert os.access(current / "share", os.X_OK)
    settings = device.root / "etc/share/agent-ann.env"
    assert settings.read_text() == "SOURCE=realsense\nKIND=ar\nKEYS=\nOPTIONS=\nEDGE=tcp://127.0.0.1:5555\n"
    rules = (device.root / "etc/udev/rules.d/99-share-realsense.rules").read_text()
    assert rules.splitlines() == list(UDEV_RULES)
    (secret,) = (device.root / "etc/share/keys").glob("*.secret")
    assert secret.stat().st_mode & 0o077 == 0
    asked = device.asked()
    assert [line for line in asked if "enable" in line or "restart" in line] == [
        "systemctl enable share-agent@ann",
        "systemctl restart share-agent@ann",
    ]
    waited = [asked.index(line) for line in ("udevadm settle -t 10", "systemctl daemon-reload")]
    assert max(waited) < asked.index("systemctl restart share-agent@ann")


def test_program_is_installed_without_a_service(device):
    program = device.program("1.0")
    done = device.deploy("program", dist=program)
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines()[-1].endswith(" is there")
    assert device.current == "1.0"
    assert (device.root / "usr/local/bin/share").is_symlink()
    rules = (device.root / "etc/udev/rules.d/99-share-realsense.rules").read_text()
    assert rules.splitlines() == list(UDEV_RULES)
    assert not (device.root / "etc/share/keys").exists()
    assert not [line for line in device.asked() if "enable" in line or "restart" in line]
    assert "is there already" in device.deploy("program", dist=program).out
    assert device.agent(program).code == 0


def test_newer_program_restarts_the_services_or_is_rolled_back(device):
    device.agent(device.program("1.0"))
    device.asked()
    assert device.deploy("program", dist=device.program("1.1")).code == 0
    assert device.current == "1.1"
    assert "systemctl restart share-agent@ann" in device.asked()
    done = device.deploy("program", dist=device.program("1.2", "broken"))
    assert done.err.rstrip().endswith("is back and runs")
    assert (done.code, device.current) == (1, "1.1")
    assert device.deploy("program", "--rollback").code == 0
    assert device.current == "1.0"


def test_doctor_finds_the_installed_udev_rule(device):
    from share.devices.host import camera_rules

    assert device.agent(device.program("1.0")).code == 0
    assert camera_rules(device.root) == ["/etc/udev/rules.d/99-share-realsense.rules"]


def test_second_deployment_changes_nothing(device):
    program = device.program("1.0")
    first = device.agent(program)
    device.asked()
    again = device.agent(program)
    assert (first.code, again.code) == (0, 0)
    assert "runs already" in again.out
    assert not [line for line in device.asked() if "restart" in line]


def test_upgrade_keeps_settings_keys_and_the_previous_release(device):
    device.agent(device.program("1.0"))
    settings = device.root / "etc/share/agent-ann.env"
    settings.write_text(settings.read_text().replace("realsense", "realsense:123") + "# by hand\n")
    (device.root / "etc/share/agent-ann.yaml").write_text("agent: {error_model: ''}\n")
    key = next((device.root / "etc/share/keys").glob("*.secret")).read_text()
    assert device.deploy("agent", "--name", "ann", dist=device.program("1.1")).code == 0
    assert device.current == "1.1"
    assert "SOURCE=realsense:123\n" in settings.read_text()
    assert "# by hand\n" in settings.read_text()
    assert (device.root / "etc/share/agent-ann.yaml").read_text() == "agent: {error_model: ''}\n"
    assert next((device.root / "etc/share/keys").glob("*.secret")).read_text() == key
    assert device.releases() == {"1.0", "1.1"}


def test_another_edge_address_restarts_the_service(device):
    program = device.program("1.0")
    device.agent(program)
    device.asked()
    assert device.deploy("agent", "--name", "ann", "--edge", "tcp://127.0.0.2:5555", dist=program).code == 0
    assert "EDGE=tcp://127.0.0.2:5555\n" in (device.root / "etc/share/agent-ann.env").read_text()
    assert "systemctl restart share-agent@ann" in device.asked()


@pytest.mark.parametrize("mark", ["broken", "flapping"])
def test_release_that_stops_is_rolled_back_with_its_settings(device, mark):
    device.agent(device.program("1.0"))
    kept = (device.root / "etc/share/agent-ann.env").read_text()
    bad = device.program("1.1", mark)
    done = device.deploy("agent", "--name", "ann", "--edge", "tcp://127.0.0.9:1", dist=bad)
    assert done.code == 1
    assert "did not stay up for 0.1 s" in done.err
    assert done.err.splitlines()[-1].startswith("1.1-")
    assert done.err.rstrip().endswith("is back and runs")
    assert device.current == "1.0"
    assert (device.root / "etc/share/agent-ann.env").read_text() == kept


def test_release_with_broken_libraries_is_rolled_back(device):
    device.agent(device.program("1.0"))
    bad = device.program("1.1")
    bad.joinpath("share").write_text('#!/bin/sh\n[ "$1" != --version ] || echo "share, version 1.1"\n')
    done = device.agent(bad)
    assert done.code == 1
    assert "its libraries do not load here" in done.err
    assert device.current == "1.0"


def test_first_release_that_fails_is_stopped(device):
    done = device.agent(device.program("1.0", "broken"))
    assert done.code == 1
    assert "no other release to go back to" in done.err
    assert "systemctl disable --now share-agent@ann" in device.asked()


@pytest.mark.parametrize("leaves", [0, signal.SIGHUP, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_rollback_needs_no_connection(device, leaves):
    """The connection to the device breaks, or the shell there ends, while the services are watched."""
    device.agent(device.program("1.0"))
    device.agent(device.program("1.1", "broken"))
    (bad,) = [path.name for path in (device.root / "opt/share/releases").glob("1.1-*")]
    device.asked()
    code = device.unseen("activate", bad, "share-agent@ann", "d435i-n100-headset", leaves=leaves)
    assert (code, device.current) == (1, "1.0")
    assert [line for line in device.asked() if "restart" in line] == ["systemctl restart share-agent@ann"] * 2


@pytest.mark.slow
def test_failed_first_service_is_reported_as_removed(device):
    program = device.program("1.0", "broken")
    assert device.deploy("program", dist=program).code == 0
    done = device.agent(program)
    assert done.err.rstrip().endswith("does not run like this; all is as it was, without a service")
    assert (done.code, device.current) == (1, "1.0")
    assert "systemctl disable --now share-agent@ann" in device.asked()


@pytest.mark.slow
def test_failed_second_service_leaves_the_first_running(device):
    program = device.program("1.0")
    assert device.deploy("edge", dist=program).code == 0
    device.asked()
    done = device.agent(device.program("1.1", "broken"))
    assert (done.code, device.current) == (1, "1.0")
    assert (device.root / "etc/share/services").read_text() == "share-edge\n"
    asked = device.asked()
    assert asked.index("systemctl disable --now share-agent@ann") < len(asked) - 1
    assert [line for line in asked if "restart" in line][-1] == "systemctl restart share-edge"


@pytest.mark.slow
def test_manual_rollback_and_return(device):
    device.agent(device.program("1.0"))
    device.agent(device.program("1.1"))
    for version in ("1.0", "1.1"):
        done = device.deploy("agent", "--name", "ann", "--rollback")
        assert (done.code, device.current) == (0, version), done.err
        assert f"{version}-" in done.out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "profile"), [("ar", "d435i-n100-headset"), ("robot", "d435i-turtlebot4"), (None, "laptop-edge")]
)
def test_doctor_uses_the_profile_of_the_device(device, kind, profile):
    program = device.program("1.0")
    if kind is None:
        device.deploy("edge", dist=program)
    else:
        device.agent(program, "--kind", kind)
        device.agent(device.program("1.1"))  # the kind is known by now
    assert (device.root / "etc/share/profile").read_text() == f"{profile}\n"
    assert profile in shipped_profiles()
    wanted = load_host_profile(profile).host
    _head, *lines = (device.root / "etc/tmpfiles.d/share.conf").read_text().splitlines()
    assert lines == list(checks.tmpfiles_lines(wanted.cpu_governor, wanted.usbfs_mb))
    assert f"systemd-tmpfiles --create {device.root}/etc/tmpfiles.d/share.conf" in device.asked()


def test_governor_reset_at_boot_gives_a_warning(device):
    unit = "systemd/system/power-profiles-daemon.service"
    for path in (f"usr/lib/{unit}", "sys/devices/system/cpu/cpufreq/policy0/energy_performance_preference"):
        (device.root / path).parent.mkdir(parents=True)
        (device.root / path).touch()
    command = "sudo systemctl mask --now power-profiles-daemon.service"
    first = device.agent(device.program("1.0"))
    assert first.code == 0 and command in first.out
    (device.root / "etc" / unit).symlink_to("/dev/null")
    second = device.agent(device.program("1.1"))
    assert second.code == 0 and command not in second.out


def test_rollback_without_a_previous_release_is_one_line(device):
    device.agent(device.program("1.0"))
    done = device.deploy("agent", "--name", "ann", "--rollback")
    assert (done.code, done.err) == (1, "deploy: there is no previous release to go back to\n")


@pytest.mark.slow
def test_only_the_newest_releases_are_kept(device):
    for version in ("1.0", "1.1", "1.2", "1.3"):
        assert device.agent(device.program(version), "--keep", 2).code == 0
    assert device.releases() == {"1.2", "1.3"}


def test_dry_run_prints_all_steps_and_changes_nothing(device):
    done = device.agent(device.program("1.0"), "--dry-run")
    assert done.code == 0
    for text in ("/opt/share/releases/1.0-", "EDGE=tcp://127.0.0.1:5555", "none -> 1.0-", "share-agent@ann"):
        assert text in done.out
    assert list(device.root.iterdir()) == []
    assert device.asked() == []


def test_edge_and_time_server_are_deployed(device):
    program = device.program("1.0")
    assert device.deploy("edge", "--http", "8080", dist=program).code == 0
    assert device.deploy("sync", dist=program).code == 0
    settings = device.root / "etc/share/edge.env"
    assert settings.read_text() == "BIND=tcp://0.0.0.0:5555\nHTTP=8080\nOPTIONS=\n"
    assert (device.root / "etc/share/services").read_text() == "share-edge\nshare-sync\n"
    assert not (device.root / "etc/share/sync.env").exists()


def test_key_of_the_edge_is_stored_for_the_service(device):
    from share.net.keys import public_key

    key = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"  # RFC 32's test vector is this long
    done = device.agent(device.program("1.0"), "--server-key", key)
    assert done.code == 0, done.err
    assert public_key(str(device.root / "etc/share/edge.public")) == key
    line = "KEYS=--keys /etc/share/keys --server-key /etc/share/edge.public\n"
    assert line in (device.root / "etc/share/agent-ann.env").read_text()


def test_wrong_use_is_one_line(device, tmp_path):
    program = device.program("1.0")
    cases = {
        "no frozen program there; make one with `make freeze`": device.agent(tmp_path / "nothing"),
        "cannot be reached: ssh: connect": device.deploy("edge", host="nowhere", dist=program),
        "--edge is required the first time": device.deploy("agent", "--name", "ann", dist=program),
        "use 1 to 64 letters": device.deploy("agent", "--name", "a/b", dist=program),
        "neither a file nor a public key": device.agent(program, "--server-key", "x"),
        "--server-key: tcp://10.0.0.1:5555 is on": device.agent(program, "--edge", "tcp://10.0.0.1:5555"),
        "'10.0.0.1' is not an address": device.agent(program, "--edge", "10.0.0.1"),
        "not allowed in a settings file": device.agent(program, "--source", "a$b"),
    }
    for text, done in cases.items():
        assert done.code in (1, 2)
        assert text in done.err
        assert len(done.err.splitlines()) == 1
    assert list(device.root.iterdir()) == []


def test_interrupted_copy_leaves_no_release(device):
    program = device.program("1.0")
    (program / "model").write_bytes(os.urandom(5_000_000))  # more than pipes hold
    (device.ssh.parent / "tar").write_text("#!/bin/sh\nhead -c 10 >/dev/null\nexit 2\n")
    (device.ssh.parent / "tar").chmod(0o755)
    done = device.agent(program)
    assert (done.code, done.err) == (
        1,
        "deploy: pi@headset1: the program was not copied: the program could not be unpacked\n",
    )
    assert list((device.root / "opt/share/releases").iterdir()) == []


def test_lost_connection_during_the_copy_is_reported(device):
    program = device.program("1.0")
    (program / "model").write_bytes(os.urandom(5_000_000))
    breaks = "*'device.sh receive '*) echo 'client_loop: send disconnect: Broken pipe' >&2; exit 255"
    device.ssh.write_text(device.ssh.read_text().replace("exec sh", f"case $2 in {breaks} ;; esac\nexec sh"))
    done = device.agent(program)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "pi@headset1: cannot be reached: client_loop: send disconnect: Broken pipe; try" in done.err


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_units(tmp_path):
    units = tmp_path / "etc/systemd/system"
    units.mkdir(parents=True)
    program = tmp_path / "opt/share/current/share"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    names = [path.name.replace("@", "@ann") for path in (TOOLS / "device").glob("*.service")]
    for path in (TOOLS / "device").glob("*.service"):
        shutil.copy(path, units / path.name)
    shutil.copytree("/lib/systemd/system", tmp_path / "lib/systemd/system", symlinks=True)
    command = ["systemd-analyze", "verify", "--man=no", f"--root={tmp_path}", *names]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    complaints = [line for line in done.stderr.splitlines() if "share" in line]
    assert (done.returncode, complaints) == (0, []), done.stderr


@pytest.mark.skipif(shutil.which("systemd-tmpfiles") is None, reason="needs systemd-tmpfiles")
def test_systemd_applies_the_profile(device):
    device.agent(device.program("1.0"))
    cores = [device.root / f"sys/devices/system/cpu/cpufreq/policy{k}/scaling_governor" for k in (0, 1)]
    usb = device.root / "sys/module/usbcore/parameters/usbfs_memory_mb"
    for path in (*cores, usb):
        path.parent.mkdir(parents=True)
        path.write_text("x" * 11)
    command = ["systemd-tmpfiles", f"--root={device.root}", "--create"]
    subprocess.run([*command, device.root / "etc/tmpfiles.d/share.conf"], check=True, timeout=60)
    assert [path.read_text() for path in cores] == ["performance"] * 2
    assert usb.read_text().startswith("128")


def test_agent_may_start_the_imu_of_the_camera():
    """ProtectKernelTunables= makes all of /sys read-only, whoever may write there."""
    lines = (TOOLS / "device" / "share-agent@.service").read_text().splitlines()
    assert "ProtectKernelTunables=yes" not in lines
    assert "SupplementaryGroups=plugdev video" in lines


@pytest.mark.parametrize("unit", ["share-edge.service", "share-agent@.service"])
def test_libzmq_may_list_network_interfaces(unit):
    """By netlink, and it aborts the program where it may not: tests/booted saw it."""
    assert re.search("^RestrictAddressFamilies=.*AF_NETLINK", (TOOLS / "device" / unit).read_text(), re.M)


def test_deployment_over_real_ssh(device, tmp_path):
    program = device.program("1.0")
    agent = ("agent", "--name", "ann", "--edge", "tcp://127.0.0.1:5555")
    with ssh_server(tmp_path / "ssh", device.path) as ssh:
        assert device.deploy(*agent, host=HOST, ssh=ssh, dist=program).code == 0
        assert device.deploy(*agent, host=HOST, ssh=ssh, dist=device.program("1.1", "broken")).code == 1
        assert (device.current, device.releases()) == ("1.0", {"1.0", "1.1"})
        stranger = ssh.replace("ssh/client", "ssh/host")
        refused = device.deploy(*agent, host=HOST, ssh=stranger, dist=program)
    assert refused.code == 2
    assert "cannot be reached" in refused.err
    assert "Permission denied" in refused.err
    gone = device.deploy(*agent, host=HOST, ssh=ssh, dist=program)
    assert (gone.code, gone.err.count("\n")) == (2, 1)
    assert "Connection refused" in gone.err


@pytest.mark.parametrize(
    ("reported", "says"),
    [
        ({"machine": "aarch64"}, "is aarch64, the program was built for x86_64"),
        ({"glibc": 31}, "has glibc 2.31, the program needs 2.36"),
        ({"free": 100_000_000}, "100 MB free at /opt/share, 330 MB are needed"),
        ({"systemd": False}, "has no systemd"),
    ],
)
def test_unsuitable_device_is_refused_before_the_copy(monkeypatch, reported, says):
    monkeypatch.syspath_prepend(TOOLS)
    tool = importlib.import_module("deploy_device")
    release = importlib.import_module("deploy_release").Release(Path(), "1.0-abc", 300_000_000, "x86_64", 36)
    fine = tool.Facts("x86_64", 36, 10**9, True, "", "", (), "")
    tool.check("headset1", release, fine)
    with pytest.raises(ShareError, match=f"^headset1: {says}"):
        tool.check("headset1", release, replace(fine, **reported))


def test_requirements_are_read_from_the_binary(monkeypatch, tmp_path, device):
    """Python itself, against objdump."""
    monkeypatch.syspath_prepend(TOOLS)
    read_release = importlib.import_module("deploy_release").read_release
    folder = device.program("1.0")
    assert read_release(folder).machine == ""
    library = Path(sys.executable).resolve()
    shutil.copy(library, folder / "python")
    reported = subprocess.run(["objdump", "-T", library], capture_output=True, text=True, check=True).stdout
    found = read_release(folder)
    assert found.glibc == max(int(minor) for minor in re.findall(r"GLIBC_2\.(\d+)", reported))
    assert found.machine == platform.machine()
    assert found.name == read_release(folder).name
    (folder / "library.so.1").write_bytes(b"other code")
    assert found.name != read_release(folder).name


def test_program_for_another_processor_is_refused_by_the_device(device):
    """A Raspberry Pi's, on a laptop: it cannot be asked for its version here, nor need it be."""
    program = device.program("1.0")
    elf = b"\x7fELF".ljust(18, b"\0") + bytes([183 if platform.machine() != "aarch64" else 62, 0])
    (program / "share").write_bytes(elf)
    assert "has no file VERSION, and its program does not start here" in device.agent(program).err
    (program / "VERSION").write_text("1.0\n")
    done = device.agent(program)
    other = "aarch64" if platform.machine() != "aarch64" else "x86_64"
    assert f"is {platform.machine()}, the program was built for {other}; " in done.err
    assert (done.code, done.err.count("\n")) == (1, 1)
    (program / "VERSION").write_text("../1.0\n")
    assert "'../1.0' is not a version" in device.agent(program).err


def test_missing_sudo_is_one_line(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(TOOLS)
    tool = importlib.import_module("deploy_device")
    ssh = tmp_path / "ssh"
    ssh.write_text(
        '#!/bin/sh\ncase "$*" in *"sudo -n true"*) exit 1 ;; esac\nfor last; do :; done\nexec sh -c "$last"\n'
    )
    ssh.chmod(0o755)
    with pytest.raises(UsageError, match="no root access without a password"):
        tool.Device("pi@headset1", str(ssh)).probe("agent-ann")


def test_units_use_existing_options():
    for path in (TOOLS / "device").glob("*.service"):
        text = path.read_text().replace("\\\n", " ")
        (started,) = re.findall(r"^ExecStart=/opt/share/current/share (\w+(?: server)?)(.*)$", text, re.M)
        command: click.Command = cli
        for word in started[0].split():
            assert isinstance(command, click.Group)
            found = command.get_command(click.Context(command), word)
            assert found is not None
            command = found
        known = {option for param in command.params for option in param.opts}
        assert set(re.findall(r"--[a-z-]+", started[1])) <= known
