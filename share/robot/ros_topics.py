"""Readers and writers of ROS 2 topics in one namespace of a DDS domain. Needs cyclonedds."""

from __future__ import annotations

from typing import Any

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
)
from cyclonedds.core import DDSException, InstanceState, Qos, ReadCondition, SampleState, ViewState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from share.errors import TransportError

_MAX_FOUND = 1000
_MAX_TAKEN = 64
_BLOCK = duration(milliseconds=0)  # a full writer drops


class RosTopics:
    """One participant. configuration: XML of Cyclone. Raises TransportError without a network."""

    def __init__(self, domain: int, namespace: str, configuration: str) -> None:
        self._namespace = f"{namespace}/" if namespace else ""
        try:
            self._domain = Domain(domain, configuration)
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise TransportError(
                f"DDS domain {domain}: cannot be joined ({error}); is the network up, and each --peer right?"
            ) from None
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._participants = BuiltinDataReader(self._participant, BuiltinTopicDcpsParticipant)
        alive = ViewState.Any | SampleState.Any | InstanceState.Alive
        self._alive_publications = ReadCondition(self._publications, alive)
        self._alive_participants = ReadCondition(self._participants, alive)

    def writer(self, name: str, kind: Any, latched: bool = False, depth: int = 1, prefix: str = "rt") -> Any:
        """Return a reliable writer. latched: late readers get the last message too."""
        qos = _qos(True, latched, depth)
        return DataWriter(self._participant, self._topic(name, kind, prefix), qos=qos)

    def reader(
        self,
        name: str,
        kind: Any,
        *,
        reliable: bool = True,
        latched: bool = False,
        depth: int = 10,
        prefix: str = "rt",
        own: bool = True,
    ) -> Any:
        """Return a reader. own: whether it hears this process too."""
        qos = _qos(reliable, latched, depth)
        if not own:
            qos += Qos(Policy.IgnoreLocal.Participant)
        return DataReader(self._participant, self._topic(name, kind, prefix), qos=qos)

    def _topic(self, name: str, kind: Any, prefix: str) -> Any:
        return Topic(self._participant, f"{prefix}/{self._namespace}{name}", kind)

    def namespaces_with(self, name: str) -> list[str]:
        """Return the other namespaces in which there is a publisher of topic `name`; "/" for none."""
        found = set()
        for one in self._publications.read(_MAX_FOUND, self._alive_publications):
            if one.topic_name.startswith("rt/") and one.topic_name.endswith(f"/{name}"):
                namespace = one.topic_name.removeprefix("rt/").removesuffix(name).strip("/")
                found.add(namespace or "/")
        return sorted(found - {self._namespace.strip("/") or "/"})

    def has_participants(self) -> bool:
        """Return whether there is any other participant on the domain."""
        return len(self._participants.read(2, self._alive_participants)) > 1

    def close(self) -> None:
        """Leave the domain."""
        del self._alive_publications, self._alive_participants, self._publications, self._participants
        del self._participant, self._domain


def taken(reader: Any, kind: type) -> list[Any]:
    """Return the messages that have come, at most 64. What cannot be decoded is left out, with what
    came in the same moment: anybody on the domain can write."""
    try:
        return [message for message in reader.take(_MAX_TAKEN) if isinstance(message, kind)]
    except Exception:  # of many types: struct, Unicode, recursion, DDS
        return []


def _qos(reliable: bool, latched: bool, depth: int) -> Any:
    return Qos(
        Policy.Reliability.Reliable(_BLOCK) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
