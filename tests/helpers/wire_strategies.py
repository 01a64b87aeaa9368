"""Hypothesis strategies for every message, shared by the tests of the wire and of the core."""

from __future__ import annotations

from functools import partial
from unicodedata import normalize

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from share.agent_names import checked_name
from share.checks import MAX_ID, MAX_ODOM_M, MAX_POSITION_M, MAX_STAMP_NS
from share.earlier_poses import MAX_SPANS, EarlierPoses
from share.geometry import se3
from share.geometry.camera import (
    BASELINE_RANGE_M,
    MAX_SENSOR_DISTANCE_M,
    MAX_TIMESHIFT_S,
    Camera,
    ImuNoise,
    Rig,
)
from share.types import (
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
from share.wire import messages as m
from share.wire import room_messages as r


def is_name(text: str) -> bool:
    try:
        return checked_name(text) == text
    except ValueError:
        return False


int64 = st.integers(-(2**63), 2**63 - 1)
stamps = st.integers(-MAX_STAMP_NS, MAX_STAMP_NS)
ids = st.integers(0, MAX_ID)
ids_or_none = st.integers(-1, MAX_ID)
near = st.floats(-MAX_POSITION_M, MAX_POSITION_M)
finite = st.floats(-1e6, 1e6)
words = st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=64)
names = st.text(st.characters(categories=["Lu", "Ll", "Lo", "Nd"]), min_size=1, max_size=64)
names = names.map(partial(normalize, "NFC")).filter(is_name)
covs = hnp.arrays(np.float64, (6, 6), elements=st.floats(-1e4, 1e4)).map(lambda A: A @ A.T)
ups = st.sampled_from([(0, 0, 0), (0, 0, 1), (0.6, 0, -0.8)]).map(lambda up: np.array(up, float))


@st.composite
def poses(draw: st.DrawFn, most_m: float = MAX_POSITION_M) -> np.ndarray:
    rotation = draw(hnp.arrays(np.float64, 3, elements=st.floats(-3, 3)))
    position = draw(hnp.arrays(np.float64, 3, elements=st.floats(-most_m, most_m)))
    return se3.from_rt(se3.so3_exp(rotation), position)


@st.composite
def views(draw: st.DrawFn, most: int = 40) -> View:
    n = draw(st.integers(0, most))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    points = rng.normal(size=(n, 3)).astype(np.float32)
    points[rng.random(n) < 0.3] = np.nan
    return View(
        rng.normal(size=(n, 2)).astype(np.float32), points, rng.integers(0, 256, (n, 32)).astype(np.uint8)
    )


@st.composite
def keyframe_images(draw: st.DrawFn, most: int = 40) -> KeyframeImage:
    n, size = draw(st.integers(0, most)), draw(st.integers(0, 500))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    surfaces = rng.normal(size=(n, 2)), rng.normal(size=(n, 3)), rng.uniform(0, 2, n)
    return KeyframeImage(rng.integers(0, 256, size).astype(np.uint8), *surfaces)


@st.composite
def earlier_poses(draw: st.DrawFn, below: int) -> EarlierPoses:
    n = draw(st.integers(0, min(below, MAX_SPANS)))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    A = rng.normal(size=(n, 6, 6))
    T = [draw(poses(MAX_ODOM_M / 2)) if k == 0 else se3.exp(rng.normal(size=6)) for k in range(n)]
    ids = draw(st.lists(st.integers(0, max(below - 1, 0)), min_size=n, max_size=n, unique=True))
    return EarlierPoses(
        np.array(ids, np.int64), np.array(T, np.float32).reshape(n, 4, 4), np.float32(A @ A.swapaxes(1, 2))
    )


@st.composite
def keyframes(draw: st.DrawFn) -> Keyframe:
    id_ = draw(ids)
    reference = draw(st.integers(-1, id_ - 1))
    follows = draw(st.integers(reference, id_ - 1))
    motion = draw(poses(MAX_ODOM_M)), draw(covs), draw(poses(MAX_ODOM_M))
    return Keyframe(
        id_,
        reference,
        draw(stamps),
        *motion,
        draw(ups),
        draw(st.floats(0, 10)),
        draw(views()),
        follows,
        draw(keyframe_images()),
        draw(earlier_poses(id_)),
    )


focals, sides = st.floats(1, 1e5), st.integers(1, m.MAX_IMAGE_SIDE)
coefficients = st.floats(-1e4, 1e4)
distortions = st.sampled_from([0, 4, 5]).flatmap(lambda n: st.tuples(*[coefficients] * n))
fisheye = st.tuples(*[coefficients] * 4), st.just("equidistant")
cameras = st.one_of(
    st.builds(Camera, sides, sides, focals, focals, finite, finite, distortions),
    st.builds(Camera, sides, sides, focals, focals, finite, finite, *fisheye),
)
amount = st.floats(0, 1e9)
late = st.floats(0, min(m.MAX_DELAY_MS, m.MAX_ERROR_CM))
noise = st.floats(0, 1e3)
imus = st.builds(ImuNoise, noise, noise, noise, noise, st.floats(0, 1e5))


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    (h, w, n), deep = draw(st.tuples(*[st.integers(0, 40)] * 3)), draw(st.integers(0, 2))
    image0, image1 = rng.integers(0, 256, (2, h, w)).astype(np.uint8)
    depth = rng.uniform(0, 9, (w, h)).astype(np.float32)
    stamps_ns = np.unique(rng.integers(-MAX_STAMP_NS, MAX_STAMP_NS, n))
    n = len(stamps_ns)
    imu = ImuBatch(stamps_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))
    seen = [(None, None), (image1, None), (None, depth)][deep]
    return Frame(draw(stamps), draw(ids), image0, *seen, imu, draw(stamps))


