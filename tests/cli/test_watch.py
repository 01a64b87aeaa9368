"""`share watch`: the room of a running edge as text."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

from share.cli.main import cli
from share.cli.watch import watch as watch_command
from share.errors import ShareError, UsageError, printable
from share.net.http_guard import read_token
from share.runtime.status_server import StatusServer

AGENT = {
    **{"kind": "ar", "state": "OK", "pose_ms": 6.0, "qoe": 0.8, "qoe_target": 0.75, "rate_hz": 3.2},
    **{"keyframes": 12, "gone": False, "trouble": []},
}
REPORT = {"agents": {"ann": AGENT}, "trouble": []}
PART = {"map_id": "a", "path": [[0.0, 0.0], [1.0, 0.0]]}
PLAN = {
    "agents": {"ann": {"kind": "ar", "map_id": "a", "parts": [PART], "position": [1.0, 0.0], "heading": 0.0}}
}


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def watch(*words: object) -> Result:
    return CliRunner().invoke(cli, ["watch", *map(str, words)])


def served(report: Any = REPORT, token: str | None = None) -> StatusServer:
    return StatusServer("0", lambda: report, token=token, plan=lambda: PLAN)


@pytest.fixture
def server() -> Iterator[StatusServer]:
    with closing(served()) as server:
        yield server


def test_once_prints_the_room(server: StatusServer) -> None:
    result = watch(server.endpoint, "--once")
    assert result.exit_code == 0
    for text in ("→ ann", "6.0 of  20 ms", "map of ann"):
        assert text in click.unstyle(result.stdout)


def test_without_a_terminal_it_ends_by_itself(server: StatusServer) -> None:
    assert "→ ann" in watch(server.endpoint.rpartition(":")[2]).stdout


def test_json_is_the_report_of_the_edge(server: StatusServer) -> None:
    assert json.loads(watch(f"http://{server.endpoint}/", "--json").stdout)["agents"] == REPORT["agents"]


def test_a_token_is_asked_for_and_taken(tmp_path: Path) -> None:
    token_file = tmp_path / "room.token"
    with closing(served(token=read_token(token_file))) as server:
        without = watch(server.endpoint, "--once")
        assert isinstance(without.exception, ShareError)
        assert "--http-token FILE" in str(without.exception)
        assert watch(server.endpoint, "--once", "--http-token", token_file).exit_code == 0


@pytest.mark.parametrize("address", ["foo", "https://a:1", "a:b", "a:99999", ""])
def test_what_is_no_address_is_said(address: str) -> None:
    error = watch(address).exception
    assert isinstance(error, UsageError)
    assert f"'{address}'" in str(error)


def test_where_no_edge_is_that_is_said() -> None:
    error = watch("127.0.0.1:9").exception
    assert isinstance(error, ShareError)
    assert "http://127.0.0.1:9/ does not answer" in str(error)


@pytest.mark.parametrize("agents", [3, [], {"a": {"kind": "tree"}}, {"a": 1}, {"a": {}}])
def test_a_report_that_cannot_be_drawn_is_one_line(agents: Any) -> None:
    with closing(served({"agents": agents})) as server:
        error = watch(server.endpoint, "--once").exception
    assert isinstance(error, ShareError)
    assert printable(str(error)) == str(error)


def test_an_edge_that_is_gone_is_said_and_its_last_report_stays(
    server: StatusServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen, now_s = Terminal(), [0.0]
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr("shutil.get_terminal_size", lambda fallback=(80, 24): os.terminal_size((100, 30)))
    monkeypatch.setattr("share.cli.terminal_room.has_room", lambda live: True)

    def sleep(seconds: float) -> None:
        server.close()
        now_s[0] += 10
        if now_s[0] > 20:
            raise KeyboardInterrupt

    monkeypatch.setattr("share.cli.watch.time", SimpleNamespace(sleep=sleep, monotonic=lambda: now_s[0]))
    callback = watch_command.callback
    assert callback is not None
    with pytest.raises(KeyboardInterrupt):
        callback(server.endpoint, None, False, False)
    drawn = click.unstyle(screen.getvalue())
    assert "→ ann" in drawn
    assert "has not answered for 10 s" in drawn
