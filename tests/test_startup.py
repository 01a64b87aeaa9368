"""How processes are set up."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys

import pytest

CHILD = """
import json
from share import startup

startup.prepare_process()


def rss_mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 1e6


kept = [bytearray(2000) for _ in range(30_000)][::100]  # a little of it, scattered
heap, found = startup.HeapTrimmer(), []
for now_s in (0.0, 59.0, 61.0, 62.0):
    heap.trim_if_due(now_s)
    found.append(rss_mb())
print(json.dumps(found))
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_free_heap_memory_is_returned_once_a_minute() -> None:
    done = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, check=True)
    at_first, before, after, later = json.loads(done.stdout)
    assert before == pytest.approx(at_first, abs=1)
    assert after < before - 40
    assert later == pytest.approx(after, abs=1)


CLOSED = """
import os, sys
from share.startup import open_standard_streams
open_standard_streams()
first = os.open(os.devnull, os.O_RDONLY)
print("x" * 10_000, file=sys.stderr)
print("x", flush=True)
sys.stdin.read()
os.write(first_fd := int(sys.argv[1]), str(first).encode())
"""


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_standard_streams_are_no_files_of_others(closed: str, tmp_path) -> None:
    script, said = tmp_path / "child.py", tmp_path / "said"
    script.write_text(CLOSED)
    command = f"exec '{sys.executable}' '{script}' 7 7>'{said}' {closed}"
    done = subprocess.run(["sh", "-c", command], stdin=subprocess.DEVNULL, capture_output=True, check=False)
    assert done.returncode == 0
    assert int(said.read_text()) > 2
