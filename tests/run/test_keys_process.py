"""An edge with keys, and agents with and without, as processes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.children import Child, start_agent
from helpers.shell import Done

FRAMES = 20  # of `plain_session`; agents play in real time


Share = Callable[..., Done]


@pytest.fixture
def keys(share: Share) -> Callable[..., str]:
    """`share keys ARGUMENTS --keys FOLDER`: what it prints."""

    def run(folder: Path, *arguments: str) -> str:
        done = share("keys", *arguments, "--keys", folder)
        assert done.code == 0, done.err
        return done.out.strip()

    return run


@pytest.fixture
def recording(plain_session: Path) -> Path:
    return plain_session / "ar1"


class Server:
    """The machine of an edge; nobody is authorized at first."""

    def __init__(self, folder: Path, keys: Callable[..., str]) -> None:
        self.keys, self.out = folder / "server-keys", folder / "edge"
        self.public = keys(self.keys, "generate", "--name", "edge")
        where = ("--bind", "tcp://0.0.0.0:0", "--keys", str(self.keys), "--out", str(self.out))
        self.edge = Child(folder / "edge.log", "edge", *where)
        port = self.edge.wait_for(r"listening on tcp://0\.0\.0\.0:(\d+),")[1]
        self.address = f"tcp://127.0.0.1:{port}"

    def events(self) -> list[dict[str, object]]:
        return [json.loads(line) for line in (self.out / "events.jsonl").read_text().splitlines()]


@pytest.fixture
def server(tmp_path: Path, keys: Callable[..., str]) -> Iterator[Server]:
    server = Server(tmp_path, keys)
    yield server
    server.edge.kill()


@pytest.mark.long
def test_only_an_agent_with_an_authorized_key_connects(
    server: Server, recording: Path, tmp_path: Path, keys: Callable[..., str]
) -> None:
    public = keys(tmp_path / "ann-keys", "generate", "--name", "ann")
    keys(server.keys, "authorize", "ann", public)
    keys(tmp_path / "eve-keys", "generate", "--name", "eve")
    quick = tmp_path / "quick.yaml"
    quick.write_text("agent: {finish_s: 0.2}")  # nobody acknowledges what the other two have
    server_file = tmp_path / "copied.public"
    server_file.write_bytes((server.keys / "edge.public").read_bytes())
    children = {
        "ann": ("--keys", str(tmp_path / "ann-keys"), "--server-key", str(server_file)),
        "eve": ("--keys", str(tmp_path / "eve-keys"), "--server-key", server.public, "--config", str(quick)),
        "bob": ("--config", str(quick)),
    }
    started = {
        name: start_agent(tmp_path, name, recording, server.address, "--frames", f":{FRAMES}", *more)
        for name, more in children.items()
    }
    codes = {name: child.wait(60) for name, child in started.items()}
    assert codes == {"ann": 0, "eve": 1, "bob": 1}
    assert "connected to the edge" in started["ann"].said
    assert (
        "refused: the edge does not know this key; on the edge's machine: share keys authorize eve '"
        in started["eve"].said
    )
    assert "refused: the edge requires keys; give its public key with --server-key" in started["bob"].said
    assert server.edge.interrupt() == 0
    report = json.loads((server.out / "edge.json").read_text())
    assert list(report["agents"]) == ["ann"]
    assert report["agents"]["ann"]["keyframes"] > 0
    assert report["refused_handshakes"] >= 2
    reasons = [str(event["reason"]) for event in server.events() if event["event"] == "connection refused"]
    assert len(reasons) == 2  # each kind once
    assert any("share keys authorize NAME" in reason for reason in reasons)
    for name in ("eve", "bob"):
        outcome = json.loads((tmp_path / name / "report.json").read_text())
        assert (outcome["corrections"], outcome["bytes_down"]) == (0, 0)
        assert outcome["tracked"] == FRAMES  # odometry goes on alone


def test_one_line_each(tmp_path: Path, share: Share) -> None:
    for arguments, said in (
        (
            ("edge", "--bind", "tcp://0.0.0.0:0", "--keys", str(tmp_path)),
            "make one with `share keys generate",
        ),
        (
            ("agent", "x", "--name", "a", "--kind", "ar", "--edge", "tcp://192.0.2.1:5555"),
            "links to other machines need keys; make them with `share keys generate`",
        ),
        (
            ("agent", "x", "--name", "a", "--kind", "ar", "--edge", "tcp://127.0.0.1:1", "--keys", "k"),
            "--keys needs --server-key",
        ),
        (("keys", "authorize", "ann", "nothing", "--keys", str(tmp_path)), "neither a file nor a public key"),
        (("keys", "revoke", "ann", "--keys", str(tmp_path)), "'ann' is not authorized; the list is empty"),
    ):
        done = share(*arguments)
        assert (done.code, done.err.count("\n"), done.out) == (2, 1, "")
        assert said in done.err


def test_keys_by_command(tmp_path: Path, keys: Callable[..., str]) -> None:
    own = keys(tmp_path, "generate", "--name", "edge")
    other = keys(tmp_path / "ann", "generate", "--name", "ann")
    keys(tmp_path, "authorize", "headset", str(tmp_path / "ann" / "ann.public"))
    listed = json.loads(keys(tmp_path, "list", "--json"))
    assert listed == {
        "folder": str(tmp_path),
        "own": {"name": "edge", "public_key": own},
        "authorized": [{"name": "headset", "public_key": other, "agents": ["headset"], "may": []}],
    }
    assert keys(tmp_path, "list").splitlines() == [f"{own}  edge (this machine)", f"{other}  headset"]
    keys(tmp_path, "revoke", "headset")
    assert json.loads(keys(tmp_path, "list", "--json"))["authorized"] == []
