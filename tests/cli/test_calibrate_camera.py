"""`share calibrate camera` on images of a known camera, and without a board."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from helpers.board_pictures import PAPER, printed
from helpers.shell import Done

from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.calibrate.target import CharucoBoard
from share.recordings.calibration import read_calibration, to_kalibr

K = np.array([[420, 0, 319.5], [0, 424, 241], [0, 0, 1]])


def test_images_without_a_board_are_refused_and_nothing_is_written(
    share: Callable[..., Done], tmp_path: Path
) -> None:
    (tmp_path / "pictures" / "cam0").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "pictures" / "cam0" / "1.png"), np.full((120, 160), 90, np.uint8))
    done = share(
        "calibrate", "camera", tmp_path / "pictures", "--target", "aprilgrid", "--camera", "cam0",
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.code == 1
    assert "no board found in 1 images" in done.err and done.err.count("\n") == 1
    assert not list((tmp_path / "out").glob("*"))


def test_unusable_given_calibration_is_refused_before_the_work(
    share: Callable[..., Done], tmp_path: Path
) -> None:
    (tmp_path / "pictures" / "cam0").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "pictures" / "cam0" / "1.png"), np.full((120, 160), 90, np.uint8))
    camera = to_kalibr(Rig(Camera(160, 120, 100.0, 100.0, 80.0, 60.0), np.eye(4)))["cam0"]
    (tmp_path / "given.yaml").write_text(yaml.safe_dump({"cam0": camera | {"timeshift_cam_imu": 5}}))
    done = share(
        "calibrate", "camera", tmp_path / "pictures", "--target", "aprilgrid", "--camera", "cam0",
        "--calib", tmp_path / "given.yaml", "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.code == 2 and "cam0: timeshift_cam_imu: 5 s is more than 1 s" in done.err


def _pictures(folder: Path, rng: np.random.Generator, count: int = 14) -> None:
    """`count` of a board all over the image, and one in which a single row of its corners is to be seen."""
    board = CharucoBoard()
    print_out = printed(board)
    middle = np.append(board.extent.mean(axis=0), 0)
    facing = se3.exp(np.array([np.pi, 0, 0, 0, 0, 0]))
    folder.mkdir(parents=True)
    for k in range(count):
        T = facing @ se3.exp(np.append(rng.uniform(-0.5, 0.5, 3), [0, 0, 0]))
        depth = rng.uniform(0.5, 0.9)
        T[:3, 3] = np.append(rng.uniform((-0.25, -0.2), (0.25, 0.2)), 1) * depth - T[:3, :3] @ middle
        cv2.imwrite(str(folder / f"{k:02}.png"), print_out.seen(K, T, (640, 480)))
    row = np.full((480, 640), PAPER, np.uint8)
    half = cv2.resize(print_out.picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)[:94]
    row[100:194, 20 : 20 + half.shape[1]] = half
    cv2.imwrite(str(folder / "row.png"), row)


@pytest.mark.long
def test_known_camera_is_estimated_from_a_folder_of_images(
    share: Callable[..., Done], tmp_path: Path, rng: np.random.Generator
) -> None:
    """All of the given camchain that is not found anew is kept."""
    _pictures(tmp_path / "pictures" / "cam0", rng)
    out, given = tmp_path / "out", tmp_path / "given.yaml"
    T_cam_imu = se3.exp(np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]))
    kept = {
        "T_cam_imu": T_cam_imu.tolist(),
        "timeshift_cam_imu": 0.004,
        "rostopic": "/left",
        "serial": "0123",
    }
    camera = to_kalibr(Rig(Camera(640, 480, 400.0, 400.0, 320.0, 240.0), np.eye(4)))["cam0"]
    given.write_text(yaml.safe_dump({"cam0": camera | kept}))
    done = share(
        "calibrate", "camera", tmp_path / "pictures", "--target", "charuco", "--camera", "cam0",
        "--calib", given, "--out", out, "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    written = yaml.safe_load((out / "kalibr_imucam_chain.yaml").read_text())["cam0"]
    np.testing.assert_allclose(written.pop("T_cam_imu"), kept.pop("T_cam_imu"), atol=1e-12)
    assert {key: written[key] for key in kept} == kept
    found = read_calibration(out).rig.cam0
    np.testing.assert_allclose(found.K, K, rtol=1e-3, atol=0.5)
    assert (found.width, found.height) == (640, 480)
    report = json.loads(done.out)
    assert report == json.loads((out / "camera-report.json").read_text())
    assert report["passed"]
    sigmas = np.sqrt(np.diag(report["covariance"]))
    np.testing.assert_allclose(sigmas, list(report["cameras"][0]["sigmas"].values()))
    assert "row" not in [view["name"] for view in report["per_view"]]
    assert (out / "camera-report.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_unreliable_result_keeps_the_earlier_one(
    share: Callable[..., Done], tmp_path: Path, rng: np.random.Generator
) -> None:
    _pictures(tmp_path / "pictures" / "cam0", rng, 5)
    out = tmp_path / "out"
    asked = ("calibrate", "camera", tmp_path / "pictures", "--target", "charuco", "--camera", "cam0", "--out")
    first = share(*asked, out)
    assert first.code == 1 and "kalibr_imucam_chain.yaml is written)" in first.err
    assert "FAILED" in (out / "kalibr_imucam_chain.yaml").read_text()
    good = ("kalibr_imucam_chain.yaml", "camera-report.json", "camera-report.png")
    for name in good:
        (out / name).write_text("a good one")
    again = share(*asked, out)
    assert again.code == 1 and again.err.count("\n") == 1
    assert "kalibr_imucam_chain.failed.yaml is written; the existing kalibr_imucam_chain.yaml" in again.err
    assert [(out / name).read_text() for name in good] == ["a good one"] * 3
    failed = (out / "kalibr_imucam_chain.failed.yaml").read_text()
    assert "FAILED, see camera-report.failed.json" in failed
    assert not json.loads((out / "camera-report.failed.json").read_text())["passed"]
    assert (out / "camera-report.failed.png").read_bytes().startswith(b"\x89PNG")
    assert "camera-report.failed.json" in again.out
