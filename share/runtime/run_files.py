"""The files that `share agent --out DIR` and `share edge --out DIR` write.

Poses of an agent are written as they come, to `.partial` files that stay readable after a crash; a run that
ends renames them. One TUM file holds poses in one map only: when the agent moves to another map, its earlier
poses are kept as `map.previous-N.tum`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from share.files.line_file import LineFile, Spool
from share.files.locks import lock_folder
from share.files.writing import atomic_write, check_replaceable
from share.metrics.frame_log import LineStore, RunLog
from share.recordings.trajectory import format_pose
from share.runtime.output_writer import OutputWriter
from share.types import F64

_MAX_MAPS = 100  # an edge that keeps moving an agent between maps must not fill the folder


def _lock_folder(out: Path, *file_names: str) -> int:
    """Lock `out` for this process; return the handle. Raises UsageError if a file cannot be replaced or
    another run writes there."""
    for name in file_names:
        check_replaceable(out / name)
    return lock_folder(out)


class AgentFiles:
    """odom.tum, map.tum, latency.csv and report.json of one run in `out`; none if `out` is None.

    `notify` is called when the disk is full. Raises UsageError if another run is writing to `out`.
    """

    def __init__(self, out: Path | None, notify: Callable[[str], None]) -> None:
        self._out, self._notify = out, notify
        self._open_files: dict[str, LineFile] = {}
        self._map_id: str | None = None
        self._previous_maps = 0
        self._has_warned = False
        names = ("odom.tum", "map.tum", "latency.csv", "report.json")
        self._lock_handle = None if out is None else _lock_folder(out, *names)
        self._remove_partials()  # left by a killed run
        self.frame_lines = Spool(None if out is None else out / "latency.csv.partial", notify)

    def write_odom_pose(self, stamp_ns: int, T_odom_body: F64) -> None:
        self._append_pose("odom.tum", stamp_ns, T_odom_body)

    def write_map_pose(self, stamp_ns: int, T_map_body: F64, map_id: str) -> None:
        if self._map_id not in (None, map_id) and "map.tum" in self._open_files and self._out is not None:
            self._open_files.pop("map.tum").close()
            self._archive_map(self._out / "map.tum.partial")
        self._map_id = map_id
        self._append_pose("map.tum", stamp_ns, T_map_body)

    def _archive_map(self, partial: Path) -> None:
        """Keep the poses in the previous map, for at most _MAX_MAPS maps."""
        if self._previous_maps < _MAX_MAPS:
            self._previous_maps += 1
            partial.rename(partial.with_name(f"map.previous-{self._previous_maps}.tum.partial"))
        elif not self._has_warned:
            self._has_warned = True
            self._notify(f"moved between more than {_MAX_MAPS} maps: poses in further ones are not kept")

    def finish(self, log: RunLog, report: dict[str, Any]) -> None:
        """Close all files, rename them and write the report, with the map id of map.tum as `map_tum_id`.

        A correction after the last frame does not change that id. Raises ShareError if the disk was full
        and poses or frame lines are missing.
        """
        files = list(self._open_files.values())
        for file in files:
            file.check()  # on failure the .partial files stay
        self.frame_lines.check()
        self._close_files()
        if self._out is None:
            return
        for old in self._out.glob("map.previous-*.tum"):
            old.unlink()  # from an earlier run in this folder
        for name in ("odom.tum", "map.tum"):
            partial = self._out / f"{name}.partial"
            partial.touch()  # without poses: an empty file, not the one of an earlier run
            partial.replace(self._out / name)
        for number in range(1, self._previous_maps + 1):
            name = f"map.previous-{number}.tum"
            (self._out / f"{name}.partial").replace(self._out / name)
        atomic_write(self._out / "latency.csv", "".join(log.csv_chunks()))
        (self._out / "latency.csv.partial").unlink(missing_ok=True)
        report = report | {"map_tum_id": self._map_id}
        atomic_write(self._out / "report.json", json.dumps(report, indent=2) + "\n")

    def discard(self) -> None:
        """Remove all files of a failed run."""
        self._close_files()
        self.frame_lines.close()
        self._remove_partials()

    def release(self) -> None:
        """Unlock the folder."""
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


class BackgroundLines:
    """Lines of a `RunLog`, written by an `OutputWriter`; `read` waits for it."""

    def __init__(self, lines: LineStore, writer: OutputWriter) -> None:
        self._lines, self._writer = lines, writer

    def write(self, line: str) -> None:
        self._writer.submit(partial(self._lines.write, line))

    def read(self) -> Iterable[str]:
        """Raises ShareError if the disk does not answer."""
        self._writer.wait()
        return self._lines.read()


class EdgeFiles:
    """events.jsonl and edge.json of one run in `out`, written by a thread; none if `out` is None.

    `notify` is called, from any thread, when the disk does not take them. Raises UsageError if another run is
    writing to `out`.
    """

    def __init__(self, out: Path | None, notify: Callable[[str], None]) -> None:
        self._out = out
        if out is not None:
            self._lock_handle = _lock_folder(out, "edge.json", "events.jsonl")
            self._events = LineFile(out / "events.jsonl", notify)
            self._writer = OutputWriter(out, notify)

    @property
    def trouble(self) -> str | None:
        """The present trouble of the disk; None without one."""
        return None if self._out is None else self._writer.trouble

    def write_event(self, fields: dict[str, Any]) -> None:
        if self._out is not None:
            self._writer.submit(partial(self._events.write, json.dumps(fields)))

    def finish(self, report: dict[str, Any]) -> None:
        """Write edge.json, at most for a few seconds. Call `check` after that."""
        if self._out is not None:
            self._writer.submit(self._events.close)
            text = json.dumps(report, indent=2) + "\n"
            self._writer.submit(partial(atomic_write, self._out / "edge.json", text))
            self._writer.stop()

    def check(self) -> None:
        """Unlock the folder. Raises ShareError if the report or an event could not be written."""
        if self._out is not None:
            self._writer.check()
            os.close(self._lock_handle)
            self._events.check()
