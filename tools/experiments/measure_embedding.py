"""Test whether embeddings of the error model find places that the vocabulary of descriptors does not.

    python tools/experiments/measure_embedding.py SESSION [SESSION ...] [--model FILE]

SESSION: a folder by `share emulate`. Keyframes are each 30 cm or 20 degrees of an agent's true path; each is
queried among those of all other agents. True matches are those that `share.mapping.recognition.verification`
verifies with a pose error below 15 cm and 2 degrees. Prints, of keyframes with a true match, how many have it
among the first 1, 3, 8 and 20 results: by words, by embedding similarity (cosine), by pictures of 16 x 12
pixels (for comparison), and by words and similarity together (reciprocal ranks, Cormack et al. 2009), at
several weights.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from keyframe_making import spaced  # noqa: E402
from keyframe_types import Spacing  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config, PlaceConfig  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.interpolation import interpolate  # noqa: E402
from share.mapping.recognition.index import PlaceIndex  # noqa: E402
from share.mapping.recognition.verification import CameraView, Verification, verify  # noqa: E402
from share.odometry.error_model.inputs import INPUT_SHAPES, input_picture  # noqa: E402
from share.odometry.error_model.network import SHIPPED_MODEL, open_network, read_model  # noqa: E402
from share.recordings.session import read_session  # noqa: E402
from share.recordings.trajectory import Trajectory  # noqa: E402
from share.runtime.pipeline import read_frames  # noqa: E402
from share.runtime.source import open_source  # noqa: E402
from share.sensors.sequencer import SequencerCounters  # noqa: E402
from share.types import F64, U8  # noqa: E402
from share.vision.orb import make_view  # noqa: E402

EVERY = Spacing(0.3, 0.35)
NEAR_M, NEAR_DEG = 2.5, 50.0  # views further apart are not verified
RIGHT_M, RIGHT_DEG = 0.15, 2.0
FIRST = (1, 3, 8, 20)
WEIGHTS = (0.25, 0.5, 1.0)
RANKS = 10  # of reciprocal ranks: flattens the differences of the first few


@dataclass(frozen=True, eq=False)
class Seen:
    """A keyframe: its agent, pose T_world_body (4, 4), view, and picture (128, 128)."""

    agent: str
    T: F64
    sight: CameraView
    picture: U8


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sessions", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=SHIPPED_MODEL)
    options = parser.parse_args()
    return exit_code("measure_embedding", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    network = open_network(read_model(options.model))
    for folder in options.sessions:
        seen = [one for agent in read_session(folder).agents for one in keyframes(folder, agent)]
        pictures = np.array([one.picture for one in seen])
        inputs = {name: np.zeros((len(seen), *shape), np.float32) for name, shape in INPUT_SHAPES.items()}
        embedding = network.run(["embedding"], {**inputs, "picture": pictures})[0]
        tiny = np.array([cv2.resize(p, (16, 12), interpolation=cv2.INTER_AREA) for p in pictures], float)
        report(folder.name, seen, {"embedding": embedding, "tiny pictures": tiny.reshape(len(tiny), -1)})


def report(name: str, seen: list[Seen], kinds: dict[str, F64]) -> None:
    agents = np.array([one.agent for one in seen])
    own, true = agents[:, None] == agents[None], truths(seen)
    if not true.any():
        raise UsageError(f"{name}: no keyframe shows a place of another agent")
    words = by_words(seen, own)
    print(f"\n{name}: {len(seen)} keyframes, {int(true.any(axis=1).sum())} with a true match\n")
    print("\n".join(line(cells) for cells in (["by", *(f"first {k}" for k in FIRST)], ["---"] * 5)))
    print(line(["words", *among_first(words, true)]))
    for kind, vectors in kinds.items():
        alike = np.where(own, -np.inf, cosine(vectors))
        print(line([kind, *among_first(alike, true)]))
        for weight in WEIGHTS:
            fused = 1 / (RANKS + ranks(words)) + weight / (RANKS + ranks(alike))
            fused = np.where(own, -np.inf, fused)
            print(line([f"words + {weight:g} {kind}", *among_first(fused, true)]), flush=True)


def keyframes(folder: Path, agent: str) -> Iterator[Seen]:
    source = open_source(str(folder / agent))
    truth, rig = source.truth(), source.rig
    if truth is None:
        raise UsageError(f"{folder}/{agent}: has no ground truth")
    stamps = np.unique(source.stamps()["cam0"])
    known, T = interpolate(truth.stamps_ns, truth.T, stamps)
    at = spaced(Trajectory(stamps[known], T), EVERY)
    wanted = dict(zip(stamps[known][at].tolist(), T[at], strict=True))
    for frame in read_frames(source, Config(), SequencerCounters()):
        if (pose := wanted.get(frame.stamp_ns)) is not None:
            sight = CameraView(make_view(frame, rig), rig.cam0.focal, rig.T_body_cam0, pose[2, :3])
            yield Seen(agent, pose, sight, input_picture(frame.image0))


def truths(seen: list[Seen]) -> np.ndarray:
    """Return (N, N): which keyframes of other agents are true matches of keyframe q."""
    config, out = PlaceConfig(), np.zeros((len(seen), len(seen)), bool)
    cameras = np.array([one.T @ one.sight.T_body_cam0 for one in seen])
    for q, one in enumerate(seen):
        apart = se3.inverse(cameras[q]) @ cameras
        near = (np.linalg.norm(apart[:, :3, 3], axis=1) < NEAR_M) & (
            se3.rotation_angle(apart) < math.radians(NEAR_DEG)
        )
        for c in np.flatnonzero(near):
            if seen[c].agent != one.agent:
                found = verify(one.sight, seen[c].sight, config)
                out[q, c] = isinstance(found, Verification) and right(seen[c].T, one.T, found.T_c_q)
    return out


def right(T_c: F64, T_q: F64, T_c_q: F64) -> bool:
    wrong = se3.inverse(se3.inverse(T_c) @ T_q) @ T_c_q
    return bool(
        np.linalg.norm(wrong[:3, 3]) < RIGHT_M and se3.rotation_angle(wrong) < math.radians(RIGHT_DEG)
    )


def by_words(seen: list[Seen], own: np.ndarray) -> F64:
    """Return scores (N, N) by the index."""
    index, out = PlaceIndex(), np.where(own, -np.inf, 0.0)
    for k, one in enumerate(seen):
        index.add(k, one.sight.view.descriptors)
    for q, one in enumerate(seen):
        exclude = np.flatnonzero(own[q]).tolist()
        for found in index.query(one.sight.view.descriptors, len(seen), exclude):
            out[q, found.id] = found.score
    return out


def cosine(vectors: F64) -> F64:
    """Return (N, N) cosine similarities of vectors (N, D), less their mean."""
    apart = vectors - vectors.mean(axis=0)
    apart /= np.linalg.norm(apart, axis=1, keepdims=True)
    return np.asarray(apart @ apart.T)


def ranks(score: F64) -> F64:
    """Return ranks, 0 for the best of a row."""
    return np.asarray(np.argsort(np.argsort(-score, axis=1, kind="stable"), axis=1, kind="stable"))


def among_first(score: F64, true: np.ndarray) -> list[str]:
    """Return, of rows with a true match, the share with one among the best."""
    order = np.argsort(-score, axis=1, kind="stable")
    first = np.take_along_axis(true, order, axis=1)[true.any(axis=1)].argmax(axis=1)
    return [f"{100 * (first < k).mean():.0f} %" for k in FIRST]


if __name__ == "__main__":
    sys.exit(main())
