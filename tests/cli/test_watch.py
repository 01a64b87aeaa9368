"""`share watch`: the room of a running edge as text."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from helpers import terminal_room
from helpers.terminal_room import PLAN, Terminal

from share.cli.main import cli
from share.cli.watch import _last_line
from share.cli.watch import watch as watch_command
from share.errors import ShareError, UsageError, printable
from share.net.http_guard import read_token
from share.runtime.status_server import StatusServer

REPORT = terminal_room.REPORT | {"trouble": []}


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


@pytest.mark.parametrize("address", ["https://a:1", "a:b", "a:99999", "", "[::1"])
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


def test_an_edge_that_loads_its_map_says_so() -> None:
    assert "loading the map: 7 keyframes" in _last_line("x", {"loading": "loading the map: 7 keyframes"}, 0.0)


def test_a_room_without_agents_says_so() -> None:
    with closing(StatusServer("0", lambda: {"agents": {}})) as server:
        assert "no agent has come yet" in watch(server.endpoint, "--once").stdout


@contextmanager
def answering(content: bytes, pause_s: float = 0.0) -> Iterator[tuple[str, list[bytes]]]:
    """Yield the address of a program that answers with `content`, a byte at a time where it pauses, and what
    it was asked."""
    asked: list[bytes] = []
    pieces = [content[i : i + 1] for i in range(len(content))] if pause_s else [content]
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    with connection, suppress(OSError):
                        asked.append(connection.recv(4096))
                        for piece in pieces:
                            connection.sendall(piece)
                            time.sleep(pause_s)

        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{listener.getsockname()[1]}", asked
        listener.shutdown(socket.SHUT_RDWR)


def page(body: bytes) -> bytes:
    return b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body)


def test_a_token_goes_to_no_other_address(tmp_path: Path) -> None:
    token_file = tmp_path / "room.token"
    read_token(token_file)
    with answering(page(b"{}")) as (elsewhere, asked):
        redirection = f"HTTP/1.1 302 Found\r\nLocation: http://{elsewhere}/\r\nContent-Length: 0\r\n\r\n"
        with answering(redirection.encode()) as (address, _):
            assert isinstance(watch(address, "--once", "--http-token", token_file).exception, ShareError)
    assert not asked


def test_a_page_that_drips_is_given_up() -> None:
    from share.cli.terminal_room import EdgeStatus

    with answering(page(b" " * 10_000), pause_s=0.02) as (address, _):
        began_s = time.monotonic()
        with pytest.raises(ShareError):
            EdgeStatus(f"http://{address}/", timeout_s=0.3).report_and_plan()
    assert time.monotonic() - began_s < 5.0


@pytest.mark.parametrize("body", [b"[" * 200_000, b"3", b"{", b"\xff", b'{"agents": NaN}'])
def test_what_is_no_report_is_one_line(body: bytes) -> None:
    with answering(page(body)) as (address, _):
        error = watch(address, "--once").exception
    assert isinstance(error, ShareError)
    assert "no edge's status page" in str(error)


@pytest.mark.parametrize("odd", [{"trouble": {"a": 1}}, {"uptime_s": "x"}, {"merges": [1]}])
def test_an_odd_report_ends_with_one_line_in_a_terminal(odd: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", Terminal())
    monkeypatch.setattr("share.cli.terminal_room.has_room", lambda live: True)
    callback = watch_command.callback
    assert callback is not None
    with closing(served(REPORT | odd)) as server, pytest.raises(ShareError, match="another release"):
        callback(server.endpoint, None, False, False)
