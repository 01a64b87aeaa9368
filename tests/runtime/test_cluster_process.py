"""A Ray cluster that is joined by a process of its own, which ends with the cluster's head: a made-up Ray."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from share.errors import ShareError, UsageError
from share.runtime import cluster_process
from share.runtime.cluster_process import ClusterProcess
from share.runtime.remote_room import WorkerLostError

_PACKAGE = Path(__file__).parents[1] / "helpers" / "made_up_ray"
_LIMIT_S = 30.0


@pytest.fixture
def head(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that is there while the cluster's head is."""
    head = tmp_path / "head"
    head.touch()
    monkeypatch.setenv("MADE_UP_HEAD", str(head))
    monkeypatch.syspath_prepend(_PACKAGE)  # spawned processes take it over
    monkeypatch.setattr(cluster_process, "_GONE_S", 4.0)
    monkeypatch.setattr(cluster_process, "_REJOIN_S", 0.2)
    return head


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def cluster(head: Path, said: list[str]) -> Iterator[ClusterProcess]:
    cluster = ClusterProcess("auto", said.append)
    yield cluster
    cluster.close()


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + _LIMIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_rooms_are_called_through_the_process(cluster: ClusterProcess, tmp_path: Path) -> None:
    first, second = cluster.start_worker(), cluster.start_worker()
    assert first.machine == "machine 127.0.0.1"
    opened = first.call("open_map", tmp_path / "a.sqlite", timeout_s=10.0)
    assert opened.writable
    second.call("open_map", tmp_path / "b.sqlite")
    with pytest.raises(ShareError, match=r"locked|another"):
        second.call("open_map", tmp_path / "a.sqlite")
    with pytest.raises(ShareError, match="no machine of the Ray cluster has room for it"):
        cluster.start_worker()
    first.kill()
    first.kill()
    with pytest.raises(WorkerLostError, match="has ended the room"):
        first.call("greet")
    cluster.start_worker().call("greet")


def test_a_cluster_that_cannot_be_joined_is_a_line(head: Path) -> None:
    with pytest.raises(UsageError, match="give HOST:PORT, auto or local"):
        ClusterProcess("nowhere")
    head.unlink()
    with pytest.raises(ShareError, match="no Ray runs on this machine"):
        ClusterProcess("auto")


def test_a_head_that_is_gone_costs_the_rooms_and_is_joined_again(
    cluster: ClusterProcess, head: Path, said: list[str]
) -> None:
    worker, reasons = cluster.start_worker(), list[str]()

    def call() -> None:
        try:
            worker.call("greet")  # no time-out: Ray waits for its head
        except WorkerLostError as error:
            reasons.append(str(error))

    head.unlink()
    waiting = threading.Thread(target=call)
    waiting.start()
    waiting.join(_LIMIT_S)
    assert reasons == ["cannot be reached: the Ray cluster is gone"]
    until(lambda: said)
    assert said == ["the Ray cluster is gone, and all rooms on it; it is joined again as soon as it is back"]
    with pytest.raises(ShareError, match=r"the Ray cluster is gone"):
        cluster.start_worker()
    with pytest.raises(WorkerLostError):
        worker.call("greet")
    head.touch()
    until(lambda: said[1:] == ["the Ray cluster is joined again"])
    cluster.start_worker().call("greet")


def test_a_process_that_ray_has_ended_is_started_again(cluster: ClusterProcess, said: list[str]) -> None:
    os.kill(cluster._child.process.pid or 0, signal.SIGKILL)
    until(lambda: len(said) == 2)
    assert said[1] == "the Ray cluster is joined again"
    cluster.start_worker().call("greet")


def test_it_is_left_at_once_while_its_head_is_gone(head: Path) -> None:
    cluster = ClusterProcess("auto")
    head.unlink()
    began = time.monotonic()
    cluster.close()
    assert time.monotonic() - began < 15.0  # Ray itself waits for a minute
