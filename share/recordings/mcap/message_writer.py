"""Write ROS 2 messages to an MCAP file, with their schemas and channels."""

from __future__ import annotations

from typing import IO, Any

from share.recordings.mcap import ros_messages as ros

CHUNK_BYTES = 256 * 1024
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
LATCHED = {  # transient local: a player sends it to late subscribers too
    "offered_qos_profiles": "- {history: 1, depth: 1, reliability: 1, durability: 1, "
    f"deadline: {_FOREVER}, lifespan: {_FOREVER}, liveliness: 1, "
    f"liveliness_lease_duration: {_FOREVER}, avoid_ros_namespace_conventions: false}}\n"
}


class MessageWriter:
    """Writes messages in CDR, in chunks of at most 256 kB or one message."""

    def __init__(self, file: IO[bytes]) -> None:
        from mcap.writer import Writer

        self._writer = Writer(file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="ros2", library="share")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[str, int] = {}

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        self._writer.add_metadata(name, values)

    def write(self, topic: str, message: Any, log_ns: int, latched: bool = False) -> None:
        """Write a message at its log time. latched: for late subscribers too."""
        self.write_encoded(topic, message.__msgtype__, ros.encode(message), log_ns, latched)

    def write_encoded(self, topic: str, kind: str, data: bytes, log_ns: int, latched: bool = False) -> None:
        """Write a message of type `kind`, given in CDR."""
        if topic not in self._channels:
            if kind not in self._schemas:
                definition = ros.message_definition(kind)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition)
            metadata = LATCHED if latched else {}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], metadata)
        number = self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(self._channels[topic], log_ns, data, log_ns, number)

    def flush(self) -> None:
        """End the chunk."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()
