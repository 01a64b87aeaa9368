"""A small map as changes: two agents, their keyframes along a line, loops between them."""

from __future__ import annotations

import numpy as np
from helpers.hellos import hello_of

from share.geometry import se3
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import (
    MapChange,
    SaveKeyframe,
    SaveLoop,
    SavePoses,
    SaveRun,
    StoredKeyframe,
    StoredMap,
)
from share.types import F64, Keyframe, KeyframeImage, View

ANN, BOB = "ann-0001", "bob-0002"


def pose(i: int) -> F64:
    return se3.exp(np.array([0.01 * i, 0.02 * i, -0.03 * i, 0.1 * i, 0.2, 0.3]))


def run(key: str) -> SaveRun:
    """Keys speak for all runs, but not for Bob's."""
    name, _, number = key.rpartition("-")
    return SaveRun(key, hello_of(name, int(number, 16), T=pose(3)), "" if key == BOB else f"key of {name}")


def keyframe(key: str, i: int, points: int = 40, first: bool = False) -> SaveKeyframe:
    """Number i of a run, relative to the one before unless it is the first of a stretch. It has `points`, and
    three more of its image."""
    rng = np.random.default_rng([i, *key.encode()])
    view = View(
        rng.normal(size=(points, 2)),
        rng.normal(size=(points, 3)),
        rng.integers(0, 256, (points, 32), np.uint8),
    )
    begins = first or i == 0
    T = pose(i) if begins else se3.inverse(pose(i - 1)) @ pose(i)
    cov = np.diag([1e-6, 1e-6, 1e-6, 1e-5, 1e-5, 2e-5])
    up = np.array([0.0, 0.0, 1.0])
    facing = np.column_stack([np.zeros((3, 2)), rng.uniform(0.2, 1, 3)])
    surfaces = rng.normal(size=(3, 2)), facing, rng.uniform(0, 0.1, 3)
    image = KeyframeImage(rng.integers(0, 256, 60).astype(np.uint8), *surfaces)
    stamp_ns = 10**9 + i * 10**8
    own = Keyframe(i, -1 if begins else i - 1, stamp_ns, T, cov, pose(i), up, 0.01, view, i - 1, image)
    return SaveKeyframe(key, own)


def kept_keyframe(key: str, i: int, stretch: int = 0) -> StoredKeyframe:
    """The same, found again."""
    return StoredKeyframe(key, keyframe(key, i).keyframe, f"{key}/{stretch}", i)


def loop(i: int, j: int) -> Loop:
    return Loop(KeyframeKey(ANN, i), KeyframeKey(BOB, j), pose(i - j), np.eye(6) * 1e-4, 20 + i)


def solution(keys: list[KeyframeKey], name: str = f"{ANN}/0") -> SavePoses:
    return SavePoses(tuple(keys), np.array([pose(7) @ pose(k.id) for k in keys]), (name,) * len(keys))


def small_map(count: int = 20, points: int = 40) -> list[MapChange]:
    """Two runs of `count` keyframes each, by turns, a loop for every fourth, and a solution of all."""
    frames = [keyframe(key, i, points) for i in range(count) for key in (ANN, BOB)]
    loops = [SaveLoop(loop(i, i)) for i in range(0, count, 4)]
    return [run(ANN), run(BOB), *frames, *loops, solution([k.keyframe_key for k in frames])]


def as_values(kept: StoredMap) -> dict[str, object]:
    """All of it in a form that can be compared to the last bit."""
    return {
        "runs": [
            (r.run_key, r.hello.name, r.hello.run_id, r.hello.rig.T_body_cam0.tobytes(), r.credential)
            for r in kept.runs
        ],
        "stretches": kept.segments,
        "keyframes": [_keyframe(k) for k in kept.keyframes],
        "links": {k: (x.reference, x.T_ref_body.tobytes(), x.cov.tobytes()) for k, x in kept.links.items()},
        "loops": [(x.a, x.b, x.T_a_b.tobytes(), x.cov.tobytes(), x.inliers) for x in kept.loops],
        "poses": kept.poses and (kept.poses.keys, kept.poses.T_map_body.tobytes(), kept.poses.map_ids),
        "next": dict(kept.next_ids),
        "complaints": kept.problems,
    }


def _keyframe(k: StoredKeyframe) -> tuple[object, ...]:
    own = k.keyframe
    arrays = (
        k.keyframe.T_odom_body,
        own.T_ref_body,
        own.cov,
        own.up,
        own.view.uv,
        own.view.points,
        own.view.descriptors,
        own.image.jpeg,
        own.image.uv,
        own.image.plane,
        own.image.rho_sigma,
    )
    return (
        k.keyframe_key,
        (k.segment_name, k.ordinal),
        own.reference,
        own.stamp_ns,
        own.predecessor,
        *(a.tobytes() for a in arrays),
    )
