"""A file of ROS messages in CDR, by topic. `share.recordings.bags.opening` opens any."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.recordings.losses import DataLosses
from share.types import I64

Messages = Iterator[tuple[str, int, bytes]]  # topic, log time ns, CDR bytes
_MIN_NS, _MAX_NS = -(2**63), 2**63 - 1


class Topic(NamedTuple):
    """A topic. kind: ROS message type, e.g. sensor_msgs/msg/Image. channels: their ids in the file."""

    name: str
    kind: str
    channels: tuple[int, ...]


class MessageFile(ABC):
    """Messages by topic. Every pass opens the file again."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    @abstractmethod
    def topics(self) -> Mapping[str, Topic]:
        """Topics in CDR by name."""

    @cached_property
    def log_times(self) -> dict[str, I64]:
        """Sorted log times (N,) ns of each topic's messages."""
        none = np.zeros(0, np.int64)
        return {
            name: np.sort(np.concatenate([none, *self._times(topic)])) for name, topic in self.topics.items()
        }

    def metadata(self, name: str) -> dict[str, str]:
        """Return the metadata record `name`, or {}."""
        return {}

    def messages(
        self,
        topics: Iterable[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        losses: DataLosses | None = None,
    ) -> Messages:
        """Yield messages within [start_ns, end_ns), as good as in order of log time.

        losses: gets what is damaged. Raises DataError if losses is None, or more than 5 % are damaged.
        """
        start, end = _MIN_NS if start_ns is None else start_ns, _MAX_NS if end_ns is None else end_ns
        return self._read([name for name in topics if name in self.topics], start, end, losses)

    def channels(self, topics: Iterable[str]) -> dict[int, str]:
        """Return the ids of the channels of these topics, which it has, with the topic of each."""
        return {id: name for name in topics for id in self.topics[name].channels}

    @abstractmethod
    def _times(self, topic: Topic) -> list[I64]:
        """Return log times ns of a topic's messages, in parts and any order."""

    @abstractmethod
    def _read(self, topics: list[str], start_ns: int, end_ns: int, losses: DataLosses | None) -> Messages:
        """As `messages`, of topics that it has."""
