"""A live line, also on a closed terminal."""

from __future__ import annotations

import errno
import io
import re

import pytest

from share.cli.terminal import LiveLine


class Gone(io.StringIO):
    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        raise OSError(errno.EIO, "Input/output error")


def test_closed_terminal_does_not_end_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", Gone())
    line = LiveLine()
    assert line.is_terminal
    line.write("1 frame")
    line.print_line("the camera is away")
    line.end()


class Screen(io.StringIO):
    """A terminal, as far as lines, `\\r` and the sequences that a block uses."""

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        rows, row, column = [""], 0, 0
        for piece in re.findall(r"\x1b\[\d*[A-Z]|\n|\r|[^\x1b\n\r]+", self.getvalue()):
            if piece == "\n":
                row, column = row + 1, 0
                rows += [""] * (row + 1 - len(rows))
            elif piece == "\r":
                column = 0
            elif piece.endswith("A") and piece.startswith("\x1b"):
                row -= int(piece[2:-1])
            elif piece == "\x1b[K":
                rows[row] = rows[row][:column]
            elif piece == "\x1b[J":
                rows = [*rows[:row], rows[row][:column]]
            else:
                rows[row] = rows[row][:column].ljust(column) + piece + rows[row][column + len(piece) :]
                column += len(piece)
        return rows


def test_a_block_is_drawn_over_itself_and_lines_stand_above_it(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen()
    monkeypatch.setattr("sys.stderr", screen)
    line = LiveLine()
    line.write_block(["a plan", "of two lines", "3 frames"])
    line.write_block(["a plan", "of two lines", "10 frames"])
    line.print_line("maps merged")
    line.write_block(["another", "20 frames"])
    line.end()
    line.print_line("done")
    line.end()
    assert screen.lines() == ["maps merged", "another", "20 frames", "done", ""]


def test_where_no_terminal_is_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr("sys.stderr", out)
    line = LiveLine()
    line.write_block(["a plan"])
    line.write("1 frame")
    line.end()
    assert out.getvalue() == ""
