"""Hosts of rooms as actors of a Ray cluster, one on each machine. The only module that imports Ray (extra
`site`)."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import logging
import os
import re
import socket
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from share.errors import ShareError, UsageError, describe_exception, install_hint, printable
from share.runtime.remote_room import WorkerLostError
from share.runtime.remote_worker import RoomHost, read_answer, request_bytes

_CPUS = 0.25  # of a room that is awake: fifty of five agents are the work of some ten mappers
_CALLS = 4  # at a time: send, receive, write, and one at the end
_MAX_PLACES = 64  # of a machine, whose host relays all messages
_START_S = 60.0  # for a host's process, which imports SHARE
_LOOK_S = 2.0  # between looks for machines that have joined
_END_S = 5.0  # for the thread, at the end
_PROBE_S = 1.0  # for a connection to a machine
_LOCAL_STORE_BYTES = 100 * 2**20  # for objects in flight, of a cluster that is started here
_HTTP2_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0\4\0\0\0\0\0"  # with empty settings
_SETTINGS_FRAME = 4


@dataclass(frozen=True)
class _Machine:
    id: str
    address: str
    port: int  # of Ray's process on it
    cpus: float

    @property
    def places(self) -> int:
        return min(int(self.cpus / _CPUS), _MAX_PLACES)


class RayWorker:
    """One room of a `RoomHost`, which is an actor. room: its number, of all in the cluster."""

    def __init__(self, ray: Any, cluster: RayCluster, machine: _Machine, host: Any, room: int) -> None:
        self._ray, self._cluster, self._machine = ray, cluster, machine
        self._host, self.room = host, room
        self._ending = threading.Lock()
        self._is_ended = False

    @property
    def machine(self) -> str:
        return f"machine {self._machine.address}"

    def call(self, method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        """See `WorkerHandle`."""
        return read_answer(self.exchange(request_bytes(method, arguments), timeout_s))

    def exchange(self, request: bytes, timeout_s: float | None) -> bytes:
        """Return the answer to a request. Raises WorkerLostError."""
        if self._is_ended:
            raise WorkerLostError("has ended the room")
        errors = self._ray.exceptions
        try:
            answer: bytes = self._ray.get(self._host.call.remote(self.room, request), timeout=timeout_s)
        except errors.GetTimeoutError:
            raise WorkerLostError(f"has not answered for {timeout_s:g} s") from None
        except errors.RayError as error:
            self._cluster.forget_host(self._machine, self._host)
            raise WorkerLostError(_why_lost(str(error))) from None
        except (OSError, RuntimeError, ValueError) as error:  # the cluster is gone
            raise WorkerLostError(f"cannot be reached: {describe_exception(error)}") from None
        return answer

    def kill(self) -> None:
        """End the room. Does not wait."""
        with self._ending:
            was_ended, self._is_ended = self._is_ended, True
        if not was_ended:
            self._cluster.release(self._machine)
            with contextlib.suppress(Exception):  # the machine is gone, or the cluster is
                self._host.drop.remote(self.room)


class RayCluster:
    """A Ray cluster that this process has joined, until `close`. Raises UsageError, ShareError.

    address: HOST:PORT of a running one, of which this machine is part; auto: the one that runs on this
    machine; local: one that is started here, for tries. on_answer: called whenever the head has answered.
    Ray ends this process a minute after the head is gone (`share.runtime.cluster_process`).
    """

    def __init__(self, address: str, on_answer: Callable[[], None] = lambda: None) -> None:
        if importlib.util.find_spec("ray") is None:
            raise UsageError(f"--ray: {install_hint('ray', 'site')}")
        _check_address(address)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else it warns on each start
        import ray
        import ray.exceptions
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self._ray, self._on_machine = ray, NodeAffinitySchedulingStrategy
        self._choosing = threading.Lock()
        self._rooms: Counter[str] = Counter()  # by machine
        where: dict[str, Any] = {"address": address}
        if address == "local":
            where |= {"include_dashboard": False, "object_store_memory": _LOCAL_STORE_BYTES}
        logging.getLogger("ray").setLevel(logging.ERROR)
        try:
            ray.init(**where, log_to_driver=False, logging_level="ERROR", configure_logging=False)
        except Exception as error:
            raise ShareError(f"--ray {address}: {_why_not_joined(str(error))}") from None
        self._host_class = ray.remote(RoomHost)
        self._hosts: dict[str, Any] = {}  # by machine
        self._numbers = itertools.count()
        self._on_answer = on_answer
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_hosts, name="room hosts", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the cluster, which ends all rooms."""
        self._closing.set()
        self._thread.join(_END_S)
        self._ray.shutdown()

    def _keep_hosts(self) -> None:
        """Start a host on each machine that joins, before a room needs it."""
        while True:
            with contextlib.suppress(Exception):  # said when a room is to start
                for machine in self._machines():
                    self._on_answer()
                    if machine.places and _is_reachable(machine.address, machine.port):
                        self._host(machine)
            if self._closing.wait(_LOOK_S):
                return

    def _host(self, machine: _Machine) -> Any:
        """Return the host of a machine, which may yet have to start."""
        options = {
            "num_cpus": 0,  # `places` are counted here
            "max_concurrency": _CALLS * machine.places + _CALLS,
            "max_restarts": 0,
        }
        with self._choosing:
            if machine.id not in self._hosts:
                there = self._on_machine(machine.id, soft=False)
                host = self._host_class.options(**options, scheduling_strategy=there).remote()
                self._hosts[machine.id] = host
            return self._hosts[machine.id]

    def forget_host(self, machine: _Machine, host: Any) -> None:
        """Start another one when a room needs it: this one has died."""
        with self._choosing:
            if self._hosts.get(machine.id) is host:
                del self._hosts[machine.id]

    def start_worker(self) -> RayWorker:
        """Begin a room on the machine with the most free places. Raises ShareError."""
        reasons = []
        for machine in self._machines():
            with self._choosing:
                if self._rooms[machine.id] >= machine.places:
                    continue
                self._rooms[machine.id] += 1
            if not _is_reachable(machine.address, machine.port):  # dead, and Ray does not know yet
                self.release(machine)
                continue
            host = self._host(machine)
            worker = RayWorker(self._ray, self, machine, host, next(self._numbers))
            try:
                worker.call("greet", timeout_s=_START_S)
                return worker
            except ShareError as error:
                worker.kill()
                self.forget_host(machine, host)
                reasons.append(f"{worker.machine} {error}")
        raise ShareError("; ".join(reasons) or self._why_full())

    def release(self, machine: _Machine) -> None:
        """A room on this machine has ended."""
        with self._choosing:
            self._rooms[machine.id] -= 1

    def _machines(self) -> list[_Machine]:
        """Return the machines that Ray takes for alive, the one with the most free places first."""
        try:
            nodes = self._ray.nodes()
        except Exception as error:  # the cluster is gone
            raise ShareError(f"Ray cannot be asked: {describe_exception(error)}") from None
        machines = [
            _Machine(
                node["NodeID"],
                node["NodeManagerAddress"],
                node["NodeManagerPort"],
                node["Resources"].get("CPU", 0.0),
            )
            for node in nodes
            if node["Alive"]
        ]
        with self._choosing:
            return sorted(machines, key=lambda one: self._rooms[one.id] - one.places)

    def _why_full(self) -> str:
        machines = [one for one in self._machines() if one.places]
        places = sum(one.places for one in machines)
        return (
            f"no machine of the Ray cluster has room for it: {len(machines)} with {places} places in all, "
            f"{1 / _CPUS:g} for each CPU of `ray start --num-cpus`; add a machine"
        )


