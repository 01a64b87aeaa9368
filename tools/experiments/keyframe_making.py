"""From a recipe to a set of keyframes: room and motions of `share emulate`, with few of the frames."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from keyframe_odometry import Drift, odometry
from keyframe_set import AgentKeyframes, KeyframeSet, Spacing

from share.geometry import se3
from share.geometry.camera import Rig
from share.lab.emulate import drawing
from share.lab.emulate.recipe import Progress, SessionRecipe, no_progress
from share.lab.emulate.recordings import EncodedPicture, encoded_image, true_trajectory
from share.lab.emulate.sensor.device import PictureTimes
from share.lab.emulate.sensor.imager import ExposureSeries
from share.lab.emulate.stage import Actor, PreparedSession, RoomStage, keep_room, prepare_session
from share.lab.pool import Pool
from share.protocol.agent_ledger import KeyframeChain
from share.recordings.trajectory import Trajectory
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.types import F64, I64, Frame, Keyframe, KeyframeImage, OdometryKeyframe, View
from share.wire.messages import Hello

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from helpers.frame_keyframe import frame_image

_SURFACES = 70  # of an image, as a tracker has
_STREAM = 81  # of random numbers, not used by the emulator


def make(recipe: SessionRecipe, every: Spacing, workers: int, progress: Progress) -> KeyframeSet:
    """Return the set without saving it. Raises UsageError, ConfigError or DataError for an invalid recipe,
    RenderError where this machine cannot draw."""
    with TemporaryDirectory(prefix="keyframes-") as folder:
        prepared = prepare_session(recipe, Path(folder) / "room", progress)
        keep_room(prepared, progress)
        chosen = [_chosen(actor, every) for actor in prepared.stage.actors]
        seen = images(prepared.stage, [at for at, _ in chosen], recipe.images, workers, progress)
    return _set(recipe, every, prepared, [truth for _, truth in chosen], seen)


def make_unseen(recipe: SessionRecipe, every: Spacing) -> KeyframeSet:
    """Return the same set with surfaces only, without images, with depths drawn from 1 to 8 m, one a
    keyframe. Takes seconds, and needs no OpenGL."""
    rng = np.random.default_rng((recipe.seed, _STREAM))
    with TemporaryDirectory(prefix="keyframes-") as folder:
        prepared = prepare_session(recipe, Path(folder) / "room", no_progress)
    truths = [_chosen(actor, every)[1] for actor in prepared.stage.actors]
    uv = rng.uniform(-0.5, 0.5, (_SURFACES, 2))
    seen = [[_facing(uv, rng.uniform(1.0, 8.0)) for _ in truth.stamps_ns] for truth in truths]
    return _set(recipe, every, prepared, truths, seen)


def _facing(uv: F64, depth_m: float) -> KeyframeImage:
    """Surfaces at uv (N, 2) of a wall that faces the camera, without an image."""
    plane = np.tile([0.0, 0.0, 1 / depth_m], (len(uv), 1))
    return replace(KeyframeImage.empty(), uv=uv, plane=plane, rho_sigma=np.full(len(uv), 0.01))


def _set(
    recipe: SessionRecipe,
    every: Spacing,
    prepared: PreparedSession,
    truths: list[Trajectory],
    seen: list[list[KeyframeImage]],
) -> KeyframeSet:
    agents = {
        actor.name: _agent(actor, truth, shown, np.random.default_rng((recipe.seed, _STREAM, k)))
        for k, (actor, truth, shown) in enumerate(zip(prepared.stage.actors, truths, seen, strict=True))
    }
    x, y, z = (float(v) for v in prepared.layout.size)
    return KeyframeSet(recipe, every, (x, y, z), agents)


def spaced(truth: Trajectory, every: Spacing) -> I64:
    """Return the indices (N,) of keyframes: the first pose, and each that is far enough from the keyframe
    before."""
    chosen = [0]
    for k in range(1, len(truth.stamps_ns)):
        last = chosen[-1]
        T = se3.inverse(truth.T[last]) @ truth.T[k]
        far = np.linalg.norm(T[:3, 3]) >= every.metres or se3.rotation_angle(T) >= every.radians
        if far and truth.stamps_ns[k] - truth.stamps_ns[last] >= every.seconds * 1e9:
            chosen.append(k)
    return np.array(chosen, np.int64)


def _chosen(actor: Actor, every: Spacing) -> tuple[I64, Trajectory]:
    """Return the indices (N,) of the actor's keyframes among its pictures, and their true poses."""
    known, truth = true_trajectory(actor)
    at = spaced(truth, every)
    return known[at], Trajectory(truth.stamps_ns[at], truth.T[at])


