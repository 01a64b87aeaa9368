"""Corner statistics of images in folders: `python tools/corner_statistics.py FOLDER ...`

For every folder: the mean over its images (PNG or JPEG, in all sub-folders), each cut to the middle 4:3 and,
where it is not 480 high, shrunk to 640 x 480 by areas. Compare a rendered room with real recordings only so.
"""

from __future__ import annotations

import argparse
from dataclasses import astuple, fields
from pathlib import Path

import cv2

from share.emulate.world.stats import ImageStatistics, comparable, mean_statistics


def images(folder: Path, most: int) -> list[Path]:
    """At most `most` images, evenly over the sorted names."""
    found = sorted(
        p for p in folder.rglob("*") if p.suffix.lower() in (".png", ".jpg") and "depth" not in p.name
    )
    return found[:: max(1, len(found) // most)][:most]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--most", type=int, default=100, help="images per folder")
    args = parser.parse_args()
    print(f"{'':24}" + "".join(f"{f.name:>10}" for f in fields(ImageStatistics)))
    for folder in args.folders:
        paths = images(folder, args.most)
        if not paths:
            parser.error(f"{folder}: no PNG or JPEG images in it")
        gray = [comparable(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)) for p in paths]
        print(f"{folder.name:24}" + "".join(f"{v:10.2f}" for v in astuple(mean_statistics(gray))))


if __name__ == "__main__":
    main()
