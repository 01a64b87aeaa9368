"""Shared by the tools: one line and an exit code for SHARE's errors; lines of Markdown tables."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from share.errors import ShareError


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Run `work`; return its exit code."""
    try:
        work()
    except ShareError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def line(cells: Iterable[str]) -> str:
    """Return a line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
