"""`share calibrate target`: the sheet, and the file that describes it."""

from pathlib import Path

from share.lab.calibrate.target import AprilGrid, read_target


def test_yaml_file_describes_the_printed_board(share, tmp_path):
    done = share("calibrate", "target", "--paper", "A3", "--size", 30, "--out", tmp_path / "b.pdf")
    assert done.code == 0, done.err
    assert read_target(tmp_path / "b.yaml") == AprilGrid(6, 6, 0.03, 0.3)
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    assert "aprilgrid, 6 x 6 tags of 30 mm, 9 mm apart, on A3" in done.out


def test_board_that_does_not_fit_is_refused(share, tmp_path):
    done = share("calibrate", "target", "--size", 40, "--out", tmp_path / "b.pdf")
    assert done.code == 2
    assert "at most 23.4 mm fit" in done.err
    assert not list(tmp_path.iterdir())


def test_other_file_endings_are_refused(share, tmp_path):
    done = share("calibrate", "target", "--out", tmp_path / "b.png")
    assert done.code == 2
    assert "ends in .pdf" in done.err
    assert not Path(tmp_path / "b.png").exists()


def test_corrected_size_is_kept(share, tmp_path):
    asked = ("calibrate", "target", "--size", 20, "--out", tmp_path / "b.pdf")
    assert share(*asked).code == 0
    assert share(*asked).code == 0  # the same board once more
    mended = (tmp_path / "b.yaml").read_text().replace("0.02\n", "0.01987  # calipers\n")
    (tmp_path / "b.yaml").write_text(mended)
    (tmp_path / "b.pdf").unlink()
    done = share(*asked)
    assert done.code == 2 and done.err.count("\n") == 1
    assert "its size was corrected, and is kept; give another --out" in done.err
    assert (tmp_path / "b.yaml").read_text() == mended and "calipers" in mended
    assert not (tmp_path / "b.pdf").exists()
