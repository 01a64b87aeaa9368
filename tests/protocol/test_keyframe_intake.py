"""What the edge accepts of a keyframe: an image that cannot be its camera's is left out, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.checks import MAX_ID
from share.config import Config
from share.earlier_poses import EarlierPoses
from share.geometry.camera import Camera
from share.mapping.corrections import MapEvent
from share.protocol import edge_events as ed
from share.protocol.edge import EdgeProtocol
from share.protocol.keyframe_intake import OdometryBase, ReorderBuffer, StepChain, sanitise
from share.types import Keyframe, KeyframeImage, View
from share.vision.image_codec import encode_jpeg
from share.vision.keyframe_images import Surfaces
from share.wire import messages as m
from share.wire.codec import encode

HELLO = hello_of("ann", 0xA000B)
CAMERA = HELLO.rig.cam0
SURFACE = Surfaces(np.array([[0.1, 0.2]]), np.array([[0.0, 0.0, 0.5]]), np.array([0.01]))
RIGHT = SURFACE.with_image(np.zeros((CAMERA.height, CAMERA.width), np.uint8))
WRONG = SURFACE.with_image(np.zeros((CAMERA.height, CAMERA.width + 8), np.uint8))
COV = 1e-6 * np.eye(6)
BASE = OdometryBase(0, 0, np.eye(4))


def keyframe(id: int, image: KeyframeImage, T: np.ndarray | None = None) -> Keyframe:
    T = np.eye(4) if T is None else T
    cov = 1e-6 * np.eye(6)
    return Keyframe(id, id - 1, 10**8 * id, T, cov, T, np.zeros(3), 0.0, View.empty(), id - 1, image)


def far() -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 50.0
    return T


def test_an_image_of_the_camera_is_kept() -> None:
    sent = keyframe(1, RIGHT)
    assert sanitise(sent, BASE, CAMERA) == (sent, None)


def test_an_image_of_another_size_is_left_out_and_the_keyframe_stays_in_its_segment() -> None:
    got, problem = sanitise(keyframe(1, WRONG), BASE, CAMERA)
    width, height = CAMERA.width, CAMERA.height
    assert problem == (
        f"keyframe 1: its image has {width + 8}x{height} px, its camera {width}x{height}: without it"
    )
    assert got.reference == 0
    assert len(got.image.jpeg) == 0 and got.image.uv.tolist() == RIGHT.uv.tolist()


@pytest.mark.parametrize("jpeg", [RIGHT.jpeg[:-200], np.zeros(5, np.uint8)], ids=["cut short", "zeros"])
def test_a_damaged_image_is_left_out(jpeg: np.ndarray) -> None:
    got, problem = sanitise(keyframe(1, replace(RIGHT, jpeg=jpeg)), BASE, CAMERA)
    assert problem == "keyframe 1: its image is no JPEG, or cut short: without it"
    assert (len(got.image.jpeg), got.reference) == (0, 0)


def reaching_back(T: np.ndarray) -> Keyframe:
    sent = keyframe(5, RIGHT, T)
    earlier = EarlierPoses(np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(6), (2, 1, 1)))
    return replace(sent, reference=4, earlier=earlier)


def test_a_keyframe_that_has_to_start_a_segment_loses_its_earlier_poses() -> None:
    steps = StepChain.start(1).extended(2, np.eye(4), COV).extended(4, np.eye(4), COV)
    base = OdometryBase(4, 4 * 10**8, np.eye(4), steps)
    got, problem = sanitise(reaching_back(far()), base, CAMERA)
    assert problem == "keyframe 5 is 50 m from the previous one: new segment"
    assert (got.reference, len(got.earlier)) == (-1, 0)
    got, problem = sanitise(reaching_back(np.eye(4)), base, CAMERA)
    assert problem is None and got.earlier.ids.tolist() == [1, 2]


def test_all_that_is_wrong_is_said() -> None:
    sent = replace(keyframe(1, WRONG, far()), cov=1e11 * np.eye(6))
    got, problem = sanitise(sent, BASE, CAMERA)
    assert problem is not None
    assert [word in problem for word in ("px", "50 m from the previous one: new segment", "1e+11")] == [
        True
    ] * 3
    assert (len(got.image.jpeg), got.reference, got.cov.max()) == (0, -1, pytest.approx(100))


def test_the_edge_records_it_once_and_keeps_the_keyframe() -> None:
    edge = EdgeProtocol(Config(), 7)

    def tell(message: m.Message) -> list[ed.EdgeEffect]:
        frames = [bytes(frame) for frame in encode(message)]
        return edge.handle(ed.PeerMessageReceived(m.peer_id(HELLO.run_id), frames), 0)

    tell(HELLO)
    first, second = (tell(keyframe(k, WRONG)) for k in (0, 1))
    (record,) = (effect for effect in first if isinstance(effect, ed.WriteEvent))
    assert "its image has" in record.fields["reason"]
    for effects, reference in ((first, -1), (second, 0)):
        (added,) = (effect for effect in effects if isinstance(effect, ed.AddKeyframe))
        assert (added.keyframe.reference, len(added.keyframe.image.jpeg)) == (reference, 0)
    ann = edge.report({})["agents"]["ann"]
    assert (ann["keyframes"], ann["suspect_keyframes"], ann["bad_messages"]) == (2, 2, 0)


def test_a_header_larger_than_any_camera_is_not_decoded() -> None:
    jpeg = encode_jpeg(np.zeros((480, 640), np.uint8), 50)
    at = jpeg.index(b"\xff\xc0") + 5
    bomb = np.frombuffer(jpeg[:at] + (65_500).to_bytes(2, "big") * 2 + jpeg[at + 4 :], np.uint8)
    camera = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)
    got, problem = sanitise(keyframe(1, replace(RIGHT, jpeg=bomb)), BASE, camera)
    assert problem is not None and "65500x65500" in problem and len(got.image.jpeg) == 0


def test_a_suspicion_of_the_mapper_counts_as_one_of_the_intake() -> None:
    """It alone decodes images."""
    edge = EdgeProtocol(Config(), 7)
    frames = [bytes(frame) for frame in encode(HELLO)]
    effects = edge.handle(ed.PeerMessageReceived(m.peer_id(HELLO.run_id), frames), 0)
    (key,) = (effect.key for effect in effects if isinstance(effect, ed.AddRun))
    found = MapEvent(key, "odometry suspect", "keyframe 3: its image is damaged: without it")
    records = [edge.handle(ed.MapperResult((found,)), k) for k in range(500)]
    written = [effect for effects in records for effect in effects if isinstance(effect, ed.WriteEvent)]
    assert 0 < len(written) < 50
    ann = edge.report({})["agents"]["ann"]
    assert (ann["suspect_keyframes"], ann["last_suspicion"]) == (500, found.reason)


def test_motions_that_drift_away_from_their_poses_start_a_segment() -> None:
    """5 % of long steps are allowed; put together they would take the map beyond all measure."""
    base, reasons, farthest_m = OdometryBase(0, 0, moved(-4500.0)), [], 0.0
    for id in range(1, 60):
        x = 4500.0 if id % 2 else -4500.0
        sent = replace(keyframe(id, RIGHT), stamp_ns=id * 2000 * 10**9)
        sent = replace(sent, T_odom_body=moved(x), T_ref_body=moved(2 * x + 425.0))
        got, problem = sanitise(sent, base, CAMERA)
        reasons += [] if problem is None else [problem]
        base = OdometryBase.from_keyframe(got, base)
        at = base.T_odom_body if base.T_odom_moved is None else base.T_odom_moved
        farthest_m = max(farthest_m, float(np.abs(at[:3, 3]).max()))
    assert farthest_m < 6000
    assert len(reasons) > 10
    assert "keyframe 3: the motions since its segment's start and its pose differ by 1275 m" in reasons[0]


def moved(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_the_last_id_cannot_be_acknowledged_and_is_refused() -> None:
    buffer = ReorderBuffer(MAX_ID - 2)
    assert len(buffer.push(keyframe(MAX_ID - 1, RIGHT))) == 0  # waits for the one before
    with pytest.raises(ValueError, match="there is no id for the next one"):
        buffer.push(keyframe(MAX_ID, RIGHT))
    assert len(buffer.push(keyframe(MAX_ID - 2, RIGHT))) == 2
    assert buffer.ack().next_keyframe == MAX_ID
