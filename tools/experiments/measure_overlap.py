"""Accuracy and cost of `share.scheduling.overlap`, by the distance of its points.

    python tools/experiments/measure_overlap.py

Accuracy: IoU of 300 pairs of views against points 6 cm apart, one of a D435i's depth camera, one of a camera
of the EuRoC rig; half of the pairs at random in a room of 8 x 8 m, half near each other. Cost: CPU time of
one thread, one view of the first camera against the 23 others of a room of the second.
"""

from __future__ import annotations

import math
import time

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.config import ControlConfig  # noqa: E402
from share.geometry.camera import Camera  # noqa: E402
from share.geometry.se3 import exp, from_rt, so3_exp  # noqa: E402
from share.scheduling.overlap import Frustum, SampledFrustum, ious, overlap_volumes  # noqa: E402
from share.types import F64  # noqa: E402

SIDE_M = 8.0
CAMERAS = Camera(848, 480, 423.0, 423.0, 423.5, 239.5), Camera(752, 480, 458.7, 457.3, 367.2, 248.4)
LOOK = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along x of a world with z up


def views(rng: np.random.Generator, count: int) -> F64:
    """Return T_w_cam (count, 4, 4) of people and robots with random directions."""
    turn = np.zeros((count, 3))
    turn[:, 2] = rng.uniform(-math.pi, math.pi, count)
    nod = np.column_stack([rng.normal(0, 0.1, count), rng.normal(0, 0.2, count), np.zeros(count)])
    place = np.column_stack([rng.uniform(0, SIDE_M, (count, 2)), rng.choice([0.3, 1.6], count)])
    return from_rt(so3_exp(turn) @ so3_exp(nod) @ LOOK, place)


def pairs(rng: np.random.Generator) -> list[tuple[F64, F64]]:
    anyhow = [(a, b) for a, b in (views(rng, 2) for _ in range(150))]
    moves = exp(np.hstack([rng.normal(0, 0.5, (150, 3)), rng.normal(0, 0.8, (150, 3))]))
    return anyhow + [(a, a @ move) for a, move in zip(views(rng, 150), moves, strict=True)]


def seen(interval_m: float) -> tuple[SampledFrustum, SampledFrustum]:
    config = ControlConfig()
    a, b = (Frustum.from_camera(camera, config.near_m, config.far_m) for camera in CAMERAS)
    return SampledFrustum(a, interval_m), SampledFrustum(b, interval_m)


def all_ious(interval_m: float, them: list[tuple[F64, F64]]) -> F64:
    a, b = seen(interval_m)
    return np.array([ious(a, T_a, b, T_b[None])[0] for T_a, T_b in them])


def cpu_ms(interval_m: float, rooms: list[F64]) -> F64:
    """Return CPU ms of each room."""
    (a, b), out = seen(interval_m), []
    for room in rooms:
        begun = time.process_time_ns()
        overlap_volumes(a, room[0], b, room[1:])
        out.append((time.process_time_ns() - begun) / 1e6)
    return np.array(out)


def main() -> None:
    rng = np.random.default_rng(3)
    them, rooms = pairs(rng), [views(rng, 24) for _ in range(300)]
    true = all_ious(0.06, them)
    some = true > 0
    print(f"{some.sum()} of {len(them)} pairs overlap, mean IoU {true[some].mean():.2f}")
    print("interval m | points of each | IoU off: rms, p95, most | 23 others: ms p50, p95")
    for interval_m in (1.0, 0.7, 0.5, 0.4, 0.3, 0.2):
        off, ms = np.abs(all_ious(interval_m, them) - true)[some], cpu_ms(interval_m, rooms)
        points = ", ".join(str(each.points.shape[1]) for each in seen(interval_m))
        wrong = f"{np.sqrt(np.mean(off**2)):.4f}, {np.quantile(off, 0.95):.4f}, {off.max():.4f}"
        cost = f"{np.median(ms):.2f}, {np.quantile(ms, 0.95):.2f}"
        print(f"{interval_m:10.1f} | {points} | {wrong} | {cost}")


if __name__ == "__main__":
    main()
