"""Shared by the tools: arguments; one line and an exit code for SHARE's errors; lines of Markdown tables."""

from __future__ import annotations

import argparse
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


def seed_range(text: str) -> range:
    """Return the seeds of an argument FIRST:END, without END. Raises ArgumentTypeError."""
    try:
        seeds = range(*map(int, text.split(":", 1)))
    except ValueError:
        seeds = range(0)
    if ":" not in text or not seeds or seeds[0] < 0:
        raise argparse.ArgumentTypeError(f"{text!r:.40}: expected FIRST:END, such as 401:403 for 401 and 402")
    return seeds


def time_range(text: str) -> tuple[float, float]:
    """Return the times of an argument A:B, s. Raises ArgumentTypeError."""
    try:
        begin_s, end_s = map(float, text.split(":"))
    except ValueError:
        begin_s = end_s = 0.0
    if not 0.0 <= begin_s < end_s < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r:.40}: expected A:B, two times in s that rise")
    return begin_s, end_s


def positive(text: str) -> float:
    """Return a positive number. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r:.40}: expected a positive number")
    return value


def count(text: str) -> int:
    """Return a whole number from 1. Raises ArgumentTypeError."""
    if not (text.isascii() and text.isdigit() and 0 < int(text) <= 1_000_000):
        raise argparse.ArgumentTypeError(f"{text!r:.40}: expected a whole number from 1")
    return int(text)


def line(cells: Iterable[str]) -> str:
    """Return a line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
