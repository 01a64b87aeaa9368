"""CSV exports of Vicon's Tracker and Nexus: what is read and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from share.errors import DataError
from share.lab.mocap.files import read_bodies

HEAD = """Objects
100
,,Ann:Ann,,,,,,Global Angle Bob:Head,,,,,
Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,RY,RZ,TX,TY,TZ
,,deg,deg,deg,mm,mm,mm,deg,deg,deg,mm,mm,mm
"""
ROWS = """101,0,10,20,-30,1000,2000,1500,0,0,90,1,2,3
102,0,11,20,-30,1001,2000,1500,,,,,,
103,0,,,,,,,0,0,91,1,2,4
105,0,12,21,-31,1002,2000,1500,0,0,0,0,0,0
106,0,13,21,-31,1003,2000,1500,0,0,92,1,2,5
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "vicon.csv"
    path.write_text(text)
    return path


def test_each_body_has_poses_where_it_is_seen(tmp_path):
    bodies = read_bodies(written(tmp_path, HEAD + ROWS))
    assert list(bodies) == ["Ann", "Bob:Head"]
    ann, bob = bodies.values()
    assert ann.stamps_ns.tolist() == [k * 10_000_000 for k in (101, 102, 105, 106)]
    assert bob.stamps_ns.tolist() == [k * 10_000_000 for k in (101, 103, 106)]  # zeros: not seen
    np.testing.assert_allclose(ann.T[0, :3, 3], [1, 2, 1.5])
    expected = Rotation.from_rotvec([10, 20, -30], degrees=True).as_matrix()
    np.testing.assert_allclose(ann.T[0, :3, :3], expected, atol=1e-12)


def test_euler_angles_are_read_if_given_as_such(tmp_path):
    ann = read_bodies(written(tmp_path, HEAD + ROWS), "xyz")["Ann"]
    expected = Rotation.from_euler("XYZ", [[10, 20, -30]], degrees=True).as_matrix()  # XYZ: intrinsic
    np.testing.assert_allclose(ann.T[:1, :3, :3], expected, atol=1e-12)


def test_quaternions_metres_and_other_blocks(tmp_path):
    """After a block of markers and a byte-order mark, with semicolons and trailing separators."""
    q = Rotation.from_euler("xyz", [0.1, -0.4, 2.0]).as_quat()
    row = ";".join(f"{x:.9f}" for x in (*q, 0.5, -0.25, 1.75))
    path = written(
        tmp_path,
        "\ufeffTrajectories;;\n120;;\n;;1;;\nFrame;Sub Frame;X;Y;Z\n;;mm;mm;mm\n1;0;1;2;3\n;;;;\n"
        "Segments;;\n120;;\n;;Ann:Ann;;;;;;\nFrame;Sub Frame;RX;RY;RZ;RW;TX;TY;TZ\n;;;;;;m;m;m\n"
        f"12;0;{row}\n18;0;{row}\n\n",
    )
    ann = read_bodies(path)["Ann"]
    assert ann.stamps_ns.tolist() == [100_000_000, 150_000_000]
    np.testing.assert_allclose(ann.T[0, :3, :3], Rotation.from_quat(q).as_matrix(), atol=1e-8)
    np.testing.assert_allclose(ann.T[0, :3, 3], [0.5, -0.25, 1.75])


def test_decimal_commas_between_semicolons(tmp_path):
    comma = (HEAD + ROWS).replace(",", ";").replace("2000", "2000,5").replace("100\n", "100,0\n", 1)
    ann = read_bodies(written(tmp_path, comma))["Ann"]
    np.testing.assert_allclose(ann.T[:, 1, 3], 2.0005)
    assert ann.stamps_ns[0] == 101 * 10_000_000


def test_a_file_without_names_has_one_body(tmp_path):
    path = tmp_path / "seen.tum"
    path.write_text("1.0 0 0 0 0 0 0 1\n1.1 0 0 0 0 0 0 1\n")
    assert list(read_bodies(path)) == [""]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("102,0,11", "102,0,eleven", "line 7: 'eleven' is not a number"),
        ("102,0,11", "102,0,1e308", "line 7: '1e308' is not a number"),
        ("1001,2000", "1e14,2000", "is farther than 1e"),
        ("\n106,", "\n1e14,", "line 10: its frame is not later"),
        ("102,0,11", "102,0," + "9" * 200_000, "line 7: field larger than field limit"),
        ("\n103,", "\n102,", "line 8: its frame is not later"),
        ("100\n", "\n", "line 2: expected the frame rate"),
        ("mm,mm,mm,deg", "ft,ft,ft,deg", "line 5: unit 'ft' is not known; known: mm"),
        ("RZ,TX,TY,TZ,RX", "RZ,TX,TY,XX,RX", "line 4: body 'Ann:Ann' has no column TZ"),
        ("Objects", "Trajectories", "has no block Objects or Segments; export rigid bodies, not markers"),
        (ROWS, "", "the file is cut short"),
    ],
)
def test_an_error_names_its_line(old, new, message, tmp_path):
    assert old in HEAD + ROWS
    path = written(tmp_path, (HEAD + ROWS).replace(old, new, 1))
    with pytest.raises(DataError, match="(?s)" + message) as error:
        read_bodies(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_body_that_was_never_seen_has_no_poses(tmp_path):
    hidden = "\n".join(f"{k},0,1,2,3,4,5,{k},,,,,," for k in range(1, 9))
    bodies = read_bodies(written(tmp_path, HEAD + hidden))
    assert [(name, seen is None) for name, seen in bodies.items()] == [("Ann", False), ("Bob:Head", True)]
    with pytest.raises(DataError, match="no body was ever seen"):
        read_bodies(written(tmp_path, HEAD + "1,0,,,,,,,,,,,,\n2,0,,,,,,,,,,,,\n"))
