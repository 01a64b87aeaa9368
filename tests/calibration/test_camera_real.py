"""EuRoC's real AprilGrid pairs: the calibration that its authors give is found again."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from share.calibration.bundle import View, calibrate
from share.calibration.detect import detector
from share.geometry.target import AprilGrid
from share.io.calibration import read_euroc


@pytest.mark.slow
def test_eurocs_own_focal_lengths_are_found_within_half_a_percent(shared_data: Path) -> None:
    folder, mav = (shared_data / "real" / name for name in ("euroc_aprilgrid", "euroc_v1_01_keyframes/mav0"))
    if not folder.is_dir() or not mav.is_dir():
        pytest.skip(f"real boards are not here: {folder} or {mav} does not exist")
    find = detector(AprilGrid())
    views = []
    for k in range(0, 52, 2):
        images = [cv2.imread(str(folder / f"{k}_{eye}.jpg"), cv2.IMREAD_GRAYSCALE) for eye in (0, 1)]
        views.append(View(str(k), tuple(find(np.asarray(image, np.uint8)) for image in images)))
    solution = calibrate(views, AprilGrid(), (752, 480))
    rig = read_euroc(mav / "cam0/sensor.yaml", mav / "cam1/sensor.yaml", None).rig
    for found, truth in zip(solution.state.cameras, (rig.cam0, rig.cam1), strict=True):
        assert truth is not None and found.focal == pytest.approx(truth.focal, rel=5e-3)
    assert np.linalg.norm(solution.state.T_cam1_cam0[:3, 3]) == pytest.approx(rig.baseline, abs=1e-3)
    assert solution.sigma_px < 0.3
