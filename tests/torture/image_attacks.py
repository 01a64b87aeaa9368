"""Attacks by keyframes with images (see `attacks.py`): what is decoded, aligned and believed of motion."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from fuzzer import own_name
from keyframe_mutations import ID, PREDECESSOR, REFERENCE, ROW_BYTES, STAMP, Fields, with_size
from raw_wire import Message, pack, unpack

STEP_NS = 300_000_000
SIZES = ((640, 480), (1920, 1200), (2000, 2000), (8192, 8192), (65_500, 65_500))  # px that headers state
MOST_SURFACES, MOST_SPANS = 256, 8
PACE_S = 0.08  # between keyframes: as many as a name may send


class Chain:
    """Keyframes of one run: recorded pictures, steps along x in odometry, spans that agree."""

    def __init__(self, c: Any, step_m: float = 0.05, pictures: int = 10**6) -> None:
        recorded = [m for m in c.corpus.by_kind["keyframe"] if len(m[8]) > 5000]
        self._recorded, self._step_m, self._next = recorded[:pictures], step_m, 0

    def next(self, change: Callable[[Fields], None] | None = None) -> Message:
        """The next keyframe, after `change`."""
        k, self._next = self._next, self._next + 1
        fields = Fields(self._recorded[k % len(self._recorded)])
        fields.scalars[ID], fields.scalars[REFERENCE], fields.scalars[PREDECESSOR] = k, k - 1, k - 1
        fields.scalars[STAMP] = 10**9 + k * STEP_NS
        fields.arrays["T_ref_body"] = along_x(self._step_m if k else 0.0)
        fields.arrays["T_odom_body"] = along_x(self._step_m * k)
        set_spans(fields, [k - back for back in (3, 7, 13) if k >= back], self._step_m)
        if change is not None:
            change(fields)
        return fields.message()


def along_x(x: float, form: str = "d") -> bytes:
    """A pose (4, 4) so far along x."""
    return struct.pack(f"<16{form}", *(x if k == 3 else float(k % 5 == 0) for k in range(16)))


def set_spans(
    fields: Fields, ids: list[int], step_m: float, off_m: float = 0.0, variance: float = 1e-6
) -> None:
    """Poses relative to these keyframes: by the steps in between, and so far off."""
    own = fields.scalars[ID]
    cov = struct.pack("<36f", *(variance * (k % 7 == 0) for k in range(36)))
    fields.arrays["ids"] = struct.pack(f"<{len(ids)}q", *ids)
    fields.arrays["T_earlier_body"] = b"".join(along_x((own - i) * step_m + off_m, "f") for i in ids)
    fields.arrays["earlier_cov"] = cov * len(ids)


def _said(c: Any, chain: Chain, change: Callable[[Fields], None] | None = None) -> None:
    """One run that sends its keyframes at the pace of an agent, until the end."""
    peer = c.peer()
    while c.going:
        if not c.send(peer, [chain.next(change)]):
            peer, chain = c.peer(), Chain(c)
        time.sleep(PACE_S)


# ------------------------------------------------------------------ what is decoded


def image_bombs(c: Any) -> None:
    """Small JPEGs that say they are huge, of cameras that are said to be as large, and of wrong kinds."""
    while c.going:
        for width, height in SIZES:
            peer = _peer_with_camera(c, width, height)
            chain = Chain(c)
            for form in (_baseline, _progressive, _many_scans, _cut):
                change = partial(form, width=width, height=height)
                c.send(peer, [chain.next(change) for _ in range(4)])
                time.sleep(PACE_S)
            peer.close()


def _peer_with_camera(c: Any, width: int, height: int) -> Any:
    identity = c.draw.randbytes(8)
    header, *arrays = c.corpus.hello(own_name(identity, c.args.keys), identity)
    fields: Any = unpack(header)
    side = min(8192, width), min(8192, height)
    fields[2][4] |= {"width": side[0], "height": side[1], "cx": side[0] / 2, "cy": side[1] / 2}
    peer = c.peer(hello=False, identity=identity)
    c.send(peer, [[pack(fields), *arrays]])
    return peer


def _baseline(fields: Fields, width: int, height: int) -> None:
    fields.arrays["jpeg"] = with_size(fields.arrays["jpeg"], width, height)


def _progressive(fields: Fields, width: int, height: int) -> None:
    _baseline(fields, width, height)
    fields.arrays["jpeg"] = fields.arrays["jpeg"].replace(b"\xff\xc0", b"\xff\xc2", 1)


def _many_scans(fields: Fields, width: int, height: int) -> None:
    _progressive(fields, width, height)
    data = fields.arrays["jpeg"]
    scan = data[(at := data.index(b"\xff\xda")) : at + 40]
    fields.arrays["jpeg"] = (data[:-2] + scan * 1000)[:63_900] + b"\xff\xd9"


def _cut(fields: Fields, width: int, height: int) -> None:
    _baseline(fields, width, height)
    data = fields.arrays["jpeg"]
    fields.arrays["jpeg"] = data[: len(data) // 2] + b"\xff\xd9"


def damaged_images(c: Any) -> None:
    """Each as libjpeg would write a line of it to the log, and fill up what is missing."""
    _said(c, Chain(c), lambda fields: _cut(fields, 640, 480))


def many_surfaces(c: Any) -> None:
    """As many as may be, all before one place; and more than may be, each time on a run of its own."""
    for _ in range(3):
        peer = c.peer()
        c.send(peer, [Chain(c).next(lambda fields: _multiply(fields, 2000))])
        peer.close()
    _said(c, Chain(c, step_m=0.001, pictures=1), lambda fields: _multiply(fields, MOST_SURFACES))


def _multiply(fields: Fields, n: int) -> None:
    """The surfaces again and again, up to n."""
    for name in ("surface_uv", "plane", "rho_sigma"):
        data = fields.arrays[name]
        fields.arrays[name] = (data * (n // fields.rows(name) + 1))[: n * ROW_BYTES[name]]


# ------------------------------------------------------------------ what is believed of motion


def false_spans(c: Any) -> None:
    """As many as may be, all very sure, half a metre off the steps; and of keyframes that are not."""
    _said(c, Chain(c), lambda fields: _false_spans(c, fields))


def _false_spans(c: Any, fields: Fields) -> None:
    own = fields.scalars[ID]
    ids = [own - 1 - back for back in range(min(own, MOST_SPANS))]
    if own % 5 == 0:
        ids = [c.draw.choice((own, own + 5, 2**31 - 1, 2**62, -1, 0, 0)) for _ in ids]
    set_spans(fields, ids, 0.05, off_m=0.5, variance=1e-12)


def odometry_elsewhere(c: Any) -> None:
    """The pose in odometry runs away from the steps, by as much a keyframe as is let pass."""

    def away(fields: Fields) -> None:
        fields.arrays["T_odom_body"] = along_x(0.3 * fields.scalars[ID])

    _said(c, Chain(c), away)


def false_loops(c: Any) -> None:
    """One picture all along a way: each keyframe closes a loop, tens of metres long, with all before it."""
    _said(c, Chain(c, step_m=0.5, pictures=1))


# ------------------------------------------------------------------ floods


def flood_image(c: Any) -> None:
    """Four agents that send whole keyframes as fast as the link takes them."""
    runs = [(c.peer(), Chain(c)) for _ in range(4)]
    while c.going:
        for k, (peer, chain) in enumerate(runs):
            if not c.send(peer, [chain.next() for _ in range(8)]):
                time.sleep(0.2)
                runs[k] = c.peer(), Chain(c)


def four_agents(c: Any) -> None:
    """What a flood is compared with: four agents at the highest rate that an agent is granted."""
    runs = [(c.peer(), Chain(c)) for _ in range(4)]
    while c.going:
        for peer, chain in runs:
            c.send(peer, [chain.next()])
        time.sleep(0.2)


IMAGE_ATTACKS: dict[str, Callable[[Any], None]] = {
    f.__name__.replace("_", "-"): f
    for f in (
        image_bombs, damaged_images, many_surfaces, false_spans, odometry_elsewhere, false_loops, flood_image,
        four_agents,
    )
}  # fmt: skip
