"""Motive's CSV in the forms of its versions: what is read and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from share.errors import DataError
from share.lab.mocap.files import read_bodies

FIRST = (
    "Format Version,{version},Take Name,Take 1,Take Notes,,Capture Frame Rate,120.000000,"
    "Export Frame Rate,120.000000,Rotation Type,Quaternion,Length Units,{units},Coordinate Space,Global\n\n"
)
KINDS = ["Rotation"] * 4 + ["Position"] * 3
AXES = [*"XYZW", *"XYZ"]
Q = Rotation.from_euler("xyz", [0.1, -0.4, 2.0])


def text(labels: bool = True, parent: bool = True, code: bool = False, units: str = "Meters") -> str:
    """Return a file of two rigid bodies and a marker of the first."""
    kinds = [*KINDS, "Mean Marker Error", *["Position"] * 3, "Marker Quality", *KINDS]
    types = ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 4 + ["Rigid Body"] * 7
    names = ["Ann"] * 8 + ["Ann:Marker1"] * 4 + ["Bob, the robot"] * 7
    axes = ["Frame", "Time (Seconds)", *(["TimeCode"] if code else []), *AXES, "", *"XYZ", "", *AXES]
    rows = [("Type", types), ("Name", names), ("ID", [f'"{k:04X}"' for k in range(19)])]
    rows += [("Parent", [""] * 19)] if parent else []
    lines = []
    for label, cells in [*rows, ("", kinds)]:
        quoted = [f'"{cell}"' if "," in cell else cell for cell in cells]
        lines.append(",".join(["", label if labels else "", *([""] if code else []), *quoted]))
    lines.append(",".join(axes))
    for k in range(4):
        q = [f"{x:.6f}" for x in Q.as_quat()]
        bob = [""] * 7 if k == 1 else [*q, "1", "2", f"{k}"]
        at = [str(k), f"{k / 120:.6f}", *([f"15:26:46:{k}"] if code else [])]
        lines.append(",".join([*at, *q, "0.5", "1.75", f"{-0.01 * k}", "0.0003", "", "", "", "", *bob]))
    return FIRST.format(version="1.25" if parent else "1.21", units=units) + "\n".join(lines) + "\n"


def written(folder: Path, content: str) -> Path:
    path = folder / "take.csv"
    path.write_text(content, encoding="utf-8-sig")
    return path


@pytest.mark.parametrize(
    ("labels", "parent", "code"), [(True, True, False), (True, False, True), (False, False, False)]
)
def test_each_rigid_body_has_poses_where_it_is_seen(tmp_path, labels, parent, code):
    bodies = read_bodies(written(tmp_path, text(labels, parent, code)))
    assert list(bodies) == ["Ann", "Bob, the robot"]
    ann, bob = bodies.values()
    assert ann.stamps_ns.tolist() == [0, 8_333_000, 16_667_000, 25_000_000]
    assert bob.stamps_ns.tolist() == [0, 16_667_000, 25_000_000]
    np.testing.assert_allclose(ann.T[:, :3, 3], [[0.5, 1.75, -0.01 * k] for k in range(4)])
    np.testing.assert_allclose(ann.T[3, :3, :3], Q.as_matrix(), atol=1e-5)


@pytest.mark.parametrize(("units", "metres"), [("Millimeters", 1e-3), ("Centimeters", 1e-2)])
def test_lengths_are_in_the_files_unit(tmp_path, units, metres):
    ann = read_bodies(written(tmp_path, text(units=units)))["Ann"]
    np.testing.assert_allclose(ann.T[0, :3, 3], [0.5 * metres, 1.75 * metres, 0])


def test_a_body_that_was_never_seen_has_no_poses(tmp_path):
    lines = text().splitlines()
    lines = [",".join(line.split(",")[:14]) if line[:1].isdigit() else line for line in lines]
    bodies = read_bodies(written(tmp_path, "\n".join(lines)))
    assert [(name, seen is None) for name, seen in bodies.items()] == [
        ("Ann", False),
        ("Bob, the robot", True),
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Meters", "Feet", "line 1: Length Units 'Feet' are not known; known: Meters"),
        ("Global", "Local", "line 1: Coordinate Space is not Global"),
        ("X,Y,Z,W", "X,Y,Z,", "line 8: body 'Ann' has no column Rotation W; export with Rotation Type Quat"),
        ("Rigid Body", "Bone", "has no rigid body; export Rigid Bodies"),
        ("Time (Seconds)", "Clock", "line 8: has no column Time"),
        ("\n2,0.016667", "\n2,0.008333", "line 11: its time is not later"),
        (",1.75,", ",1e308,", "line 9: '1e308' is not a number"),
        ("0,0.000000,", "0,0.000000," + "9" * 200_000, "line 9: field larger than field limit"),
        (",1.75,", ",high,", "line 9: 'high' is not a number"),
        ("Frame,Time", "Time,Frame", "was exported without its header"),
        ("0,0.000000,", "0,0.000000,9", "pose 1: quaternion norm is"),
    ],
)
def test_an_error_names_its_line(tmp_path, old, new, message):
    assert old in text()
    path = written(tmp_path, text().replace(old, new, -1 if old == "Rigid Body" else 1))
    with pytest.raises(DataError, match=message) as error:
        read_bodies(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
