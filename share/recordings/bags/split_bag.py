"""The folder of a ROS 2 bag: metadata.yaml, and the bag in one file or several, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from share.errors import ConfigError, DataError, UsageError
from share.files.reading import path_inside
from share.files.yaml_file import read_yaml
from share.recordings.bags import METADATA
from share.recordings.losses import DataLosses
from share.recordings.mcap.file import Topic
from share.types import I64

if TYPE_CHECKING:
    from share.recordings.bags.message_file import MessageFile

_TOP_KEY = "rosbag2_bagfile_information"
_SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}  # by storage_identifier
_MAX_FILES = 1000


class BagMetadata(NamedTuple):
    """What metadata.yaml says. files: of the bag, in order."""

    storage: str
    compression: str
    files: list[Path]


def bag_metadata(folder: Path) -> BagMetadata | None:
    """Return what a folder's metadata.yaml says; None if it is no ROS 2 bag's. Raises DataError, UsageError
    for a bag that is not read."""
    path = folder / METADATA
    if not path.is_file():
        return None
    try:
        top = read_yaml(path)
        if _TOP_KEY not in top:
            return None
        info = top.section(_TOP_KEY)
        storage, compression = info.text("storage_identifier"), info.text("compression_format", "")
        names = info.get("relative_file_paths")
    except ConfigError as error:
        raise DataError(str(error)) from None
    if storage not in _SUFFIXES:
        raise UsageError(f"{path}: storage '{storage:.40}' is not read; known: {', '.join(_SUFFIXES)}")
    if compression:
        raise UsageError(
            f"{folder}: is compressed ({compression:.40}); convert it with "
            "`ros2 bag convert`, or record without --compression-mode (MCAP compresses by itself)"
        )
    if not isinstance(names, list) or not 0 < len(names) <= _MAX_FILES:
        raise DataError(f"{path}: relative_file_paths: expected 1 to {_MAX_FILES} names of files")
    return BagMetadata(storage, compression, [_bag_file(folder, str(name), storage) for name in names])


def _bag_file(folder: Path, name: str, storage: str) -> Path:
    """Return a bag's file; up to ROS 2 Foxy its name begins with that of the folder. Raises DataError."""
    where = str(folder / METADATA)
    path = path_inside(folder, name, where)
    if not path.is_file():
        path = path_inside(folder, Path(name).name, where)
    if path.suffix != _SUFFIXES[storage] or not path.is_file():
        raise DataError(f"{where}: {name:.200} is missing; copy the bag again")
    return path


class SplitBag:
    """The messages of several files, which follow each other in time."""

    def __init__(self, path: Path, files: Sequence[MessageFile]) -> None:
        self.path = path
        self._files = sorted(files, key=_first_ns)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Topics by name. Raises DataError if files differ on a topic's type."""
        out: dict[str, Topic] = {}
        for file in self._files:
            for name, topic in file.topics.items():
                first = out.setdefault(name, topic)
                if first.kind != topic.kind:
                    raise DataError(
                        f"{self.path}: {name} is {first.kind} in one file, {topic.kind} in another"
                    )
        return out

    @cached_property
    def log_times(self) -> Mapping[str, I64]:
        none = np.zeros(0, np.int64)
        return {
            name: np.sort(np.concatenate([file.log_times.get(name, none) for file in self._files]))
            for name in self.topics
        }

    def metadata(self, name: str) -> dict[str, str]:
        return next((found for file in self._files if (found := file.metadata(name))), {})

    def messages(
        self,
        topics: Iterable[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        losses: DataLosses | None = None,
    ) -> Iterator[tuple[str, int, bytes]]:
        """As `MessageFile.messages`, file after file."""
        names = list(topics)
        for file in self._files:
            yield from file.messages(names, start_ns, end_ns, losses)


def _first_ns(file: MessageFile) -> int:
    return min((int(times[0]) for times in file.log_times.values() if len(times)), default=0)
