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
