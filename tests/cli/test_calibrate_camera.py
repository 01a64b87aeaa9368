"""`share calibrate camera` where there is nothing to calibrate."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from shell import Done


def test_pictures_without_a_board_are_one_line_and_leave_nothing(
    share: Callable[..., Done], tmp_path: Path
) -> None:
    (tmp_path / "pictures" / "cam0").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "pictures" / "cam0" / "1.png"), np.full((120, 160), 90, np.uint8))
    done = share(
        "calibrate", "camera", tmp_path / "pictures", "--target", "aprilgrid", "--camera", "cam0",
        "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.code == 1
    assert "no board in 1 pictures" in done.err and done.err.count("\n") == 1
    assert not list((tmp_path / "out").glob("*"))
