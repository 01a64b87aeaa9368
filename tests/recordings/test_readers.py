"""EuRoC and TUM folders are read exactly; errors name file and line."""

import re
import shutil

import cv2
import numpy as np
import pytest
from helpers.live import frames
from helpers.recordings import HEIGHT, START_NS, STEP_NS, WIDTH, depth_mm, make_euroc, make_tum

from share.errors import ConfigError, DataError, ShareError, UsageError
from share.geometry import se3
from share.runtime.source import open_source


@pytest.fixture
def euroc(tmp_path):
    return make_euroc(tmp_path / "walk", suffix=".png")


@pytest.fixture
def tum(tmp_path):
    return make_tum(tmp_path / "kitchen")


def test_euroc(euroc):
    for path in (euroc, euroc / "mav0"):
        source = open_source(str(path))
        assert (source.name, source.rig.kind, source.images_count) == ("walk", "stereo+imu", 6)
        assert source.rate_hz == pytest.approx(20.0)
    out = frames(source)
    assert [f.stamp_ns for f in out] == [START_NS + i * STEP_NS for i in range(6)]
    assert [len(f.imu) for f in out] == [11, 10, 10, 10, 10, 10]
    for name, images in (("cam0", [f.image0 for f in out]), ("cam1", [f.image1 for f in out])):
        for f, image in zip(out, images, strict=True):
            file = euroc / "mav0" / name / "data" / f"{f.stamp_ns}.png"
            np.testing.assert_array_equal(image, cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
    np.testing.assert_allclose(source.rig.T_cam1_cam0[:3, 3], [-0.11, 0, 0], atol=1e-12)
    assert source.truth().T[:, 0, 3] == pytest.approx(0.1 * np.arange(6))


def test_body_is_the_imu_and_the_truth_follows(euroc):
    """Another mounting of the IMU changes T_body_cam0 and the truth, not the pose of the camera."""
    before = open_source(str(euroc))
    truth = before.truth()
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, 0.3]))
    file = euroc / "mav0" / "imu0" / "sensor.yaml"
    head, _, tail = file.read_text().partition("  data: [")
    file.write_text(head + f"  data: {T.reshape(-1).tolist()}" + tail.partition("]")[2])
    after = open_source(str(euroc))
    np.testing.assert_allclose(after.rig.T_body_cam0, se3.inverse(T), atol=1e-12)
    for a, b in zip(truth.T, after.truth().T, strict=True):
        np.testing.assert_allclose(a @ before.rig.T_body_cam0, b @ after.rig.T_body_cam0, atol=1e-12)
    (euroc / "mav0" / "state_groundtruth_estimate0" / "sensor.yaml").write_text(file.read_text())
    same_mount = after.truth().T  # the truth's sensor sits where the IMU sits: the table tells of the IMU
    np.testing.assert_allclose(same_mount[:, :3, 3], [[0.1 * i, 0, 1] for i in range(6)], atol=1e-12)
    np.testing.assert_allclose(same_mount[:, :3, :3], [np.eye(3)] * 6, atol=1e-12)


def test_without_imu_the_body_is_cam0(euroc):
    shutil.rmtree(euroc / "mav0" / "imu0")
    source = open_source(str(euroc))
    assert source.rig.kind == "stereo"
    np.testing.assert_array_equal(source.rig.T_body_cam0, np.eye(4))
    assert [len(f.imu) for f in frames(source)] == [0] * 6


def test_a_part_by_frames(euroc):
    part = frames(open_source(str(euroc), frames=slice(2, 4)))
    whole = frames(open_source(str(euroc)))
    assert [f.stamp_ns for f in part] == [f.stamp_ns for f in whole[2:4]]
    assert [f.imu.stamps_ns.tolist() for f in part] == [f.imu.stamps_ns.tolist() for f in whole[2:4]]
    halves = [f for s in (slice(3), slice(3, None)) for f in frames(open_source(str(euroc), frames=s))]
    assert [f.imu.stamps_ns.tolist() for f in halves] == [f.imu.stamps_ns.tolist() for f in whole]
    for nothing in (slice(6, None), slice(3, 3), slice(0, 6, 2)):
        with pytest.raises(UsageError, match="selects nothing; it has 6 frames"):
            open_source(str(euroc), frames=nothing)


