"""Errors of the inertial tracker's feature tracks, px. Prints JSON, a session a line, then a table.

    python tools/experiments/measure_tracks.py [--seconds S] [SESSION/NAME ...]

On emulated sessions of one agent; without any, it makes its own and keeps them: two rooms, two seeds, with
and without the sensor's effects on pictures.

A feature is the point of the room at its first pixel, with the renderer's exact depth there. The error is the
distance in cam0 between the tracked position and that point at the true pose. `age`: frames since the first
one. Stamps, and so true poses, are of the middle of an exposure, about which blur is symmetric except for the
camera's acceleration.

`edge`: depth varies by over 10 % in the first 11 x 11 px. There the first pixel may show the background of
what is tracked, and the error is not the track's.

`own_depth`: the error that is left with the depth that fits all of the feature's track best. A filter that
estimates depth suffers from this at most; it excludes a wrong depth of the first pixel, but also drift along
the epipolar line that looks like depth.

`align_ms`: CPU time of alignment per frame, both cameras; without the alignment of keyframes.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from share.array_table import ArrayTable  # noqa: E402
from share.config import Config  # noqa: E402
from share.errors import ShareError, UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.camera import Camera, rays  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe, no_progress  # noqa: E402
from share.lab.emulate.sensor.effects import NO_EFFECTS, Effects  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.lab.emulate.stage import keep_room, prepare_session  # noqa: E402
from share.lab.emulate.types import SceneInstant  # noqa: E402
from share.lab.emulate.world.room_files import open_renderer  # noqa: E402
from share.odometry.inertial_tracker import InertialTracker  # noqa: E402
from share.odometry.state import FilterState  # noqa: E402
from share.recordings.session import read_session  # noqa: E402
from share.runtime.pipeline import read_frames  # noqa: E402
from share.runtime.source import open_source  # noqa: E402
from share.sensors.sequencer import SequencerCounters  # noqa: E402
from share.types import F32, F64, I64  # noqa: E402
from share.vision import patches  # noqa: E402

Row = dict[str, Any]
ROOMS, SEEDS, PROFILE = ("warehouse", "firestation"), (11, 12), "d435i:640x480@30"
AGES = (1, 5, 10, 20, 40, 80)
EDGE = 0.1  # of the depth: range within a patch
FEWEST = 20  # errors needed for percentiles
SAME = 0.03  # of a depth: two pixels that differ by less show one surface
ROUNDS, UNSURE = 6, 1.0  # of the depth fit; prior weight where there is no parallax, px^2 m^2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sessions", nargs="*", metavar="SESSION/NAME")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the sessions that it makes")
    options = parser.parse_args()
    found, spent = [], watch_alignment()
    try:
        for name in options.sessions or own_sessions(options.seconds):
            found.append(of_session(name, spent))
            print(json.dumps(found[-1]), flush=True)
    except ShareError as error:
        sys.exit(f"measure_tracks: {error}")
    print("\n" + table(found))


def own_sessions(seconds: float) -> Iterator[str]:
    """Yield the sessions. Pictures of the perfect device are lossless, others JPEG."""
    for effects, images in ((NO_EFFECTS, "png"), (Effects(), "jpeg")):
        for scene in ROOMS:
            for seed in SEEDS:
                motion, profiles = ("a=walk:",), {"": PROFILE}
                recipe = SessionRecipe(
                    scene, motion, seconds, seed, profiles=profiles, effects=effects, images=images
                )
                yield str(make_cached_session(recipe) / "a")


def of_session(name: str, spent: list[float]) -> Row:
    """Measure one agent of a session. spent: see `watch_alignment`. Raises UsageError for a session that was
    not emulated, or has other agents."""
    source, room = open_source(name), TrueRoom(Path(name))
    tracker, tracks = (
        InertialTracker(source.rig, Config().inertial, Config().tracker),
        Tracks(source.rig.cam0),
    )
    align_ms = []
    for frame in read_frames(source, Config(), SequencerCounters()):
        spent.clear()
        result = tracker.track(frame)
        align_ms.append(sum(spent))
        tracks.see(frame.stamp_ns, tracker, room)
        if result.keyframe_ready:
            tracker.make_keyframe(frame)
            tracker.finish_keyframe()
        tracks.begin(frame.stamp_ns, tracker, room)
    return {
        "session": name,
        "scene": room.recipe.scene,
        "motion": room.recipe.motions[0].partition(":")[0].split("=")[-1],
        "seed": room.recipe.seed,
        "effects": "none" if room.recipe.effects == NO_EFFECTS else "device",
        "frames": len(align_ms),
        "features": tracks.features,
        "align_ms": {"median": _round(np.median(align_ms)), "p99": _round(np.percentile(align_ms, 99))},
        "error_px": by_age(tracks.errors()),
    }


class TrueRoom:
    """A session's room and its one agent's true path: exact depth of its pictures."""

    def __init__(self, name: Path) -> None:
        source, session = open_source(str(name)), read_session(name.parent)
        truth = source.truth()
        if session.provenance.get("generator") != "share emulate" or truth is None:
            raise UsageError(f"{name}: not a session of `share emulate`")
        if len(session.agents) > 1:
            raise UsageError(f"{name}: has other agents; features on them move")
        self.recipe = recipe_of(session.provenance)
        self._camera = source.rig.cam0
        T_world_cam = truth.T @ source.rig.T_body_cam0
        self._T: dict[int, F64] = dict(zip(truth.stamps_ns.tolist(), T_world_cam, strict=True))
        with tempfile.TemporaryDirectory() as folder:
            prepared = prepare_session(self.recipe, Path(folder) / "room", no_progress)
            keep_room(prepared, no_progress)
            self._renderer = open_renderer(prepared.stage.room)

    def T_world_cam(self, stamp_ns: int) -> F64:
        """Return (4, 4). Raises KeyError where there is no ground truth."""
        return self._T[stamp_ns]

    def surface(self, stamp_ns: int, px: F32) -> tuple[F64, F64]:
        """Return inverse depth (N,) 1/m at px (N, 2), and the relative range (N,) of depth in their
        patches."""
        depth = self._renderer.depth(self._camera, SceneInstant(self.T_world_cam(stamp_ns)))
        square = np.ones((2 * patches.HALF_SIZE + 1,) * 2, np.uint8)
        span = (cv2.dilate(depth, square) - cv2.erode(depth, square)) / depth
        inside = np.clip(px, 0, (self._camera.width - 1.001, self._camera.height - 1.001))  # or just beyond
        x, y = np.rint(inside).astype(int).T
        return one_surface(np.float32(1) / depth, inside), span[y, x].astype(np.float64)


def recipe_of(about: Row) -> SessionRecipe:
    """Return the recipe of a session."""
    given = {f.name: about[f.name] for f in fields(SessionRecipe)}
    size = about["size"] and tuple(about["size"])
    effects = Effects(**about["effects"])
    return SessionRecipe(**given | {"motions": tuple(about["motions"]), "size": size, "effects": effects})


def one_surface(values: F32, px: F32) -> F64:
    """Return values (N,) at px (N, 2), bilinear, without those of the four pixels that are on another surface
    than the nearest one."""
    low = np.floor(px).astype(int)
    corners = low[:, None] + [[0, 0], [1, 0], [0, 1], [1, 1]]
    weight = (1 - np.abs(corners - px[:, None])).prod(axis=2)
    four = values[corners[..., 1], corners[..., 0]].astype(np.float64)
    nearest = np.take_along_axis(four, weight.argmax(axis=1)[:, None], axis=1)
    weight *= np.abs(four - nearest) < SAME * nearest
    out: F64 = (weight * four).sum(axis=1) / weight.sum(axis=1)
    return out


@dataclass(frozen=True, eq=False)
class Births(ArrayTable):
    """Of N features: index of the first frame, ray (N, 2) and inverse depth (N,) there, relative range of
    depth (N,) in the patch."""

    frame: I64
    ray: F64
    rho: F64
    edge: F64


@dataclass(frozen=True, eq=False)
class Errors(ArrayTable):
    """Of M observations: frames since the first; edge as above; px errors, and with the best depths."""

    age: I64
    edge: F64
    px: F64
    own_px: F64


class Tracks:
    """First and later observations of features."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._number: dict[int, int] = {}  # index of a feature among all births, by the state's id
        self._T_world_cam: list[F64] = []  # of frames
        self._births = [Births(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0))]
        self._sights: list[tuple[I64, I64, F32]] = []  # features, their frame, px

    @property
    def features(self) -> int:
        return sum(len(births.rho) for births in self._births)

    def see(self, stamp_ns: int, tracker: InertialTracker, room: TrueRoom) -> None:
        """Add the frame just tracked."""
        self._T_world_cam.append(room.T_world_cam(stamp_ns))
        if tracker.state is None or tracker.appearance is None:
            self._number = {}  # ids start again with a new segment
            return
        known = self._known(tracker.state)
        which = np.array([self._number[k] for k in tracker.state.feature_ids[known].tolist()], np.int64)
        self._sights.append((which, np.full(len(which), self._now), tracker.appearance.last_px[known]))

    def begin(self, stamp_ns: int, tracker: InertialTracker, room: TrueRoom) -> None:
        """Add features that the frame just tracked has begun."""
        if tracker.state is None or tracker.appearance is None:
            return
        new, first = ~self._known(tracker.state), self.features
        self._number |= {k: first + i for i, k in enumerate(tracker.state.feature_ids[new].tolist())}
        if new.any():
            surface = room.surface(stamp_ns, tracker.appearance.last_px[new])
            self._births.append(Births(np.full(new.sum(), self._now), tracker.state.ray[new], *surface))

    def errors(self) -> Errors:
        """Return the errors of all observations."""
        which, frame, px = (np.concatenate(column) for column in zip(*self._sights, strict=True))
        births = self._births[0].concatenate(*self._births[1:])
        host = births.frame[which]
        T = np.array(self._T_world_cam)
        ways = Ways(self._camera, se3.inverse(T[frame]) @ T[host], births.ray[which])
        own = ways.best_depth(px, which, births.rho)
        px_off, own_off = (np.linalg.norm(px - ways.at(rho[which])[0], axis=1) for rho in (births.rho, own))
        return Errors(frame - host, births.edge[which], px_off, own_off)

    @property
    def _now(self) -> int:
        return len(self._T_world_cam) - 1

    def _known(self, state: FilterState) -> NDArray[np.bool_]:
        return np.array([k in self._number for k in state.feature_ids.tolist()], bool)


