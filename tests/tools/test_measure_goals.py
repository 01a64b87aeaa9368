"""tools/experiments/measure_goals.py: its file, its table, and a drive without pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from helpers.experiments import experiment

from share.errors import UsageError
from share.lab.emulate.small_pictures import profile_of_mode
from share.sensors.profile import load_profile

WORDS = ["--scene", "plain", "--seeds", "3:4", "--runs", "truth", "--seconds", "60", "--headset-s", "10"]


@pytest.fixture(scope="module")
def tool() -> Any:
    return experiment("measure_goals")


def goal(number: int, error_m: float, **more: Any) -> dict[str, Any]:
    row = {"kind": "goal", "scene": "plain", "seed": 1, "run": "wheels", "mode": None, "number": number}
    row |= {"error_m": error_m, "reached": error_m < 0.35, "says_reached": True, "attempts": 1}
    return row | {"seconds": 10.0 * number, "text": "reached", "lines": []} | more


def test_the_table_counts_goals_by_the_truth(tool: Any, tmp_path: Path, capsys: Any) -> None:
    file = tmp_path / "goals.jsonl"
    rows = [
        goal(1, 0.9),
        goal(1, 0.1),
        goal(2, 0.2),
        goal(3, 0.5),
        goal(4, 2.0, says_reached=False, attempts=5),
    ]
    run = goal(0, 0.0) | {"kind": "run", "number": None, "goals": 6, "ended": 4, "place_error_m": 0.07}
    file.write_text("".join(json.dumps(row) + "\n" for row in [*rows, run]))
    assert tool.main(["--out", str(file), "--table", "--plot", str(tmp_path / "goals.png")]) == 0
    head, _, row, _, _, _, *failed = capsys.readouterr().out.splitlines()
    assert dict(zip(head.strip("| ").split(" | "), row.strip("| ").split(" | "), strict=True)) == {
        "run": "wheels",
        "rooms": "1",
        "goals": "4 (2 more not in time)",
        "reached": "2, 50 %",
        "said so and was not there": "1",
        "given again": "1",
        "final error, m": "0.35 (1.77, 2.00)",
        "time, s": "25 (38, 40)",
        "place error, m": "0.070",
    }
    assert [line.split(" | ")[2:4] for line in failed] == [["3", "0.50"], ["4", "2.00"]]
    assert (tmp_path / "goals.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_without_goals_is_refused(tool: Any, tmp_path: Path, capsys: Any) -> None:
    assert tool.main(["--out", str(tmp_path / "none.jsonl"), "--table"]) == 2
    assert "has no goals" in capsys.readouterr().err


def test_pictures_are_scaled_and_cut_from_the_middle(
    tool: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    full, half = (
        load_profile(*name.split(":")) for name in ("d435i:640x480@15", profile_of_mode("320x240@15") + ":")
    )
    whole, small = full.rig(depth=False).cam0, half.rig(depth=False).cam0
    assert (small.width, small.height, half.rate_hz) == (320, 240, 15)
    assert small.fx == whole.fx / 2 and small.cx == pytest.approx((whole.cx + 0.5) / 2 - 0.5, abs=1e-3)
    narrow = load_profile(profile_of_mode("280x240@10")).rig(depth=False).cam0
    assert narrow.cx == pytest.approx(small.cx - 20, abs=1e-3)
    with pytest.raises(UsageError, match="expected WxH@HZ"):
        profile_of_mode("small")


@pytest.mark.slow
@pytest.mark.long
def test_what_has_been_driven_is_not_driven_again(tool: Any, tmp_path: Path, capsys: Any) -> None:
    file = tmp_path / "goals.jsonl"
    words = ["--out", str(file), *WORDS, "--goals", "1"]
    assert tool.main(words) == 0
    text = file.read_text()
    one, run = map(json.loads, text.splitlines())
    assert one["kind"] == "goal" and one["reached"] and one["error_m"] < 0.35 and one["lines"]
    assert run["kind"] == "run" and run["ended"] == 1 and run["machine"]["cores"] >= 1
    assert tool.main(words) == 0 and file.read_text() == text
    file.write_text(json.dumps(one) + "\n")  # interrupted
    assert tool.main(words) == 0
    again = tool.read_rows(file)
    assert [row["kind"] for row in again] == ["goal", "run"] and again[0] == one
