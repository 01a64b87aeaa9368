"""The last release as real processes with this one, in both directions."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from helpers.children import Child, start_agent, start_edge

from share.wire.codec import WIRE_VERSION

LAST, LAST_VERSION = "f2e709f", 4  # the commit of the last release, and its wire version
ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def last_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its source, as git knows it."""
    command = ["git", "-C", str(ROOT), "archive", LAST]
    try:
        archive = subprocess.run(command, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip(f"the source of the last release is not here: no git, or its history lacks {LAST}")
    folder = tmp_path_factory.mktemp("last")
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    return folder


@pytest.fixture
def of_last_release(last_release: Path, monkeypatch: pytest.MonkeyPatch):
    """Children that are started within `with` are of the last release."""

    class Within:
        def __enter__(self) -> None:
            self.patch = pytest.MonkeyPatch()
            self.patch.setenv("PYTHONPATH", str(last_release))
            code = "import share.wire.codec as c; print(c.VERSION)"
            found = subprocess.check_output([sys.executable, "-c", code], cwd=last_release, text=True)
            assert int(found) == LAST_VERSION

        def __exit__(self, *_: object) -> None:
            self.patch.undo()

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return Within()


def odometry(folder: Path, name: str) -> int:
    return len((folder / name / "odom.tum").read_text().splitlines())


def test_an_agent_of_the_last_release_is_asked_to_upgrade(
    of_last_release, plain_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    edge, address = start_edge(tmp_path)
    with of_last_release:
        old = start_agent(tmp_path, "ann", plain_session / "ar1", address)
    assert old.wait(60) == 2
    line = f"(wire {WIRE_VERSION}), this agent speaks wire {LAST_VERSION}: upgrade the agent"
    assert "share: the edge refuses 'ann': this edge is SHARE" in old.said
    assert line in old.said and "Traceback" not in old.said
    new = start_agent(tmp_path, "bob", plain_session / "ar2", address)
    assert new.wait(60) == 0, new.said
    assert edge.interrupt() == 0
    assert line in edge.said and "Traceback" not in edge.said


def test_an_agent_whose_edge_is_upgraded_goes_on_alone(
    of_last_release, plain_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with of_last_release:
        edge, address = start_edge(tmp_path / "before")
        old = start_agent(tmp_path, "ann", plain_session / "ar1", address)
    old.wait_for("connected to the edge")
    edge.kill()
    edge, _ = start_edge(tmp_path / "after", address)
    refused = old.wait_for("upgrade the agent; tracking continues without the edge")
    assert refused and old.wait(60) == 0
    assert odometry(tmp_path, "ann") == 45
    assert edge.interrupt() == 0


def test_an_agent_says_that_the_edge_is_of_the_last_release(
    of_last_release, plain_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with of_last_release:
        edge, address = start_edge(tmp_path)
    agent = start_agent(tmp_path, "ann", plain_session / "ar1", address)
    agent.wait(60)
    line = f"the edge speaks wire {LAST_VERSION}, this SHARE"
    assert (
        agent.said.count(line) == 1 and "upgrade the edge; tracking continues without the edge" in agent.said
    )
    assert "Traceback" not in agent.said
    assert odometry(tmp_path, "ann") == 45
    doctor = Child(tmp_path / "doctor.log", "doctor", "--edge", address)
    doctor.wait(60)
    assert f"{line}" in doctor.said and "upgrade the edge" in doctor.said
    assert edge.process.poll() is None
    edge.process.send_signal(signal.SIGINT)
    edge.wait(20)
