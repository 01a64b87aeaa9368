"""The suite's own tools, without any process: they would otherwise prove nothing."""

from __future__ import annotations

import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import msgspec
import numpy as np
import pytest
from corpus import KINDS, Corpus, Recorded, read, write
from fuzzer import _small
from helpers.hellos import hello_of
from keyframe_mutations import ARRAYS, ROW_BYTES, Fields, mutate_keyframe
from mutations import mutate
from raw_wire import multipart, pack, unpack
from replay import shrink
from soak import slope

from share.earlier_poses import EarlierPoses
from share.errors import WireError
from share.wire.codec import decode, encode
from share.wire.messages import Ping, PoseUpdate


@pytest.fixture
def traffic(tmp_path: Path) -> Path:
    from share.types import Keyframe, KeyframeImage, TrackState, View
    from share.vision.image_codec import encode_jpeg

    n, eye = 20, np.eye(4)
    view = View(np.zeros((n, 2)), np.ones((n, 3)), np.zeros((n, 32)))
    jpeg = np.frombuffer(encode_jpeg(np.tile(np.arange(160, dtype=np.uint8), (120, 1)), 50), np.uint8)
    image = KeyframeImage(jpeg, np.zeros((n, 2)), np.ones((n, 3)), np.full(n, 0.01))
    earlier = EarlierPoses(np.array([2, 5]), np.tile(eye, (2, 1, 1)), 1e-6 * np.tile(np.eye(6), (2, 1, 1)))
    keyframe = Keyframe(9, 8, 5, eye, 1e-6 * np.eye(6), eye, np.zeros(3), 0.0, view, 8, image, earlier)
    said = [hello_of("ann", 7), PoseUpdate(1, TrackState.OK, -1, eye), keyframe, Ping(1, 2)]
    path = tmp_path / "traffic.jsonl"
    write(
        path, [Recorded(b"12345678", True, [bytes(f) for f in encode(m)]) for m in said], {"from": "a test"}
    )
    return path


@pytest.mark.parametrize(
    "value",
    [
        0,
        -1,
        127,
        128,
        -33,
        2**63 - 1,
        -(2**63),
        1.5,
        "é" * 40,
        [1, [2, "x"]],
        {"a": None},
        True,
        b"ab",
        "x" * 300,
    ],
)
def test_msgpack_is_msgpack(value: object) -> None:
    assert msgspec.msgpack.decode(pack(value)) == value
    assert unpack(msgspec.msgpack.encode(value)) == value


def test_what_is_no_msgpack_is_a_value_error(rng: np.random.Generator) -> None:
    for _ in range(2000):
        try:
            unpack(rng.bytes(int(rng.integers(0, 40))))
        except ValueError:
            continue


def test_traffic_is_read_as_it_was_written(traffic: Path) -> None:
    about, messages = read(traffic)
    assert about == {"from": "a test"}
    assert [m.kind for m in messages] == ["hello", "pose", "keyframe", "ping"]


def test_messages_that_are_made_up_are_valid(traffic: Path) -> None:
    corpus = Corpus(traffic)
    for kind in ("bye", "evaluation", "frame", "refused", "rate", "tracked", "correction"):
        decode(corpus.by_kind[kind][0])
    hello = decode(corpus.hello("eve", b"\0" * 7 + b"\5"))
    assert (hello.name, hello.run_id) == ("eve", 5)  # type: ignore[union-attr]
    assert len(decode(_small(corpus.by_kind["keyframe"], "keyframe")[0]).view) == 12  # type: ignore[union-attr]


def test_mutations_are_mostly_refused_but_not_all(traffic: Path) -> None:
    """Some get through the decoder: it is what comes after it that is to be tried."""
    corpus, draw = Corpus(traffic), random.Random(1)
    passed, refused = set(), set()
    for kind in KINDS:
        for _ in range(400):
            for base in corpus.by_kind[kind][:1]:
                try:
                    decode(mutate(draw, base))
                    passed.add(kind)
                except WireError:
                    refused.add(kind)
    assert {"hello", "pose", "keyframe", "evaluation", "ping"} <= passed
    assert {"hello", "pose", "keyframe", "evaluation", "ping"} <= refused


def test_mutations_of_keyframes_reach_image_surfaces_and_spans(traffic: Path) -> None:
    """A third passes the decoder, each array changed in some of them."""
    (message,) = Corpus(traffic).by_kind["keyframe"]
    draw, passed, changed = random.Random(1), 0, set()
    for _ in range(1000):
        mutated = mutate(draw, message)
        try:
            decode(mutated)
        except WireError:
            continue
        passed += 1
        changed |= {name for name, a, b in zip(ARRAYS, mutated[1:], message[1:], strict=True) if a != b}
    assert passed > 330
    assert changed >= {*ARRAYS} - {"uv", "points", "descriptors"}  # which SHARE's agents do not send


@pytest.mark.parametrize("seed", range(3))
def test_a_mutated_keyframe_has_the_form_that_its_header_states(traffic: Path, seed: int) -> None:
    (message,) = Corpus(traffic).by_kind["keyframe"]
    draw = random.Random(seed)
    for _ in range(200):
        fields = Fields(mutate_keyframe(draw, message))
        for spec, (name, data) in zip(fields.head[3], fields.arrays.items(), strict=True):
            if name in ROW_BYTES:
                assert spec[1][0] == len(data) // ROW_BYTES[name]


def test_multipart_has_its_flags() -> None:
    assert multipart([b"a", b"b" * 300]) == b"\x01\x01a" + b"\x02" + (300).to_bytes(8, "big") + b"b" * 300


def test_shrinking_finds_the_two_that_matter() -> None:
    messages = [Recorded(bytes([k]), True, []) for k in range(40)]
    fewest = shrink(messages, lambda left: {7, 31} <= {m.peer[0] for m in left}, tries=300)
    assert [m.peer[0] for m in fewest] == [7, 31]


def test_slope_of_a_leak_and_of_noise(rng: np.random.Generator) -> None:
    hours = np.linspace(0, 2, 240)
    noise = np.convolve(rng.normal(size=250), np.ones(11) / 3, mode="valid")  # it remembers a while
    _, low, high = slope(hours, 100 + 3.0 * hours + noise)
    assert low < 3.0 < high
    assert low > 0
    _, low, high = slope(hours, 100 + noise)
    assert low < 0 < high