@pytest.mark.parametrize("associations", [False, True])
def test_tum(tmp_path, associations):
    path = make_tum(tmp_path / "kitchen", associations=associations)
    source = open_source(str(path))
    assert (source.name, source.rig.kind, source.images_count, source.notes) == ("kitchen", "rgbd", 5, ())
    out = frames(source)
    assert [f.stamp_ns for f in out] == [
        10_000_000_000 + n for n in (0, 33333000, 66667000, 10**8, 133333000)
    ]
    for i, f in enumerate(out):
        file = str(path / "rgb" / f"{i}.jpg")
        np.testing.assert_array_equal(f.image0, cv2.imread(file, cv2.IMREAD_GRAYSCALE))
        np.testing.assert_array_equal(f.depth, depth_mm(i) / np.float32(1000))


def test_tum_truth_belongs_to_the_named_camera(tum):
    depth_camera = open_source(str(tum)).truth()
    yaml = tum / "camera.yaml"
    yaml.write_text(yaml.read_text() + "truth_frame: cam0\n")
    cam0 = open_source(str(tum)).truth()
    np.testing.assert_allclose(depth_camera.T[:, 0, 3] - cam0.T[:, 0, 3], 0.025, atol=1e-12)
    yaml.write_text(yaml.read_text().replace("truth_frame: cam0", "truth_frame: imu"))
    with pytest.raises(ConfigError, match="truth_frame 'imu' is not known"):
        open_source(str(tum)).truth()


def test_unpaired_tum_images_are_counted_in_the_notes(tum):
    lines = (tum / "depth.txt").read_text().splitlines(keepends=True)
    (tum / "depth.txt").write_text("".join(lines[:2] + lines[3:]))
    source = open_source(str(tum))
    assert source.images_count == 4
    assert source.notes == ("1 of 5 colour images have no depth image within 20 ms",)
    (tum / "depth.txt").write_text("99.0 depth/0.png\n")
    with pytest.raises(DataError, match="no colour image has a depth image within 20 ms"):
        open_source(str(tum))


def test_a_given_calibration_overrides_the_recordings(euroc, tmp_path):
    chain = tmp_path / "chain.yaml"
    cam = f"{{resolution: [{WIDTH}, {HEIGHT}], intrinsics: [77, 78, 31, 23], T_cn_cnm1: T}}"
    one = "[[1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    chain.write_text(f"cam0: {cam}\ncam1: {cam}\n".replace("T}", f"{one}}}"))
    source = open_source(str(euroc), calib=str(chain))
    assert source.rig.cam0.fx == 77
    assert source.rig.baseline == pytest.approx(0.2)
    assert source.rig.kind == "stereo"
    assert source.notes == ("imu0 is not used: the calibration has no imu",)
    with pytest.raises(UsageError, match="--calib"):
        open_source(str(euroc), calib=str(tmp_path / "no.yaml"))
    shutil.rmtree(euroc / "mav0" / "cam1")
    with pytest.raises(ConfigError, match="calibration has cam1, the recording does not"):
        open_source(str(euroc), calib=str(chain))


def _cut_csv(root):
    file = root / "mav0" / "imu0" / "data.csv"
    file.write_text(file.read_text()[:-30])


def _unsorted(root):
    file = root / "mav0" / "cam1" / "data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], *lines[:0:-1]]))


def _edit(name, old, new):
    def edit(root):
        file = root / "mav0" / name
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, new, 1))

    return edit


def _nan_stamps(root):
    file = root / "mav0" / "cam0" / "data.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], *("nan" + line[19:] for line in lines[1:3]), *lines[3:]]))


def _names_lead_out(root):
    file = root / "mav0" / "cam0" / "data.csv"
    file.write_text(file.read_text().replace(",", ",../../x.png,"))


DAMAGE = {
    "unsorted": (
        _unsorted,
        DataError,
        r"cam1/data\.csv, line .* out of order; sort.*5 of 6",
    ),
    "NaN stamps": (_nan_stamps, DataError, r"line 2: stamp 'nan'.*2 of 6 lines of .* too many to skip"),
    "names lead out": (_names_lead_out, DataError, r"line 2: '\.\./\.\./x\.png' is not a file name below"),
    "no list": (lambda r: (r / "mav0/cam0/data.csv").unlink(), DataError, r"data\.csv: no such file"),
    "empty list": (lambda r: (r / "mav0/cam0/data.csv").write_text(""), DataError, "has no data"),
    "no images": (
        lambda r: shutil.rmtree(r / "mav0/cam0/data"),
        DataError,
        "is missing from .*6 of 6 images",
    ),
    "no sensor.yaml": (lambda r: (r / "mav0/cam0/sensor.yaml").unlink(), ConfigError, "give .* --calib"),
    "no extrinsics": (_edit("cam1/sensor.yaml", "T_BS", "T"), ConfigError, "cam1.*: key 'T_BS' is missing"),
    "no cameras": (lambda r: shutil.rmtree(r / "mav0/cam0"), ConfigError, "cam0/sensor.yaml: no such file"),
    "other size": (
        _edit("cam0/sensor.yaml", "resolution: [64, 48]", "resolution: [32, 24]"),
        DataError,
        r"png: is 64x48, but the calibration is for 32x24.*--calib",
    ),
}


