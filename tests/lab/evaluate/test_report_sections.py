"""Optional sections of a report."""

from __future__ import annotations

import math

import pytest

from share.errors import DataError, UsageError
from share.lab.evaluate.report import read_section
from share.lab.train.score import ErrorModelScore, read_scores, scores_json

SCORES = [
    ErrorModelScore("always the mean", 2.5, 1.0, 0.0, 0.2),
    ErrorModelScore("ours", 1.5, 0.5, 0.8, 0.1, 0.9, 1.2),
]


def test_models_of_the_error(tmp_path):
    file = tmp_path / "scores.json"
    file.write_text(scores_json(SCORES))
    assert "NaN" not in file.read_text()
    first, second = read_scores(file)
    assert math.isnan(first.cpu_ms)
    assert second == SCORES[1]
    made = read_section(file, 1)
    assert made.text.startswith("## Error models: scores\n")
    assert "| ours | 1.500 | 0.500 | 0.80 | 0.100 | 90 % | 1.20 |" in made.text
    assert made.pictures == {}


@pytest.mark.parametrize("text", ["", "{}", "[1]", '[{"name": "x"}]', '[{"name": "x", "more": 1}]'])
def test_damaged_scores_are_reported(tmp_path, text):
    file = tmp_path / "scores.json"
    file.write_text(text)
    with pytest.raises(DataError, match=r"\.json: not a file of `share train compare --json`, or damaged"):
        read_section(file, 1)


def test_settings_tried(tmp_path):
    folder = tmp_path / "gains"
    folder.mkdir()
    with pytest.raises(UsageError, match="give a folder of `share evaluate sweep`"):
        read_section(folder, 1)
    (folder / "sweep.md").write_text("| control.kp |\n|---|\n| 0.8 |\n")
    assert read_section(folder, 1).pictures == {}
    (folder / "heat.png").write_bytes(b"")
    made = read_section(folder, 2)
    text, shown = made.text.split("\n![")
    assert text == "## Settings swept: gains\n\n| control.kp |\n|---|\n| 0.8 |\n"
    assert shown == "Means over the first two settings](heat-2.png)\n"
    assert made.pictures == {"heat-2.png": folder / "heat.png"}
