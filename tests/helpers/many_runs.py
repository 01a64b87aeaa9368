"""Rooms that have known many runs, and how much work something is."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import numpy as np
from helpers.hellos import hello_of

from share.mapping.map_changes import SaveKeyframe, SaveRun, StoredMap
from share.protocol.admission import new_run_key
from share.store.map_store import MapStore
from share.types import Keyframe, View
from share.wire.messages import Hello


def plain_keyframe(id_: int) -> Keyframe:
    """A keyframe at the origin, without a view."""
    reference, T, cov = id_ - 1, np.eye(4), 1e-4 * np.eye(6)
    return Keyframe(id_, reference, id_ * 10**8, T, cov, T, np.zeros(3), 0.0, View.empty(), reference)


@cache
def hellos(count: int, names: int) -> dict[str, Hello]:
    """Hellos of runs by key; the names take turns."""
    out: dict[str, Hello] = {}
    randomness = random.Random(5)
    for k in range(count):
        hello = hello_of(f"n{k % names}", randomness.getrandbits(62))
        out[new_run_key(hello, out)] = hello
    return out


@cache
def stored_map(count: int, names: int) -> StoredMap:
    """A map file's contents with runs of a keyframe each, each a map of its own."""
    changes: list[Any] = []
    for key, hello in hellos(count, names).items():
        changes += [SaveRun(key, hello, ""), SaveKeyframe(key, plain_keyframe(0))]
    with TemporaryDirectory() as folder:
        store = MapStore.open(Path(folder) / "map.sqlite")
        store.write(changes)
        stored = store.load()
        store.close()
    return stored


def work_of(call: Callable[[], Any]) -> int:
    """How many bytecodes a call executes; not what C functions do."""
    count = 0

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count
