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
from share.files.writing import atomic_write, check_replaceable, lock_folder
from share.metrics.frame_log import RunLog
from share.recordings.trajectory import format_pose
from share.types import F64

_MAX_MAPS = 100  # an edge that moves an agent from map to map must not fill a folder
_FILE_NAMES = ("odom.tum", "map.tum", "latency.csv", "report.json")


def _lock_folder(out: Path) -> int:
    for name in _FILE_NAMES:
        check_replaceable(out / name)
    return lock_folder(out)


class AgentFiles:
    """odom.tum, map.tum, latency.csv and report.json of one run in `out`; nothing where that is None.

    `notify` is told of a disk that is full. Raises UsageError if another run is writing there.
    """

    def __init__(self, out: Path | None, notify: Callable[[str], None]) -> None:
        self._out, self._notify = out, notify
        self._open_files: dict[str, LineFile] = {}
        self._map_id: str | None = None
        self._previous_maps = 0
        self._has_warned = False
        self._lock_handle = None if out is None else _lock_folder(out)
        self._remove_partials()  # of a run that was killed
        self.frame_lines = Spool(
            None if out is None else out / "latency.csv.partial", notify
        )  # of the run's log

    def write_odom_pose(self, stamp_ns: int, T_odom_body: F64) -> None:
        self._append_pose("odom.tum", stamp_ns, T_odom_body)

    def write_map_pose(self, stamp_ns: int, T_map_body: F64, map_id: str) -> None:
        if self._map_id not in (None, map_id) and "map.tum" in self._open_files and self._out is not None:
            self._open_files.pop("map.tum").close()
            self._archive_map(self._out / "map.tum.partial")
        self._map_id = map_id
        self._append_pose("map.tum", stamp_ns, T_map_body)

    def _archive_map(self, partial: Path) -> None:
        """Poses of the map before, but not of more than _MOST_MAPS."""
        if self._previous_maps < _MAX_MAPS:
            self._previous_maps += 1
            partial.rename(partial.with_name(f"map.before-{self._previous_maps}.tum.partial"))
        elif not self._has_warned:
            self._has_warned = True
            self._notify(f"taken into more than {_MAX_MAPS} maps: poses of those between are not kept")

    def finish(self, log: RunLog, report: dict[str, Any]) -> None:
        """Close what is open and give everything its name; the report also says in which map map.tum is: a
        correction after the last frame does not change that. Raises ShareError if the disk was full: then the
        report, too, is of a part of the frames only."""
        files = list(self._open_files.values())
        for file in files:
            file.check()  # what there is stays, as .partial
        self.frame_lines.check()
        self._close_files()
        if self._out is None:
            return
        for old in self._out.glob("map.before-*.tum"):
            old.unlink()  # of an earlier run in the same folder
        for name in ("odom.tum", "map.tum"):
            partial = self._out / f"{name}.partial"
            partial.touch()  # no pose at all is an empty file, not an older run's
            partial.replace(self._out / name)
        for number in range(1, self._previous_maps + 1):
            name = f"map.before-{number}.tum"
            (self._out / f"{name}.partial").replace(self._out / name)
        atomic_write(self._out / "latency.csv", "".join(log.csv_chunks()))
        (self._out / "latency.csv.partial").unlink(missing_ok=True)
        report = report | {"map_tum": self._map_id}
        atomic_write(self._out / "report.json", json.dumps(report, indent=2) + "\n")

    def discard(self) -> None:
        """The run came to nothing: leave no trace of it."""
        self._close_files()
        self.frame_lines.close()
        self._remove_partials()

    def release(self) -> None:
        """Give the folder free for another run."""
        self._close_files()
        self.frame_lines.close()
        if self._lock_handle is not None:
            os.close(self._lock_handle)
            self._lock_handle = None

    def _append_pose(self, name: str, stamp_ns: int, T: F64) -> None:
        if self._out is None:
            return
        if name not in self._open_files:
            self._open_files[name] = LineFile(self._out / f"{name}.partial", self._notify)
        self._open_files[name].write(format_pose(stamp_ns, T))

    def _remove_partials(self) -> None:
        if self._out is not None:
            for partial in (*self._out.glob("*.tum.partial"), *self._out.glob("latency.csv.partial")):
                partial.unlink()

    def _close_files(self) -> None:
        for file in self._open_files.values():
            file.close()
        self._open_files.clear()
