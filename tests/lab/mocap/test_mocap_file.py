"""Motion capture files: TUM and CSV, and the choice of a body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from share.errors import DataError, UsageError
from share.lab.mocap.files import pick_body, read_bodies, read_mocap
from share.lab.mocap.trajectory import MocapTrajectory

TUM = "1.0 1 2 3 0 0 0 1\n1.1 1 2 4 0 0 0 1\n1.2 1 2 5 0 0 0 1\n"
CSV = "1000000000,1,2,3,1,0,0,0\n1100000000,1,2,4,1,0,0,0\n1200000000,1,2,5,1,0,0,0\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(("name", "text"), [("a.tum", TUM), ("a.csv", CSV), ("a.CSV", CSV), ("A.TXT", TUM)])
@pytest.mark.parametrize("head", ["", "\ufeff", "\ufeff# t x y z and a quaternion\n"])
def test_capitals_and_a_byte_order_mark_do_not_matter(
    tmp_path: Path, name: str, text: str, head: str
) -> None:
    mocap = read_mocap(written(tmp_path / name, head + text))
    assert mocap.stamps_ns.tolist() == [1_000_000_000, 1_100_000_000, 1_200_000_000]
    np.testing.assert_allclose(mocap.T[:, :3, 3], [[1, 2, 3], [1, 2, 4], [1, 2, 5]])


@pytest.mark.parametrize(
    ("name", "text", "row", "unseen"),
    [
        ("a.tum", TUM, "1.1 1 2 4 0 0 0 1", "1.1 nan nan nan nan nan nan nan"),
        ("a.tum", TUM, "1.1 1 2 4 0 0 0 1", "1.1 -nan 2 4 0 0 0 1"),
        ("a.tum", TUM, "1.1 1 2 4 0 0 0 1", "1.1 0 0 0 0 0 0 0"),
        ("a.csv", CSV, "1100000000,1,2,4,1,0,0,0", "1100000000,NaN,NaN,NaN,NaN,NaN,NaN,NaN"),
        ("a.csv", CSV, "1100000000,1,2,4,1,0,0,0", "1100000000,,,,,,,"),
        ("a.csv", CSV, "1100000000,1,2,4,1,0,0,0", "1100000000,0,0,0,0,0,0,0"),
    ],
)
def test_rows_where_the_body_is_not_seen_are_gaps(
    tmp_path: Path, name: str, text: str, row: str, unseen: str
) -> None:
    assert row in text
    (mocap,) = read_bodies(written(tmp_path / name, text.replace(row, unseen))).values()
    assert mocap.stamps_ns.tolist() == [1_000_000_000, 1_200_000_000]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TUM.replace("4 0 0 0 1", "inf 0 0 0 1"), "line 2: 'inf' is not finite"),
        (TUM.replace("4 0 0 0 1", "4 0 0 0 2"), "pose 2: quaternion norm is 2"),
        ("1 0 0 0 0 0 0 0\n" + TUM.replace("1.2 1 2 5 0 0 0 1", "1.2 1 2 5 0 0 0 2"), "pose 4: quaternion"),
        ("1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n", "the body was never seen"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=f"a.tum.*{message}"):
        read_mocap(written(tmp_path / "a.tum", text))


SEEN = MocapTrajectory(np.array([0, 10]), np.tile(np.eye(4), (2, 1, 1)))


def test_the_body_is_the_given_one_or_of_the_devices_name_or_the_only_one() -> None:
    there = {"Ann": SEEN, "Hat": SEEN}
    assert pick_body("v.csv", there, None, "ann", "--body") == ("Ann", SEEN)
    assert pick_body("v.csv", there, "hat", "ann", "--body") == ("Hat", SEEN)
    assert pick_body("v.csv", {"Hat": SEEN}, None, "ann", "--body") == ("Hat", SEEN)
    assert pick_body("a.tum", {"": SEEN}, None, "ann", "--body") == ("", SEEN)


def test_a_body_that_was_never_seen_is_not_replaced_by_another() -> None:
    there = {"Ann": SEEN, "Bob": None}
    with pytest.raises(UsageError, match="body 'Bob' is in the file but was never seen"):
        pick_body("v.csv", there, None, "bob", "--body")
    with pytest.raises(UsageError, match=r"has no body for 'eve' .*; it has Ann, Bob"):
        pick_body("v.csv", there, None, "eve", "--body")
