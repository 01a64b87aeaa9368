"""Corner statistics of recordings and of rooms, one line each, and contact sheets of the rooms.

    python tools/experiments/corner_statistics.py FOLDER ...             images (PNG, JPEG) in all sub-folders
    python tools/experiments/corner_statistics.py --room warehouse:1 --room firestation:2 [--sheet FILE]

Images of folders are cropped to the middle 4:3 and, where they are not 480 high, shrunk to 640 x 480 by
areas. Rooms are drawn as the middle of a EuRoC camera's image (640 x 480, f = 458 px, no distortion) from
free places of people and robots, exposed to a mean of 110, with 0.5 px of blur and 1.5 gray levels of noise.
All figures are means over the images except for the last three: quartiles of `fast`.
"""

from __future__ import annotations

import argparse
from dataclasses import astuple, fields
from pathlib import Path

import cv2
import numpy as np
from image_statistics import (
    HEIGHT,
    WIDTH,
    ImageStatistics,
    image_statistics,
    resize_to_standard,
)

from share.types import F32, U8

_FOCAL, _MEAN, _BLUR, _NOISE = 458.0, 110.0, 0.5, 1.5


def of_folder(folder: Path, most: int) -> list[U8]:
    """Return at most `most` images, evenly over the sorted names, without depth images."""
    found = sorted(
        p for p in folder.rglob("*") if p.suffix.lower() in (".png", ".jpg") and "depth" not in p.parts
    )
    chosen = found[:: max(1, len(found) // most)][:most]
    return [
        resize_to_standard(np.asarray(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE), np.uint8)) for p in chosen
    ]


def of_room(name: str, seed: int, count: int) -> list[U8]:
    """Return views of one room."""
    from room_views import standing_views

    from share.geometry.camera import Camera
    from share.lab.emulate.render.gl import GlRenderer
    from share.lab.emulate.types import SceneInstant
    from share.lab.emulate.world.build import build_room
    from share.lab.emulate.world.occupancy import Occupancy
    from share.lab.emulate.world.scenes import make_scene_layout

    room, rng = make_scene_layout(name, seed), np.random.default_rng((seed, 5))
    camera = Camera(WIDTH, HEIGHT, _FOCAL, _FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
    renderer = GlRenderer(build_room(room))
    views = standing_views(Occupancy.from_layout(room), seed, count)
    return [taken(renderer.radiance(camera, [SceneInstant(T)]), rng) for T in views]


def taken(radiance: F32, rng: np.random.Generator) -> U8:
    """Return a plain camera's image of the radiance."""
    soft = cv2.GaussianBlur(radiance * (_MEAN / max(float(radiance.mean()), 1.0)), (0, 0), _BLUR)
    out: U8 = (soft + rng.normal(0, _NOISE, soft.shape)).clip(0, 255).astype(np.uint8)
    return out


def sheet(images: list[U8], columns: int = 4, rows: int = 3) -> U8:
    """Return a contact sheet."""
    small = [cv2.resize(i, (400, 300), interpolation=cv2.INTER_AREA) for i in images[: columns * rows]]
    return np.asarray(np.block([small[k * columns : (k + 1) * columns] for k in range(rows)]), np.uint8)


def line(name: str, images: list[U8]) -> str:
    found = np.array([astuple(image_statistics(image)) for image in images])
    figures = [*found.mean(0), *np.percentile(found[:, 0], (25, 50, 75))]
    return f"{name:22}" + "".join(f"{v:10.2f}" for v in figures)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--room", action="append", default=[], metavar="NAME:SEED")
    parser.add_argument("--most", type=int, default=60, help="images of each folder or room")
    parser.add_argument("--sheet", type=Path, help="file for a contact sheet of the last room")
    args = parser.parse_args()
    names = [*(f.name for f in fields(ImageStatistics)), "q25", "q50", "q75"]
    print(f"{'':22}" + "".join(f"{name:>10}" for name in names))
    for folder in args.folders:
        images = of_folder(folder, args.most)
        if not images:
            parser.error(f"{folder}: no PNG or JPEG images in it")
        print(line(folder.name, images))
    for room in args.room:
        name, _, seed = room.partition(":")
        images = of_room(name, int(seed or 1), args.most)
        print(line(room, images), flush=True)
        if args.sheet:
            cv2.imwrite(str(args.sheet), sheet(images), [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
