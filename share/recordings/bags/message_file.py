"""A file of ROS messages, by topic: MCAP, a ROS 2 bag in MCAP or SQLite, a ROS 1 bag."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

from share.recordings.bags.ros1_bag import Ros1Bag
from share.recordings.bags.split_bag import SplitBag, bag_metadata
from share.recordings.bags.sqlite_bag import SqliteBag, is_sqlite_bag
from share.recordings.losses import DataLosses
from share.recordings.mcap.file import McapFile, Topic
from share.types import I64


class MessageFile(Protocol):
    """Messages in CDR by topic. Every pass opens the file again."""

    path: Path

    @property
    def topics(self) -> Mapping[str, Topic]: ...

    @property
    def log_times(self) -> Mapping[str, I64]:
        """Sorted log times (N,) ns of each topic's messages."""

    def metadata(self, name: str) -> dict[str, str]:
        """Return the metadata record `name`, or {}."""

    def messages(
        self,
        topics: Iterable[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        losses: DataLosses | None = None,
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, log time, CDR bytes) within [start_ns, end_ns), as good as in order of log time.

        losses: gets what is damaged. Raises DataError if losses is None, or more than 5 % are damaged.
        """


def is_message_file(path: Path) -> bool:
    """Return whether `path` is an MCAP file or a ROS bag."""
    return is_bag(path) or (path.suffix == ".mcap" and path.is_file())


def is_bag(path: Path) -> bool:
    """Return whether `path` is a ROS bag: a folder of ROS 2, its SQLite file, or a file of ROS 1."""
    if path.is_dir():
        return bag_metadata(path) is not None
    return path.is_file() and (path.suffix == ".bag" or is_sqlite_bag(path))


def open_messages(path: Path) -> MessageFile:
    """Open a file for which `is_message_file` holds. Raises UsageError, DataError."""
    if path.is_dir():
        return SplitBag(path, [McapFile(f) if f.suffix == ".mcap" else SqliteBag(f) for f in bag_files(path)])
    if path.suffix == ".bag":
        return Ros1Bag(path)
    return McapFile(path) if path.suffix == ".mcap" else SqliteBag(path)


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a ROS 2 bag, in order. Raises DataError."""
    metadata = bag_metadata(folder)
    assert metadata is not None
    return metadata.files
