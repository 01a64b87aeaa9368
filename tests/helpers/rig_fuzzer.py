"""Rigs that nobody has, and what a tracker makes of them.

    python tests/helpers/rig_fuzzer.py [RIGS] [SEED] [--unguarded]

prints how many of them are refused, are tracked, and end in an exception. --unguarded: neither what a tracker
needs is asked for, nor are its failures caught."""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from helpers import plain_walk
from helpers.plain_walk import RIG

from share.config import Config
from share.geometry import rig_check, se3
from share.geometry.camera import Camera, Rig
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.pipeline import make_tracker
from share.types import U8, Frame, ImuBatch

SEED, RATE_HZ, STEP_S, _H = 18, 15.0, 0.005, 2e-3
BEGIN_S = 0.6  # while the walker still stands: a tracker begins at once, and soon has to move
_HUGE = (-1e4, -30.0, -1.0, -0.3, -1e-12, 0.0, 1e-6, 0.1, 0.3, 1.0, 30.0, 1e4)


@dataclass(frozen=True, eq=False)
class Walk:
    """Frames of a walker in the plain room, stereo with IMU and a depth image."""

    frames: tuple[Frame, ...]


def walk(count: int) -> Walk:
    """The same each time."""
    seconds = BEGIN_S + np.arange(count) / RATE_HZ
    pairs = plain_walk.pairs(plain_walk.poses("walker", seconds, SEED), SEED)
    rng = np.random.default_rng(SEED)
    depth = cv2.GaussianBlur(rng.uniform(0.5, 6.0, (480, 640)).astype(np.float32), (0, 0), 40)
    frames, last = [], BEGIN_S - 0.3
    for k, (at, (left, right)) in enumerate(zip(seconds.tolist(), pairs, strict=True)):
        frames.append(Frame(round(at * 1e9), k, left, right, depth, _imu(last, at)))
        last = at
    return Walk(tuple(frames))


