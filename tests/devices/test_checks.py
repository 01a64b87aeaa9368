"""Each check on both sides of its limit."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from share.devices import camera_check, checks
from share.devices import host as facts
from share.devices.camera_check import SdkReport, UsbCamera
from share.devices.checks import CheckState, check_calibration, check_serial
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.se3 import inverse


@pytest.mark.parametrize(("mbit_s", "state"), [(480, "FAIL"), (5000, "OK"), (10000, "OK")])
def test_usb_3_link_has_at_least_5000_mbit(mbit_s: float, state: str) -> None:
    assert camera_check.check_link([UsbCamera("2-1", mbit_s)]).state.value == state
    assert camera_check.check_link([]).state is camera_check.check_link(None).state is CheckState.FAIL


@pytest.mark.parametrize(
    ("found", "state"),
    [("5.9.0.0", "FAIL"), ("5.12.0", "WARN"), ("5.13.0.50", "OK"), ("5.15", "WARN"), ("5.16.0.1", "OK")],
)
def test_firmware_versions_are_compared_as_numbers(found: str, state: str) -> None:
    good = ["5.13.0.50", "5.16.0.1"]
    reported = camera_check.check_firmware(SdkReport(firmware=(found,)), good, "5.12.0.0")
    assert reported.state.value == state
    assert any("librealsense2-utils" in line for line in reported.fix) == (state != "OK")


def test_newer_firmware_passes() -> None:
    found = camera_check.check_firmware(
        SdkReport(firmware=("5.17.0.10",)), ["5.9.0.1", "5.16.0.1", "5.13"], None
    )
    assert (found.state, found.fix) == (CheckState.OK, ())
    assert found.what.startswith("5.17.0.10, newer than those tested")


def test_missing_poselib_is_reported() -> None:
    assert checks.check_libraries({"numpy": None, "poselib": None}).what == "numpy, poselib load"
    found = checks.check_libraries({"numpy": None})
    assert (found.state, found.fix) == (CheckState.OK, ())
    assert found.what.startswith("numpy load; without poselib")


def test_advice_in_a_frozen_program_is_not_to_install() -> None:
    for frozen in (False, True):
        mends = [
            *camera_check.check_sdk(SdkReport("no module pyrealsense2"), [], frozen).fix,
            *checks.check_libraries({"zmq": "no", "numpy": None}, frozen).fix,
        ]
        assert ["pip" in mend for mend in mends] == [not frozen] * 2
        assert ["tools/deploy" in mend for mend in mends] == [frozen] * 2
    assert camera_check.check_sdk(SdkReport("libusb-1.0.so.0: not there"), [], True).fix == (
        "sudo apt install libusb-1.0-0",
    )


def test_attached_camera_that_the_sdk_misses_fails() -> None:
    here, seen = UsbCamera("2-1", 5000), SdkReport(firmware=("5.16.0.1",))
    assert (
        camera_check.check_sdk(seen, [here]).state
        is camera_check.check_sdk(SdkReport(), []).state
        is CheckState.OK
    )
    assert camera_check.check_sdk(seen, [here, here]).state is CheckState.FAIL
    unseen, closed = (
        camera_check.check_sdk(SdkReport(), [here]),
        camera_check.check_sdk(SdkReport(), [UsbCamera("2-1", 5000, may_open=False)]),
    )
    assert unseen.state is closed.state is CheckState.FAIL
    assert unseen.what == "loads, but sees 0 of 1 cameras: not permitted, or in use"
    assert closed.what == "loads, but sees 0 of 1 cameras: this user may not open 2-1"
    assert "plugdev" in unseen.fix[0]


def test_invisible_facts_are_skipped() -> None:
    found = [
        checks.check_governor([], "performance"),
        checks.check_throttling([]),
        camera_check.check_usb_memory(None, 128),
    ]
    found += [
        camera_check.check_firmware(SdkReport("no"), [], None),
        camera_check.check_autosuspend([], False),
    ]
    assert {one.state for one in found} == {CheckState.SKIPPED}


def test_host_is_compared_with_the_profile() -> None:
    assert checks.check_governor(["performance"] * 4, "performance").state is CheckState.OK
    assert "1 of 2 cores" in checks.check_governor(["performance", "powersave"], "performance").what
    assert (
        checks.check_throttling([0, 3]).state
        is camera_check.check_usb_memory(16, 128).state
        is CheckState.WARN
    )
    assert camera_check.check_usb_memory(128, 128).state is CheckState.OK
    assert camera_check.check_udev([], is_root=False).state is CheckState.FAIL


@pytest.mark.parametrize(
    ("bits", "what", "mend"),
    [
        (0x0, "none since the start", ""),
        (0x50005, "the supply voltage is too low and it is slowed (get_throttled 0x50005)", "5.1 V"),
        (0x50000, "the supply voltage was too low and it was slowed since the start (", "5.1 V"),
        (0x80000, "it was slowed since the start (get_throttled 0x80000)", "cool it"),
        (0x8, "it is slowed (get_throttled 0x8)", "cool it"),
    ],
)
def test_supply_and_heat_of_a_raspberry_pi_are_reported(bits: int, what: str, mend: str) -> None:
    found = checks.check_throttling([], bits)
    assert found.state is (CheckState.WARN if bits else CheckState.OK)
    assert found.what.startswith(what)
    assert all(mend in line for line in found.fix) and bool(found.fix) == bool(bits)
    assert len(checks.check_throttling([], bits | 0x90000).fix) == 2  # each has a remedy of its own


def test_edge_without_keys_or_authorized_agents_gives_a_warning() -> None:
    assert (checks.missing_edge_keys("k").state, checks.missing_edge_keys("k").fix) == (
        CheckState.WARN,
        ("share keys generate",),
    )
    assert checks.check_edge_keys("edge", []).state is CheckState.WARN
    assert checks.check_edge_keys("edge", ["ann", "bob"]).what == "edge; authorized: ann, bob"


def test_advice_for_the_host_persists_over_a_reboot() -> None:
    lines, mend = checks.tmpfiles_lines("performance", 128), checks.boot_settings_fix("performance", 128)
    assert [line.split()[-1] for line in lines] == ["performance", "128"]
    assert all(f"'{line}'" in mend[0] for line in lines)
    assert checks.TMPFILES_PATH in mend[0] and checks.TMPFILES_PATH in mend[1]
    assert checks.tmpfiles_lines("", 0) == ()
    asleep = camera_check.check_autosuspend([UsbCamera("2-1", 5000, "auto")], allowed=False)
    assert any('ATTR{power/control}="on"' in line and "rules.d" in line for line in asleep.fix)


@pytest.mark.parametrize(("minutes", "state"), [(4, "FAIL"), (6, "WARN"), (61, "OK")])
def test_free_disk_is_given_in_minutes_of_recording(minutes: int, state: str) -> None:
    assert checks.check_disk("/", minutes * 60 * 10_000_000, 1e7).state.value == state


def test_unwritable_disk_fails() -> None:
    found = checks.check_disk("/data", 10**12, 1e7, may_write=False)
    assert (found.state, found.what) == (CheckState.FAIL, "/data: this user may not write there")


@pytest.mark.parametrize(
    ("offset", "state"), [(0.5, CheckState.OK), (-0.5, CheckState.OK), (0.8, CheckState.WARN)]
)
def test_clock_is_judged_with_its_uncertainty(offset: float, state: CheckState) -> None:
    assert checks.check_clock((offset, 0.3), None).state is state
    assert checks.check_clock(None, None).state is CheckState.WARN


def test_inverted_extrinsics_differ_from_misplaced_ones() -> None:
    T = np.eye(4)
    T[:3, 3] = (-0.03, 0.02, 0.01)
    T_10 = np.eye(4)
    T_10[0, 3] = -0.05
    lens = Camera(640, 480, 385.0, 385.0, 320.0, 240.0)

    def of(
        T_imu_cam0: np.ndarray, cam1: np.ndarray, size: tuple[int, int] = (640, 480)
    ) -> tuple[CheckState, str]:
        noise = ImuNoise(1e-4, 2e-3, 2e-5, 3e-3, 200.0)
        rig = Rig(lens, T_imu_cam0, cam1=lens, T_cam1_cam0=cam1, imu=noise)
        found = check_calibration(rig, 1.0, T, 0.05, size)
        return found.state, found.what

    assert of(T, T_10) == (CheckState.OK, "cameras (640x480) and IMU, 1 days old")
    assert of(T, T_10, (848, 480))[1].endswith("; valid only with --mode 640x480")
    assert of(inverse(T), T_10) == (CheckState.FAIL, "the extrinsics to the IMU are inverted")
    assert of(np.eye(4), T_10)[0] is CheckState.WARN
    assert "cam1 is left" in of(T, inverse(T_10))[1]


@pytest.mark.parametrize(
    ("said", "there", "state", "mended"),
    [
        (("0123",), ("0123",), CheckState.OK, []),
        (("0123",), ("0456", "0123"), CheckState.OK, []),
        (("0123",), ("0456",), CheckState.WARN, ["0456"]),
        (("0123", "0789"), ("0123",), CheckState.WARN, ["0123"]),
        (("0123",), (), CheckState.SKIPPED, []),
        ((), ("0123",), CheckState.SKIPPED, []),
    ],
)
def test_calibration_of_another_camera_gives_a_warning(
    said: tuple[str, ...], there: tuple[str, ...], state: CheckState, mended: list[str]
) -> None:
    found = check_serial(said, there)
    assert found.state is state
    assert [line.partition("  #")[0] for line in found.fix] == [
        f"share calibrate realsense {one} --out calib/{one}" for one in mended
    ]
    assert all(one in found.what for one in said)


def test_facts_are_read_from_a_tree(tmp_path: Path) -> None:
    usb, rules = tmp_path / "sys/bus/usb/devices/2-1", tmp_path / "etc/udev/rules.d"
    assert facts.cameras(tmp_path) is None
    (usb / "power").mkdir(parents=True)
    rules.mkdir(parents=True)
    for name, text in {
        "idVendor": "8086",
        "idProduct": "0b3a",
        "speed": "480",
        "power/control": "auto",
        "busnum": "2",
        "devnum": "13",
    }.items():
        (usb / name).write_text(text + "\n")
    assert facts.cameras(tmp_path) == [UsbCamera("2-1", 480.0, "auto", may_open=False, may_start_imu=None)]
    (usb / "speed").write_text("unknown\n")  # on its way out
    assert camera_check.check_link(facts.cameras(tmp_path)).state is CheckState.FAIL
    (usb / "speed").write_text("480\n")
    node = tmp_path / "dev/bus/usb/002/013"
    node.parent.mkdir(parents=True)
    node.touch()
    assert facts.cameras(tmp_path) == [UsbCamera("2-1", 480.0, "auto", may_open=True, may_start_imu=None)]
    for reported in (
        [],
        [f"# {rule}" for rule in camera_check.UDEV_RULES],
        camera_check.UDEV_RULES[:1],
        camera_check.UDEV_RULES[1:2],
    ):
        (rules / "9.rules").write_text("\n".join(reported))
        assert facts.camera_rules(tmp_path) == []  # the IMU as well as the camera
    (rules / "9.rules").write_text("\n".join(camera_check.UDEV_RULES))
    assert facts.camera_rules(tmp_path) == ["/etc/udev/rules.d/9.rules"]


def test_imu_needs_writable_files_in_sys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usb = tmp_path / "sys/bus/usb/devices/2-1"
    switches = usb / "2-1:1.5/0003:8086:0B3A.0001/HID-SENSOR-200073.1.auto/iio:device0/scan_elements"
    switches.mkdir(parents=True)
    for name, text in {"idVendor": "8086", "idProduct": "0b3a", "speed": "5000"}.items():
        (usb / name).write_text(text + "\n")
    for name in ("in_accel_x_en", "in_accel_x_index"):
        (switches / name).write_text("0\n")
    shut: set[str] = set()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name not in shut)  # root may anything
    assert camera_check.check_imu(facts.cameras(tmp_path) or ()).state is CheckState.OK
    shut.add("in_accel_x_en")
    found = camera_check.check_imu(facts.cameras(tmp_path) or ())
    assert found.state is CheckState.FAIL
    assert [
        rule for rule in camera_check.UDEV_RULES if not any(f"echo '{rule}'" in line for line in found.fix)
    ] == []
    (switches / "in_accel_x_en").unlink()
    assert camera_check.check_imu(facts.cameras(tmp_path) or ()).state is CheckState.WARN
    assert camera_check.check_imu([]).state is CheckState.SKIPPED
