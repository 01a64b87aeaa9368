"""The room as text over an edge's status page."""

from __future__ import annotations

import io
import os
import sys
from contextlib import closing
from typing import Any

import click
import pytest
from helpers.terminal_room import PLAN, REPORT, Terminal

from share.cli.stderr import flush_all
from share.cli.terminal import LiveLine
from share.cli.terminal_room import TerminalRoom, draw_room, has_room
from share.cli.watch import _last_line
from share.runtime.status_server import StatusServer
from share.view.terminal_picture import TerminalPicture


def watched(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal in place of stderr; within a test, since pytest sets stderr anew before each."""
    out = Terminal()
    monkeypatch.setattr("sys.stderr", out)
    monkeypatch.setattr("shutil.get_terminal_size", lambda fallback=(80, 24): os.terminal_size((100, 30)))
    return out


def test_what_the_edge_says_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = watched(monkeypatch)
    live = LiveLine()
    with closing(StatusServer("0", lambda: REPORT, plan=lambda: PLAN)) as server:
        room = TerminalRoom(live, f"http://{server.endpoint}/")
        assert room.show("frames: ann 10")
        live.end()
        drawn = click.unstyle(screen.getvalue())
        for text in ("→ ann", "6.0 of  20 ms", "map of ann", "frames: ann 10"):
            assert text in drawn
    assert room.show("frames: ann 20")  # the edge is gone: what was drawn stays
    assert "ann 20" not in screen.getvalue()


@pytest.mark.parametrize(
    "report",
    [
        {"trouble": ["\x1b]0;owned\x07\r\n"]},
        {"policy": "\x1b]0;owned\x07"},
        {"merges": {"done": "\x1b]0;owned\x07"}},
    ],
)
def test_no_line_of_the_edge_brings_escapes(monkeypatch: pytest.MonkeyPatch, report: dict[str, Any]) -> None:
    screen = watched(monkeypatch)
    draw_room(LiveLine(), TerminalPicture(), REPORT, PLAN, _last_line("http://h:1/", report, 0.0))
    flush_all()
    drawn = screen.getvalue()
    assert "?]0;owned?" in drawn and "\x1b]" not in drawn and "\x07" not in drawn


def test_without_an_edge_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = watched(monkeypatch)
    assert not TerminalRoom(LiveLine(), "http://127.0.0.1:9/").show("frames: ann 10")
    assert screen.getvalue() == ""


def test_it_needs_a_terminal_on_both_streams_that_is_large_and_knows_the_characters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen = watched(monkeypatch)
    monkeypatch.setattr(sys, "stdout", Terminal())
    assert has_room(LiveLine())
    monkeypatch.setattr("shutil.get_terminal_size", lambda fallback=(80, 24): os.terminal_size((60, 30)))
    assert not has_room(LiveLine())
    monkeypatch.setattr("shutil.get_terminal_size", lambda fallback=(80, 24): os.terminal_size((100, 30)))
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert not has_room(LiveLine())
    monkeypatch.setattr(sys, "stdout", Terminal())
    screen.encoding = "latin-1"
    assert not has_room(LiveLine())
