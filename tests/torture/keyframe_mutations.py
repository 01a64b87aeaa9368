"""Mutations of recorded keyframes: the image's bytes, its surfaces, poses relative to earlier keyframes.

Most of them keep the form that docs/lookup/wire.md states, so that the decoder passes them: it is what reads
the values afterwards that is tried.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from typing import Any

from raw_wire import Message, pack, unpack

ARRAYS = (
    "T_ref_body", "cov", "T_odom_body", "up", "uv", "points", "descriptors", "jpeg", "surface_uv", "plane",
    "rho_sigma", "ids", "T_earlier_body", "earlier_cov",
)  # fmt: skip
ROW_BYTES = {"uv": 8, "points": 12, "descriptors": 32, "jpeg": 1, "surface_uv": 8, "plane": 12}
ROW_BYTES |= {"rho_sigma": 4, "ids": 8, "T_earlier_body": 64, "earlier_cov": 144}
ID, REFERENCE, STAMP, PREDECESSOR, UP_SIGMA = range(5)  # of the scalars
SIZES = (0, 1, 7, 8, 480, 640, 641, 2000, 8192, 65_500, 65_535)  # px, that a JPEG's header states
PNG = b"\x89PNG\r\n\x1a\n"
FLOATS = (0.0, -0.0, 1e-38, 1e-9, 0.03, 1.0, 50.0, 999.9, 1e3, 1.001e3, 1e5, 1e6, 3e38)
FLOATS = (*FLOATS, *(-value for value in FLOATS), math.nan, math.inf, -math.inf)
IDS = (0, 1, 2, 63, 10**6, 2**31 - 2, 2**31 - 1, 2**31, 2**62, 2**63 - 1, -1, -(2**63))


class Fields:
    """A keyframe's message taken apart: scalars by position, arrays by name."""

    def __init__(self, message: Message) -> None:
        self.head: Any = unpack(message[0])
        self.scalars: list[Any] = self.head[2]
        self.arrays = dict(zip(ARRAYS, message[1:], strict=True))

    def message(self) -> Message:
        """With the number of rows that each array has now."""
        for spec, (name, data) in zip(self.head[3], self.arrays.items(), strict=True):
            if name in ROW_BYTES:
                spec[1] = [len(data) // ROW_BYTES[name], *spec[1][1:]]
        return [pack(self.head), *self.arrays.values()]

    def rows(self, name: str) -> int:
        return len(self.arrays[name]) // ROW_BYTES[name]

    def floats(self, name: str, form: str) -> list[float]:
        data = self.arrays[name]
        return list(struct.unpack(f"<{len(data) // struct.calcsize(form)}{form}", data))

    def set_floats(self, name: str, form: str, values: list[float]) -> None:
        self.arrays[name] = struct.pack(f"<{len(values)}{form}", *values)


Change = Callable[[random.Random, Fields], None]


def is_keyframe(message: Message) -> bool:
    """Of the present form: with an image and spans, or empty ones."""
    return len(message) == 1 + len(ARRAYS)


def mutate_keyframe(draw: random.Random, message: Message) -> Message:
    """One mutation of a keyframe; other messages, and what is one no more, as they are."""
    try:
        fields = Fields(message)
        draw.choice(_ALL)(draw, fields)
        return fields.message()
    except (ValueError, LookupError, TypeError, AttributeError, struct.error, OverflowError):
        return message


# ------------------------------------------------------------------ the image


def _scan_damaged(draw: random.Random, fields: Fields) -> None:
    """Bits of the compressed pixels: what libjpeg complains of and fills up."""
    data = bytearray(fields.arrays["jpeg"])
    start = data.index(b"\xff\xda") + 10
    for _ in range(draw.choice((1, 5, 50, 500))):
        data[draw.randrange(start, len(data) - 2)] = draw.randrange(256)
    fields.arrays["jpeg"] = bytes(data)


def _header_damaged(draw: random.Random, fields: Fields) -> None:
    """Bytes before the pixels: tables, sizes, sampling."""
    data = bytearray(fields.arrays["jpeg"])
    end = data.index(b"\xff\xda") + 10
    for _ in range(draw.choice((1, 1, 2, 8))):
        data[draw.randrange(2, end)] = draw.choice((0, 1, 0xFF, draw.randrange(256)))
    fields.arrays["jpeg"] = bytes(data)


def _stated_size(draw: random.Random, fields: Fields) -> None:
    fields.arrays["jpeg"] = with_size(fields.arrays["jpeg"], draw.choice(SIZES), draw.choice(SIZES))


def with_size(jpeg: bytes, width: int, height: int) -> bytes:
    """The same with a header that states another size."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :]


def _segments(draw: random.Random, fields: Fields) -> None:
    """Markers that a camera's JPEG does not have: restarts, comments, tables, second frames and scans."""
    data = fields.arrays["jpeg"]
    scan = data.index(b"\xff\xda")
    added = draw.choice(
        (
            b"\xff\xdd\x00\x04" + struct.pack(">H", draw.choice((0, 1, 2, 65_535))),
            b"\xff\xfe" + struct.pack(">H", 30_000) + bytes(29_998),
            b"\xff\xfe\x00\x02" * draw.choice((1, 1000)),
            b"\xff" * draw.choice((1, 20_000)),
            b"\xff\xd8\xff\xd8",
            data[data.index(b"\xff\xc0") : scan],
            b"\xff\xdb\x00\x43\x00" + bytes(64),
            b"\xff\xcc\x00\x04\x00\x00",
        )
    )
    at = draw.choice((2, scan, scan, len(data) - 2))
    fields.arrays["jpeg"] = (data[:at] + added + data[at:])[:64_000]


def _scans(draw: random.Random, fields: Fields) -> None:
    """The scan over and over, as far as the bytes go."""
    data = fields.arrays["jpeg"]
    scan = data[data.index(b"\xff\xda") : -2][: draw.choice((10, 12, 40, 4000))]
    fields.arrays["jpeg"] = (data[:-2] + scan * (60_000 // len(scan)))[:63_998] + b"\xff\xd9"


def _cut_short(draw: random.Random, fields: Fields) -> None:
    data = fields.arrays["jpeg"]
    end = b"\xff\xd9" if draw.random() < 0.7 else b""
    fields.arrays["jpeg"] = data[: draw.randrange(len(data))] + end


def _other_bytes(draw: random.Random, fields: Fields) -> None:
    start = draw.choice((PNG, b"\xff\xd8", b"GIF89a", b"BM", b""))
    fields.arrays["jpeg"] = start + draw.randbytes(draw.choice((0, 9, 900, 63_000))) + b"\xff\xd9"


# ------------------------------------------------------------------ its surfaces


def _surface_values(draw: random.Random, fields: Fields) -> None:
    """Extreme numbers of some or of all surfaces."""
    name = draw.choice(("surface_uv", "plane", "rho_sigma"))
    values = fields.floats(name, "f")
    value, share = draw.choice(FLOATS), draw.choice((0.02, 0.3, 1.0))
    columns = ROW_BYTES[name] // 4
    column = draw.randrange(columns)
    fields.set_floats(
        name,
        "f",
        [value if k % columns == column and draw.random() < share else old for k, old in enumerate(values)],
    )


def _surfaces_scaled(draw: random.Random, fields: Fields) -> None:
    """All planes nearer, farther, behind the camera, or turned edge on; sigmas with them."""
    by = draw.choice((-1.0, 1e-6, 0.5, 1.05, 20.0, 1e3))
    planes = fields.floats("plane", "f")
    z = draw.choice((by, by, 1e-4))
    fields.set_floats("plane", "f", [n * (z if k % 3 == 2 else by) for k, n in enumerate(planes)])
    if draw.random() < 0.5:
        sure = draw.choice((0.0, 1e-6, 1e3))
        fields.set_floats("rho_sigma", "f", [sure * s for s in fields.floats("rho_sigma", "f")])


def _surface_count(draw: random.Random, fields: Fields) -> None:
    """Another number of them: none, the most, too many; or of one array only."""
    n = draw.choice((0, 1, 25, 255, 256, 257, 2000))
    names = ["surface_uv", "plane", "rho_sigma"]
    for name in names if draw.random() < 0.8 else [draw.choice(names)]:
        data, size = fields.arrays[name], ROW_BYTES[name]
        fields.arrays[name] = (
            (data * (n // max(1, fields.rows(name)) + 1))[: n * size] if data else bytes(n * size)
        )


# ------------------------------------------------------------------ spans, poses, ids


def _span_ids(draw: random.Random, fields: Fields) -> None:
    """Unknown, future, huge, the same twice."""
    n = fields.rows("ids")
    own = fields.scalars[ID]
    ids = [draw.choice((own - 1, own, own + 1, own - 500, 0, *IDS)) for _ in range(n)]
    if draw.random() < 0.3:
        ids = ids[:1] * n
    fields.arrays["ids"] = struct.pack(f"<{n}q", *ids)


def _span_count(draw: random.Random, fields: Fields) -> None:
    """Many, to all that went before."""
    n, own = draw.choice((0, 1, 7, 8, 9, 200)), fields.scalars[ID]
    fields.arrays["ids"] = struct.pack(f"<{n}q", *[max(0, own - 1 - k) for k in range(n)])
    for name in ("T_earlier_body", "earlier_cov"):
        data = fields.arrays[name] or bytes(ROW_BYTES[name])
        fields.arrays[name] = (data * (n + 1))[: n * ROW_BYTES[name]]


def _span_poses(draw: random.Random, fields: Fields) -> None:
    """Rigid, but somewhere else than the steps in between say."""
    values = fields.floats("T_earlier_body", "f")
    away = draw.choice((0.05, 0.3, 1.0, 50.0, 9_999.0, 1.1e4, 1e30))
    for row in range(fields.rows("T_earlier_body")):
        if draw.random() < 0.2:
            values[16 * row : 16 * row + 16] = [float(k % 5 == 0) for k in range(16)]
        values[16 * row + draw.choice((3, 7, 11))] += away
    fields.set_floats("T_earlier_body", "f", values)


def _span_covs(draw: random.Random, fields: Fields) -> None:
    size, ranks = draw.choice((0.0, 1e-30, 1e-12, 1.0, 1e11, 1e13)), draw.choice((6, 3, 0))
    n = fields.rows("earlier_cov")
    one = [size * (k % 7 == 0 and k // 7 < ranks) for k in range(36)]
    fields.set_floats("earlier_cov", "f", one * n)


def _odom_elsewhere(draw: random.Random, fields: Fields) -> None:
    """The pose in odometry moves or turns, the steps do not."""
    pose = fields.floats("T_odom_body", "d")
    pose[draw.choice((3, 7, 11))] += draw.choice((0.1, 0.29, 0.4, 100.0, 9_990.0))
    if draw.random() < 0.3:
        for k in (0, 1, 4, 5, 8, 9):
            pose[k] = -pose[k]
    fields.set_floats("T_odom_body", "d", pose)


def _step(draw: random.Random, fields: Fields) -> None:
    """The step leaps; with odometry, or without it."""
    names = ("T_ref_body", "T_odom_body") if draw.random() < 0.5 else ("T_ref_body",)
    away = draw.choice((0.02, 0.3, 1.9, 40.0, 9_999.0))
    for name in names:
        pose = fields.floats(name, "d")
        pose[3] += away
        fields.set_floats(name, "d", pose)


def _step_covs(draw: random.Random, fields: Fields) -> None:
    size, ranks = draw.choice((0.0, 1e-300, 1e-14, 1e-3, 1e3, 1e12, 1e13, math.nan)), draw.choice((6, 5, 1))
    fields.set_floats("cov", "d", [size * (k % 7 == 0 and k // 7 < ranks) for k in range(36)])


def _up(draw: random.Random, fields: Fields) -> None:
    direction = draw.choice(([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.6, 0.0, 0.9]))
    fields.set_floats("up", "d", [draw.choice((1, -1)) * value for value in direction])
    fields.scalars[UP_SIGMA] = draw.choice((0.0, 1e-300, 1e-9, 0.01, 1e6, 1e7, -1.0))


def _order(draw: random.Random, fields: Fields) -> None:
    """Ids, references, predecessors, stamps."""
    at = draw.choice((ID, REFERENCE, PREDECESSOR, STAMP))
    old = fields.scalars[at]
    near = [old + d for d in (-2, -1, 1, 2, 64)]
    times = (-(2**62), 2**62, 2**63 - 1, 0, old - 10**9, old + 10**18)
    fields.scalars[at] = draw.choice(times if at == STAMP else (*near, *IDS))


def _begins(draw: random.Random, fields: Fields) -> None:
    """A segment begins; its spans stay."""
    fields.scalars[REFERENCE] = -1
    fields.arrays["T_ref_body"] = fields.arrays["T_odom_body"]


_IMAGE: tuple[Change, ...] = (
    _scan_damaged, _scan_damaged, _header_damaged, _header_damaged, _stated_size, _segments, _scans,
    _cut_short, _other_bytes,
)  # fmt: skip
_SURFACES: tuple[Change, ...] = (_surface_values, _surface_values, _surfaces_scaled, _surface_count)
_MOTION: tuple[Change, ...] = (
    _span_ids, _span_count, _span_poses, _span_covs, _odom_elsewhere, _step, _step_covs, _up, _order, _begins,
)  # fmt: skip
_ALL = (*_IMAGE, *_SURFACES, *_SURFACES, *_MOTION)
