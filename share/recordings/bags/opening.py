"""Open a file of ROS messages: MCAP, a ROS 2 bag in MCAP or SQLite, a ROS 1 bag."""

from __future__ import annotations

from pathlib import Path

from share.recordings.bags.ros1_bag import Ros1Bag
from share.recordings.bags.ros2_bag import SplitBag, SqliteBag, bag_metadata, is_sqlite_bag
from share.recordings.mcap.file import McapFile
from share.recordings.message_file import MessageFile


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