@st.composite
def tracked(draw: st.DrawFn) -> m.RemoteTrackingResult:
    state = draw(st.sampled_from(TrackState))
    T = draw(poses()) if state.has_pose else None
    flags = draw(
        st.tuples(st.booleans(), st.booleans(), st.booleans(), st.none() | st.sampled_from(WaitReason))
    )
    return m.RemoteTrackingResult(draw(ids), draw(stamps), state, T, *flags)


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    beside = poses(BASELINE_RANGE_M[1] / 2).filter(lambda T: np.linalg.norm(T[:3, 3]) > BASELINE_RANGE_M[0])
    cam1 = draw(st.none() | st.tuples(cameras, beside)) or (None, None)
    depth = draw(st.none() | st.tuples(cameras, poses(MAX_SENSOR_DISTANCE_M))) or (None, None)
    shift_s = draw(st.floats(-MAX_TIMESHIFT_S, MAX_TIMESHIFT_S))
    return Rig(
        draw(cameras), draw(poses(MAX_SENSOR_DISTANCE_M)), *cam1, *depth, draw(st.none() | imus), shift_s
    )


numbers = st.integers(0, 2**62)
answers = st.text(st.characters(categories=["L", "N"]), max_size=r.MAX_ANSWER_LENGTH)
kinds, floors = st.sampled_from(r.ObjectKind), st.floats(-r.MAX_PLACE_M, r.MAX_PLACE_M)
turns, commanders = st.floats(-6.28, 6.28), st.just("") | names
lists = st.lists(st.tuples(ids, numbers), max_size=r.MAX_LISTED).map(
    lambda rows: tuple(zip(*rows, strict=True)) or ((), ())
)
parties = numbers, st.none() | names, commanders
of_clients = st.one_of(
    st.builds(r.ClientHello, names, int64, st.booleans(), st.booleans(), st.booleans()),
    st.builds(r.PutObject, numbers, ids, kinds, st.none() | words, poses(r.MAX_PLACE_M)),
    st.builds(r.RemoveObject, numbers, ids),
    st.builds(r.ObjectsSeen, int64, numbers),
    st.builds(r.Goto, *parties, st.none() | words, floors, floors, st.none() | turns, st.booleans()),
    st.builds(r.Cancel, *parties),
    st.builds(r.CommandState, *parties, answers, st.booleans(), st.booleans()),
    st.builds(r.RobotPlace, st.none() | names, st.none() | words, floors, floors, turns, answers),
    st.builds(r.Receipt, numbers, answers),
    st.builds(r.RoomObject, int64, numbers, ids, kinds, names, words, poses(), answers),
    st.builds(lambda s, n, rows: r.ObjectList(s, n, *rows), int64, numbers, lists),
)
messages = st.one_of(
    of_clients,
    st.builds(m.Hello, names, st.sampled_from(AgentKind), int64, rigs(), st.booleans()),
    st.builds(
        m.PoseUpdate,
        stamps,
        st.sampled_from(TrackState),
        ids_or_none,
        poses(),
        st.floats(0, m.MAX_POSE_AGE_MS),
        *[st.none() | st.floats(0, m.MAX_SIGMA)] * 2,
    ),
    keyframes(),
    st.builds(m.Evaluation, ids_or_none, late, st.none() | late, late, late, late, late),
    st.builds(
        m.Status,
        st.sampled_from(TrackState),
        st.floats(0, m.MAX_POSE_AGE_MS),
        st.text(st.characters(categories=["L", "N"]), max_size=m.MAX_REASON_LENGTH),
    ),
    st.builds(m.Ping, int64, stamps),
    st.just(m.Bye()),
    st.builds(m.Welcome, int64, ids, st.floats(0, m.MAX_HOLD_MS)),
    st.builds(m.Refused, st.text(st.characters(codec="utf-8"), max_size=m.MAX_TEXT_LENGTH)),
    st.builds(m.Ack, ids, st.lists(ids, max_size=m.MAX_BUFFERED).map(tuple)),
    st.builds(Correction, poses(), covs, words, ids, ids, ids_or_none),
    st.builds(
        m.Rate,
        st.floats(0, m.MAX_RATE_HZ),
        st.booleans(),
        st.none() | st.floats(m.MIN_POSE_HZ, m.MAX_RATE_HZ),
    ),
    st.builds(m.Pong, int64, stamps, stamps, stamps, int64),
    frames(),
    tracked(),
)
