"""A Ray cluster, joined by a process of its own: Ray ends the process that has joined a minute after the
cluster's head is gone, and waits for the head in calls that take no timeout.

loop, threads -> ClusterProcess -> manager's socket -> child: RayCluster -> Ray
child: looks for machines -> pipe -> ClusterProcess: the head answers
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.managers import BaseManager
from typing import Any

from share.errors import ShareError, brief_reason
from share.runtime.ray_cluster import RayCluster, RayWorker
from share.runtime.remote_room import WorkerLostError
from share.runtime.remote_worker import read_answer, request_bytes
from share.spawning import SPAWN_CONTEXT

_GONE_S = 20.0  # without an answer of the cluster's head: it is gone
_REJOIN_S = 3.0  # between tries to join again
_END_S = 5.0  # for leaving the cluster in good order
_GONE = "the Ray cluster is gone"


class _Cluster:
    """In the child: the cluster, and its rooms by number. on_answer: see `RayCluster`."""

    def __init__(self, on_answer: Callable[[], None]) -> None:
        self._on_answer = on_answer
        self._cluster: RayCluster | None = None
        self._workers: dict[int, RayWorker] = {}  # by room

    def join(self, address: str) -> None:
        """Join. Raises UsageError, ShareError."""
        self._cluster = RayCluster(address, self._on_answer)

    def start_worker(self) -> tuple[int, str]:
        """Begin a room: its number and its machine. Raises ShareError."""
        assert self._cluster is not None
        worker = self._cluster.start_worker()
        self._workers[worker.room] = worker
        return worker.room, worker.machine

    def exchange(self, number: int, request: bytes, timeout_s: float | None) -> bytes:
        """Return a room's answer to a request. Raises WorkerLostError."""
        if (worker := self._workers.get(number)) is None:
            raise WorkerLostError("has ended the room")
        return worker.exchange(request, timeout_s)

    def kill(self, number: int) -> None:
        """End a room. Does not wait."""
        if (worker := self._workers.pop(number, None)) is not None:
            worker.kill()

    def leave(self) -> None:
        if self._cluster is not None:
            self._cluster.close()


class _Manager(BaseManager):
    """Carries calls to `_Cluster`, from each thread on a connection of its own."""


_Manager.register("Cluster")  # in the child with what makes it


def _serve(pipe: Connection) -> None:
    """Run the child: answer calls until it is killed."""
    sending = threading.Lock()

    def tell_front() -> None:
        with sending, contextlib.suppress(OSError):
            pipe.send(None)

    _Manager.register("Cluster", partial(_Cluster, tell_front))
    server = _Manager().get_server()
    pipe.send(server.address)
    server.serve_forever()


@dataclass(frozen=True, eq=False)
class _Child:
    """pipe: something comes whenever the head has answered."""

    process: SpawnProcess
    pipe: Connection
    cluster: Any  # proxy of `_Cluster`

    @classmethod
    def start(cls) -> _Child:
        ours, theirs = SPAWN_CONTEXT.Pipe()
        process = SPAWN_CONTEXT.Process(target=_serve, args=(theirs,), name="cluster")
        try:
            process.start()
            theirs.close()
            manager = _Manager(ours.recv())
            manager.connect()
            return cls(process, ours, manager.Cluster())  # type: ignore[attr-defined]
        except (OSError, EOFError) as error:
            raise ShareError(f"--ray: its process could not be started: {error}") from None

    def is_head_there(self) -> bool:
        """Wait for an answer of the cluster's head. Return whether it came, and the child lives."""
        try:
            if not self.pipe.poll(_GONE_S):
                return False
            self.pipe.recv()
        except (EOFError, OSError):
            return False
        return True

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


class ClusterWorker:
    """One room of a cluster that has been joined by a child."""

    def __init__(self, cluster: Any, number: int, machine: str) -> None:
        self._cluster, self._number, self.machine = cluster, number, machine

    def call(self, method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        """See `WorkerHandle`."""
        request = request_bytes(method, arguments)
        return read_answer(_ask(self._cluster.exchange, self._number, request, timeout_s))

    def kill(self) -> None:
        with contextlib.suppress(ShareError):
            _ask(self._cluster.kill, self._number)


class ClusterProcess:
    """A Ray cluster, from joining it until `close`. If its head is lost, so are all rooms, and it is joined
    again as soon as it is back.

    address: see `RayCluster`. say: gets a line when either happens, from a thread. Raises UsageError,
    ShareError."""

    def __init__(self, address: str, say: Callable[[str], None] = lambda line: None) -> None:
        self._address, self._say = address, say
        self._closing, self._is_joined = threading.Event(), threading.Event()
        self._failure = _GONE
        self._child = _Child.start()
        try:
            self._join()
        except BaseException:
            self._child.kill()
            raise
        self._thread = threading.Thread(target=self._watch, name="cluster", daemon=True)
        self._thread.start()

    def start_worker(self) -> ClusterWorker:
        """Begin a room on the machine with the most free places. Raises ShareError."""
        if not self._is_joined.is_set():
            raise ShareError(self._failure)
        cluster = self._child.cluster
        number, machine = _ask(cluster.start_worker)
        return ClusterWorker(cluster, number, machine)

    def close(self) -> None:
        """Leave the cluster, which ends all rooms."""
        self._closing.set()
        if self._is_joined.is_set():
            leaving = threading.Thread(target=_leave, args=(self._child.cluster,), daemon=True)
            leaving.start()
            leaving.join(_END_S)
        self._child.kill()
        self._thread.join(_END_S)

    def _join(self) -> None:
        """Join by the child that has just started. Raises UsageError, ShareError."""
        _ask(self._child.cluster.join, self._address)
        self._is_joined.set()

    def _watch(self) -> None:
        """Notice that the head is gone, and join again."""
        while not self._closing.is_set():
            if self._child.is_head_there() or self._closing.is_set():
                continue
            self._is_joined.clear()
            self._child.kill()  # ends all calls that wait for it
            self._say(f"{_GONE}, and all rooms on it; it is joined again as soon as it is back")
            while not self._closing.wait(_REJOIN_S):
                if self._rejoin():
                    self._say("the Ray cluster is joined again")
                    break

    def _rejoin(self) -> bool:
        try:
            self._child = _Child.start()
            if self._closing.is_set():
                self._child.kill()
            self._join()
        except Exception as error:
            self._child.kill()
            self._failure = f"{_GONE}: {brief_reason(error)}"
        return self._is_joined.is_set()


def _leave(cluster: Any) -> None:
    with contextlib.suppress(Exception):  # killed meanwhile
        cluster.leave()


def _ask(method: Callable[..., Any], *arguments: Any) -> Any:
    """Return what the child answers. Raises WorkerLostError if it is gone, and what it raises."""
    try:
        return method(*arguments)
    except (OSError, EOFError):
        raise WorkerLostError(f"cannot be reached: {_GONE}") from None
