"""Recorded traffic and reproducers: one file form for both, a JSON object a line.

The first line says where it comes from; each further line is a message: its peer's routing id (hex), which
way it went, and its parts (base64).
"""

from __future__ import annotations

import base64
import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from raw_wire import Message, pack, unpack

KINDS = {
    "hello": 1,
    "pose": 2,
    "keyframe": 3,
    "evaluation": 4,
    "ping": 5,
    "bye": 6,
    "frame": 7,
    "welcome": 16,
    "refused": 17,
    "ack": 18,
    "correction": 19,
    "rate": 20,
    "pong": 21,
    "tracked": 22,
    "client": 32,
    "put": 33,
    "remove": 34,
    "seen": 35,
    "goto": 36,
    "cancel": 37,
    "state": 38,
    "place": 39,
    "receipt": 48,
    "object": 49,
    "objects": 50,
}
UP = tuple(name for name, code in KINDS.items() if code < 16 or 32 <= code < 48)
DOWN = tuple(name for name in KINDS if name not in UP)
NAMES = {code: name for name, code in KINDS.items()}


@dataclass(frozen=True)
class Recorded:
    """One message as it went by."""

    peer: bytes
    up: bool
    parts: Message

    @property
    def kind(self) -> str:
        """By its header, or "broken"."""
        try:
            header = unpack(self.parts[0])
            return NAMES.get(header[1], "broken")  # type: ignore[index]
        except (ValueError, LookupError, TypeError):
            return "broken"


def write(path: Path, messages: Iterable[Recorded], about: dict[str, Any]) -> None:
    lines = [json.dumps(about)]
    for m in messages:
        parts = [base64.b64encode(part).decode() for part in m.parts]
        lines.append(json.dumps({"peer": m.peer.hex(), "up": m.up, "kind": m.kind, "parts": parts}))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def read(path: Path) -> tuple[dict[str, Any], list[Recorded]]:
    about, *rows = map(json.loads, path.read_text().splitlines())
    return about, [
        Recorded(bytes.fromhex(row["peer"]), row["up"], [base64.b64decode(part) for part in row["parts"]])
        for row in rows
    ]


class Corpus:
    """Recorded messages by kind. A kind that was not recorded is made up by docs/lookup/wire.md."""

    def __init__(self, path: Path) -> None:
        self.by_kind: dict[str, list[Message]] = defaultdict(list)
        for message in read(path)[1]:
            self.by_kind[message.kind].append(message.parts)
        version = unpack(self.by_kind["ping"][0][0])[0]  # type: ignore[index]
        for kind, made in _made_up(version).items():
            self.by_kind[kind] = self.by_kind[kind] or [made]

    def hello(self, name: str, identity: bytes, kind: str = "hello") -> Message:
        """A valid one, of another name and run. kind: hello of an agent, or client."""
        header, *arrays = self.by_kind[kind][0]
        fields = unpack(header)
        scalars = fields[2]  # type: ignore[index]
        scalars[0], scalars[2 if kind == "hello" else 1] = name, int.from_bytes(identity, "big", signed=True)
        return [pack(fields), *arrays]


def _made_up(version: int) -> dict[str, Message]:
    import struct

    eye = struct.pack("<16d", *[float(i % 5 == 0) for i in range(16)])
    pose = [["<f8", [4, 4]]]
    image = ["|u1", [8, 8]]
    arrays = [image, ["|u1", [0]], ["<f4", [0]], ["<i8", [1]], ["<f8", [1, 3]], ["<f8", [1, 3]]]
    return {
        "bye": [pack([version, 6, [], []])],
        "evaluation": [pack([version, 4, [0, 50.0, 3.0, 9.0, 5.0, 8.0, 0.3], []])],
        "frame": [
            pack([version, 7, [10, 0, 0], arrays]),
            bytes(64),
            b"",
            b"",
            bytes(8),
            bytes(24),
            bytes(24),
        ],
        "client": [pack([version, 32, ["eve", 77, False, True, True], []])],
        "put": [pack([version, 33, [9, 3, "cube", "ann-1234/0"], pose]), eye],
        "remove": [pack([version, 34, [10, 3], []])],
        "seen": [pack([version, 35, [1, 2], []])],
        "goto": [pack([version, 36, [11, "bot", "", "ann-1234/0", 1.0, 2.0, 0.5, False], []])],
        "cancel": [pack([version, 37, [12, "bot", ""], []])],
        "state": [pack([version, 38, [11, None, "ann", "1.20 m to go", False, False], []])],
        "place": [pack([version, 39, [None, "ann-1234/0", 1.0, 2.0, 0.5, ""], []])],
        "receipt": [pack([version, 48, [9, ""], []])],
        "object": [pack([version, 49, [1, 2, 3, "cube", "ann", "ann-1234/0", ""], pose]), eye],
        "objects": [pack([version, 50, [1, 2, [3], [2]], []])],
        "refused": [pack([version, 17, ["no"], []])],
        "rate": [pack([version, 20, [3.0, True, None, 20], []])],
        "tracked": [pack([version, 22, [0, 10, "OK", False, False, True, None], pose]), eye],
        "correction": [
            pack([version, 19, ["ann-1234/0", 1, 0, 0], [*pose, ["<f8", [6, 6]]]]),
            eye,
            struct.pack("<36d", *[1e-6 * (i % 7 == 0) for i in range(36)]),
        ],
    }
