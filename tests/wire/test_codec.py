"""The codec: exact round trips, stated sizes, and WireError (nothing else) on anything malformed."""

from __future__ import annotations

import dataclasses
import re
import tracemalloc
from collections import Counter

import msgspec
import numpy as np
import pytest
from helpers.wire_strategies import messages
from hypothesis import given, settings
from hypothesis import strategies as st

from share.earlier_poses import MAX_SPANS, EarlierPoses
from share.errors import WireError
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.net.backlog import BacklogLimits
from share.types import (
    MAX_JPEG_BYTES,
    MAX_SURFACES,
    AgentKind,
    Correction,
    Frame,
    ImuBatch,
    Keyframe,
    KeyframeImage,
    TrackState,
    View,
    WaitReason,
)
from share.wire import codec, layouts
from share.wire import messages as m
from share.wire import room_messages as r

POSE = np.eye(4)
V = codec.WIRE_VERSION
CAMERA = Camera(752, 480, 458.0, 457.0, 367.0, 248.0, (-0.28, 0.07, 2e-4, 1.8e-5))
BESIDE = np.block([[np.eye(3), np.array([[-0.05], [0], [0]])], [0, 0, 0, 1]])
STEREO = Rig(CAMERA, POSE, CAMERA, BESIDE, imu=ImuNoise(1.7e-4, 2e-3, 2e-5, 3e-3, 200.0), timeshift_s=0.01)
EVERY_CLASS = set(m.Message.__args__)


def keyframe(n: int, id_: int = 7) -> Keyframe:
    rng = np.random.default_rng(n)
    points = rng.normal(size=(n, 3)).astype(np.float32)
    points[::3] = np.nan
    view = View(rng.normal(size=(n, 2)), points, rng.integers(0, 256, (n, 32)))
    return Keyframe(id_, id_ - 1, 10**18, POSE, np.eye(6), POSE, np.array([0, 0, 1.0]), 0.01, view)


def keyframe_with_image(n: int, jpeg_bytes: int, id_: int = 7) -> Keyframe:
    """A keyframe as an agent sends it: an image and `n` surfaces, no ORB features."""
    rng = np.random.default_rng(n)
    jpeg = rng.integers(0, 256, jpeg_bytes).astype(np.uint8)
    surfaces = rng.normal(size=(n, 2)), rng.normal(size=(n, 3)), rng.uniform(0, 0.1, n)
    return dataclasses.replace(keyframe(0, id_), image=KeyframeImage(jpeg, *surfaces))


def frame(stereo: bool) -> Frame:
    rng = np.random.default_rng(1)
    image0, image1 = rng.integers(0, 256, (2, 12, 16)).astype(np.uint8)
    depth = rng.uniform(0, 9, (10, 14)).astype(np.float32)
    imu = ImuBatch(np.arange(5) + 10**18, rng.normal(size=(5, 3)), rng.normal(size=(5, 3)))
    return Frame(10**18, 4, image0, *((image1, None) if stereo else (None, depth)), imu, 7)


