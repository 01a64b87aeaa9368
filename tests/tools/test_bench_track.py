"""The benchmark times functions by name; all of them have to exist."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "experiments"


def test_all_timed_stages_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TOOLS)
    tool = importlib.import_module("bench_track")
    assert [(str(owner), name) for owner, name, _ in tool.STAGES if not hasattr(owner, name)] == []
