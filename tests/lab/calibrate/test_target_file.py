"""Target files with Kalibr's keys."""

import re

import pytest
import yaml

from share.errors import ConfigError
from share.lab.calibrate.target import AprilGrid, CharucoBoard, read_target, target_mapping

KALIBR = """
target_type: 'aprilgrid' #gridtype
tagCols: 6               #number of apriltags
tagRows: 5               #number of apriltags
tagSize: 0.088           #size of apriltag, edge to edge [m]
tagSpacing: 0.3          #ratio of space between tags to tagSize
"""


def written(tmp_path, text):
    path = tmp_path / "target.yaml"
    path.write_text(text)
    return path


def test_kalibrs_file_is_read(tmp_path):
    assert read_target(written(tmp_path, KALIBR)) == AprilGrid(
        rows=5, cols=6, tag_size=0.088, tag_spacing=0.3
    )


def test_kalibrs_newer_file_is_read(tmp_path):
    assert read_target(written(tmp_path, KALIBR + "codeOffset: 0\n")).rows == 5


@pytest.mark.parametrize(
    "target", [AprilGrid(3, 4, 0.05, 0.2), CharucoBoard(5, 4, 0.1, 0.07, "DICT_6X6_250")]
)
def test_a_written_target_is_read(tmp_path, target):
    assert read_target(written(tmp_path, yaml.safe_dump(target_mapping(target)))) == target


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (KALIBR.replace("'aprilgrid'", "circles"), "target_type: 'circles' is not known; known: aprilgrid"),
        (KALIBR.replace("tagSpacing", "tagSpace"), "unknown key 'tagSpace'; did you mean 'tagSpacing'?"),
        (KALIBR.replace("tagSize: 0.088", ""), "key 'tagSize' is missing"),
        (KALIBR.replace("tagCols: 6", "tagCols: 6.5"), "tagCols: expected a positive whole number"),
        (KALIBR.replace("0.088", "-1"), "tagSize: -1 must be positive"),
        (KALIBR.replace("0.3", "3"), "tag_spacing: 3 must be below 1"),
        (KALIBR.replace("0.3", "wide"), "tagSpacing: expected numbers, found ['wide']"),
        (KALIBR + "codeOffset: 36\n", "codeOffset: 36 is not supported; tags must be numbered from 0"),
        ("target_type: charuco\ncodeOffset: 0\n", "unknown key 'codeOffset'"),
        ("- 1", "expected keys and values"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)) as raised:
        read_target(written(tmp_path, text))
    assert str(raised.value).startswith(str(tmp_path / "target.yaml"))
    assert "\n" not in str(raised.value)
