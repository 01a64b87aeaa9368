"""The regression gate: which figures count as worse, and the gate itself (`make slow`)."""

from __future__ import annotations

import importlib
import json
import math
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from share.errors import DataError, ShareError, UsageError
from share.lab.evaluate.run_metrics import Conditions, RunMetrics

TOOLS = Path(__file__).resolve().parents[2] / "tools"


def comparable(policy: str, in_one_map: int) -> RunMetrics:
    return RunMetrics(Conditions("room", policy, "wifi5", 0), (), in_one_map, 1.0, 1, 0, 1)


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
def test_worse_figures_are_found(tool, name, before, now, says):
    (verdict,) = tool.judged({name: now}, {name: before})
    assert verdict.says == says
    assert f"| {says} |" in tool.table([verdict])


def test_next_run_is_compared_with_the_kept_one(tool, monkeypatch, tmp_path, capsys):
    file = tmp_path / "history.jsonl"
    options = Namespace(history=file, keep="the first", accept=[], cache=None, workers=1)
    monkeypatch.setattr(tool, "played", lambda config, options: {"share: joint ATE": 1.0})
    tool.compare(options)
    (first,) = tool.history(file)
    assert first["why"] == "the first"
    assert first["figures"] == {"share: joint ATE": 1.0}

    monkeypatch.setattr(tool, "played", lambda config, options: {"share: joint ATE": 5.0})
    options.keep = "though it is worse"
    with pytest.raises(ShareError, match=r"worse than before: share: joint ATE"):
        tool.compare(options)
    assert len(tool.history(file)) == 1  # it is not what the next is held against
    assert "| worse |" in capsys.readouterr().out
    options.accept = ["share: joint ATF"]
    with pytest.raises(UsageError, match="joint ATF: not known; known: share: joint ATE, all"):
        tool.compare(options)
    options.accept = ["all"]
    tool.compare(options)
    assert tool.history(file)[1]["accepted"] == ["share: joint ATE"]
    assert tool.wanted(tool.history(file)) == {"share: joint ATE": 5.0}

    file.write_text(json.dumps(first) + "\n{")
    with pytest.raises(DataError, match="is damaged"):
        tool.history(file)


def test_many_small_losses_are_found(tool):
    lines = [{"figures": {"share: joint ATE": value}} for value in (1.0, 1.1, 1.3, 1.6, 1.7)]
    now = {"share: joint ATE": 2.1}
    assert tool.judged(now, lines[-1]["figures"])[0].says == ""
    assert tool.judged(now, tool.wanted(lines))[0].says == "worse"


def test_agent_outside_the_map_is_found(tool):
    """In one of four runs by each policy."""
    runs = [comparable(policy, 2 if k == 0 else 3) for policy in tool.POLICIES for k in range(4)]
    assert tool.figures_of(runs)["covins-g: agents in one map"] == 2.75


def test_history_holds_the_judged_figures(tool):
    for one in tool.history(tool.HISTORY):
        assert {name.partition(": ")[2] for name in one["figures"]} <= set(tool.NOISE)


@pytest.mark.slow
def test_no_figure_became_worse():
    """The gate. If it is better or worse for a reason, say so: `python tools/regression.py --keep WHY`."""
    reported = [sys.executable, str(TOOLS / "regression.py")]
    done = subprocess.run(reported, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout + done.stderr
