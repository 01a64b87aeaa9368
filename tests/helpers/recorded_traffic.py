"""What agents and edges of earlier releases said to each other, as tools/record_wire.py kept it."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import msgspec

FOLDER = Path(__file__).resolve().parents[1] / "wire" / "recorded"
VERSIONS = sorted(int(path.name[5:].split(".")[0]) for path in FOLDER.glob("wire-*.msgpack.gz"))


@dataclass(frozen=True)
class Message:
    """edge: which of the edges that ran. way: up to it or down from it; peer: the agent's routing id."""

    edge: str
    way: str
    peer: bytes
    t_ns: int
    frames: list[bytes]

    @property
    def code(self) -> int:
        return int(msgspec.msgpack.decode(self.frames[0])[1])


def traffic(version: int) -> list[Message]:
    """All messages of the release with this wire version, in the order in which they passed."""
    data = gzip.decompress((FOLDER / f"wire-{version}.msgpack.gz").read_bytes())
    return [Message(**fields) for fields in msgspec.msgpack.decode(data)["messages"]]


def map_file(version: int, folder: Path) -> Path:
    """A copy of the map that its edge wrote."""
    path = folder / f"map-{version}.sqlite"
    path.write_bytes(gzip.decompress((FOLDER / f"map-{version}.sqlite.gz").read_bytes()))
    return path
