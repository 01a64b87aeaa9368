"""Joining a Ray cluster, and placing rooms in it: with a made-up `ray`."""

from __future__ import annotations

import socket
import sys
import threading
import types
from typing import Any

import pytest

from share.errors import ShareError, UsageError
from share.runtime import ray_cluster
from share.runtime.ray_cluster import RayCluster
from share.runtime.remote_room import WorkerLostError


class RayError(Exception): ...


class GetTimeoutError(RayError): ...


class Actor:
    """As of `ray.remote(RoomHost).remote()`."""

    def __init__(self, host: Any, node: str, world: World) -> None:
        self.node, self.world, self._host = node, world, host
        self.call = types.SimpleNamespace(remote=lambda room, request: (self, room, request))
        self.drop = types.SimpleNamespace(remote=world.dropped.append)
        world.hosts.append(node)

    def answer(self, room: int, request: bytes) -> bytes:
        if self.node in self.world.errors:
            raise RayError(self.world.errors[self.node])
        return self._host.call(room, request)


class World:
    """A cluster. errors: by node, what its actors say."""

    def __init__(self) -> None:
        self.servers: list[socket.socket] = []
        self.nodes: list[dict[str, Any]] = []
        self.dropped: list[int] = []
        self.hosts: list[str] = []  # nodes on which one was started
        self.errors: dict[str, str] = {}
        self.init_error: BaseException | None = None
        self.joined: dict[str, Any] = {}

    def add(self, name: str, cpus: float, is_listening: bool = True) -> None:
        server = socket.create_server(("127.0.0.1", 0))
        node = {"NodeID": name, "Alive": True, "NodeManagerAddress": "127.0.0.1"}
        resources = {"CPU": cpus} if cpus else {}
        self.nodes.append(node | {"NodeManagerPort": server.getsockname()[1], "Resources": resources})
        if is_listening:
            self.servers.append(server)
        else:
            server.close()

    def module(self) -> types.ModuleType:
        ray: Any = types.ModuleType("ray")
        ray.exceptions = types.ModuleType("ray.exceptions")
        ray.exceptions.RayError, ray.exceptions.GetTimeoutError = RayError, GetTimeoutError
        ray.init, ray.nodes, ray.shutdown = self.init, lambda: self.nodes, lambda: None
        ray.get = lambda ref, timeout=None: ref[0].answer(*ref[1:])
        ray.remote = lambda cls: types.SimpleNamespace(options=lambda **how: self._options(cls, **how))
        return ray

    def _options(self, cls: Any, *, scheduling_strategy: Any, **how: Any) -> Any:
        assert how["max_restarts"] == 0
        return types.SimpleNamespace(remote=lambda: Actor(cls(), scheduling_strategy, self))

    def init(self, **where: Any) -> None:
        if self.init_error is not None:
            raise self.init_error
        self.joined = where


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Any:
    world = World()
    ray = world.module()
    strategies: Any = types.ModuleType("ray.util.scheduling_strategies")
    strategies.NodeAffinitySchedulingStrategy = lambda node, soft: node
    util: Any = types.ModuleType("ray.util")
    for name, module in (
        ("ray", ray),
        ("ray.exceptions", ray.exceptions),
        ("ray.util", util),
        ("ray.util.scheduling_strategies", strategies),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(ray_cluster.importlib.util, "find_spec", lambda name: object())
    yield world
    for server in world.servers:
        server.close()


def test_rooms_go_where_most_places_are_free(world: World) -> None:
    world.add("head", 0)
    world.add("small", 1)
    world.add("large", 2)
    cluster = RayCluster("auto")
    workers = [cluster.start_worker() for _ in range(8)]
    assert sorted(world.hosts) == ["large", "small"]  # one on each machine with places
    assert [one._machine.id for one in workers].count("large") == 6
    for one in workers[:4]:
        one.kill()
        one.kill()  # counts once
    assert world.dropped == [0, 1, 2, 3]
    again = [cluster.start_worker() for _ in range(8)]
    assert len(again) == 8
    with pytest.raises(ShareError, match=r"no machine .* has room for it: 2 with 12 places in all"):
        cluster.start_worker()


def test_a_machine_that_is_dead_is_left_out_before_ray_knows(world: World) -> None:
    world.add("dead", 8, is_listening=False)
    world.add("alive", 1)
    cluster = RayCluster("auto")
    assert {cluster.start_worker()._machine.id for _ in range(4)} == {"alive"}


def test_a_machine_without_share_is_said_and_another_taken(world: World) -> None:
    world.add("bare", 8)
    world.errors["bare"] = "The actor failed to import ... ModuleNotFoundError: No module named 'share'"
    cluster = RayCluster("auto")
    with pytest.raises(ShareError, match=r"machine 127\.0\.0\.1 lacks share: install SHARE on it"):
        cluster.start_worker()
    world.add("whole", 1)
    assert cluster.start_worker()._machine.id == "whole"


def test_what_a_dead_actor_says_is_a_line(world: World) -> None:
    world.add("one", 1)
    cluster = RayCluster("auto")
    worker = cluster.start_worker()
    for said, line in (
        ("The actor died because its node has died. Node Id: 0a5e", "is gone"),
        ("The actor 18 is unavailable: RpcError: Socket closed rpc_code: 14", "does not answer"),
        ("The actor died unexpectedly", "has lost the room's process"),
    ):
        world.errors["one"] = said
        with pytest.raises(WorkerLostError, match=f"^{line}"):
            worker.call("greet")
    del world.errors["one"]
    cluster.start_worker()
    assert world.hosts == ["one", "one"]  # it was started anew, once
    worker.kill()
    with pytest.raises(WorkerLostError, match="has ended the room"):
        worker.call("greet")


@pytest.mark.parametrize("host", ["a..b", 70 * "a", "\udcff"])
def test_a_host_that_cannot_be_looked_up_is_refused(host: str) -> None:
    with pytest.raises(UsageError, match="is no name of a machine"):
        ray_cluster._check_address(f"{host}:6379")


@pytest.mark.parametrize("address", ["", "here", "ray://a:1", "a:0", "a:99999", ":6379", "a:6379/x"])
def test_what_is_no_address_is_refused(world: World, address: str) -> None:
    with pytest.raises(UsageError, match="give HOST:PORT, auto or local"):
        RayCluster(address)
    assert not world.joined


@pytest.mark.usefixtures("world")
def test_a_server_that_is_not_there_or_is_another_is_said_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"

        def serve() -> None:
            with server.accept()[0] as connection:
                connection.recv(100)
                connection.sendall(b"SSH-2.0-OpenSSH_9.2\r\n")

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(UsageError, match="what answers there is not Ray"):
            RayCluster(address)
        thread.join()
    with pytest.raises(ShareError, match=r"cannot be reached: .*ray start --head"):
        RayCluster(address)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ConnectionError("Could not find any running Ray instance. Please"), "no Ray runs on this machine"),
        (
            RuntimeError(
                "Version mismatch: The cluster was started with:\n    Ray: 2.40.0\n    Python: 3.12.1\n"
                "This process on node 10.0.0.2 was started with:\n    Ray: 2.60.0\n    Python: 3.11.2\n"
            ),
            "another version: there and here Ray 2.40.0, Python 3.12.1, Ray 2.60.0, Python 3.11.2",
        ),
        (Exception("The current node\ntimed out"), "The current node timed out"),
    ],
)
def test_a_cluster_that_cannot_be_joined_is_a_line(world: World, error: BaseException, line: str) -> None:
    world.init_error = error
    with pytest.raises(ShareError) as raised:
        RayCluster("auto")
    assert str(raised.value).startswith(f"--ray auto: {line}")
    assert "\n" not in str(raised.value)


def test_without_ray_it_is_said_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"--ray: ray is not installed: pip install 'share-slam\[site\]'"):
        RayCluster("auto")