EXAMPLES: list[m.Message] = [
    m.Hello("ann", AgentKind.AR, 2**62, STEREO),
    m.PoseUpdate(1_700_000_000_123_456_789, TrackState.INERTIAL_ONLY, 2**31 - 1, POSE, 6.25, 0.012, 0.004),
    keyframe(5),
    keyframe_with_image(3, 40),
    m.Evaluation(3, 12.5, None),
    m.Status(TrackState.LOST, 2100.5, "no image for 2.1 s", 90.5, 0.25),
    m.Ping(1, 10**18),
    m.Bye(),
    m.Welcome(2**62, 3),
    m.Welcome(1, 0, 660.0),
    m.Refused("the name 'ann' is taken"),
    m.Ack(4, (6, 7)),
    Correction(POSE, np.eye(6), "map-1", 5, 7, 3),
    m.Rate(4.5),
    m.Pong(1, 1, 2, 3, 2**62),
    frame(True),
    frame(False),
    m.RemoteTrackingResult(4, 10**18, TrackState.OK, POSE, is_keyframe=True),
    m.RemoteTrackingResult(5, 10**18, TrackState.INITIALISING, None, waiting_for=WaitReason.TILT),
    r.ClientHello("ann", 2**62, wants_objects=True),
    r.PutObject(2**40, 7, r.ObjectKind.MARKER, "ann-1a2b/0", POSE),
    r.PutObject(2**40, 7, r.ObjectKind.CUBE, None, POSE),
    r.RemoveObject(2**40, 7),
    r.ObjectsSeen(2**62, 12),
    r.Goto(2**60, "bot", "ann", "ann-1a2b/0", 1.5, -2.0, 0.5, has_begun=True),
    r.Goto(2**60, None, "", None, 1.5, -2.0),
    r.Cancel(2**60, "bot"),
    r.CommandState(2**60, "bot", "ann", "1.20 m to go"),
    r.RobotPlace("bot", "ann-1a2b/0", 1.0, 2.0, 3.0, ""),
    r.RobotPlace(None, None, 0.0, 0.0, 0.0, "the agent has lost tracking"),
    r.Receipt(2**40, "there are 64 objects already"),
    r.RoomObject(2**62, 12, 7, r.ObjectKind.CUBE, "ann", "ann-1a2b/0", POSE, "removed by 'bob'"),
    r.ObjectList(2**62, 12, (7, 9), (12, 3)),
]


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and np.array_equal(a, b, equal_nan=a.dtype != np.uint8)
        )
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    return type(a) is type(b) and a == b


def copied(frames: list) -> list[bytes]:
    return [bytes(frame) for frame in frames]


def test_the_examples_cover_every_message() -> None:
    assert {type(message) for message in EXAMPLES} == EVERY_CLASS == set(layouts.MESSAGE_CODES)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_the_start_of_the_header_says_what_a_message_is(message: m.Message) -> None:
    header, *_ = copied(codec.encode(message))
    version, code, *_ = msgspec.msgpack.decode(header)
    for start in (header, msgspec.msgpack.encode((version, code, "no scalars", 7))):
        assert codec.message_type([start]) is type(message)


def test_codes_are_unique() -> None:
    assert len(set(layouts.MESSAGE_CODES.values())) == len(layouts.MESSAGE_CODES)


@given(messages)
@settings(max_examples=400, deadline=None)
@pytest.mark.long
def test_round_trip(message: m.Message) -> None:
    frames = codec.encode(message)
    assert same(codec.decode(copied(frames)), message)
    assert same(codec.decode(frames), message)


def test_a_pose_fits_into_200_bytes_and_a_keyframe_into_its_image_and_3_kb() -> None:
    assert codec.message_bytes(codec.encode(EXAMPLES[1])) <= 200
    sent = keyframe_with_image(70, 17_000, 10**9)
    assert codec.message_bytes(codec.encode(sent)) <= 17_000 + 3_000


def with_earlier(sent: Keyframe, count: int) -> Keyframe:
    T = se3.exp(np.full((count, 6), 0.1))
    cov = np.tile(1e-6 * np.eye(6), (count, 1, 1))
    return dataclasses.replace(sent, earlier=EarlierPoses(np.arange(count), T, cov))


def test_poses_relative_to_earlier_keyframes_come_as_they_were_sent() -> None:
    sent = with_earlier(keyframe(0, 40), MAX_SPANS)
    got = codec.decode(copied(codec.encode(sent)))
    assert isinstance(got, Keyframe)
    for name in ("ids", "T_earlier_body", "cov"):
        np.testing.assert_array_equal(getattr(got.earlier, name), getattr(sent.earlier, name))
    three, none = (codec.message_bytes(codec.encode(with_earlier(keyframe(0, 40), n))) for n in (3, 0))
    assert three - none < 700


def test_the_largest_keyframe_image_is_decoded() -> None:
    sent = with_earlier(keyframe_with_image(MAX_SURFACES, MAX_JPEG_BYTES, 40), MAX_SPANS)
    assert same(codec.decode(copied(codec.encode(sent))), sent)
    assert max(map(len, codec.encode(sent))) <= layouts.MAX_FRAME_BYTES
    guard = BacklogLimits.for_frame_size(layouts.MAX_FRAME_BYTES)
    assert codec.message_bytes(codec.encode(sent)) < guard.message_bytes  # else its connection is reset


