"""The regression gate: what it calls worse, and the gate itself (`make slow`)."""

from __future__ import annotations

import importlib
import json
import math
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from share.errors import DataError, ShareError

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("regression")


@pytest.mark.parametrize(
    ("name", "before", "now", "says"),
    [
        ("share: joint ATE", 1.0, 1.1, ""),  # within its noise
        ("share: joint ATE", 1.0, 9.0, "worse"),
        ("share: joint ATE", 1.0, 0.1, "better"),
        ("share: joint ATE", 1.0, math.nan, "worse"),
        ("share: joint ATE", math.nan, 1.0, ""),  # not known before
        ("share: agents in one map", 3.0, 2.0, "worse"),
        ("share: agents in one map", 2.0, 3.0, "better"),
    ],
)
def test_what_is_worse(tool, name, before, now, says):
    (verdict,) = tool.judged({name: now}, {name: before})
    assert verdict.says == says
    assert f"| {says} |" in tool.table([verdict])


def test_a_run_is_kept_and_the_next_is_held_against_it(tool, monkeypatch, tmp_path, capsys):
    file = tmp_path / "history.jsonl"
    options = Namespace(history=file, keep="the first", cache=None, workers=1)
    monkeypatch.setattr(tool, "played", lambda config, options: {"share: joint ATE": 1.0})
    tool.compare(options)
    (first,) = tool.history(file)
    assert first["why"] == "the first"
    assert first["figures"] == {"share: joint ATE": 1.0}

    monkeypatch.setattr(tool, "played", lambda config, options: {"share: joint ATE": 5.0})
    options.keep = None
    with pytest.raises(ShareError, match=r"worse than .* \(the first\): share: joint ATE"):
        tool.compare(options)
    assert len(tool.history(file)) == 1
    assert "| worse |" in capsys.readouterr().out

    file.write_text(json.dumps(first) + "\n{")
    with pytest.raises(DataError, match="is damaged"):
        tool.history(file)


def test_history_is_of_figures_that_are_judged(tool):
    for one in tool.history(tool.HISTORY):
        assert {name.partition(": ")[2] for name in one["figures"]} <= set(tool.NOISE)


@pytest.mark.slow
def test_nothing_has_become_worse():
    """The gate. If it is better or worse for a reason, say so: `python tools/regression.py --keep WHY`."""
    told = [sys.executable, str(TOOLS / "regression.py")]
    done = subprocess.run(told, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout + done.stderr
