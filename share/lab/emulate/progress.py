"""Progress of a session."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]  # task, done, total


def no_progress(what: str, done: int, total: int) -> None:
    """Ignore progress."""
