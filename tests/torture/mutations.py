"""Mutations of recorded messages: what an encoder of ours would never write, and what it just might."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from typing import Any

from keyframe_mutations import is_keyframe, mutate_keyframe
from raw_wire import Message, Raw, pack, unpack

INTS = [
    0,
    1,
    -1,
    2**31,
    2**32,
    2**53,
    5 * 10**7,
    10**9,
    10**12,
    2**62,
    2**63 - 2,
    2**63 - 1,
    -(2**63),
    2**64 - 1,
]
FLOATS = [0.0, -0.0, 1e-308, 5e-324, 1e-9, 1e3, 1e6, 1e12, 1e30, 1e153, 1e155, 1e300, 1.7e308, -1.7e308]
FLOATS += [math.nan, math.inf, -math.inf]
TEXTS = [
    "",
    "x",
    "a" * 57,
    "b" * 58,
    "c" * 64,
    "d" * 65,
    "e" * 512,
    "f" * 3000,
    "../../etc",
    "a/b",
    "\x00",
    "\n",
]
TEXTS += ["‮evil", "é" * 64, "\ud7ff" * 64, "<script>alert(1)</script>", "%s%n{0}", "OK", "LOST", "robot"]
DTYPES = ["<f8", "<f4", "<i8", "|u1", "|O", ">f8", "<U9999", "", "\x00"]
DIMS = [0, 1, 3, 4, 32, 2000, 2001, 8192, 2**31, 2**63 - 1, 2**64 - 1, -1]
LEFT_BE = 0.04  # the share that is a replay as it was
MOST_PARTS = 17  # in a message: with more, its connection ends
BEYOND = 0.0005  # the share that may have more


def mutate(draw: random.Random, message: Message) -> Message:
    """One to three mutations of a copy."""
    if draw.random() < LEFT_BE:
        return list(message)
    changes = _OF_KEYFRAMES if is_keyframe(message) else _ALL
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        message = draw.choice(changes)(draw, message)
    return message if draw.random() < BEYOND else message[:MOST_PARTS]


# ------------------------------------------------------------------ of bytes


def _flip(draw: random.Random, message: Message) -> Message:
    parts = list(message)
    i = draw.randrange(len(parts))
    if parts[i]:
        data = bytearray(parts[i])
        for _ in range(draw.choice((1, 1, 2, 8))):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        parts[i] = bytes(data)
    return parts


def _cut(draw: random.Random, message: Message) -> Message:
    parts = list(message)
    i = draw.randrange(len(parts))
    n = len(parts[i])
    most = draw.choice((0, n // 2, max(0, n - 1)))
    parts[i] = parts[i][:most] if draw.random() < 0.6 else parts[i] + bytes(draw.choice((1, 8, 300)))
    return parts


def _parts(draw: random.Random, message: Message) -> Message:
    parts = list(message)
    match draw.randrange(6):
        case 0 if len(parts) > 1:
            del parts[draw.randrange(len(parts))]
        case 1:
            parts.insert(draw.randrange(len(parts) + 1), draw.choice(parts))
        case 2:
            parts += [b""] * draw.choice((1, 7, 8, 9, 50))
        case 3:
            draw.shuffle(parts)
        case 4:
            parts.insert(0, b"")
        case _:
            parts[draw.randrange(len(parts))] = b""
    return parts


def _noise(draw: random.Random, message: Message) -> Message:
    return [draw.randbytes(draw.choice((0, 1, 5, 40, 4096, 4097))), *message[1:]]


# ------------------------------------------------------------------ of the header's fields


def _header(
    change: Callable[[random.Random, list[Any]], None],
) -> Callable[[random.Random, Message], Message]:
    def mutated(draw: random.Random, message: Message) -> Message:
        try:
            fields = unpack(message[0])
            if not isinstance(fields, list) or len(fields) < 4:
                return message
            change(draw, fields)
            return [pack(fields), *message[1:]]
        except (ValueError, LookupError, TypeError, AttributeError):
            return message  # mutated beyond what has fields

    return mutated


def _extreme(draw: random.Random, old: object) -> object:
    if isinstance(old, bool) or draw.random() < 0.15:
        return draw.choice((None, True, False, [], {}, b"\x00", -1, 1e308, "x"))
    if isinstance(old, int):
        return draw.choice(
            (draw.choice(INTS), old + draw.choice((-1, 1, 2, 63, 64, 65)), 1 << draw.randrange(63))
        )
    if isinstance(old, float):
        return draw.choice((draw.choice(FLOATS), 10.0 ** draw.randrange(-300, 308)))
    if isinstance(old, str):
        return draw.choice(TEXTS)
    return draw.choice(INTS)


def _scalar(draw: random.Random, fields: list[Any]) -> None:
    at: Any = fields[2]
    while at:
        key = draw.choice(list(at)) if isinstance(at, dict) else draw.randrange(len(at))
        if isinstance(at[key], list | dict) and at[key] and draw.random() < 0.8:
            at = at[key]
            continue
        at[key] = _extreme(draw, at[key])
        return


def _shape(draw: random.Random, fields: list[Any]) -> None:
    if not fields[3]:
        fields[3] = [["<f8", [draw.choice(DIMS)]]]
        return
    spec = draw.choice(fields[3])
    match draw.randrange(4):
        case 0:
            spec[0] = draw.choice(DTYPES)
        case 1 if spec[1]:
            spec[1][draw.randrange(len(spec[1]))] = draw.choice(DIMS)
        case 2:
            spec[1] = [draw.choice(DIMS)] * draw.choice((0, 1, 2, 3, 32, 300))
        case _:
            fields[3] = fields[3] * draw.choice((0, 2, 40))


def _form(draw: random.Random, fields: list[Any]) -> None:
    match draw.randrange(5):
        case 0:
            fields[1] = draw.choice((0, *range(1, 24), *range(31, 52), 255, 2**31, -1))
        case 1:
            fields[0] = draw.choice((0, 1, 3, 5, 255, 2**63, -1, "4", None))
        case 2:
            fields[2] = Raw(_nest(draw.choice((10, 900, 1500)), draw.choice((b"\x91", b"\x81\x01"))))
        case 3:
            fields[2] = [*fields[2], *[0] * draw.choice((1, 200))] if draw.random() < 0.5 else fields[2][:-1]
        case _:
            fields += [0] * draw.choice((1, 5, 100))


def _nest(depth: int, head: bytes) -> bytes:
    return head * depth + b"\xc0"


# ------------------------------------------------------------------ of arrays: valid form, wild values


def _array_of(message: Message, shape: list[int]) -> list[int]:
    try:
        specs = unpack(message[0])[3]  # type: ignore[index]
        return [i + 1 for i, spec in enumerate(specs) if spec[1] == shape and i + 1 < len(message)]
    except (ValueError, LookupError, TypeError):
        return []


def _far(draw: random.Random, message: Message) -> Message:
    """A pose stays rigid, but is somewhere else: up to the end of the number range."""
    found = [i for i in _array_of(message, [4, 4]) if len(message[i]) == 128]
    parts = list(message)
    for i in found if draw.random() < 0.5 else found[:1]:
        rows = list(struct.unpack("<16d", parts[i]))
        for at in draw.choice(((3,), (7,), (3, 7, 11))):
            rows[at] = draw.choice((1, -1)) * draw.choice((*FLOATS[2:14], 10.0 ** draw.randrange(308)))
        parts[i] = struct.pack("<16d", *rows)
    return parts


def _turned(draw: random.Random, message: Message) -> Message:
    """A pose stays rigid, but is turned by half a turn, or a little out of true."""
    parts = list(message)
    for i in _array_of(message, [4, 4]):
        if len(parts[i]) == 128:
            rows = list(struct.unpack("<16d", parts[i]))
            stretch = draw.choice((-1.0, 1 + 4e-4, 1 - 4e-4, 1.01))
            for at in (0, 4, 8, 1, 5, 9):
                rows[at] *= stretch
            parts[i] = struct.pack("<16d", *rows)
    return parts


def _cov(draw: random.Random, message: Message) -> Message:
    parts = list(message)
    for i in _array_of(message, [6, 6]):
        size = draw.choice((0.0, 1e-300, 1e-30, 1e-12, 1e6, 1e11, 1e12, 1e13, 1e300, math.nan))
        ranks = draw.choice((6, 6, 5, 1, 0))
        parts[i] = struct.pack("<36d", *[size * (r % 7 == 0 and r // 7 < ranks) for r in range(36)])
    return parts


def _value(draw: random.Random, message: Message) -> Message:
    """Extreme numbers at some places of an array."""
    parts = list(message)
    if len(parts) < 2:
        return parts
    i = draw.randrange(1, len(parts))
    form, size = draw.choice((("<d", 8), ("<f", 4)))
    if len(parts[i]) >= size:
        data = bytearray(parts[i])
        for _ in range(draw.choice((1, 1, 4, 32))):
            at = size * draw.randrange(len(data) // size)
            value = draw.choice(FLOATS)
            if form == "<f" and math.isfinite(value):
                value = max(-3.4e38, min(3.4e38, value))
            data[at : at + size] = struct.pack(form, value)
        parts[i] = bytes(data)
    return parts


_ALL = (_flip, _cut, _parts, _noise, _far, _far, _turned, _cov, _value, _value)
_ALL += tuple(_header(change) for change in (_scalar, _scalar, _scalar, _shape, _form))
_OF_KEYFRAMES = (*_ALL, *[mutate_keyframe] * len(_ALL))
