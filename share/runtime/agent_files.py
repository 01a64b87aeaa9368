"""What `share agent --out DIR` leaves behind.

Poses are written as they come, under a `.partial` name that a crash leaves behind readable; a run
that ends gives them their real name. One TUM file holds poses of one map only: when the agent is
taken into another map, what it wrote before is kept as `map.before-N.tum`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from share.files.line_file import LineFile, Spool
from share.files.writing import atomic_write, check_replaceable, claim
from share.metrics.frame_log import RunLog
from share.recordings.trajectory import format_pose
from share.types import F64

_MOST_MAPS = 100  # an edge that moves an agent from map to map must not fill a folder
_NAMES = ("odom.tum", "map.tum", "latency.csv", "report.json")


def _claim(out: Path) -> int:
    for name in _NAMES:
        check_replaceable(out / name)
    return claim(out)


class AgentFiles:
    """odom.tum, map.tum, latency.csv and report.json of one run in `out`; nothing where that is None.

    `say` is told of a disk that is full. Raises UsageError if another run is writing there.
    """

    def __init__(self, out: Path | None, say: Callable[[str], None]) -> None:
        self._out, self._say = out, say
        self._open: dict[str, LineFile] = {}
        self._map_id: str | None = None
        self._maps_before = 0
        self._too_many_said = False
        self._claim = None if out is None else _claim(out)
        self._remove_partials()  # of a run that was killed
        self.frames = Spool(None if out is None else out / "latency.csv.partial", say)  # of the run's log

    def odom(self, stamp_ns: int, T_odom_body: F64) -> None:
        self._line("odom.tum", stamp_ns, T_odom_body)

    def map(self, stamp_ns: int, T_map_body: F64, map_id: str) -> None:
        if self._map_id not in (None, map_id) and "map.tum" in self._open and self._out is not None:
            self._open.pop("map.tum").close()
            self._keep_map(self._out / "map.tum.partial")
        self._map_id = map_id
        self._line("map.tum", stamp_ns, T_map_body)

    def _keep_map(self, partial: Path) -> None:
        """Poses of the map before, but not of more than _MOST_MAPS."""
        if self._maps_before < _MOST_MAPS:
            self._maps_before += 1
            partial.rename(partial.with_name(f"map.before-{self._maps_before}.tum.partial"))
        elif not self._too_many_said:
            self._too_many_said = True
            self._say(f"taken into more than {_MOST_MAPS} maps: poses of those between are not kept")

    def finish(self, log: RunLog, report: dict[str, Any]) -> None:
        """Close what is open and give everything its name; the report also says in which map map.tum is: a
        correction after the last frame does not change that. Raises ShareError if the disk was full: then the
        report, too, is of a part of the frames only."""
        files = list(self._open.values())
        for file in files:
            file.check()  # what there is stays, as .partial
        self.frames.check()
        self._close()
        if self._out is None:
            return
        for old in self._out.glob("map.before-*.tum"):
            old.unlink()  # of an earlier run in the same folder
        for name in ("odom.tum", "map.tum"):
            partial = self._out / f"{name}.partial"
            partial.touch()  # no pose at all is an empty file, not an older run's
            partial.replace(self._out / name)
        for number in range(1, self._maps_before + 1):
            name = f"map.before-{number}.tum"
            (self._out / f"{name}.partial").replace(self._out / name)
        atomic_write(self._out / "latency.csv", "".join(log.csv()))
        (self._out / "latency.csv.partial").unlink(missing_ok=True)
        report = report | {"map_tum": self._map_id}
        atomic_write(self._out / "report.json", json.dumps(report, indent=2) + "\n")

    def discard(self) -> None:
        """The run came to nothing: leave no trace of it."""
        self._close()
        self.frames.close()
        self._remove_partials()

    def release(self) -> None:
        """Give the folder free for another run."""
        self._close()
        self.frames.close()
        if self._claim is not None:
            os.close(self._claim)
            self._claim = None

    def _line(self, name: str, stamp_ns: int, T: F64) -> None:
        if self._out is None:
            return
        if name not in self._open:
            self._open[name] = LineFile(self._out / f"{name}.partial", self._say)
        self._open[name].write(format_pose(stamp_ns, T))

    def _remove_partials(self) -> None:
        if self._out is not None:
            for partial in (*self._out.glob("*.tum.partial"), *self._out.glob("latency.csv.partial")):
                partial.unlink()

    def _close(self) -> None:
        for file in self._open.values():
            file.close()
        self._open.clear()
