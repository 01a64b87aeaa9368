"""Fixtures of the mapper's tests."""

from __future__ import annotations

import pytest

from share.mapping import settling


@pytest.fixture
def entered_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Agents enter another map by the solution that opens the gate, without further keyframes."""
    monkeypatch.setattr(settling, "SETTLING_KEYFRAMES", 0)
