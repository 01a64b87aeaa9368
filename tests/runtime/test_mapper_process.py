"""In the mapper's process, one agent's keyframes do not wait for another's."""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.config import Config
from share.mapping.mapper import Mapper
from share.protocol.edge_events import AddKeyframe, AddRun, MapperResult
from share.runtime import mapper_process
from share.runtime.mapper_process import StartMapper, run_mapper
from share.runtime.worker_process import END
from share.types import Keyframe, View

EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))


class NoSolver:
    def __init__(self, *arguments: Any) -> None: ...
    def send(self, step: Any) -> None: ...
    def close(self) -> None: ...


def add(run: str, id: int) -> AddKeyframe:
    T = np.eye(4)
    return AddKeyframe(run, Keyframe(id, id - 1, id, T, 1e-6 * np.eye(6), T, np.zeros(3), 0.0, EMPTY, id - 1))


@pytest.mark.parametrize("ends", [False, True])
def test_an_agent_with_many_keyframes_delays_only_itself(monkeypatch: pytest.MonkeyPatch, ends: bool) -> None:
    """eve has two runs; ann's keyframes come after all of hers."""
    monkeypatch.setattr(mapper_process, "WorkerProcess", NoSolver)
    order: list[str] = []
    add_keyframe = Mapper.add_keyframe

    def record(mapper: Mapper, run: str, *more: Any) -> Any:
        order.append(run)
        return add_keyframe(mapper, run, *more)

    monkeypatch.setattr(Mapper, "add_keyframe", record)
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    inbox.put(StartMapper(Config()))
    for name, run in (("eve", "eve-1"), ("eve", "eve-2"), ("ann", "ann-1")):
        inbox.put(AddRun(run, hello_of(name, 1)))
    for run, count in (("eve-1", 40), ("eve-2", 40), ("ann-1", 3)):
        for k in range(count):
            inbox.put(add(run, k))
    if ends:
        inbox.put(END)
    mapper = threading.Thread(target=run_mapper, args=(inbox, lambda answer: None))
    mapper.start()
    deadline = time.monotonic() + 20
    while len(order) < 83 and time.monotonic() < deadline:
        time.sleep(0.005)
    inbox.put(END)
    mapper.join(20)
    assert len(order) == 83
    assert max(k for k, run in enumerate(order) if run == "ann-1") <= 5


def test_a_failed_keyframe_costs_itself_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapper_process, "WorkerProcess", NoSolver)
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    answers: list[Any] = []
    for message in (
        StartMapper(Config()),
        AddRun("ann-1", hello_of("ann", 1)),
        add("who-1", 0),
        add("ann-1", 0),
        END,
    ):
        inbox.put(message)
    run_mapper(inbox, answers.append)
    events = [one.event for found in answers if isinstance(found, MapperResult) for one in found.map_events]
    assert "step failed" in events
    assert len(events) == 2