def test_a_keyframe_of_wire_5_is_decoded_where_its_version_is_accepted() -> None:
    """It is today's without its last seven arrays. Map files keep such; a peer may not send one."""
    sent = keyframe(5)
    _, code, scalars, table = msgspec.msgpack.decode(codec.encode(sent)[0])
    old = [header(5, code, scalars, table[:7]), *copied(codec.encode(sent))[1:8]]
    assert same(codec.decode(old, (5, V)), sent)
    with pytest.raises(WireError, match="peer speaks wire 5"):
        codec.decode(old)
    with pytest.raises(WireError, match="7 declared, 14 expected"):
        codec.decode([header(V, code, scalars, table[:7]), *old[1:]])
    with pytest.raises(WireError, match="14 declared, 7 expected"):
        codec.decode([header(5, code, scalars, table), *copied(codec.encode(sent))[1:]], (5, V))


def test_arrays_are_views_on_both_sides() -> None:
    sent = keyframe(500)
    frames = codec.encode(sent)
    assert np.shares_memory(np.frombuffer(frames[7], np.uint8), sent.view.descriptors)
    got = codec.decode(copied(frames))
    assert isinstance(got, Keyframe)
    assert not got.view.descriptors.flags.writeable
    assert got.view.descriptors.base is not None


def test_unaligned_frames_are_copied() -> None:
    frames = copied(codec.encode(EXAMPLES[1]))
    shifted = memoryview(b"x" + frames[1])[1:]
    got = codec.decode([frames[0], shifted])
    assert isinstance(got, m.PoseUpdate)
    assert got.T_keyframe_body.flags.aligned


def test_numpy_scalars_are_sent_as_plain_ones() -> None:
    got = codec.decode(codec.encode(m.Ping(np.int64(3), np.int64(4))))  # type: ignore[arg-type]
    assert got == m.Ping(3, 4)


@pytest.mark.parametrize("message", [m.Ping(2**63, 0), m.Refused("\ud800"), m.Ping("x", 0)])  # type: ignore[arg-type]
def test_a_message_that_could_not_be_decoded_is_not_encoded(message: m.Message) -> None:
    with pytest.raises(WireError):
        codec.encode(message)


def header(version: object = V, code: object = 5, scalars: object = (1, 2), arrays: object = ()) -> bytes:
    return msgspec.msgpack.encode((version, code, scalars, arrays))


T_FRAMES = [b"\0" * 128]
OURS = bytes([0x94, V])  # how a header begins
POSE_SCALARS = (1, "OK", -1, 3.0, 0.01, None)


def bad_keyframe(
    scalars: object = (7, -1, 0, 6, 0.0), at: int = 0, entry: object = None, data: bytes = b""
) -> list[bytes]:
    """A keyframe without features, with these scalars and with array number `at`, if `entry` is given."""
    frames = copied(codec.encode(keyframe(0)))
    table = msgspec.msgpack.decode(frames[0])[3]
    if entry is not None:
        table[at], frames[at + 1] = entry, data
    return [header(V, 3, scalars, table), *frames[1:]]