def _imu(after: float, until: float) -> ImuBatch:
    """What a perfect IMU says in (after, until], and the first sample beyond."""
    t = np.arange(round(after / STEP_S) + 2, round(until / STEP_S) + 2) * STEP_S
    before, now, then = (
        plain_walk.poses("walker", t + d, SEED) @ se3.inverse(RIG.T_body_cam0) for d in (-_H, 0.0, _H)
    )
    turned = np.swapaxes(before[:, :3, :3], 1, 2) @ then[:, :3, :3]
    force = (then[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / _H**2 + [0, 0, 9.81]
    body = (np.swapaxes(now[:, :3, :3], 1, 2) @ force[:, :, None])[:, :, 0]
    return ImuBatch(np.rint(t * 1e9).astype(np.int64), se3.so3_log(turned) / (2 * _H), body)


# ---------------------------------------------------------------- rigs


def rigs(count: int, seed: int) -> Iterator[tuple[str, Rig]]:
    """What was done to each, and the rig; such as cannot even be made are left out."""
    rng, made = np.random.default_rng(seed), 0
    while made < count:
        what, rig = [], _base(rng)
        try:
            for _ in range(rng.choice([1, 1, 1, 2, 3])):
                name = str(rng.choice(list(_CHANGES)))
                rig, said = _CHANGES[name](rig, rng)
                what.append(f"{name} {said}")
        except ValueError:  # no rig at all: the types refuse it
            continue
        made += 1
        yield f"{rig.kind}: " + ", ".join(what), rig


def _base(rng: np.random.Generator) -> Rig:
    depth = {"depth": RIG.cam0, "T_depth_cam0": se3.from_rt(np.eye(3), np.array([0.015, 0, 0]))}
    kinds = [
        RIG,
        RIG,
        RIG.without_imu(),
        replace(RIG, cam1=None, T_cam1_cam0=None, **depth),
        replace(RIG, cam1=None, T_cam1_cam0=None, **depth).without_imu(),
        replace(RIG, cam1=None, T_cam1_cam0=None),
        replace(RIG, cam1=None, T_cam1_cam0=None).without_imu(),
    ]
    return kinds[int(rng.integers(len(kinds)))]


def _camera(rig: Rig, rng: np.random.Generator, **values: object) -> Rig:
    names = [name for name in ("cam0", "cam1", "depth") if getattr(rig, name) is not None]
    chosen = names if rng.random() < 0.5 else [str(rng.choice(names))]
    return replace(rig, **{name: replace(getattr(rig, name), **values) for name in chosen})


def _lens(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    reported = [0.0] * int(rng.choice([4, 5]))
    for _ in range(int(rng.integers(1, 4))):
        reported[int(rng.integers(len(reported)))] = float(rng.choice(_HUGE))
    return _camera(rig, rng, distortion=tuple(reported)), str(tuple(reported))


def _focal(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    f = float(rng.choice([1.0, 3.0, 20.0, 200.0, 900.0, 5e3, 1e5]))
    f2 = f if rng.random() < 0.7 else float(rng.choice([1.0, 40.0, 1e5]))
    return _camera(rig, rng, fx=f, fy=f2), f"{f:g} {f2:g}"


def _centre(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    cx, cy = (float(rng.choice([-1e6, -700.0, 0.0, 639.0, 2e3, 1e6])) for _ in range(2))
    return _camera(rig, rng, cx=cx, cy=cy), f"{cx:g} {cy:g}"


def _size(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    width, height = rng.choice([1, 8, 16, 33, 64, 640], 2).tolist()
    names = [name for name in ("cam0", "cam1", "depth") if getattr(rig, name) is not None]
    at = float(width) / 640, float(height) / 480
    made = {
        name: Camera(width, height, max(c.fx * at[0], 1.0), max(c.fy * at[1], 1.0), width / 2, height / 2)
        for name in names
        for c in (getattr(rig, name),)
    }
    return replace(rig, **made), f"{width}x{height}"


def _rotation(rng: np.random.Generator) -> np.ndarray:
    axis = np.eye(3)[int(rng.integers(3))]
    return np.asarray(se3.so3_exp(np.radians(float(rng.choice([3, 30, 60, 90, 180]))) * axis))


def _right(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    if rig.T_cam1_cam0 is None:
        return _lever(rig, rng)
    T = rig.T_cam1_cam0.copy()
    if rng.random() < 0.5:
        T[:3, :3] = _rotation(rng)
    else:
        T[:3, 3] = rng.choice([-1.5, -0.1, -0.005, 0.0, 0.005, 0.1, 1.5], 3)
    return replace(rig, T_cam1_cam0=T), f"{np.round(T, 3).tolist()}"


def _lever(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    name = "T_depth_cam0" if rig.depth is not None and rng.random() < 0.5 else "T_body_cam0"
    T = getattr(rig, name).copy()
    if rng.random() < 0.5:
        T[:3, :3] = _rotation(rng)
    else:
        T[:3, 3] = rng.choice([-1e5, -30.0, -1.0, 0.0, 1.0, 30.0, 1e5], 3)
    return replace(rig, **{name: T}), f"{name} {np.round(T, 3).tolist()}"


def _noise(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    if rig.imu is None:
        return _focal(rig, rng)
    name = str(rng.choice(["gyro_density", "accel_density", "gyro_walk", "accel_walk", "rate_hz"]))
    value = float(rng.choice([0.0, 1e-300, 1e-7, 1.0, 1e3]))
    return replace(rig, imu=replace(rig.imu, **{name: value})), f"{name} {value:g}"


def _shift(rig: Rig, rng: np.random.Generator) -> tuple[Rig, str]:
    if rig.imu is None:
        return _centre(rig, rng)
    shift = float(rng.choice([-1.0, -0.1, 0.1, 1.0]))
    return replace(rig, timeshift_s=shift), f"{shift:g}"


_CHANGES = {
    "lens": _lens,
    "focal": _focal,
    "centre": _centre,
    "size": _size,
    "cam1": _right,
    "lever": _lever,
    "noise": _noise,
    "timeshift": _shift,
}


# ---------------------------------------------------------------- tracking


def frames_for(rig: Rig, walk: Walk) -> Iterator[Frame]:
    """Yield the frames of the walk as this rig would deliver them."""
    for frame in walk.frames:
        yield replace(
            frame,
            image0=_fitted(frame.image0, rig.cam0),
            image1=None if rig.cam1 is None else _fitted(frame.image1, rig.cam1),
            depth=None if rig.depth is None else _fitted(frame.depth, rig.depth),
            imu=frame.imu if rig.imu is not None else ImuBatch.empty(),
        )


def _fitted(image: U8, camera: Camera) -> U8:
    size = (camera.width, camera.height)
    return image if image.shape[::-1] == size else np.asarray(cv2.resize(image, size))


def play(rig: Rig, walk: Walk, guarded: bool = True) -> Counter[str]:
    """States of the frames, what failed (`failed`), or why the rig was refused (`refused`)."""
    states: Counter[str] = Counter()
    if guarded and rig_check.rig_problem(rig) is not None:
        return Counter(refused=1)
    guard = FaultGuard(lambda text: states.update([f"failed: {text}"]))
    tracker = GuardedTracker(rig, Config(), guard) if guarded else make_tracker(rig, Config())
    for frame in frames_for(rig, walk):
        result = tracker.track(frame)
        states[str(result.state)] += 1
        if result.T_odom_body is not None:
            assert np.isfinite(result.T_odom_body).all()
        if result.keyframe_ready:
            if isinstance(tracker, GuardedTracker):
                tracker.attempt("keyframe", frame, lambda frame=frame: make_keyframe(tracker, frame))
            else:
                make_keyframe(tracker, frame)
    return states


def make_keyframe(tracker: object, frame: Frame) -> None:
    tracker.make_keyframe(frame)
    tracker.finish_keyframe()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("rigs", type=int, nargs="?", default=200)
    parser.add_argument("seed", type=int, nargs="?", default=35)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--unguarded", action="store_true")
    options = parser.parse_args()
    seen, tally, slowest = walk(options.frames), Counter(), (0.0, "")
    for what, rig in rigs(options.rigs, options.seed):
        began = time.process_time()
        with warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter("always")
            try:
                states = play(rig, seen, not options.unguarded)
            except Exception as error:
                at = error.__traceback__
                while at is not None and at.tb_next is not None:
                    at = at.tb_next
                states = Counter({f"{type(error).__name__} in {at.tb_frame.f_code.co_name}": 1})
        slowest = max(slowest, (time.process_time() - began, what))
        kind = next((k for k in states if not k.isupper() and "_" not in k[:9]), None)
        tally[kind or ("tracked" if states["OK"] or states["WEAK"] else "no pose")] += 1
        tally["with warnings"] += bool(noted)
        if kind is not None and kind != "refused":
            print(f"{kind[:160]} <- {what}", flush=True)
        if noted:
            first = noted[0]
            print(f"   {len(noted)} warnings: {first.message}, {first.filename}:{first.lineno} <- {what}")
    print(dict(tally), f"slowest {slowest[0]:.1f} s: {slowest[1]}")


if __name__ == "__main__":
    from share import startup

    startup.prepare_process()
    main()
