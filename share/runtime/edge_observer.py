"""Who looks on while an edge runs, such as the live room: is shown what happens, and holds nothing up."""

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
        """The newest pose of each present run, by run key, twenty times a second."""

    def add_report(self, report: Mapping[str, Any]) -> None:
        """edge.json as it is now, twice a second."""


class NoObserver(EdgeObserver):
    """Nobody looks on."""

    def begin_session(self, map_file: Path | None, known: Sequence[RestoredRun]) -> None: ...

    def add_effect(self, effect: EdgeEffect) -> None: ...

    def add_result(self, result: MapperResult) -> None: ...

    def add_poses(self, poses: Mapping[str, PoseUpdate]) -> None: ...

    def add_report(self, report: Mapping[str, Any]) -> None: ...
