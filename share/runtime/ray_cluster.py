"""Workers of rooms as actors of a Ray cluster. The only module that imports Ray (extra `site`)."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import socket
import threading
from collections import Counter
from dataclasses import dataclass
from typing import Any

from share.errors import ShareError, UsageError, describe_exception, install_hint, printable
from share.runtime.remote_room import WorkerLostError
from share.runtime.remote_worker import RoomWorker, read_answer, request_bytes

_CPUS = 0.25  # of a room that is awake: fifty of five agents are the work of some ten mappers
_CALLS = 4  # at a time: send, receive, write, and one at the end
_START_S = 60.0  # for a worker's process, which imports SHARE
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
        return int(self.cpus / _CPUS)


class RayWorker:
    """An actor with a `RoomWorker`."""

    def __init__(self, ray: Any, cluster: RayCluster, machine: _Machine, actor: Any) -> None:
        self._ray, self._cluster, self._machine, self._actor = ray, cluster, machine, actor
        self._killing = threading.Lock()

    @property
    def machine(self) -> str:
        return f"machine {self._machine.address}"

    def call(self, method: str, *arguments: Any, timeout_s: float | None = None) -> Any:
        """See `WorkerHandle`."""
        errors = self._ray.exceptions
        try:
            answer = self._actor.call.remote(request_bytes(method, arguments))
            answer = self._ray.get(answer, timeout=timeout_s)
        except errors.GetTimeoutError:
            raise WorkerLostError(f"has not answered for {timeout_s:g} s") from None
        except errors.RayError as error:
            raise WorkerLostError(_why_lost(str(error))) from None
        except (OSError, RuntimeError, ValueError) as error:  # the cluster is gone
            raise WorkerLostError(f"cannot be reached: {describe_exception(error)}") from None
        return read_answer(answer)

    def kill(self) -> None:
        with self._killing:
            actor, self._actor = self._actor, _Killed()
        if not isinstance(actor, _Killed):
            self._cluster.release(self._machine)
            with contextlib.suppress(Exception):  # it is gone, or the cluster is
                self._ray.kill(actor)


class _Killed:
    """Stands for an actor that was killed."""

    @property
    def call(self) -> Any:
        raise WorkerLostError("has ended the room")


class RayCluster:
    """A Ray cluster that this process has joined, until `close`. Raises UsageError, ShareError.

    address: HOST:PORT of a running one, of which this machine is part; auto: the one that runs on this
    machine; local: one that is started here, for tries.
    """

    def __init__(self, address: str) -> None:
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
        try:
            ray.init(**where, log_to_driver=False, logging_level="ERROR", configure_logging=False)
        except Exception as error:
            raise ShareError(f"--ray {address}: {_why_not_joined(str(error))}") from None
        self._worker_class = ray.remote(RoomWorker)

    def close(self) -> None:
        """Leave the cluster, which ends all workers."""
        self._ray.shutdown()

    def start_worker(self) -> RayWorker:
        """Start a worker on the machine with the most free places. Raises ShareError."""
        reasons = []
        for machine in self._machines():
            with self._choosing:
                if self._rooms[machine.id] >= machine.places:
                    continue
                self._rooms[machine.id] += 1
            if not _is_reachable(machine.address, machine.port):  # dead, and Ray does not know yet
                self.release(machine)
                continue
            worker = self._start_on(machine)
            try:
                worker.call("greet", timeout_s=_START_S)
                return worker
            except ShareError as error:
                worker.kill()
                reasons.append(f"{worker.machine} {error}")
        raise ShareError("; ".join(reasons) or self._why_full())

    def _start_on(self, machine: _Machine) -> RayWorker:
        options = {
            "num_cpus": _CPUS,
            "max_concurrency": _CALLS,
            "max_restarts": 0,
            "scheduling_strategy": self._on_machine(machine.id, soft=False),
        }
        return RayWorker(self._ray, self, machine, self._worker_class.options(**options).remote())

    def release(self, machine: _Machine) -> None:
        """A worker on this machine has ended."""
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