def _gone(root):
    (root / f"mav0/cam1/data/{START_NS}.png").unlink()


ONE = {
    "line of IMU cut": (_cut_csv, 6, 70, r"1 of the lines of .*imu0/data\.csv, line 72: 6 of 7 columns; the line is cut short"),  # noqa: E501
    "NaN in the IMU": (_edit("imu0/data.csv", ",0", ",nan"), 6, 70, r"1 of the lines of .*line \d+: 'nan.*' is not "),  # noqa: E501
    "NaN stamp": (_edit("cam0/data.csv", str(START_NS), "nan"), 5, 71, r"1 of the lines of .*cam0/data.csv, line 2: stamp 'nan'"),  # noqa: E501
    "stamp far ahead": (_edit("imu0/data.csv", "14037152", "24037152"), 6, 70, "line 2: stamp .* is out of order"),  # noqa: E501
    "one image gone": (_gone, 5, 71, rf"1 of the images of .*cam1/data.csv.*: {START_NS}\.png is missing"),
}  # fmt: skip


@pytest.mark.parametrize("case", ONE)
def test_a_damaged_line_or_image_is_skipped_and_counted(euroc, case):
    damage, images, samples, said = ONE[case]
    damage(euroc)
    source = open_source(str(euroc))
    assert min(len(stamps) for name, stamps in source.stamps().items() if name != "imu") == images
    assert len(source.stamps()["imu"]) == samples
    (line,) = source.losses.lines()
    assert re.search(said, line) and "\n" not in line


@pytest.mark.parametrize("file", ["state_groundtruth_estimate0/data.csv", "groundtruth.txt"])
def test_a_damaged_line_of_a_ground_truth_is_skipped(request, file):
    root = request.getfixturevalue("tum" if file.endswith("txt") else "euroc")
    path = root / file if file.endswith("txt") else root / "mav0" / file
    whole = open_source(str(root)).truth()
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-1], lines[-1].replace("0.", "nan", 1)]))
    source = open_source(str(root))
    truth = source.truth()
    np.testing.assert_array_equal(truth.T, whole.T[:-1])
    (said,) = source.losses.lines()
    assert said.startswith(f"skipped as damaged: 1 of the lines of {path}")


def test_listed_images_cannot_leave_the_folder(tum):
    (tum / "rgb.txt").write_text("10.0 ../../../etc/passwd\n10.033333 /etc/passwd\n10.066667 rgb/2.jpg\n")
    with pytest.raises(
        DataError, match=r"rgb\.txt, line 1: '\.\./\.\./\.\./etc/passwd' is not a file name below"
    ):
        open_source(str(tum))


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_folder_gives_one_clear_line(euroc, case):
    damage, kind, complaint = DAMAGE[case]
    damage(euroc)
    with pytest.raises(kind, match=complaint) as error:
        frames(open_source(str(euroc)))
    assert "\n" not in str(error.value)


def test_cut_image_in_a_folder(tum):
    file = tum / "depth" / "3.png"
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(DataError, match=r"3\.png: the image is cut short"):
        frames(open_source(str(tum)))


def test_other_folders_and_files_are_refused(tmp_path):
    for spec, complaint in (
        (str(tmp_path / "no"), "no such file or folder"),
        (str(tmp_path), "not a recording that SHARE reads"),
        ("realsense:1234", "share capture"),
    ):
        with pytest.raises(UsageError, match=complaint):
            open_source(spec)
    (tmp_path / "mav0").mkdir()
    with pytest.raises(ShareError, match="no such file"):
        open_source(str(tmp_path))


@pytest.mark.long
def test_real_recordings(shared_data):
    euroc = open_source(str(shared_data / "real" / "euroc_v1_01_keyframes"))
    assert euroc.rig.kind == "stereo+imu"
    out = frames(euroc)
    assert len(out) == 50
    assert sum(len(f.imu) for f in out) == 18051  # every sample until the last image
    assert {f.image0.shape for f in out} == {(480, 752)}
    kitchen = open_source(str(shared_data / "real" / "redkitchen_0000_0499"), frames=slice(100, 110))
    out = frames(kitchen)
    assert [f.stamp_ns for f in out][:2] == [3_333_333_000, 3_366_667_000]
    assert 0.5 < float(np.median(out[0].depth[out[0].depth > 0])) < 5.0
