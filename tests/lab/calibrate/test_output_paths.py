"""A failed calibration never replaces an earlier one."""

from pathlib import Path

from share.lab.calibrate.report import output_paths


def test_a_calibration_that_passed_replaces_earlier_files(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("old")
    assert output_paths(tmp_path, True, "a.yaml", "b.json") == (tmp_path / "a.yaml", tmp_path / "b.json")


def test_a_failed_calibration_is_written_into_an_empty_folder(tmp_path: Path) -> None:
    assert output_paths(tmp_path, False, "a.yaml", "b.json") == (tmp_path / "a.yaml", tmp_path / "b.json")


def test_a_failed_calibration_is_written_beside_earlier_files(tmp_path: Path) -> None:
    """Also where only one of the files exists: they belong together."""
    (tmp_path / "b.json").write_text("old")
    beside = (tmp_path / "a.failed.yaml", tmp_path / "b.failed.json")
    assert output_paths(tmp_path, False, "a.yaml", "b.json") == beside
