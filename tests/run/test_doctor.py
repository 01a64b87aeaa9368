"""`share doctor` with edges that are present, absent, or refuse its keys."""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.children import Child, start_edge
from helpers.shell import Done

from share.cameras.realsense import devices
from share.devices.host import governors, is_governor_reset, pi_throttled_bits, throttle_counts, usb_memory_mb
from share.runtime import doctor

Share = Callable[..., Done]
LAPTOP = ("--profile", "laptop-edge")


@pytest.fixture
def edge(tmp_path: Path) -> Iterator[str]:
    child, address = start_edge(tmp_path / "room")
    yield address
    child.kill()


class Guarded:
    """An edge with keys, and the folder of ours."""

    def __init__(self, folder: Path, share: Share) -> None:
        self.keys, self.ours = folder / "its-keys", folder / "our-keys"
        self.public = share("keys", "generate", "--name", "edge", "--keys", self.keys).out.strip()
        self.our_public = share("keys", "generate", "--name", "ann", "--keys", self.ours).out.strip()
        where = ("--bind", "tcp://0.0.0.0:0", "--keys", str(self.keys))
        self.child = Child(folder / "edge.log", "edge", *where)
        self.address = f"tcp://127.0.0.1:{self.child.wait_for(r'listening on tcp://0.0.0.0:([0-9]+),')[1]}"


@pytest.fixture
def guarded(tmp_path: Path, share: Share) -> Iterator[Guarded]:
    made = Guarded(tmp_path, share)
    yield made
    made.child.kill()


def of_edge(done: Done) -> dict[str, object]:
    reported = json.loads(done.out)
    (found,) = [one for one in reported["findings"] if one["name"] == "edge"]
    assert reported["ok"] == (done.code == 0) == all(one["state"] != "FAIL" for one in reported["findings"])
    return dict(found)


