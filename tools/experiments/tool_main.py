"""What tools share: an error of SHARE's is one line and an exit code; lines of Markdown tables."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from share.errors import ShareError


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Of a tool that does `work`."""
    try:
        work()
    except ShareError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def line(cells: Iterable[str]) -> str:
    """Of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
