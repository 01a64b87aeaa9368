"""The map that Nav2's static layer wants: cells of the floor, free or occupied."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from share.errors import ConfigError
from share.files.reading import read_bytes, read_errors
from share.files.yaml_file import read_yaml
from share.robot.area import DrivingArea
from share.robot.planar import PlanarPose

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
_RESOLUTION_M, _MARGIN_M = 0.05, 0.5
_MAX_CELLS = 4_000_000  # 100 m by 100 m at 5 cm
_MAX_IMAGE_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """cells (rows, columns) int8: FREE, OCCUPIED or UNKNOWN; the first row is the lowest y. origin: of the
    corner of the first cell, in the map."""

    cells: NDArray[np.int8]
    resolution_m: float
    origin: PlanarPose


def free_rectangle(size_m: float) -> FloorGrid:
    """Return a free square about the origin of the map."""
    n = round(size_m / _RESOLUTION_M)
    return FloorGrid(np.full((n, n), FREE, np.int8), _RESOLUTION_M, PlanarPose(-size_m / 2, -size_m / 2, 0.0))


def area_grid(area: DrivingArea) -> FloorGrid:
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
    return FloorGrid(cells, _RESOLUTION_M, PlanarPose(x0 - _MARGIN_M, y0 - _MARGIN_M, 0.0))


def read_grid(path: Path) -> FloorGrid:
    """Read a map in the form of nav2_map_server: a YAML file and the image that it names. Raises
    ConfigError."""
    import cv2

    form = read_yaml(path)
    image_path = path.parent / form.text("image")
    with read_errors(image_path, ConfigError):
        data = read_bytes(image_path, _MAX_IMAGE_BYTES)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None or image.size > _MAX_CELLS:
        raise ConfigError(
            f"{image_path}: is no image of at most {_MAX_CELLS:,} pixels, as map_saver writes them"
        )
    x, y, yaw = form.numbers("origin", (3,))
    shade = image.astype(float) / 255
    occupancy = shade if form.number("negate", 0.0) else 1 - shade
    cells = np.full(image.shape, UNKNOWN, np.int8)
    cells[occupancy > form.number("occupied_thresh", 0.65)] = OCCUPIED
    cells[occupancy < form.number("free_thresh", 0.25)] = FREE
    return FloorGrid(cells[::-1].copy(), form.number("resolution", positive=True), PlanarPose(x, y, yaw))
