"""What the attacks share: where results go, a short session of two walkers, and its traffic as recorded."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import corpus
import harness
import pytest
from relay import Relay

SECONDS = 8


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """$TORTURE_OUT, where `make torture` wants its JSON."""
    folder = os.environ.get("TORTURE_OUT")
    return Path(folder).resolve() if folder else tmp_path_factory.mktemp("results")


@pytest.fixture(scope="session")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ann and bob in the plain room for some seconds; $TORTURE_SESSION may name a session that is there."""
    if ready := os.environ.get("TORTURE_SESSION"):
        return Path(ready).resolve()
    folder = tmp_path_factory.mktemp("session") / "room"
    motions = ("--motion", "ann=walk:", "--motion", "bob=walk:")
    size = ("--seconds", str(SECONDS), "--profile", "d435i:640x480@15", "--out", str(folder))
    subprocess.run(
        [*harness.SHARE, "emulate", "--scene", "plain", *motions, *size],
        check=True, env=harness.ENV, capture_output=True,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def traffic(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that two real agents and an edge said to each other."""
    folder = tmp_path_factory.mktemp("traffic")
    edge = harness.EdgeProgram(folder, harness.Setup(http=False))
    relay = Relay(edge.address, record=True)
    address = relay.start()
    agents = [harness.start_agent(folder, name, session / name, address) for name in ("ann", "bob")]
    with harness.ended(edge, *agents):
        codes = [a.process.wait(120) for a in agents]
        relay.close()
        assert codes == [0, 0], agents[0].said + agents[1].said
        assert edge.interrupt() == 0
    path = folder / "traffic.jsonl"
    corpus.write(path, relay.recorded, {"from": "two agents and an edge"})
    return path


@pytest.fixture
def start_agent() -> Iterator[Callable[..., harness.Program]]:
    """`harness.start_agent`, ended with the test."""
    started: list[harness.Program] = []

    def start(*arguments: object, **how: object) -> harness.Program:
        started.append(harness.start_agent(*arguments, **how))  # type: ignore[arg-type]
        return started[-1]

    yield start
    for program in started:
        if program.running:
            program.kill()
