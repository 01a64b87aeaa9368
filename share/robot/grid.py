"""The map that Nav2's static layer wants: cells of the floor, free or occupied."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from share.errors import ConfigError, DataError
from share.files.reading import read_bytes, read_errors
from share.files.yaml_file import read_yaml
from share.robot.planar import PlanarPose
from share.robot.settings import DrivingArea
from share.vision.image_codec import decode_gray

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
_RESOLUTION_M, _MARGIN_M = 0.05, 0.5
_MAX_CELLS = 4_000_000  # 100 m by 100 m at 5 cm
_MAX_IMAGE_BYTES = 64 << 20
_PGM_HEADER = re.compile(rb"P5\s+(?:#[^\n]*\n\s*)*(\d{1,6})\s+(\d{1,6})\s+255\s")


@dataclass(frozen=True, eq=False)
class FloorMap:
    """cells (rows, columns) int8: FREE, OCCUPIED or UNKNOWN; the first row is the lowest y. origin: of the
    corner of the first cell, in the map."""

    cells: NDArray[np.int8]
    resolution_m: float
    origin: PlanarPose


def free_rectangle(size_m: float) -> FloorMap:
    """Return a free square about the origin of the map."""
    n = round(size_m / _RESOLUTION_M)
    return FloorMap(np.full((n, n), FREE, np.int8), _RESOLUTION_M, PlanarPose(-size_m / 2, -size_m / 2, 0.0))


def area_grid(area: DrivingArea) -> FloorMap:
    """Return a grid that is free where a cell's centre is within the area, occupied elsewhere. Raises
    ConfigError for a large area."""
    x0, y0, x1, y1 = area.box
    columns, rows = (
        int(np.ceil((high - low + 2 * _MARGIN_M) / _RESOLUTION_M)) for low, high in ((x0, x1), (y0, y1))
    )
    if columns * rows > _MAX_CELLS:
        raise ConfigError(f"the area is {x1 - x0:.0f} m by {y1 - y0:.0f} m; draw a smaller one")
    x = x0 - _MARGIN_M + _RESOLUTION_M * (np.arange(columns) + 0.5)
    y = (y0 - _MARGIN_M + _RESOLUTION_M * (np.arange(rows) + 0.5))[:, None]
    inside = np.zeros((rows, columns), bool)
    corners = area.corners
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    cells = np.where(inside, FREE, OCCUPIED).astype(np.int8)
    return FloorMap(cells, _RESOLUTION_M, PlanarPose(x0 - _MARGIN_M, y0 - _MARGIN_M, 0.0))


def read_grid(path: Path) -> FloorMap:
    """Read a map in the form of nav2_map_server: a YAML file and the image that it names. Raises
    ConfigError."""
    form = read_yaml(path)
    image_path = path.parent / form.text("image")
    with read_errors(image_path, ConfigError):
        image = _gray(read_bytes(image_path, _MAX_IMAGE_BYTES), str(image_path))
    x, y, yaw = form.numbers("origin", (3,))
    shade = image.astype(float) / 255
    occupancy = shade if form.number("negate", 0.0) else 1 - shade
    cells = np.full(image.shape, UNKNOWN, np.int8)
    cells[occupancy > form.number("occupied_thresh", 0.65)] = OCCUPIED
    cells[occupancy < form.number("free_thresh", 0.25)] = FREE
    return FloorMap(cells[::-1].copy(), form.number("resolution", positive=True), PlanarPose(x, y, yaw))


def _gray(data: bytes, where: str) -> NDArray[np.uint8]:
    """Return an image (rows, columns) of PGM, in bytes, or PNG. Raises ConfigError."""
    if not data.startswith(b"P5"):
        try:
            return decode_gray(data, where)
        except DataError as error:
            raise ConfigError(f"{error} (a map is a PGM or PNG image)") from None
    header = _PGM_HEADER.match(data)
    columns, rows = (int(header[1]), int(header[2])) if header else (0, 0)
    pixels = np.frombuffer(data, np.uint8, offset=0 if header is None else header.end())
    if not 0 < columns * rows <= min(_MAX_CELLS, len(pixels)):
        raise ConfigError(
            f"{where}: is no PGM image of at most {_MAX_CELLS:,} bytes, or was cut off; save the map again"
        )
    return pixels[: columns * rows].reshape(rows, columns)
