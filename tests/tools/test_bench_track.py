"""The benchmark times functions by their names: each has to be there."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "experiments"


def test_every_stage_that_is_timed_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TOOLS)
    tool = importlib.import_module("bench_track")
    assert [(str(owner), name) for owner, name, _ in tool.STAGES if not hasattr(owner, name)] == []
