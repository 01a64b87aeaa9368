"""`share calibrate camera-imu` on images of a board and samples of an IMU, from a known rig."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from helpers.board_pictures import printed
from helpers.camera_imu_sim import NOISE, SHIFT_S, T_IMU_CAM0, Dance, record
from helpers.shell import Done

from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.lab.calibrate.camera_initialisation import intrinsics, parameter_names
from share.lab.calibrate.target import CharucoBoard
from share.recordings.calibration import read_calibration, to_kalibr

SECONDS, HZ = 7.5, 8.0
CAMERA = Camera(400, 300, 241.0, 241.0, 199.5, 150.0)


@pytest.fixture(scope="module")
def dance(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """cam0/STAMP.png, imu0/data.csv, imu.yaml; camera.yaml with an inverted mounting, bare.yaml with none."""
    folder = tmp_path_factory.mktemp("dance")
    board = CharucoBoard()
    motion, print_out = Dance(1, target=board), printed(board)
    run = record(motion, SECONDS, hz=HZ)
    (folder / "cam0").mkdir()
    T = motion.camera((run.stamps_ns - run.imu.stamps_ns[0]) * 1e-9 + SHIFT_S)
    for stamp, T_cam_target in zip(run.stamps_ns, se3.inverse(T), strict=True):
        picture = print_out.seen(CAMERA.K, T_cam_target, (CAMERA.width, CAMERA.height))
        cv2.imwrite(str(folder / "cam0" / f"{stamp}.png"), picture)
    (folder / "imu0").mkdir()
    rows = np.concatenate([run.imu.gyro, run.imu.accel], axis=1).tolist()
    lines = [f"{t},{','.join(map(repr, row))}\n" for t, row in zip(run.imu.stamps_ns, rows, strict=True)]
    (folder / "imu0" / "data.csv").write_text("".join(lines))
    chain = to_kalibr(Rig(CAMERA, se3.inverse(T_IMU_CAM0), imu=NOISE))  # the other way round
    (folder / "imu.yaml").write_text("# measured\n" + yaml.safe_dump({"imu0": chain.pop("imu0")}))
    chain["cam0"] |= {"rostopic": "/left", "serial": "0123"}
    (folder / "camera.yaml").write_text(yaml.safe_dump(chain))
    del chain["cam0"]["T_cam_imu"]
    (folder / "bare.yaml").write_text(yaml.safe_dump(chain))
    return folder


def asked(folder: Path, out: Path, *more: object, camera: str = "bare.yaml") -> tuple[object, ...]:
    known = ("--camera", folder / camera, "--imu", folder / "imu.yaml")
    return ("calibrate", "camera-imu", folder, "--target", "charuco", *known, "--out", out, *more)


@pytest.mark.long
def test_mounting_and_offset_are_estimated_and_inverted_extrinsics_reported(
    share: Callable[..., Done], dance: Path, tmp_path: Path
) -> None:
    done = share(*asked(dance, tmp_path, "--json", camera="camera.yaml"))
    assert done.code == 0, done.err
    assert "the given extrinsics are inverted" in done.err and done.err.count("\n") == 1
    rig = read_calibration(tmp_path).rig  # both chains, as `share track --calib` reads them
    off = se3.log(se3.inverse(rig.T_body_cam0) @ T_IMU_CAM0)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1 and np.linalg.norm(off[3:]) < 2e-3
    assert rig.timeshift_s == pytest.approx(SHIFT_S, abs=2e-4)
    assert rig.cam0 == CAMERA and rig.imu == NOISE
    assert read_calibration(tmp_path).topics == {"cam0": "/left"}
    assert read_calibration(tmp_path).serials == ("0123",)
    assert (tmp_path / "kalibr_imu_chain.yaml").read_text() == (dance / "imu.yaml").read_text()
    report = json.loads(done.out)
    assert report == json.loads((tmp_path / "camera-imu-report.json").read_text())
    assert report["passed"] and report["given"]["inverted"]
    assert report["sigmas_by_cameras"] is None and "no camera-report.json" in report["camera_sigmas_from"]
    assert (tmp_path / "camera-imu-report.png").read_bytes().startswith(b"\x89PNG")


def badly_known(dance: Path, folder: Path) -> Path:
    """bare.yaml and a report beside it, of half a pixel: 2e-3 rad."""
    folder.mkdir()
    (folder / "kalibr_imucam_chain.yaml").write_text((dance / "bare.yaml").read_text())
    parameters = dict(zip(parameter_names(CAMERA), intrinsics(CAMERA).tolist(), strict=True))
    covariance = np.diag([0.3, 0.3, 0.5, 0.5, 1e-3, 1e-3, 1e-4, 1e-4]) ** 2
    reported = {"passed": False, "cameras": [{"parameters": parameters}], "covariance": covariance.tolist()}
    (folder / "camera-report.json").write_text(json.dumps(reported))
    return folder


@pytest.mark.long
def test_unreliable_result_fails_and_keeps_the_earlier_one(
    share: Callable[..., Done], dance: Path, tmp_path: Path
) -> None:
    """DIR holds a measured IMU chain and an accepted camchain. The cameras come from a camchain whose report
    calls them unreliable."""
    proud = yaml.safe_load((dance / "imu.yaml").read_text())
    proud["imu0"]["gyroscope_noise_density"] /= 30
    (tmp_path / "proud.yaml").write_text(yaml.safe_dump(proud))
    before = {
        "kalibr_imu_chain.yaml": (dance / "imu.yaml").read_text(),
        "kalibr_imucam_chain.yaml": (dance / "camera.yaml").read_text(),
    }
    for name, text in before.items():
        (tmp_path / name).write_text(text)
    known = badly_known(dance, tmp_path / "known")
    done = share(*asked(dance, tmp_path, "--imu", tmp_path / "proud.yaml", camera=str(known)))
    assert done.code == 1
    doubted, kept, failed = done.err.splitlines()
    assert "camera-report.json calls these cameras unreliable" in doubted
    assert f"cameras: uncertainty of {known / 'camera-report.json'};" in done.out
    assert "position known to 2." in failed and "calibrate the cameras better first" in failed
    reported = json.loads((tmp_path / "camera-imu-report.failed.json").read_text())
    parts = [np.array(reported[f"sigmas{part}"]["rotation_rad"]) for part in ("", "_by_noise", "_by_cameras")]
    np.testing.assert_allclose(parts[0] ** 2, parts[1] ** 2 + parts[2] ** 2)
    assert "kalibr_imu_chain.yaml has other noise than was used (that of --imu" in kept
    assert "unreliable result" in failed and "gyroscope: residuals" in failed
    assert "kalibr_imucam_chain.failed.yaml is written; the existing kalibr_imucam_chain.yaml" in failed
    assert "time offset: +12." in done.out and "kalibr_imucam_chain.failed.yaml" in done.out
    assert "FAILED" in (tmp_path / "kalibr_imucam_chain.failed.yaml").read_text()
    assert {name: (tmp_path / name).read_text() for name in before} == before


def test_wrong_use_is_one_line_and_leaves_no_output(
    share: Callable[..., Done], dance: Path, tmp_path: Path
) -> None:
    def refused(code: int, *arguments: object) -> str:
        done = share("calibrate", "camera-imu", *arguments, "--out", tmp_path / "out")
        assert done.code == code and done.err.count("\n") == 1, done.err
        assert not list((tmp_path / "out").glob("*"))
        return done.err

    board, imu = ("--target", "charuco"), ("--imu", dance / "imu.yaml")
    assert "give --camera FILE" in refused(2, dance, *board, *imu)
    assert "no such file" in refused(2, dance, *board, *imu, "--camera", tmp_path / "no.yaml")
    assert "--imu" in refused(2, dance, *board, "--camera", dance / "bare.yaml", "--imu", tmp_path)
    (tmp_path / "still" / "cam0").mkdir(parents=True)
    (tmp_path / "still" / "imu0").symlink_to(dance / "imu0")
    cv2.imwrite(str(tmp_path / "still" / "cam0" / "1.png"), np.full((300, 400), 90, np.uint8))
    known = (*board, *imu, "--camera", dance / "bare.yaml")
    assert "no board in 1 images" in refused(1, tmp_path / "still", *known)
    cv2.imwrite(str(tmp_path / "still" / "cam0" / "1.png"), np.full((36, 48), 90, np.uint8))
    assert "calibrate it at the recorded size" in refused(1, tmp_path / "still", *known)