class Ways:
    """Predicted positions of M observations by inverse depth. T_cam_host (M, 4, 4), ray (M, 2) in the
    host."""

    def __init__(self, camera: Camera, T_cam_host: F64, ray: F64) -> None:
        self._camera, self._t = camera, T_cam_host[:, :3, 3]
        self._far = (T_cam_host[:, :3, :3] @ rays(ray)[:, :, None])[:, :, 0]

    def at(self, rho: F64) -> tuple[F64, F64]:
        """Return px (M, 2) at inverse depths (M,), and the derivative (M, 2)."""
        q = self._far + rho[:, None] * self._t
        uv = q[:, :2] / q[:, 2:]
        by_rho = (self._t[:, :2] - uv * self._t[:, 2:]) / q[:, 2:]
        slope = (self._camera.jacobian(uv) @ by_rho[:, :, None])[:, :, 0]
        return self._camera.distort(uv), slope

    def best_depth(self, px: F32, which: I64, rho: F64) -> F64:
        """Return the inverse depths (N,) that fit the observations (M,) of features `which` best:
        Gauss-Newton from rho (N,)."""
        for _ in range(ROUNDS):
            there, slope = self.at(rho[which])
            pull = np.bincount(which, (slope * (px - there)).sum(axis=1), len(rho))
            weight = np.bincount(which, (slope * slope).sum(axis=1), len(rho))
            rho = rho + pull / (weight + UNSURE)
        return rho


