"""A live line, also on a closed terminal."""

from __future__ import annotations

import errno
import io

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
