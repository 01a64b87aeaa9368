"""A solver that iterates to the end, for comparisons to the last digits."""

from __future__ import annotations

import pytest

from share.mapping.graph import covariance, optimiser


def make_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("STEP_TOLERANCE", 1e-8), ("RELATIVE_TOLERANCE", 1e-14), ("INNER_TOLERANCE", 1e-6)):
        monkeypatch.setattr(optimiser, name, value)


def use_all_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Covariances by nearly every path there is."""
    monkeypatch.setattr(covariance, "MAX_EDGES", 10**6)
    monkeypatch.setattr(covariance, "_MAX_ROUNDS", 200)