def _agent(
    actor: Actor, truth: Trajectory, seen: list[KeyframeImage], rng: np.random.Generator
) -> AgentKeyframes:
    run_id = int(rng.integers(2**63))
    hello = Hello(actor.name, actor.kind, run_id, actor.rig)
    T_odom_body, cov = odometry(truth.T, truth.stamps_ns, rng, Drift())
    return AgentKeyframes(hello, _chained(T_odom_body, cov, truth.stamps_ns, seen), truth.T, T_odom_body)


def _chained(T_odom_body: F64, cov: F64, stamps_ns: I64, seen: list[KeyframeImage]) -> tuple[Keyframe, ...]:
    """Return all candidates as sent keyframes. As with a tracker, up is the z of odom."""
    before = np.concatenate([np.eye(4)[None], T_odom_body[:-1]])
    T_last_body = se3.orthonormal(se3.inverse(before) @ T_odom_body)
    chain, out = KeyframeChain(), []
    for T, T_last, step, stamp_ns, image in zip(
        T_odom_body, T_last_body, cov, stamps_ns.tolist(), seen, strict=True
    ):
        candidate = OdometryKeyframe(T, T_last, step, T[2, :3], Drift().tilt_rad, View.empty(), image=image)
        chain.extend(candidate)
        out.append(chain.make_keyframe(candidate, stamp_ns))
    return tuple(out)


_STRIP = 12  # frames a job


@dataclass(frozen=True, eq=False)
class Strip:
    """Pictures first .. last - 1 of actor number `actor_index`, on a stage with keyframes only. shots:
    exposure of each picture. rig: for measuring depth."""

    actor_index: int
    first: int
    last: int
    shots: ExposureSeries
    rig: Rig


def images(
    stage: RoomStage, chosen: list[I64], encoding: str, workers: int, progress: Progress
) -> list[list[KeyframeImage]]:
    """Return the images of each actor at the chosen (N,) of its pictures. The light is metered over all
    pictures, as for a recording, so that they are made of the recording's, byte by byte. encoding: jpeg or
    png, as in `SessionRecipe.images`."""
    thinned = replace(stage, actors=tuple(map(_thinned, stage.actors, chosen)))
    with Pool(workers, drawing.start_worker, (thinned, encoding)) as pool:
        exposed = [
            _exposed(pool, actor_index, actor, progress) for actor_index, actor in enumerate(stage.actors)
        ]
        strips = [
            Strip(
                actor_index,
                k,
                min(k + _STRIP, len(at)),
                _of(exposed[actor_index], at[k : k + _STRIP]),
                actor.rig,
            )
            for actor_index, (actor, at) in enumerate(zip(stage.actors, chosen, strict=True))
            for k in range(0, len(at), _STRIP)
        ]
        seen: dict[tuple[int, int], list[KeyframeImage]] = {}
        for strip, found in pool.run(see, strips):
            seen[strip.actor_index, strip.first] = found
            progress("drawing keyframes", len(seen), len(strips))
    return [_of_one(seen, actor_index) for actor_index in range(len(chosen))]


def see(strip: Strip) -> list[KeyframeImage]:
    """Draw, encode and decode, and measure the depth of corners, in a worker process."""
    pictures = drawing.draw_pictures(strip.actor_index, slice(strip.first, strip.last), strip.shots)
    frames = groupby(pictures, key=lambda picture: picture.stamp_ns)
    return [frame_image(_frame(stamp_ns, of_one), strip.rig, _SURFACES) for stamp_ns, of_one in frames]


def _of_one(seen: dict[tuple[int, int], list[KeyframeImage]], actor_index: int) -> list[KeyframeImage]:
    return [image for key in sorted(seen) if key[0] == actor_index for image in seen[key]]


def _frame(stamp_ns: int, pictures: Iterator[EncodedPicture]) -> Frame:
    images = {picture.stream: encoded_image(picture, "keyframe").load() for picture in pictures}
    return Frame(stamp_ns, 0, images[CAM0], images.get(CAM1), images.get(DEPTH))


def _exposed(pool: Pool, actor_index: int, actor: Actor, progress: Progress) -> ExposureSeries:
    """Return the exposures of all pictures of an actor."""
    jobs, found = drawing.meter_jobs(actor_index, actor), {}
    for job, brightness in pool.run(drawing.measure_brightness, jobs):
        found[int(job.true_ns[0])] = brightness
        progress(f"metering {actor.name}", len(found), len(jobs))
    return drawing.exposure_series(actor, jobs, np.concatenate([found[int(job.true_ns[0])] for job in jobs]))


def _thinned(actor: Actor, at: I64) -> Actor:
    p = actor.pictures
    return replace(actor, pictures=PictureTimes(p.index[at], p.true_ns[at], p.stamp_ns[at]))


def _of(shots: ExposureSeries, at: I64) -> ExposureSeries:
    return ExposureSeries(shots.exposure_ms[at], shots.gain[at], shots.light[at])
