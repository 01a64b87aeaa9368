"""Contact sheets of the scenes, and of a session.

    python tools/experiments/contact_sheets.py [--scene NAME ...] [--out DIR]
    python tools/experiments/contact_sheets.py --session SESSION [--out DIR]

For every scene and two seeds: 3 x 4 views of people (1.5-1.75 m) and robots (0.35 m) from free places along
free directions, each exposed to the same mean. With --session:
DIR/session.jpg, the plan of an emulated session and a row of images for each agent.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from room_views import level_camera_pose

from share.geometry.camera import Camera
from share.lab.emulate.render.gl import GlRenderer
from share.lab.emulate.session import PLAN_FILE
from share.lab.emulate.types import SceneInstant
from share.lab.emulate.world.build import build_room
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy
from share.lab.emulate.world.scenes import SCENES, make_scene_layout
from share.recordings.session import read_session
from share.runtime.source import open_source
from share.sensors.measurement import CAM0
from share.types import F32, F64, U8

ROWS, COLUMNS = 3, 4
CAMERA = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)  # like a D435i's infrared pair
CLEARANCE = 0.45  # m
EXPOSED, BRIGHTEST_GAIN = 110.0, 1.3  # mean gray level; largest gain for dark views
SMALL = (288, 216)  # px, of an image on a sheet
BLUR, NOISE = 0.5, 1.5  # px, gray levels; of a good camera


def views(room: Layout, count: int) -> list[F64]:
    """Return poses (4, 4) of people and, for every third, of a robot. Each looks along the freest of three
    directions, as people mostly look where they go."""
    rng = np.random.default_rng((room.seed, 77))
    distance, origin, step = Occupancy.from_layout(room, 0.1).floor_clearance(0.1, 1.9)
    cells = np.argwhere(distance >= CLEARANCE)
    out = []
    for k in range(count):
        x, y = origin + cells[rng.integers(len(cells))] * step
        yaw = max(rng.uniform(-np.pi, np.pi, 3), key=lambda a: _free_ahead(distance, x / step, y / step, a))
        robot = k % 3 == 2
        height = 0.35 if robot else rng.uniform(1.5, 1.75)
        pitch = 0.1 if robot else rng.normal(-0.08, 0.12)
        out.append(level_camera_pose((x, y, height), yaw, pitch))
    return out


def _free_ahead(distance: F32, x: float, y: float, yaw: float) -> int:
    """Return the number of free cells from (x, y) to the first blocked one."""
    for k in range(1, max(distance.shape)):
        i, j = int(x + k * np.cos(yaw)), int(y + k * np.sin(yaw))
        if not (0 <= i < distance.shape[0] and 0 <= j < distance.shape[1]) or distance[i, j] <= 0:
            return k
    return max(distance.shape)


def photograph(room: Layout, poses: list[F64]) -> list[U8]:
    """Return images (480, 640) of a room."""
    renderer, rng, out = GlRenderer(build_room(room)), np.random.default_rng((room.seed, 78)), []
    for T in poses:
        light = renderer.radiance(CAMERA, [SceneInstant(T)])
        light *= min(BRIGHTEST_GAIN, EXPOSED / max(float(light.mean()), 1.0))
        light = cv2.GaussianBlur(light, (0, 0), BLUR)
        out.append((light + rng.normal(0, NOISE, light.shape)).clip(0, 255).astype(np.uint8))
    return out


def sheet(images: list[U8]) -> U8:
    """Return ROWS x COLUMNS images, made small."""
    small = [cv2.resize(image, SMALL, interpolation=cv2.INTER_AREA) for image in images]
    return np.block([[small[r * COLUMNS + c] for c in range(COLUMNS)] for r in range(ROWS)])


def seen(folder: Path) -> U8:
    """Return the plan of a session (colour), and COLUMNS images of each agent over its whole length."""
    rows = [_along(folder / name) for name in read_session(folder).agents]
    images = cv2.cvtColor(np.concatenate(rows), cv2.COLOR_GRAY2BGR)
    plan = cv2.imread(str(folder / PLAN_FILE))
    size = round(plan.shape[1] * len(images) / plan.shape[0]), len(images)
    return np.hstack([cv2.resize(plan, size, interpolation=cv2.INTER_AREA), images])


def _along(agent: Path) -> U8:
    """Return images of cam0 of SESSION/NAME side by side."""
    source = open_source(str(agent))
    count = source.images_count
    chosen = {(2 * k + 1) * count // (2 * COLUMNS) for k in range(COLUMNS)}
    of_cam0 = (m for m in source.measurements() if m.stream == CAM0)
    images = [m.payload.load() for k, m in enumerate(of_cam0) if k in chosen]
    return np.hstack([cv2.resize(i, SMALL, interpolation=cv2.INTER_AREA) for i in images])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", action="append", choices=SCENES, help="only this one; may be repeated")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument(
        "--size", type=float, nargs=3, metavar=("X", "Y", "Z"), help="m, instead of the usual"
    )
    parser.add_argument("--session", type=Path, help="an emulated session, instead of scenes")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[2] / "docs" / "pictures")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.session:
        write(args.out / "session.jpg", seen(args.session))
        return
    for name in args.scene or SCENES:
        for seed in args.seeds:
            room = make_scene_layout(name, seed, tuple(args.size) if args.size else None)
            images = photograph(room, views(room, ROWS * COLUMNS))
            write(args.out / f"{name}-{seed}.jpg", sheet(images))


def write(path: Path, picture: U8) -> None:
    """Write a JPEG and print its name."""
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(f"{path}  {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
