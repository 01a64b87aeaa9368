"""A grid of scheduler settings in virtual time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

TOOL = Path(__file__).parents[2] / "tools" / "experiments" / "tune_rates.py"


def tuned(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(TOOL), *arguments], capture_output=True, text=True, timeout=300
    )


@pytest.mark.slow
def test_fewer_keyframes_save_latency_and_a_picture_shows_it(tmp_path: Path) -> None:
    one = ("--scenes", "warehouse", "--rooms", "501:502", "--workers", "1")
    where = ("--json", str(tmp_path / "a.json"), "--picture", str(tmp_path / "a.png"))
    done = tuned("control.rate_min_hz=0.5,1.5", "control.kp=0.8,3.2", *one, *where)
    assert done.returncode == 0, done.stderr
    rows = [line.split("|")[1:-1] for line in done.stdout.splitlines()[2:]]
    latency = np.array([float(row[2].split("±")[0]) for row in rows])
    assert len(rows) == 4 and (latency > 0.5).all() and (latency < 0.95).all()
    assert latency[:2].mean() < latency[2:].mean()  # at most 0.5 Hz less, so sooner
    runs = json.loads((tmp_path / "a.json").read_text())
    assert len(runs) == 5 and {run["policy"] for run in runs} == {"covins-g", "share"}
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_unknown_setting_is_refused() -> None:
    done = tuned("control.kp")
    said = "tune_rates: 'control.kp': expected SECTION.NAME=VALUE,VALUE…\n"
    assert (done.returncode, done.stderr) == (2, said)


@pytest.mark.slow
def test_given_motions_and_fixed_rates_are_used(tmp_path: Path) -> None:
    one = ("--scenes", "warehouse", "--rooms", "501:502", "--workers", "1")
    where = ("--json", str(tmp_path / "a.json"))
    motions = ("--motions", "ann=walk:speed=0.3,pauses=8", "bob=robot:speed=0.7")
    done = tuned("control.rate_min_hz+control.rate_max_hz=1,2", *one, *where, *motions)
    assert done.returncode == 0, done.stderr
    runs = json.loads((tmp_path / "a.json").read_text())
    assert [run["settings"][1:] for run in runs[1:]] == [
        [f"control.rate_min_hz={hz}", f"control.rate_max_hz={hz}"] for hz in (1, 2)
    ]
    slow, quick = ([run["agents"][name]["sent"] for run in runs] for name in ("ann", "bob"))
    assert [run["agents"]["bob"]["kind"] for run in runs] == ["robot"] * 3
    assert 45 <= quick[1] <= 65 < quick[2] and slow[2] < slow[0] < quick[0]
