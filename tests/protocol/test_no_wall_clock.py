"""No module of a live run reads the wall clock: setting it changes nothing."""

import ast
from pathlib import Path

import pytest

SHARE = Path(__file__).resolve().parents[2] / "share"
LIVE = (
    *("cameras", "devices", "files", "mapping", "net", "odometry", "protocol", "recordings"),
    *("runtime", "scheduling", "sensors", "store", "vision", "wire"),
)
WALL = {"time.time", "time.time_ns", "time.localtime", "time.gmtime", "time.ctime", "datetime.now"}
WALL |= {"datetime.utcnow", "datetime.today", "date.today", "datetime.datetime.now", "time.clock_settime"}
WALL |= {"time.CLOCK_REALTIME"}

# What the wall clock is for: to compare it between machines (`share sync`), and a date for a person.
ALLOWED = {
    "net/udp.py": {"time.time_ns"},  # of `share sync`: stamps of datagrams
    "devices/time_client.py": {"time.time_ns"},
    "devices/time_server.py": {"time.time_ns"},
    "runtime/imu_bias_store.py": {"time.time_ns", "time.gmtime"},  # how old the bias of an earlier run is
    "store/map_store.py": {"time.time"},  # when a keyframe came, for `edge.keep_days`
    "runtime/mapper_process.py": {"time.time"},
    "runtime/room_keeper.py": {"time.time"},
    "runtime/robot_bridge.py": {"time.time_ns"},  # how long a datagram has waited: the kernel stamps it so
    "runtime/doctor.py": {"time.time"},  # how old a calibration's file is
}


def asked(source: str) -> set[str]:
    """Names by which a module reads the wall clock."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute):
            found |= {ast.unparse(node)} & WALL
        elif isinstance(node, ast.ImportFrom) and node.module == "time":
            found |= {f"time.{name.name}" for name in node.names} & WALL
    return found


@pytest.mark.long
def test_the_wall_clock_is_read_only_where_listed():
    found = {}
    for package in LIVE:
        for file in sorted((SHARE / package).rglob("*.py")):
            if names := asked(file.read_text()):
                found[str(file.relative_to(SHARE))] = names
    assert found == ALLOWED


def test_the_scan_finds_a_use_of_the_wall_clock():
    assert asked("import time\nx = time.time()") == {"time.time"}
    assert asked("from time import time_ns") == {"time.time_ns"}
    assert asked("from datetime import datetime\nx = datetime.now()") == {"datetime.now"}
    assert asked("import time\nx = time.monotonic()") == set()
