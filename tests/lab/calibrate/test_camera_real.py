"""Real AprilGrid pairs of EuRoC against the calibration of its authors."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from share.lab.calibrate.camera_bundle import calibrate_cameras
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.corners import detector
from share.lab.calibrate.target import AprilGrid
from share.recordings.calibration import read_asl_calibration


@pytest.mark.slow
def test_focal_lengths_are_those_of_euroc_within_half_a_percent(shared_data: Path) -> None:
    folder, mav = (shared_data / "real" / name for name in ("euroc_aprilgrid", "euroc_v1_01_keyframes/mav0"))
    if not folder.is_dir() or not mav.is_dir():
        pytest.skip(f"real boards are not here: {folder} or {mav} does not exist")
    find = detector(AprilGrid())
    views = []
    for k in range(0, 52, 2):
        images = [cv2.imread(str(folder / f"{k}_{eye}.jpg"), cv2.IMREAD_GRAYSCALE) for eye in (0, 1)]
        views.append(BoardView(str(k), tuple(find(np.asarray(image, np.uint8)) for image in images)))
    solution = calibrate_cameras(views, AprilGrid(), (752, 480))
    rig = read_asl_calibration(mav / "cam0/sensor.yaml", mav / "cam1/sensor.yaml", None).rig
    for found, truth in zip(solution.state.cameras, (rig.cam0, rig.cam1), strict=True):
        assert truth is not None and found.focal == pytest.approx(truth.focal, rel=5e-3)
    assert np.linalg.norm(solution.state.T_cam1_cam0[:3, 3]) == pytest.approx(rig.baseline, abs=1e-3)
    assert solution.sigma_px < 0.3


def test_corners_of_real_boards_are_those_of_basalt(shared_data: Path) -> None:
    folder = shared_data / "real" / "euroc_aprilgrid"
    if not folder.is_dir():
        pytest.skip(f"real boards are not here: {folder} does not exist")
    frames = json.loads((folder / "detected_corners.json").read_text())["value0"]
    given = {(f["key"]["first"], f["key"]["second"]): f["value"] for f in frames}
    find, apart, theirs = detector(AprilGrid()), [], 0
    for k in range(0, 52, 8):
        image = cv2.imread(str(folder / f"{k}_0.jpg"), cv2.IMREAD_GRAYSCALE)
        found = find(np.asarray(image, np.uint8))
        ids = np.array(given[k, 0]["value1"], int)
        px = np.array([[p["value0"], p["value1"]] for p in given[k, 0]["value0"]]).reshape(-1, 2)
        _, ours, there = np.intersect1d(found.ids, ids, return_indices=True)
        apart.append(np.linalg.norm(found.px[ours] - px[there], axis=1))
        theirs += len(ids)
    distances = np.concatenate(apart)
    assert np.median(distances) < 0.03
    assert np.quantile(distances, 0.98) < 0.3
    assert len(distances) > 0.6 * theirs