BAD = {
    "empty message": [],
    "header of 4097 bytes": [b"\0" * 4097],
    "header: ": [b""],
    f"peer speaks wire 2, this SHARE wire {V}: upgrade the older one": [header(version=2)],
    "peer speaks wire 9": [msgspec.msgpack.encode((9, "some", {"other": "layout"}))],
    "unknown message type 99": [header(code=99)],
    "Ping: Expected `int`": [header(scalars=("a", 2))],
    "Ping: Expected `int` <= ": [header(scalars=(2**63, 2))],
    "Rate: a number is not finite": [header(code=20, scalars=(float("nan"), False, None, None))],
    "Rate: rate: -1.0": [header(code=20, scalars=(-1.0, False, None, None))],
    "Rate: jpeg_quality: 0": [header(code=20, scalars=(1.0, False, None, 0))],
    "Ping: 1 array frames, 0 declared, 0 expected": [header(), b""],
    "PoseUpdate: 0 array frames, 1 declared": [header(V, 2, POSE_SCALARS, [("<f8", (4, 4))])],
    "T_keyframe_body: |O of shape": [header(V, 2, POSE_SCALARS, [("|O", (4, 4))]), *T_FRAMES],
    "T_keyframe_body: <f4 of shape": [header(V, 2, POSE_SCALARS, [("<f4", (4, 4))]), *T_FRAMES],
    "T_keyframe_body: <f8 of shape (2, 8)": [header(V, 2, POSE_SCALARS, [("<f8", (2, 8))]), *T_FRAMES],
    "T_keyframe_body: 127 bytes": [header(V, 2, POSE_SCALARS, [("<f8", (4, 4))]), b"\0" * 127],
    "is not a rigid transform": [header(V, 2, POSE_SCALARS, [("<f8", (4, 4))]), *T_FRAMES],
    "sigma_rad: -0.1 is outside 0 .. 1e+06": [
        header(V, 2, (*POSE_SCALARS[:5], -0.1), [("<f8", (4, 4))]),
        np.eye(4).tobytes(),
    ],
    "not finite": [header(V, 2, POSE_SCALARS, [("<f8", (4, 4))]), b"\xff" * 128],
    "Invalid enum value 'LOSTER'": [
        header(V, 2, (1, "LOSTER", *POSE_SCALARS[2:]), [("<f8", (4, 4))]),
        *T_FRAMES,
    ],
    "predecessor: 9": bad_keyframe((7, -1, 0, 9, 0.0)),
    "up_sigma: -0.1 is outside 0 .. 1e+06": bad_keyframe((7, -1, 0, 6, -0.1)),
    "view.uv: <f4 of shape (2001, 2)": bad_keyframe(at=4, entry=("<f4", (2001, 2)), data=b"\0" * 16008),
    "image.jpeg: |u1 of shape (64001,)": bad_keyframe(at=7, entry=("|u1", (64_001,)), data=b"\0" * 64_001),
    "image.jpeg: 3 bytes, its shape needs 4": bad_keyframe(at=7, entry=("|u1", (4,)), data=b"\0" * 3),
    "image.uv: <f4 of shape (2001, 2)": bad_keyframe(at=8, entry=("<f4", (2001, 2)), data=b"\0" * 16008),
    "plane: shape (1, 3), expected (0, 3)": bad_keyframe(at=9, entry=("<f4", (1, 3)), data=b"\0" * 12),
    "rho_sigma: shape (1,), expected (0,)": bad_keyframe(at=10, entry=("<f4", (1,)), data=b"\0" * 4),
    "earlier.ids: <i8 of shape (33,)": bad_keyframe(at=11, entry=("<i8", (33,)), data=b"\0" * 264),
    "T_earlier_body: shape (0, 4, 4), expected (1, 4, 4)": bad_keyframe(
        at=11, entry=("<i8", (1,)), data=b"\0" * 8
    ),
    "earlier.cov: shape (1, 6, 6), expected (0, 6, 6)": bad_keyframe(
        at=13, entry=("<f4", (1, 6, 6)), data=b"\0" * 144
    ),
}  # fmt: skip


@pytest.mark.parametrize("says", BAD)
def test_errors_name_what_is_wrong(says: str) -> None:
    with pytest.raises(WireError) as caught:
        codec.decode(BAD[says])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_peer_cannot_forge_log_lines() -> None:
    for text in ("a\nb", "\x1b[2J", "x" * 2000):
        assert refused([header(V, 2, (1, text, -1, 3.0), [(text, (4, 4))]), *T_FRAMES])
        assert refused([header(V, 2, POSE_SCALARS, [(text, (4, 4))]), *T_FRAMES])


def test_surfaces_that_no_camera_sees_are_refused() -> None:
    frames = copied(codec.encode(keyframe_with_image(3, 0)))
    for index, shape, value, said in (
        (9, (3, 2), np.nan, "uv: has values that are not finite"),
        (9, (3, 2), 1001.0, "uv: values beyond 1000"),
        (10, (3, 3), -1001.0, "plane: values beyond 1000"),
        (10, (3, 3), np.inf, "plane: has values that are not finite"),
        (11, (3,), -0.1, "rho_sigma: outside 0"),
        (11, (3,), 1e7, "rho_sigma: outside 0"),
    ):
        data = np.full(shape, value, np.float32).tobytes()
        with pytest.raises(WireError, match=said):
            codec.decode([*frames[:index], data, *frames[index + 1 :]])


