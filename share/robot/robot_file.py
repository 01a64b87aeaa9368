"""The file that describes a robot: where its camera sits, where and how fast it may drive
(docs/do/robot.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import radians
from pathlib import Path

import numpy as np

from share.errors import ConfigError
from share.files.yaml_file import Section, read_yaml
from share.geometry.se3 import from_rt, inverse, so3_exp
from share.robot.grid import FloorMap, area_grid, free_rectangle, read_grid
from share.robot.settings import CREATE3_SPEED_M_S, DrivingArea, RobotSettings
from share.types import F64

_MAX_MOUNTING_M = 10.0  # of the camera from base_link; a position in mm is beyond
FREE_SQUARE_M = 40.0  # the map, where neither an area nor a map is given
_KEYS = ("camera", "T_base_body", "area", "area_map", "map", "max_speed_m_s", "max_sigma_m", "edge_silence_s")
# a camera's body (x right, y down, z ahead) in a base (x ahead, y left, z up), both level and looking ahead
_R_BASE_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """The content of a robot file: settings of the bridge, and the map to publish."""

    settings: RobotSettings
    grid: FloorMap = field(default_factory=lambda: free_rectangle(FREE_SQUARE_M))


def read_robot(path: Path) -> RobotDescription:
    """Read the file. Raises ConfigError that names the key."""
    form = read_yaml(path)
    if unknown := [key for key in form.data if key not in _KEYS]:
        raise ConfigError(f"{path}: unknown key '{unknown[0]}'; known: {', '.join(_KEYS)}")
    area = _area(form) if "area" in form else None
    T_base_body = _T_base_body(form)
    if np.abs(T_base_body[:3, 3]).max() > _MAX_MOUNTING_M:
        raise ConfigError(
            f"{path}: the camera is more than {_MAX_MOUNTING_M:g} m from base_link; give metres"
        )
    settings = RobotSettings(inverse(T_base_body), area=area)
    settings = replace(
        settings,
        max_speed_m_s=form.number("max_speed_m_s", settings.max_speed_m_s, positive=True),
        max_sigma_m=form.number("max_sigma_m", settings.max_sigma_m, positive=True),
        edge_silence_s=form.number("edge_silence_s", settings.edge_silence_s, positive=True),
    )
    if settings.max_speed_m_s > CREATE3_SPEED_M_S:
        raise ConfigError(f"{path}: max_speed_m_s: a Create 3 drives {CREATE3_SPEED_M_S} m/s at most")
    if "map" in form:
        return RobotDescription(settings, read_grid(path.parent / form.text("map")))
    return RobotDescription(settings) if area is None else RobotDescription(settings, area_grid(area))


def _T_base_body(form: Section) -> F64:
    """Return the place of the agent's body in base_link: as a matrix, or as measured with a ruler."""
    if ("T_base_body" in form) == ("camera" in form):
        raise ConfigError(
            f"{form.where}: give either 'camera' (position_m, yaw_deg, pitch_deg) or 'T_base_body'"
        )
    if "T_base_body" in form:
        return form.pose("T_base_body")
    camera = form.section("camera")
    if unknown := [key for key in camera.data if key not in ("position_m", "yaw_deg", "pitch_deg")]:
        raise ConfigError(
            f"{camera.where}: unknown key '{unknown[0]}'; known: position_m, yaw_deg, pitch_deg"
        )
    return T_base_of_camera(
        camera.numbers("position_m", (3,)), camera.number("yaw_deg", 0.0), camera.number("pitch_deg", 0.0)
    )


def T_base_of_camera(position_m: Sequence[float], yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> F64:
    """Return T_base_body (4, 4) of a camera at a position in base_link (3,), its view turned to the left and
    down."""
    yaw, pitch = radians(yaw_deg), radians(pitch_deg)
    R = so3_exp(np.array([0.0, 0.0, yaw])) @ so3_exp(np.array([0.0, pitch, 0.0])) @ _R_BASE_CAMERA
    return from_rt(R, np.array(position_m, float))


def _area(form: Section) -> DrivingArea:
    corners = form.get("area")
    if not isinstance(corners, list) or not 3 <= len(corners) <= 100:
        raise ConfigError(f"{form.where}: area: expected 3 to 100 corners [x, y]")
    points = [
        Section({"corner": corner}, f"{form.where}: area").numbers("corner", (2,)) for corner in corners
    ]
    return DrivingArea(
        tuple((x, y) for x, y in points), form.text("area_map") if "area_map" in form else None
    )
