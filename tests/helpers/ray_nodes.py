"""A Ray cluster on this machine whose nodes are processes of their own, each with its object store."""

from __future__ import annotations

import os
import signal
import time
import warnings
from pathlib import Path
from typing import Any

import pytest

_STORE_BYTES = 80 * 2**20


class RayNodes:
    """A head on which no room runs, and nodes that can be killed; until `close`. port: of the head."""

    def __init__(self, cpus: list[int], port: int | None = None) -> None:
        os.environ["RAY_AUTH_MODE"] = "disabled"  # else it makes a token in the home folder
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        os.environ["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cluster_utils = pytest.importorskip(
                "ray.cluster_utils", reason="ray is not installed: pip install 'share-slam[site]'"
            )
        head = {"num_cpus": 0, "object_store_memory": _STORE_BYTES, "include_dashboard": False}
        if port is not None:
            head["gcs_server_port"] = port
        self._cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
        self.nodes = [self.add(one) for one in cpus]

    @property
    def address(self) -> str:
        return str(self._cluster.address)

    def add(self, cpus: int) -> Any:
        return self._cluster.add_node(num_cpus=cpus, object_store_memory=_STORE_BYTES)

    def settle(self, node: Any) -> None:
        """Wait until a node has started the processes that it keeps ready."""
        before = -1.0
        while (used := sum(map(cpu_s, self.pids(node)))) - before > 0.3:
            before = used
            time.sleep(1.5)

    def kill_all(self) -> None:
        for node in [self._cluster.head_node, *self.nodes]:
            self.kill(node)

    def kill(self, node: Any) -> None:
        """Kill all its processes, as when its machine loses power."""
        for pid in self.pids(node):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue

    def pids(self, node: Any) -> list[int]:
        """The processes of a node, and all below them: workers, mappers, solvers."""
        found = [info.process.pid for infos in node.all_processes.values() for info in infos]
        for pid in found:  # grows meanwhile
            found += [child for child in children(pid) if child not in found]
        return found

    def forget(self, node: Any) -> None:
        """Clean up after a killed one."""
        self._cluster.worker_nodes.discard(node)
        for infos in node.all_processes.values():
            for info in infos:
                info.process.wait()

    def close(self) -> None:
        self._cluster.shutdown()


def children(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    try:
        return [int(child) for file in tasks for child in file.read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


def cpu_s(pid: int) -> float:
    """CPU time of a process so far."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pids: list[int]) -> float:
    """What these processes have for themselves, and their part of what they share (PSS)."""
    total = 0
    for pid in pids:
        try:
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        except (FileNotFoundError, ProcessLookupError):
            continue
        total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024
