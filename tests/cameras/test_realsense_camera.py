"""The RealSense camera on the real SDK with its software device."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.software_camera import BASELINE, T_GYRO_IR, Listed, SoftwareCamera

from share.cameras.realsense import camera as adapter
from share.cameras.realsense.camera import RealSenseCamera
from share.cameras.realsense.devices import AttachedDevice, choose_device
from share.cameras.realsense.streams import StreamRequest, read_extrinsics, scale_depth
from share.cameras.realsense.streams import read_camera as factory_camera
from share.errors import ShareError, UsageError
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.ros_messages import encode_raw
from share.sensors.profile import load_profile
from share.sensors.sample_processor import DeviceSample

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

D435I = load_profile("d435i")
FACTS = D435I.device


def attached(serial: str = "1", firmware: str = "5.16.0.1", usb: str = "3.2") -> AttachedDevice:
    return AttachedDevice(serial, "Intel RealSense D435I", firmware, usb, None)


@pytest.fixture
def camera() -> SoftwareCamera:
    return SoftwareCamera(rs)


def read(
    camera: SoftwareCamera, count: int, feed: Callable[[], None], wanted: StreamRequest | None = None
) -> list[DeviceSample]:
    """Return the samples that `feed` puts in; wait for `count`, at most 5 s."""
    got: list[DeviceSample] = []
    with RealSenseCamera(wanted or StreamRequest(D435I), context=camera.context) as device:
        device.start(got.append)
        feed()
        until = time.monotonic() + 5
        while len(got) < count and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(0.05)
    return got


def test_images_and_motion_samples_are_unchanged(camera: SoftwareCamera) -> None:
    left, right = (np.random.default_rng(k).integers(0, 255, (480, 640), np.uint8) for k in (0, 1))

    def feed() -> None:
        camera.image(0, 4_294_967_295, left)
        camera.image(1, 4_294_967_295, right)
        camera.turn(12_345, 0.25, -0.5, 1.0)
        camera.force(23_456, 0.5, 9.75, -1.0)

    got = {sample.stream: sample for sample in read(camera, 4, feed)}
    assert np.array_equal(got["cam0"].payload.load(), left)
    assert np.array_equal(got["cam1"].payload.load(), right)
    assert got["cam0"].stamp_ns == 4_294_967_295_000
    assert (got["gyro"].stamp_ns, got["gyro"].payload) == (12_345_000, [0.25, -0.5, 1.0])
    assert (got["accel"].stamp_ns, got["accel"].payload) == (23_456_000, [0.5, 9.75, -1.0])
    assert all(sample.is_device_clock for sample in got.values())


@pytest.mark.parametrize(
    ("unit_m", "encoding"), [(0.001, "16UC1"), (0.0001, "32FC1"), (0.0005, "32FC1"), (0.00123, "32FC1")]
)
def test_depth_in_millimetres_is_recorded_as_such(unit_m: float, encoding: str) -> None:
    steps = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    reported = float(np.float32(unit_m))  # in single precision
    depth = scale_depth(steps, reported)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, steps * unit_m, rtol=2e-7)
    message = encode_raw(ros.make_header(0, "depth"), depth)
    assert message.encoding == encoding
    if encoding == "16UC1":
        np.testing.assert_array_equal(message.data.view(np.uint16).reshape(256, 256), steps)


def test_no_imu_sample_of_a_thousand_is_lost(camera: SoftwareCamera) -> None:
    def feed() -> None:
        for k in range(1000):
            camera.turn(2500 * k, k, 0, 0)

    assert [s.payload[0] for s in read(camera, 1000, feed)] == [float(k) for k in range(1000)]


def test_a_stamp_of_the_hosts_clock_is_recognised(camera: SoftwareCamera) -> None:
    picture = np.zeros((480, 640), np.uint8)
    got = read(camera, 1, lambda: camera.image(0, 1000, picture, rs.timestamp_domain.system_time))
    assert [sample.is_device_clock for sample in got] == [False]


def test_the_factory_calibration_becomes_a_rig_with_the_body_in_the_imu(camera: SoftwareCamera) -> None:
    rig = RealSenseCamera(StreamRequest(D435I), context=camera.context).rig
    assert (rig.cam0.fx, rig.cam0.fy, rig.cam0.cx, rig.cam0.cy) == (385.0, 386.0, 320.5, 239.5)
    assert rig.T_cam1_cam0 is not None
    assert rig.baseline == pytest.approx(BASELINE)
    np.testing.assert_allclose(rig.T_cam1_cam0[:3, 3], (-BASELINE, 0, 0), atol=1e-7)
    np.testing.assert_allclose(rig.T_body_cam0[:3, 3], T_GYRO_IR, atol=1e-7)
    assert rig.imu == D435I.rig().imu


def test_a_rotation_of_the_sdk_is_read_column_by_column() -> None:
    class Told:
        rotation, translation = (0, 1, 0, -1, 0, 0, 0, 0, 1), (1, 2, 3)  # rs2_extrinsics: column-major

        def get_extrinsics_to(self, other: object) -> Any:
            return self

    T = read_extrinsics(Told(), None)
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)


def test_a_mode_that_the_camera_lacks_is_named(camera: SoftwareCamera) -> None:
    with pytest.raises(
        UsageError, match=r"cam0 \(848x480@30\), cam1 \(848x480@30\); choose .* infrared has 640x480@30"
    ):
        RealSenseCamera(StreamRequest(load_profile("d435i", "848x480@30")), context=camera.context)
    with pytest.raises(UsageError, match=r"does not offer depth"):
        RealSenseCamera(StreamRequest(D435I, depth=True), context=camera.context)


@pytest.mark.parametrize(
    ("offered", "taken"), [((100, 200), 200), ((63, 100), 100), ((200, 250), 250), ((63,), 63)]
)
def test_an_imu_with_other_rates_is_read_at_the_best_of_them(offered: tuple[int, ...], taken: int) -> None:
    said: list[str] = []
    with RealSenseCamera(
        StreamRequest(D435I), context=SoftwareCamera(rs, accel_hz=offered).context, notify=said.append
    ) as one:
        one.start(print)
        assert (one.rates_hz["accel"], one.rates_hz["gyro"], one.rates_hz["cam0"]) == (taken, 400, 30)
    reported = [f"the camera has no accel at 250 Hz; using {taken} Hz"]
    assert said == ([] if taken == 250 else reported)


def test_the_rate_of_the_gyroscope_that_is_read_is_in_the_rig() -> None:
    imu = RealSenseCamera(StreamRequest(D435I), context=SoftwareCamera(rs, gyro_hz=(200,)).context).rig.imu
    assert imu is not None and imu.rate_hz == 200


def test_an_imu_with_none_of_the_rates_is_named() -> None:
    with pytest.raises(UsageError, match=r"does not offer accel \(250 or 200 or 100 or 63 Hz\)"):
        RealSenseCamera(StreamRequest(D435I), context=SoftwareCamera(rs, accel_hz=(50,)).context)


def test_an_emitter_that_another_program_left_on_is_switched_off_and_no_longer_alternates(
    camera: SoftwareCamera,
) -> None:
    for option in (rs.option.emitter_enabled, rs.option.emitter_on_off):
        reported = rs.option_range()
        reported.min, reported.max, reported.step, reported.default = 0, 1, 1, 1
        camera.stereo.add_option(option, reported, True)
        camera.stereo.set_option(option, 1)
    read(camera, 0, lambda: None)
    assert camera.stereo.get_option(rs.option.emitter_enabled) == 0
    assert camera.stereo.get_option(rs.option.emitter_on_off) == 0


def test_dots_of_an_emitter_that_should_be_off_give_one_warning(camera: SoftwareCamera) -> None:
    """They begin with the third image; one image of thirty is checked."""
    said, got = list[str](), list[DeviceSample]()
    with RealSenseCamera(StreamRequest(D435I), context=camera.context, notify=said.append) as device:
        device.start(got.append)
        for k in range(70):
            camera.stereo.set_metadata(rs.frame_metadata_value.frame_laser_power_mode, int(k > 1))
            camera.image(0, 1_000_000 + 33_333 * k, np.zeros((480, 640), np.uint8))
            deadline = time.monotonic() + 5
            while len(got) <= k and time.monotonic() < deadline:
                time.sleep(0.002)
            assert (len(said) > 0) == (k >= 30)
        assert len(got) == 70
    assert [text.partition(":")[0] for text in said] == ["the emitter is on although it was switched off"]


def test_an_interleaved_emitter_that_does_not_alternate_gives_a_warning(camera: SoftwareCamera) -> None:
    said, got = list[str](), list[DeviceSample]()
    interleaved = replace(D435I, device=replace(FACTS, emitter="interleaved"))
    with RealSenseCamera(StreamRequest(interleaved), context=camera.context, notify=said.append) as device:
        device.start(got.append)
        camera.stereo.set_metadata(rs.frame_metadata_value.frame_laser_power_mode, 1)
        for k in range(40):
            camera.image(0, 1_000_000 + 33_333 * k, np.zeros((480, 640), np.uint8))
            time.sleep(0.01)
        time.sleep(0.1)
    assert got == []
    assert said == [
        "emitter interleaved: all images have dots, so none is kept; use a profile with emitter off"
    ]


def test_an_unreadable_frame_gives_one_warning_and_later_ones_are_read(
    camera: SoftwareCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    said, got, as_sample = list[str](), list[DeviceSample](), adapter.to_sample

    def sometimes(sdk: Any, frame: Any, *more: Any) -> DeviceSample:
        if frame.frame_number in (1, 2):
            raise RuntimeError("null pointer passed for argument")
        return as_sample(sdk, frame, *more)

    monkeypatch.setattr(adapter, "to_sample", sometimes)
    with RealSenseCamera(StreamRequest(D435I), context=camera.context, notify=said.append) as device:
        device.start(got.append)
        for k in range(4):
            camera.image(0, 1_000_000 + 33_333 * k, np.zeros((480, 640), np.uint8))
            time.sleep(0.05)
    assert [sample.number for sample in got] == [0, 3]
    assert said == ["a frame cannot be read: null pointer passed for argument"]


def test_without_a_camera_the_error_is_one_line() -> None:
    with pytest.raises(UsageError, match=r"no RealSense camera is attached, or none may.*plugdev.*stop"):
        RealSenseCamera(StreamRequest(D435I), context=rs.context())


class Leaving:
    """A context or device whose call `last` fails."""

    def __init__(self, of: Any, last: str) -> None:
        self._of, self._last = of, last

    def __getattr__(self, name: str) -> Any:
        if name == self._last:
            raise RuntimeError("get_xu(ctrl=1) failed! Last Error: No such device\nand more")
        return getattr(self._of, name)


@pytest.mark.parametrize("last", ["query_devices", "get_info", "query_sensors"])
def test_a_camera_unplugged_while_opening_gives_one_line(camera: SoftwareCamera, last: str) -> None:
    context = Leaving(Listed([Leaving(camera.device, last)]), last)
    with pytest.raises(ShareError, match=r"^RealSense camera 0123: cannot be opened: get_xu.*device; replug"):
        RealSenseCamera(StreamRequest(D435I), "0123", context)


def test_an_absent_serial_number_lists_the_attached_ones(camera: SoftwareCamera) -> None:
    with pytest.raises(UsageError, match=r"serial number 99 is attached; there is 0123 \(Intel"):
        RealSenseCamera(StreamRequest(D435I), "99", camera.context)


def test_a_camera_unplugged_while_starting_gives_one_line_and_is_released(
    camera: SoftwareCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(opened: object) -> float:
        raise RuntimeError("gone")

    monkeypatch.setattr(adapter, "_depth_unit", gone)
    with pytest.raises(ShareError, match=r"^Intel RealSense D435I 0123: cannot be opened: gone; "):
        RealSenseCamera(StreamRequest(D435I), context=camera.context).start(print)
    monkeypatch.undo()
    assert len(read(camera, 1, lambda: camera.turn(1, 0, 0, 0))) == 1


@pytest.mark.parametrize(
    ("devices", "says"),
    [
        ([attached("1"), attached("2")], "several RealSense cameras"),
        ([attached(usb="2.1")], "USB 2.1, which is too slow"),
        ([attached(firmware="5.9.14.0")], "firmware 5.9.14.0 is older than 5.12.0.0; update"),
    ],
)
def test_an_unusable_camera_is_refused(devices: list[AttachedDevice], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        choose_device(devices, None, FACTS)


def test_firmware_versions_are_compared_as_numbers() -> None:
    assert choose_device([attached(firmware="5.12.10.0")], None, replace(FACTS, firmware_oldest="5.12.9.0"))


def test_a_factory_fisheye_lens_is_read() -> None:
    """A T265 has four coefficients, and a fifth number of 0."""
    models = SimpleNamespace(brown_conrady=1, kannala_brandt4=2)
    reported = SimpleNamespace(
        width=848, height=800, fx=286.0, fy=286.1, ppx=420.0, ppy=400.0, model=2,
        coeffs=[-0.008, 0.045, -0.042, 0.007, 0.0],
    )  # fmt: skip
    profile = SimpleNamespace(
        as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: reported)
    )
    camera = factory_camera(SimpleNamespace(distortion=models), profile)
    assert (camera.model, camera.distortion) == ("equidistant", (-0.008, 0.045, -0.042, 0.007))
