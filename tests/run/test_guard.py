"""A step that fails costs that step."""

from __future__ import annotations

import pytest

from share.errors import UsageError
from share.runtime.guarded_tracker import FaultGuard


def test_a_failure_is_counted_and_said_once_with_its_place() -> None:
    said: list[str] = []
    guard = FaultGuard(said.append)
    for _ in range(3):
        with guard.step("handling Received"):
            raise ZeroDivisionError("by \x1b zero")
    assert guard.failure_count == 3
    [line] = said
    assert line.startswith("handling Received: ZeroDivisionError at test_guard.py:")
    assert line.endswith("by ? zero; this step is skipped and the run goes on")


def test_what_ends_a_run_by_intent_passes() -> None:
    guard = FaultGuard(lambda text: None)
    with pytest.raises(UsageError), guard.step("handling Received"):
        raise UsageError("the name is taken")
    assert guard.failure_count == 0


def test_lines_are_bounded() -> None:
    said: list[str] = []
    guard = FaultGuard(said.append)
    for k in range(100):
        with guard.step(f"step {k}"):
            raise ValueError
    assert (guard.failure_count, len(said)) == (100, 16)