def test_infinite_points_and_disagreeing_lengths_are_refused() -> None:
    frames = copied(codec.encode(keyframe(5)))
    for index, frame in ((5, np.full((5, 3), np.inf, np.float32).tobytes()), (4, frames[4][:-8])):
        with pytest.raises(WireError):
            codec.decode([*frames[:index], frame, *frames[index + 1 :]])


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ("OK; agent 'hope': lost", """PoseUpdate: Invalid enum value "OK; agent 'hope': lost" - at `$[1]`"""),
        ("OK' - at `$[1]`; agent", """PoseUpdate: Invalid enum value "OK' - at `$[1]`; agent" - at `$[1]`"""),
        ("x'" * 60, f"""PoseUpdate: Invalid enum value "{"x'" * 19}x…" - at `$[1]`"""),
        ("x" * 100, f"PoseUpdate: Invalid enum value '{'x' * 39}…' - at `$[1]`"),
        ("\u2028x\n", r"PoseUpdate: Invalid enum value '\u2028x\n' - at `$[1]`"),
    ],
)
def test_text_of_a_peer_is_quoted_and_cut(state: str, said: str) -> None:
    """An unclosed quote would let the text continue as the edge's own."""
    frames = [header(V, 2, [0, state, *POSE_SCALARS[2:]], [("<f8", (4, 4))]), np.eye(4).tobytes()]
    with pytest.raises(WireError) as refused:
        codec.decode(frames)
    assert str(refused.value) == said


# ---------------------------------------------------------------- anything at all


def refused(frames: list[bytes]) -> bool:
    """Whether the decoder refuses; whatever else it raises fails the test."""
    try:
        codec.decode(frames)
    except WireError as error:
        said = str(error)
    else:
        return False
    assert said.isprintable()
    assert len(said) < 300
    return True


@given(st.lists(st.binary(max_size=200), max_size=8))
@settings(max_examples=1000, deadline=None)
def test_random_bytes(frames: list[bytes]) -> None:
    refused(frames)


nested = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=20,
)


def _message(code: int, scalars: object, table: list, frames: list[bytes]) -> list[bytes]:
    return [header(V, min(max(code, -(2**63)), 2**64 - 1), scalars, table), *frames]


wrong_content = st.builds(
    _message,
    st.sampled_from(sorted(layouts.MESSAGE_CODES.values())) | st.integers(),
    nested,
    st.lists(
        st.tuples(
            st.sampled_from(["<f8", "<f4", "|u1", ">f8", "O"]), st.lists(st.integers(-9, 2**62), max_size=4)
        )
    ),
    st.lists(st.binary(max_size=160), max_size=7),
)


@given(wrong_content)
@settings(max_examples=500, deadline=None)
@pytest.mark.long
def test_well_formed_headers_with_wrong_content(frames: list[bytes]) -> None:
    refused(frames)


def mutate(rng: np.random.Generator, frames: list[bytes], others: list[list[bytes]]) -> list[bytes]:
    """One to three random damages: flipped, cut, grown, replaced, swapped, doubled, lost frames."""
    frames = list(frames)
    for _ in range(rng.integers(1, 4)):
        if not frames:
            break
        i, j = rng.integers(len(frames), size=2)
        at = int(rng.integers(len(frames[i]) + 1))
        match rng.integers(9):
            case 0 | 1 if frames[i]:
                flipped = bytearray(frames[i])
                flipped[at - 1] ^= 1 << int(rng.integers(8))
                frames[i] = bytes(flipped)
            case 2:
                frames[i] = frames[i][:at]
            case 3:
                frames[i] = frames[i][:at] + rng.bytes(int(rng.integers(1, 12))) + frames[i][at:]
            case 4:
                frames[i], frames[j] = frames[j], frames[i]
            case 5:
                del frames[i]
            case 6:
                frames.insert(i, frames[j])
            case 7:
                other = others[rng.integers(len(others))]
                frames[i] = other[rng.integers(len(other))]
            case _:  # lengths and numbers at their extremes
                value = [b"\xdd\xff\xff\xff\xff", b"\xcf" + b"\xff" * 8, b"\xdb\x7f\xff\xff\xff"][
                    rng.integers(3)
                ]
                frames[i] = frames[i][:at] + value + frames[i][at + 1 :]
    return frames


