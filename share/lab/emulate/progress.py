"""How far a session is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]  # what is done, how far, of how much


def no_progress(what: str, done: int, total: int) -> None:
    """Progress for nobody."""
