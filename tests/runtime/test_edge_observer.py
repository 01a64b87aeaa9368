"""Who looks on while an edge runs sees all that happens."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.edge_in_process import Link, Thread
from helpers.edge_sim import Person, Town, walls
from helpers.hellos import hello_of

from share.config import Config
from share.protocol.edge_events import AddKeyframe, AddRun, EdgeEffect, MapperResult, WriteEvent
from share.protocol.peer import RestoredRun
from share.runtime import mapper_process
from share.runtime.edge import EdgeRun
from share.runtime.edge_observer import EdgeObserver
from share.runtime.room_plan import RoomPlan
from share.types import TrackState
from share.wire.messages import PoseUpdate


class Recorder(EdgeObserver):
    def __init__(self) -> None:
        self.sessions: list[Path | None] = []
        self.effects: list[EdgeEffect] = []
        self.results: list[MapperResult] = []
        self.poses: Mapping[str, PoseUpdate] = {}
        self.reports: list[Mapping[str, Any]] = []

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None:
        self.sessions.append(map_file)

    def add_effect(self, effect: EdgeEffect) -> None:
        self.effects.append(effect)

    def add_result(self, result: MapperResult) -> None:
        self.results.append(result)

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None:
        self.poses = poses

    def add_report(self, report: Mapping[str, Any]) -> None:
        self.reports.append(report)


@pytest.mark.long
def test_observers_see_runs_keyframes_decisions_corrections_poses_and_reports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    town = Town([Person("ann", walls(1), 0.0, 11)])
    town.walk(4)
    pose = PoseUpdate(7, TrackState.OK, 0, np.eye(4), 5.0)
    link: Any = Link([(11, hello_of("ann", 11)), *((11, k) for k in town.keyframes("ann")), (11, pose)])
    monkeypatch.setattr(mapper_process, "WorkerProcess", Thread)
    seen, plan = Recorder(), RoomPlan()
    run = EdgeRun(Config(), link, None, lambda fields: None, observers=[seen, plan])
    thread = threading.Thread(target=run.run)
    thread.start()
    try:
        deadline = time.monotonic() + 20
        while not (plan.report()["agents"] and len(seen.reports) > 2):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        run.stop()
        thread.join(20)
    assert seen.sessions == [None]
    (added,) = (one for one in seen.effects if isinstance(one, AddRun))
    assert [one.key for one in seen.effects if isinstance(one, AddKeyframe)] == [added.key] * 4
    assert "agent joined" in {one.fields["event"] for one in seen.effects if isinstance(one, WriteEvent)}
    assert any(map_event.correction for result in seen.results for map_event in result.map_events)
    assert seen.poses[added.key].stamp_ns == 7
    assert seen.reports[-1]["agents"]["ann"]["keyframes"] == 4
    assert plan.report()["agents"]["ann"]["position"] is not None
