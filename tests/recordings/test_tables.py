"""Tables and trajectories have exact stamps; errors name file and line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.errors import DataError
from share.geometry import se3
from share.recordings.losses import DataLosses
from share.recordings.tables import parse_seconds, read_table
from share.recordings.trajectory import Trajectory, format_seconds, format_tum, read_tum

GOOD = "#t,a,b\n1403715273262142976,0.5,-1e-3\n1403715273267142912,1.5,2\n"


def test_a_table_keeps_nanoseconds(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(GOOD.replace("\n", "\r\n"))
    stamps, values = read_table(path, 3)
    assert stamps.tolist() == [1403715273262142976, 1403715273267142912]
    assert values.tolist() == [[0.5, -1e-3], [1.5, 2.0]]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (GOOD + "1403715273272142848,0.5", "line 4: 2 of 3 columns; the line is cut short"),
        (GOOD + "14037152\n", "line 4: 1 of 3 columns"),
        (GOOD + "nan,1,2\n", "line 4: stamp 'nan' is not a whole number of nanoseconds"),
        (GOOD + "1.4e18,1,2\n", "line 4: stamp '1.4e18'"),
        (GOOD + "99999999999999999999,1,2\n", "line 4: stamp 9+ is out of range"),
        (GOOD + "1503715273272142848,x,2\n", "line 4: 'x' is not a number"),
        (GOOD + "1503715273272142848,nan,2\n", "line 4: 'nan' is not finite"),
        (GOOD + "\n1403715273262142976,1,2\n", "line 5: .* is out of order; sort"),
        ("", "has no data"),
        ("#t,a,b\n\n", "has no data"),
    ],
)
def test_a_wrong_line_is_refused_by_its_number(tmp_path, text, complaint):
    path = tmp_path / "data.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=f"data.csv.*{complaint}"):
        read_table(path, 3)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_table(tmp_path / "no.csv", 3)
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(DataError, match="not a text file"):
        read_table(tmp_path / "b.csv", 3)


@given(st.integers(-(10**18), 4 * 10**18))
def test_seconds_are_exact(stamp):
    assert parse_seconds(format_seconds(stamp), "x") == stamp


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1.403636579763555527e+09", 1_403_636_579_763_555_527),  # as evo and np.savetxt write it
        ("-1.403636579763555527E9", -1_403_636_579_763_555_527),
        ("0.000000000000000000e+00", 0),
        ("1e3", 10**12),
        ("2.5e-09", 2),
        ("1e-999999", 0),
    ],
)
def test_seconds_with_an_exponent_are_exact(text, stamp):
    assert parse_seconds(text, "x") == stamp


BAD_SECONDS = "nan inf e 1e snane3 1e10 1e999999 -1e99999999 9.3e9 9300000000 1,5 0x10 1.2.3 99999999999"


@pytest.mark.parametrize("text", ["", *BAD_SECONDS.split()])
def test_other_seconds_are_refused(text):
    with pytest.raises(DataError, match=r"t\.txt, line 1"):
        parse_seconds(text, "t.txt, line 1")


def test_tum_files_are_deterministic_and_accurate(tmp_path, rng):
    T = se3.exp(rng.normal(size=(50, 6)))
    stamps = np.cumsum(rng.integers(1, 10**9, 50)) + 1_700_000_000_000_000_001
    path = tmp_path / "t.tum"
    path.write_text(format_tum(Trajectory(stamps, T)))
    back = read_tum(path)
    assert (back.stamps_ns == stamps).all()
    np.testing.assert_allclose(back.T, T, atol=5e-9)
    assert format_tum(Trajectory(stamps, T)) == path.read_text()
    np.testing.assert_allclose(numbers(format_tum(back)), numbers(path.read_text()), atol=1.1e-9)
    assert "-0.000000000" not in format_tum(Trajectory(stamps[:1], np.eye(4)[None]))


def numbers(text: str) -> np.ndarray:
    return np.array([line.split()[1:] for line in text.splitlines()], float)


def test_tum_files_with_invalid_rotations_or_cut_lines_are_refused(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("1.0 0 0 0 0 0 0 0\n")
    with pytest.raises(DataError, match="quaternion norm is 0"):
        read_tum(path)
    path.write_text("# t\n1.0 0 0 0 0 0 0 1\n2.0 0 0")
    with pytest.raises(DataError, match="line 3: 3 of 8 columns"):
        read_tum(path)


def test_an_overflowing_quaternion_is_one_damaged_line(tmp_path):
    lines = [f"{k}.0 0 0 0 0 0 0 1" for k in range(40)]
    lines[7] = "7.0 0 0 0 0 0 1e308 1e308"
    path, losses = tmp_path / "truth.tum", DataLosses()
    path.write_text("\n".join(lines))
    assert len(read_tum(path, losses).stamps_ns) == 39
    with pytest.raises(DataError, match="pose 8: quaternion norm is inf"):
        read_tum(path)
