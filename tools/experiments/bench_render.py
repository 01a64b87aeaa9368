"""Cost of drawing a room: CPU time per image, and images per second in one and in two processes. Prints JSON.

    python tools/experiments/bench_render.py [--scene NAME] [--images N] [--seed S] [--room FOLDER]

A room of `share.lab.emulate.world` (kept in FOLDER if given, as baking takes a while), seen while turning on
the spot in its middle. `cpu_ms` is the median over images of `radiance` and `depth` together; `per_second` is
by wall time, and two processes need two idle cores.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.geometry.camera import Camera  # noqa: E402
from share.lab.emulate.render.gl import GlRenderer  # noqa: E402
from share.lab.emulate.types import DrawableRoom, SceneInstant  # noqa: E402
from share.lab.emulate.world.build import build_room  # noqa: E402
from share.lab.emulate.world.room_files import load_room, save_room  # noqa: E402
from share.lab.emulate.world.scenes import SCENES, make_scene_layout  # noqa: E402
from share.spawning import SPAWN_CONTEXT  # noqa: E402

D435I = Camera(640, 480, 383.2, 384.1, 318.7, 242.3)
EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
MOMENTS = 8  # of an image with motion blur


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scene", choices=sorted(SCENES), default="warehouse")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--room", type=Path, help="folder that keeps the room between runs")
    options = parser.parse_args()
    room = the_room(options.scene, options.seed, options.room)
    renderer = GlRenderer(room)
    report: dict[str, Any] = {
        "room": room.name,
        "triangles": len(room.mesh.faces),
        "device": renderer.device,
        "cpu_ms": {name: cpu_ms(renderer, room, name, options.images) for name in JOBS},
        "per_second": {n: per_second(room, n, options.images) for n in (1, 2)},
    }
    print(json.dumps(report, indent=2))


def the_room(scene: str, seed: int, kept: Path | None) -> DrawableRoom:
    if kept and kept.exists():
        return load_room(kept)
    room = build_room(make_scene_layout(scene, seed))
    if kept:
        save_room(room, kept)
    return room


def moments(room: DrawableRoom, k: int, count: int) -> list[SceneInstant]:
    """Return the instants of the k-th image's exposure: a slow turn in the middle of the room."""
    return [SceneInstant(looking(room.size, 0.15 * k + 0.005 * j)) for j in range(count)]


def looking(size: np.ndarray, yaw: float) -> np.ndarray:
    T = np.eye(4)
    c, s = np.cos(yaw), np.sin(yaw)
    T[:3, :3] = np.array([[s, -c, 0], [0, 0, -1], [c, s, 0]]).T
    T[:3, 3] = size[0] / 2, size[1] / 2, 1.6
    return T


JOBS = {
    "image": lambda r, room, k: r.radiance(D435I, moments(room, k, 1)),
    "depth": lambda r, room, k: r.depth(D435I, moments(room, k, 1)[0]),
    f"image_blurred_by_{MOMENTS}": lambda r, room, k: r.radiance(D435I, moments(room, k, MOMENTS)),
    "image_with_lens": lambda r, room, k: r.radiance(EUROC, moments(room, k, 1)),
    "depth_with_lens": lambda r, room, k: r.depth(EUROC, moments(room, k, 1)[0]),
}


def cpu_ms(renderer: GlRenderer, room: DrawableRoom, job: str, images: int) -> float:
    times = []
    for k in range(max(4, images if "lens" not in job else images // 4)):
        start = time.process_time()
        JOBS[job](renderer, room, k)
        times.append(time.process_time() - start)
    return round(1e3 * float(np.median(times[2:])), 1)  # the first ones compile and allocate


def per_second(room: DrawableRoom, processes: int, images: int) -> float:
    """Return images per second, without depth, of all processes together."""
    barrier, done = SPAWN_CONTEXT.Barrier(processes + 1), SPAWN_CONTEXT.Queue()
    workers = [
        SPAWN_CONTEXT.Process(target=draw, args=(room, images, barrier, done)) for _ in range(processes)
    ]
    for worker in workers:
        worker.start()
    barrier.wait()
    slowest = max(done.get() for _ in workers)
    for worker in workers:
        worker.join()
    return round(processes * images / slowest, 1)


def draw(room: DrawableRoom, images: int, barrier: Any, done: Any) -> None:
    renderer = GlRenderer(room)
    JOBS["image"](renderer, room, 0)
    barrier.wait()
    start = time.perf_counter()
    for k in range(images):
        JOBS["image"](renderer, room, k)
    done.put(time.perf_counter() - start)


if __name__ == "__main__":
    main()