def one_injured(seed: int) -> list[bytes]:
    rng = np.random.default_rng(seed)
    valid = [copied(codec.encode(message)) for message in EXAMPLES]
    return mutate(rng, valid[rng.integers(len(valid))], valid)


def injured(seed: int, cases: int) -> Counter[bool]:
    """Number of damaged messages that are refused; others are damaged where any value is valid."""
    rng = np.random.default_rng(seed)
    valid = [copied(codec.encode(message)) for message in EXAMPLES]
    return Counter(refused(mutate(rng, valid[case % len(valid)], valid)) for case in range(cases))


@pytest.mark.parametrize("cases", [25_000, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.long
def test_damaged_messages(cases: int) -> None:
    assert injured(seed=3, cases=cases)[True] > 0.8 * cases


@pytest.mark.slow
@given(wrong_content | st.lists(st.binary(max_size=200), max_size=8) | st.integers(0, 2**63).map(one_injured))
@settings(max_examples=100_000, deadline=None, database=None)
def test_a_hundred_thousand_generated_messages(frames: list[bytes]) -> None:
    refused(frames)


def test_damaged_messages_leak_no_memory() -> None:
    injured(seed=4, cases=1000)
    tracemalloc.start()
    try:
        injured(seed=5, cases=3000)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 64 * 1024
    assert peak < 512 * 1024


def test_huge_declarations_allocate_nothing() -> None:
    huge = [
        b"\xdd\xff\xff\xff\xff" + b"\x01" * 100,
        OURS + b"\x05\xdd\xff\xff\xff\xff\x01",
        OURS + b"\x05\x90\xdd\xff\xff\xff\xff\x01",
        OURS + b"\x12\x92\x01\xdd\xff\xff\xff\xff\x01\x90",
        OURS + b"\x11\x91\xdb\xff\xff\xff\xff\x90",
        OURS + b"\x05" + b"\x91" * 4000,
        b"\x91" * 4096,
        header(V, 3, (1, 0, 0, 0), [("|u1", (2**40, 2**40))] * 6),
        header(V, 3, (1, 0, 0, 0), [("|u1", (2000, 32))] * 400),
    ]
    tracemalloc.start()
    try:
        for head in huge:
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            assert refused([head] + [b""] * 6)
            assert tracemalloc.get_traced_memory()[1] - before < 256 * 1024
    finally:
        tracemalloc.stop()


def test_an_invalid_rig_is_refused() -> None:
    frames = copied(codec.encode(EXAMPLES[0]))
    version, code, scalars, table = msgspec.msgpack.decode(frames[0])
    for wrong, said in (
        ({**scalars[4], "fx": 0.5}, "focal lengths 0.5, 457 px are not within"),
        ({**scalars[4], "width": 8193}, "image: 8193x480 px exceeds 8192 px a side"),
        ({**scalars[4], "fx": float("nan")}, "focal lengths nan"),
        ({**scalars[4], "height": 0}, "resolution: 752x0 is not positive"),
        ({"width": 3}, "missing required field"),
        (None, "Expected `object`"),
    ):
        spoiled = [*scalars[:4], wrong, *scalars[5:]]
        with pytest.raises(WireError, match=re.escape(said)):
            codec.decode([header(version, code, spoiled, table), *frames[1:]])
    loud = [*scalars[:7], {**scalars[7], "gyro_walk": float("inf")}, *scalars[8:]]
    with pytest.raises(WireError, match="noise or a rate"):
        codec.decode([header(version, code, loud, table), *frames[1:]])


def injured_frame(at: int, entry: tuple[str, tuple[int, ...]], data: bytes) -> list[bytes]:
    """A depth frame with array number `at` declared and sent in another way."""
    frames = copied(codec.encode(frame(False)))
    version, code, scalars, table = msgspec.msgpack.decode(frames[0])
    table[at] = entry
    head = header(version, code, scalars, table)
    return [head, *frames[1 : at + 1], data, *frames[at + 2 :]]


@pytest.mark.parametrize(
    ("at", "entry", "data", "said"),
    [
        (0, ("|u1", (12,)), b"\0" * 12, "image0: |u1 of shape (12,)"),
        (0, ("|u1", (0,)), b"", "image0: |u1 of shape (0,)"),
        (0, ("|u1", (8193, 1)), b"\0" * 8193, "image0: |u1 of shape (8193, 1)"),
        (0, ("|u1", (8192, 8192)), b"\0" * 9, "image0: 67108864 bytes, at most 9216000"),
        (0, ("|u1", (12, 16)), b"\0" * 191, "image0: 191 bytes, its shape needs 192"),
        (1, ("|u1", (0,)), b"\0", "image1: 1 bytes, its shape needs 0"),
        (2, ("<f4", (1, 2)), np.array([[1, np.nan]], "<f4").tobytes(), "depth: negative or non-finite"),
        (2, ("<f4", (1, 2)), np.array([[1, -1]], "<f4").tobytes(), "depth: negative or non-finite"),
        (3, ("<i8", (4,)), b"\0" * 32, "gyro: shape (5, 3), expected (4, 3)"),
        (3, ("<i8", (20_001,)), b"\0" * 160_008, "imu.stamps_ns: <i8 of shape (20001,)"),
        (4, ("<f8", (5, 3)), np.full(15, np.inf).tobytes(), "gyro: has values that are not finite"),
        (
            4,
            ("<f8", (5, 3)),
            np.array([0.0, 1e300] + [0.0] * 13).tobytes(),
            "gyro: values beyond 1000, the limit of any IMU",
        ),
        (
            4,
            ("<f8", (5, 3)),
            np.full(15, -1001.0).tobytes(),
            "gyro: values beyond 1000, the limit of any IMU",
        ),
        (
            5,
            ("<f8", (5, 3)),
            np.full(15, 1.1e4).tobytes(),
            "accel: values beyond 10000, the limit of any IMU",
        ),
        (3, ("<i8", (5,)), np.array([1, 2, 2, 3, 4]).tobytes(), "stamps_ns: not strictly increasing"),
        (3, ("<i8", (5,)), np.array([1, 2, 1, 3, 4]).tobytes(), "stamps_ns: not strictly increasing"),
    ],
)
def test_an_invalid_frame_is_refused(
    at: int, entry: tuple[str, tuple[int, ...]], data: bytes, said: str
) -> None:
    with pytest.raises(WireError, match=re.escape(said)):
        codec.decode(injured_frame(at, entry, data))


def test_images_are_not_copied_on_either_side() -> None:
    sent = frame(True)
    frames = codec.encode(sent)
    assert np.shares_memory(np.frombuffer(frames[1], np.uint8), sent.image0)
    got = codec.decode(copied(frames))
    assert isinstance(got, Frame)
    assert got.image0.base is not None and not got.image0.flags.owndata


def test_a_pose_is_present_if_and_only_if_the_state_has_one() -> None:
    for state, T in ((TrackState.LOST, POSE), (TrackState.OK, None)):
        with pytest.raises(ValueError, match="required with a pose"):
            m.RemoteTrackingResult(1, 2, state, T)


def test_a_second_camera_needs_its_pose() -> None:
    frames = copied(codec.encode(EXAMPLES[0]))
    version, code, scalars, table = msgspec.msgpack.decode(frames[0])
    table[1] = ("<f8", (0,))
    with pytest.raises(WireError, match="cam1 and its extrinsics"):
        codec.decode([header(version, code, scalars, table), frames[1], b"", frames[3]])


@pytest.mark.parametrize("bad", [-np.eye(6), np.triu(np.ones((6, 6))), 1e300 * np.eye(6)])
def test_an_invalid_covariance_is_refused_when_decoded(bad: np.ndarray) -> None:
    """From a peer without our checks: our own types refuse to build such a message."""
    good = Correction(np.eye(4), np.eye(6), "map", 1, 0)
    frames = [bytes(frame) for frame in codec.encode(good)]
    raw = np.eye(6).tobytes()
    spoiled = [bad.astype("<f8").tobytes() if frame == raw else frame for frame in frames]
    assert spoiled != frames
    with pytest.raises(WireError):
        codec.decode(spoiled)
