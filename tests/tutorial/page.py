"""docs/start/first-room.md as what is typed on which machine, and what was shown there.

In a fenced block, `MACHINE$ words` is typed; a line that ends in a backslash continues in the next. What
follows up to the next prompt was shown; a line `…` stands for lines that the page leaves out. Within a block
machines run in parallel; blocks run in sequence.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

MACHINES = ("laptop", "headset", "robot")
LEFT_OUT = "…"
_FENCE = "```"
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
    """Lines `start` to `end` - 1 of the page, between two fences."""

    start: int
    end: int
    steps: tuple[Step, ...]


def blocks(text: str) -> list[Block]:
    """Those in which something is typed."""
    return list(_blocks(text.splitlines()))


def _blocks(lines: Sequence[str]) -> Iterator[Block]:
    fences = [k for k, line in enumerate(lines) if line.startswith(_FENCE)]
    assert len(fences) % 2 == 0, "a fence is not closed"
    for opening, closing in zip(fences[::2], fences[1::2], strict=True):
        inside = lines[opening + 1 : closing]
        if any(map(_TYPED.match, inside)):
            yield Block(opening + 1, closing, tuple(_steps(inside)))


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
    """The page with what these steps showed in place of what stood there, abridged where that was."""
    lines = text.splitlines()
    for block, steps in reversed(walked):
        new = [abridged(step, old) for old, step in zip(block.steps, steps, strict=True)]
        lines[block.start : block.end] = [line.rstrip() for step in new for line in step.lines]
    return "\n".join(lines) + "\n"


def abridged(step: Step, old: Step) -> Step:
    """The step with as many lines before and after a line `…` as `old` shows; whole where `old` has none."""
    if LEFT_OUT not in old.shown:
        return step
    first = old.shown.index(LEFT_OUT)
    last = len(step.shown) - (len(old.shown) - first - 1)
    if first >= last:
        return step
    return replace(step, shown=(*step.shown[:first], LEFT_OUT, *step.shown[last:]))
