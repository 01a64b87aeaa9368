"""docs/tutorial.md as what is typed on which machine, and what was shown there.

In an indented block, `MACHINE$ words` is typed; a line that ends in a backslash goes on in the next. What
follows up to the next one was shown. Within a block each machine goes on by itself; blocks follow each other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

MACHINES = ("laptop", "headset", "robot")
_INDENT = "    "
_TYPED = re.compile(rf"({'|'.join(MACHINES)})\$ (.*)")


@dataclass(frozen=True)
class Step:
    """typed: its lines as they stand there. shown: lines."""

    machine: str
    typed: tuple[str, ...]
    shown: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """For a shell."""
        return "\n".join(self.typed)

    @property
    def lines(self) -> list[str]:
        first, *rest = self.typed
        return [f"{self.machine}$ {first}", *rest, *self.shown]


@dataclass(frozen=True)
class Block:
    """Lines `start` to `end` - 1 of the page."""

    start: int
    end: int
    steps: tuple[Step, ...]


def blocks(text: str) -> list[Block]:
    """Those in which something is typed."""
    return list(_blocks(text.splitlines()))


def _blocks(lines: Sequence[str]) -> Iterator[Block]:
    k = 0
    while k < len(lines):
        end = k
        while end < len(lines) and (lines[end].startswith(_INDENT) or (end > k and _goes_on(lines, end))):
            end += 1
        inside = [line.removeprefix(_INDENT) for line in lines[k:end]]
        if any(map(_TYPED.match, inside)):
            yield Block(k, end, tuple(_steps(inside)))
        k = max(end, k + 1)


def _goes_on(lines: Sequence[str], k: int) -> bool:
    """An empty line inside of a block."""
    return not lines[k].strip() and any(line.startswith(_INDENT) for line in lines[k + 1 : k + 2])


def _steps(lines: Sequence[str]) -> Iterator[Step]:
    k = 0
    while k < len(lines):
        typed = _TYPED.match(lines[k])
        assert typed is not None, lines[k]
        words, k = [typed[2]], k + 1
        while words[-1].endswith("\\"):
            words.append(lines[k])
            k += 1
        shown = k
        while k < len(lines) and not _TYPED.match(lines[k]):
            k += 1
        yield Step(typed[1], tuple(words), tuple(lines[shown:k]))


def renewed(text: str, walked: Sequence[tuple[Block, Sequence[Step]]]) -> str:
    """The page with what these steps showed in place of what stood there."""
    lines = text.splitlines()
    for block, steps in reversed(walked):
        lines[block.start : block.end] = [
            f"{_INDENT}{line}".rstrip() for step in steps for line in step.lines
        ]
    return "\n".join(lines) + "\n"
