"""Files of an earlier calibration are not lost to a worse one."""

from pathlib import Path

from share.lab.calibrate.report import output_paths


def test_what_is_to_be_believed_takes_the_place(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("old")
    assert output_paths(tmp_path, True, "a.yaml", "b.json") == (tmp_path / "a.yaml", tmp_path / "b.json")


def test_what_failed_takes_an_empty_place(tmp_path: Path) -> None:
    assert output_paths(tmp_path, False, "a.yaml", "b.json") == (tmp_path / "a.yaml", tmp_path / "b.json")


def test_what_failed_goes_beside_all_that_is_there(tmp_path: Path) -> None:
    """Also where only one of the files is: they belong together."""
    (tmp_path / "b.json").write_text("old")
    beside = (tmp_path / "a.failed.yaml", tmp_path / "b.failed.json")
    assert output_paths(tmp_path, False, "a.yaml", "b.json") == beside