def by_age(errors: Errors) -> Row:
    """Return percentiles by group and age."""
    edge = errors.edge > EDGE
    groups = {"all": errors, "smooth": errors.take(~edge), "edge": errors.take(edge)}
    return {
        name: {age: percentiles(group.take(group.age == age)) for age in AGES}
        for name, group in groups.items()
    }


def percentiles(errors: Errors) -> Row:
    if len(errors.px) < FEWEST:
        return {"n": len(errors.px)}
    median, p90, p99 = (_round(p) for p in np.percentile(errors.px, (50, 90, 99)))
    own_median, own_p90 = (_round(p) for p in np.percentile(errors.own_px, (50, 90)))
    return {"n": len(errors.px), "median": median, "p90": p90, "p99": p99} | {
        "own_depth": {"median": own_median, "p90": own_p90}
    }


def watch_alignment() -> list[float]:
    """Return a list that gets the CPU ms of every alignment from now on."""
    spent: list[float] = []
    align = patches.align

    @wraps(align)
    def timed(*arguments: Any, **named: Any) -> patches.AlignedPatches:
        began = time.process_time()
        found = align(*arguments, **named)
        spent.append(1e3 * (time.process_time() - began))
        return found

    setattr(patches, "align", timed)  # noqa: B010 -- mypy takes it for a method
    return spent


def table(rows: list[Row]) -> str:
    """Return a Markdown table: median / p90 / p99 px, (n)."""
    lines = ["| room, motion, seed, effects | features | " + " | ".join(f"age {age}" for age in AGES) + " |"]
    lines.append("|---" * (2 + len(AGES)) + "|")
    for row in rows:
        where = ", ".join(str(row[key]) for key in ("scene", "motion", "seed", "effects"))
        for group, ages in row["error_px"].items():
            lines.append(f"| {where} | {group} | " + " | ".join(map(cell, ages.values())) + " |")
    return "\n".join(lines)


def cell(found: Row) -> str:
    if "median" not in found:
        return "–"
    return f"{found['median']:.2f} / {found['p90']:.2f} / {found['p99']:.1f} ({found['n']})"


def _round(value: Any) -> float:
    return round(float(value), 3)


if __name__ == "__main__":
    main()