def _check_address(address: str) -> None:
    """Refuse what is no address, and where no server of Ray answers: Ray itself would try for minutes."""
    if address in ("auto", "local"):
        return
    host, _, port = address.rpartition(":")
    if not host or not re.fullmatch(r"\d{1,5}", port) or not 0 < int(port) < 65_536 or "/" in host:
        raise UsageError(f"--ray {address}: give HOST:PORT, auto or local")
    try:
        with socket.create_connection((host, int(port)), 3.0) as connection:
            connection.settimeout(3.0)
            connection.sendall(_HTTP2_HELLO)
            head = connection.recv(9)
    except UnicodeError:
        raise UsageError(f"--ray {address}: '{host}' is no name of a machine") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise ShareError(
            f"--ray {address}: cannot be reached: {reason}; start it there with `ray start --head`"
        ) from None
    if len(head) < 9 or head[3] != _SETTINGS_FRAME:
        raise UsageError(f"--ray {address}: what answers there is not Ray")


def _is_reachable(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), _PROBE_S).close()
    except OSError:
        return False
    return True


def _why_not_joined(text: str) -> str:
    """Return the cause in what `ray.init` says."""
    if "Could not find any running Ray" in text:
        return "no Ray runs on this machine; start it with `ray start --head`, or give local for a try"
    if "ersion mismatch" in text:
        versions = re.findall(r"(Ray|Python): (\S+)", text)
        listed = ", ".join(f"{name} {version}" for name, version in versions)
        return f"another version: there and here {listed}; install the same on all machines"
    if "raylet" in text.lower() and "expects this IP address" in text:
        return "this machine is not part of that cluster; run `ray start --address HOST:PORT` on it first"
    return printable(text.replace("\n", " "))[:300] or "Ray does not start"


def _why_lost(text: str) -> str:
    """Return the cause in an error of Ray."""
    if (missing := re.search(r"No module named '([\w.]+)'", text)) is not None:
        return f"lacks {missing[1]}: install SHARE on it as on this machine"
    if "node has died" in text:
        return "is gone"
    if "unavailable" in text:
        return "does not answer"
    cause = re.search(r"(?:died because|due to|The actor is dead because) ([^.\n]*)", text)
    return f"has lost the room's process{': ' + printable(cause[1])[:200] if cause else ''}"
