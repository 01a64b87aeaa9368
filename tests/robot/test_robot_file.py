"""The file of a robot, and the map that is made of it."""

import cv2
import numpy as np
import pytest

from share.errors import ConfigError
from share.geometry.se3 import inverse
from share.robot.grid import FREE, OCCUPIED, UNKNOWN
from share.robot.planar import PlanarPose
from share.robot.robot_file import read_robot

CAMERA = "camera: {position_m: [0.08, 0.01, 0.2]}\n"


def read(tmp_path, text):
    file = tmp_path / "robot.yaml"
    file.write_text(text)
    return read_robot(file)


def test_a_camera_that_looks_ahead(tmp_path):
    T_base_body = inverse(read(tmp_path, CAMERA).settings.T_body_base)
    ahead, right, down = (T_base_body[:3, :3] @ axis for axis in np.eye(3)[[2, 0, 1]])
    assert np.allclose(ahead, [1, 0, 0]) and np.allclose(right, [0, -1, 0]) and np.allclose(down, [0, 0, -1])
    assert np.allclose(T_base_body[:3, 3], [0.08, 0.01, 0.2])


def test_a_camera_that_looks_left_and_down(tmp_path):
    camera = "camera: {position_m: [0, 0, 0], yaw_deg: 90, pitch_deg: 30}\n"
    T_base_body = inverse(read(tmp_path, camera).settings.T_body_base)
    assert np.allclose(T_base_body[:3, 2], [0, np.cos(np.pi / 6), -np.sin(np.pi / 6)])


def test_an_area_is_free_within_and_occupied_around(tmp_path):
    description = read(tmp_path, CAMERA + "area: [[0, 0], [2, 0], [2, 1], [0, 1]]\narea_map: ann-1/0\n")
    area, grid = description.settings.area, description.grid
    assert (
        area.map_id == "ann-1/0"
        and area.contains(PlanarPose(1, 0.5, 0))
        and not area.contains(PlanarPose(1, 1.1, 0))
    )
    assert (grid.cells == FREE).sum() * grid.resolution_m**2 == pytest.approx(2.0, abs=1e-9)
    rows, columns = np.nonzero(grid.cells == FREE)
    x = grid.origin.x + grid.resolution_m * (columns + 0.5)
    y = grid.origin.y + grid.resolution_m * (rows + 0.5)
    assert (x > 0).all() and (x < 2).all() and (y > 0).all() and (y < 1).all()
    assert set(np.unique(grid.cells)) == {FREE, OCCUPIED}


def test_a_map_of_map_saver(tmp_path):
    image = np.array([[0, 254, 205], [254, 254, 254]], np.uint8)  # the top row of the image is the highest y
    cv2.imwrite(str(tmp_path / "room.pgm"), image)
    (tmp_path / "room.yaml").write_text(
        "image: room.pgm\nmode: trinary\nresolution: 0.1\norigin: [-1, -2, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    grid = read(tmp_path, CAMERA + "map: room.yaml\n").grid
    assert grid.cells.tolist() == [[FREE, FREE, FREE], [OCCUPIED, FREE, UNKNOWN]]
    assert grid.origin == PlanarPose(-1, -2, 0) and grid.resolution_m == 0.1


@pytest.mark.parametrize(
    "data", [b"", b"P5", b"P5 9 9 255\n12", b"P5 0 0 255\n", b"P2 1 1 255\n0", b"GIF89a"]
)
def test_a_map_whose_image_is_none(tmp_path, data):
    (tmp_path / "room.pgm").write_bytes(data)
    (tmp_path / "room.yaml").write_text("image: room.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n")
    with pytest.raises(ConfigError, match=r"room\.pgm"):
        read(tmp_path, CAMERA + "map: room.yaml\n")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("max_speed_m_s: 0.1\n", "give either 'camera'"),
        ("camera: {position_m: [0, 0]}\n", "position_m: expected 3 numbers"),
        ("camera: {position_m: [0, 0, 0], roll_deg: 1}\n", "unknown key 'roll_deg'"),
        ("T_base_body: [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n", "T_base_body"),
        (CAMERA + "max_speed_m_s: 0.5\n", "0.306 m/s at most"),
        (CAMERA + "max_speed_m_s: 0\n", "must be positive"),
        (CAMERA + "area: [[0, 0], [1, 1]]\n", "3 to 100 corners"),
        (CAMERA + "area: [[0, 0], [1, 1], [1, .nan]]\n", "area: corner"),
        (CAMERA + "area: [[0, 0], [9000, 0], [9000, 9000]]\n", "draw a smaller one"),
        (CAMERA + "area: [[-1e308, 0], [1e308, 0], [0, 1e308]]\n", "area: corner: has values beyond 1e"),
        ("camera: {position_m: [1e308, 0, 0]}\n", "position_m: has values beyond 1e"),
        ("camera: {position_m: [90, 18, 210]}\n", "more than 10 m from base_link; give m"),
        ("camera: {position_m: [0, 0, 0], yaw_deg: 1e308}\n", "yaw_deg: has values beyond 1e"),
        (CAMERA + "map: none.yaml\n", "none.yaml"),
        (CAMERA + "speed: 1\n", "unknown key 'speed'"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, said):
    with pytest.raises(ConfigError, match=said):
        read(tmp_path, text)
