"""Observers of a running edge, such as the live room: they see what happens, and delay nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from share.protocol.edge_events import EdgeEffect, MapperResult
from share.protocol.peer import RestoredRun
from share.wire.messages import PoseUpdate


class EdgeObserver(Protocol):
    """Called from the edge's loop. No method may wait or raise."""

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None:
        """A session starts with what a map file holds. known: its runs."""

    def add_effect(self, effect: EdgeEffect) -> None: ...

    def add_result(self, result: MapperResult) -> None: ...

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None:
        """The newest pose of each present run, by run key: as soon as one may have come, and now and then."""

    def add_report(self, report: Mapping[str, Any]) -> None:
        """edge.json as it is now, twice a second."""


class EdgeObservers(EdgeObserver):
    """Shows all of some observers, perhaps none, what happens."""

    def __init__(self, *observers: EdgeObserver) -> None:
        self._observers = observers

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None:
        for one in self._observers:
            one.begin_session(map_file, known)

    def add_effect(self, effect: EdgeEffect) -> None:
        for one in self._observers:
            one.add_effect(effect)

    def add_result(self, result: MapperResult) -> None:
        for one in self._observers:
            one.add_result(result)

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None:
        for one in self._observers:
            one.add_poses(poses)

    def add_report(self, report: Mapping[str, Any]) -> None:
        for one in self._observers:
            one.add_report(report)
