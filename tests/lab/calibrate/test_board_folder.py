"""Images of a board in a folder: ordered by stamp, and each skipped one counted."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from share.errors import DataError, UsageError
from share.geometry.camera import Camera, Rig
from share.lab.calibrate import board_views
from share.lab.calibrate.board_views import RigImages, find_stamped_views, open_board_images
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.corners import Detection
from share.lab.calibrate.target import AprilGrid

CORNER = Detection(np.array([3]), np.array([[10.0, 20.0]]))

CAMERA = {"intrinsics": [36.0, 36.0, 24.0, 16.0], "resolution": [48, 32]}


def written(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.full((32, 48), 90, np.uint8))
    return folder


def test_images_are_ordered_by_number(tmp_path: Path) -> None:
    written(tmp_path / "cam0", "100000000000.png", "99950000000.png", "99900000000.png")
    names = [name for name, _ in open_board_images(str(tmp_path), ("cam0",)).read_images()]
    assert names == ["99900000000", "99950000000", "100000000000"]


def test_a_camera_without_images_gives_a_hint(tmp_path: Path) -> None:
    written(tmp_path / "mono" / "cam0", "1.png", "2.png")
    with pytest.raises(DataError, match=r"of the same name in cam0 and cam1; give --camera cam0$"):
        open_board_images(str(tmp_path / "mono"), ("cam0", "cam1"))
    beside = np.eye(4)
    beside[0, 3] = -0.05
    chain = {"cam0": CAMERA, "cam1": CAMERA | {"T_cn_cnm1": beside.tolist()}}
    (tmp_path / "stereo.yaml").write_text(yaml.safe_dump(chain))
    with pytest.raises(
        DataError, match=r"in cam0 and cam1; for one camera, give --camera a camchain without"
    ):
        board_views.open_rig_images(str(tmp_path / "mono"), str(tmp_path / "stereo.yaml"))
    flat = written(tmp_path / "flat", "1.png")
    with pytest.raises(
        UsageError, match=r"flat: has images, but no folder cam0; give a folder with cam0/\*\.png"
    ):
        open_board_images(str(flat), ("cam0",))


def stamped(monkeypatch: pytest.MonkeyPatch, *names: str) -> board_views.StampedViews:
    """Return the views in images of these names, which all show the board."""
    views = [BoardView(name, (CORNER,)) for name in names]
    monkeypatch.setattr(board_views, "find_views", lambda *_: (views, [(12, 8)]))
    rig = Rig(Camera(12, 8, 9.0, 9.0, 6.0, 4.0), np.eye(4))
    return find_stamped_views(RigImages("dance", None, rig, None), AprilGrid(), 1, lambda done, total: None)  # type: ignore[arg-type]


def test_images_whose_stamps_do_not_increase_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    found = stamped(monkeypatch, "10", "30", "20", "30", "40")
    assert found.stamps.tolist() == [10, 30, 40]
    assert [view.name for view in found.views] == ["10", "30", "40"]
    assert (found.images_searched, found.with_target, found.dropped) == (5, 5, 2)


@pytest.mark.parametrize("name", ["row", "1.5", "12345678901234567890"])
def test_a_name_that_is_not_a_stamp_is_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    with pytest.raises(DataError, match="dance: images have no stamps; name them cam0/STAMP"):
        stamped(monkeypatch, "10", name)