def test_a_used_port_is_reported(share: Share, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        monkeypatch.setattr(doctor, "_PORT", other.getsockname()[1])
        taken = json.loads(share("doctor", *LAPTOP, "--json").out)
    free = json.loads(share("doctor", *LAPTOP, "--json").out)
    of_agent = json.loads(share("doctor", "--json").out)
    state = [
        {one["name"]: one["state"] for one in reported["findings"]} for reported in (taken, free, of_agent)
    ]
    assert [found.get("port") for found in state] == ["WARN", "OK", None]


def test_a_profile_without_a_camera_needs_none(share: Share, tmp_path: Path) -> None:
    done = share("doctor", *LAPTOP, "--keys", tmp_path / "none")
    states = {line.split()[0] for line in done.out.split("\n\n")[0].splitlines()}
    assert (done.code, done.err) == (0, "")
    assert states <= {"OK", "WARN", "SKIPPED"}
    assert re.search(
        r"^OK +clock +with `share sync server` all devices follow this clock", done.out, re.MULTILINE
    )
    assert "libraries" in done.out


def test_a_running_edge_answers(share: Share, edge: str, tmp_path: Path) -> None:
    found = of_edge(share("doctor", *LAPTOP, "--edge", edge, "--keys", tmp_path / "none", "--json"))
    assert found["state"] == "OK"
    assert "answers in" in str(found["what"])


def test_an_absent_edge_fails_in_one_line(
    share: Share, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "_EDGE_TIMEOUT_S", 0.3)
    done = share("doctor", *LAPTOP, "--edge", "tcp://127.0.0.1:1", "--keys", tmp_path / "none")
    assert done.code == 1
    assert done.err == "share: doctor: 1 check failed: edge\n"
    assert "no answer within 0.3 s" in done.out
    assert "share edge --bind tcp://127.0.0.1:1" in done.out


def test_a_malformed_address_is_wrong_use(share: Share) -> None:
    done = share("doctor", *LAPTOP, "--edge", "kitchen")
    assert (done.code, done.out) == (2, "")
    assert "kitchen" in done.err


@pytest.mark.long
def test_an_edge_with_keys_accepts_authorized_ones(share: Share, guarded: Guarded) -> None:
    ask = ("doctor", *LAPTOP, "--edge", guarded.address, "--keys", guarded.ours, "--json")
    unknown = of_edge(share(*ask, "--server-key", guarded.public))
    assert unknown["state"] == "FAIL"
    assert "authorize" in str(unknown["what"])
    share("keys", "authorize", "ann", guarded.our_public, "--keys", guarded.keys)
    assert of_edge(share(*ask, "--server-key", guarded.public))["state"] == "OK"


@pytest.mark.long
def test_the_key_of_another_edge_is_reported(share: Share, guarded: Guarded) -> None:
    ask = ("doctor", *LAPTOP, "--edge", guarded.address, "--keys", guarded.ours, "--json")
    found = of_edge(share(*ask, "--server-key", guarded.our_public))
    assert found["state"] == "FAIL"


def test_librealsense_may_hang_or_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_query_sdk", lambda: time.sleep(60))
    began = time.monotonic()
    assert "did not answer for 0.2 s" in str(devices.probe_sdk(0.2).trouble)
    assert time.monotonic() - began < 10
    monkeypatch.setattr(devices, "_query_sdk", lambda: os._exit(3))
    assert "crashed" in str(devices.probe_sdk().trouble)


def test_facts_of_the_computer_are_read(tmp_path: Path) -> None:
    cpu = tmp_path / "sys/devices/system/cpu"
    for k, governor in enumerate(("performance", "powersave")):
        (cpu / f"cpu{k}/cpufreq").mkdir(parents=True)
        (cpu / f"cpu{k}/cpufreq/scaling_governor").write_text(f"{governor}\n")
        (cpu / f"cpu{k}/thermal_throttle").mkdir()
        (cpu / f"cpu{k}/thermal_throttle/core_throttle_count").write_text(f"{3 * k}\n")
    usb = tmp_path / "sys/module/usbcore/parameters"
    usb.mkdir(parents=True)
    (usb / "usbfs_memory_mb").write_text("16\n")
    assert sorted(governors(tmp_path)) == ["performance", "powersave"]
    assert sorted(throttle_counts(tmp_path)) == [0, 3]
    assert usb_memory_mb(tmp_path) == 16
    assert usb_memory_mb(tmp_path / "nowhere") is None


@pytest.mark.parametrize(
    ("path", "text", "bits"),
    [
        ("sys/devices/platform/soc/soc:firmware/get_throttled", "50005", 0x50005),
        ("sys/devices/platform/soc@107c000000/soc@107c000000:firmware/get_throttled", "0", 0),
        ("sys/devices/platform/soc/soc:firmware/get_throttled", "oops", None),
        ("sys/class/hwmon/hwmon1/in0_lcrit_alarm", "1", 1),
    ],
)
def test_a_raspberry_pi_is_read(path: str, text: str, bits: int | None, tmp_path: Path) -> None:
    assert pi_throttled_bits(tmp_path) is None
    (tmp_path / path).parent.mkdir(parents=True)
    (tmp_path / path).write_text(text + "\n")
    if "hwmon" in path:
        assert pi_throttled_bits(tmp_path) is None  # of something else
        (tmp_path / path).with_name("name").write_text("rpi_volt\n")
    assert pi_throttled_bits(tmp_path) == bits


def test_a_service_that_resets_the_governor_is_found(tmp_path: Path) -> None:
    unit = tmp_path / "usr/lib/systemd/system/power-profiles-daemon.service"
    unit.parent.mkdir(parents=True)
    unit.touch()
    assert not is_governor_reset(tmp_path)  # it leaves processors alone that have no energy preference
    policy = tmp_path / "sys/devices/system/cpu/cpufreq/policy0"
    policy.mkdir(parents=True)
    (policy / "energy_performance_preference").touch()
    assert is_governor_reset(tmp_path)
    masked = tmp_path / "etc/systemd/system/power-profiles-daemon.service"
    masked.parent.mkdir(parents=True)
    masked.symlink_to("/dev/null")
    assert not is_governor_reset(tmp_path)


def test_keys_of_an_edge_are_checked(share: Share, tmp_path: Path) -> None:
    def keys_of(folder: Path) -> tuple[str, str, list[str]]:
        reported = json.loads(share("doctor", *LAPTOP, "--keys", folder, "--json").out)
        return next((f["state"], f["what"], f["mend"]) for f in reported["findings"] if f["name"] == "keys")

    state, what, mend = keys_of(tmp_path / "none")
    assert (state, mend) == ("WARN", ["share keys generate"]) and "this machine alone" in what
    share("keys", "generate", "--name", "edge", "--keys", tmp_path / "its")
    assert keys_of(tmp_path / "its")[:2] == ("WARN", "edge; no other machine is authorized")
    public = share("keys", "generate", "--name", "ann", "--keys", tmp_path / "ann").out.strip()
    share("keys", "authorize", "ann", public, "--keys", tmp_path / "its")
    assert keys_of(tmp_path / "its")[:2] == ("OK", "edge; authorized: ann")
    (tmp_path / "its" / "authorized").write_text("half a li")
    state, what, _ = keys_of(tmp_path / "its")
    assert state == "FAIL" and "authorized, line 1" in what
