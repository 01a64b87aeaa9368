"""A simulated room shows a live room what a real edge would."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from helpers.observed_simulation import observed_simulation

from share.config import Config
from share.protocol.edge_events import AddKeyframe, AddRun, EdgeEffect, MapperResult
from share.protocol.peer import RestoredRun
from share.recordings.session import read_session
from share.runtime.edge_observer import EdgeObserver
from share.wire.messages import PoseUpdate


class Seen(EdgeObserver):
    def __init__(self) -> None:
        self.begun = 0
        self.effects: list[EdgeEffect] = []
        self.results: list[MapperResult] = []
        self.poses: list[Mapping[str, PoseUpdate]] = []
        self.reports: list[Mapping[str, Any]] = []

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None:
        self.begun += 1

    def add_effect(self, effect: EdgeEffect) -> None:
        self.effects.append(effect)

    def add_result(self, result: MapperResult) -> None:
        self.results.append(result)

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None:
        self.poses.append(dict(poses))

    def add_report(self, report: Mapping[str, Any]) -> None:
        self.reports.append(report)


@pytest.mark.long
def test_all_that_an_edge_shows_is_shown(plain_session: Path) -> None:
    session, seen, times = read_session(plain_session), Seen(), list[float]()
    observed_simulation(session, Config(), seen).play(2.0, times.append)
    assert seen.begun == 1 and times == pytest.approx([0.05 * k for k in range(1, 41)])
    assert len(seen.poses) == 40 and len(seen.reports) == 4
    assert {one.hello.name for one in seen.effects if isinstance(one, AddRun)} == set(session.agents)
    assert any(isinstance(one, AddKeyframe) for one in seen.effects)
    assert any(one.map_events for one in seen.results)
    assert len(seen.poses[-1]) == 3 and set(seen.reports[-1]["agents"]) == set(session.agents)
