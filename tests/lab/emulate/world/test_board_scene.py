"""The board's room: tiles without seams, a pose by the seed, the target known."""

import numpy as np
import pytest

from share.geometry import se3
from share.lab.calibrate.target import AprilGrid, CharucoBoard
from share.lab.emulate.world.scenes import make_scene_layout
from share.lab.emulate.world.scenes.board import BLACK, WHITE, printed_sheet

pytestmark = pytest.mark.long

TARGETS = [AprilGrid(), AprilGrid(5, 7, 0.08, 0.28), CharucoBoard()]


def tiles(target):
    """Return of each tile its picture, the place (2,) m of the picture's upper left corner, and m a texel."""
    shape, _ = printed_sheet(target)
    mesh, out = shape.mesh, []
    for k, material in enumerate(shape.materials):
        at = np.flatnonzero(mesh.layer == k)
        a, b = mesh.vertices[at[0], :2].astype(float), mesh.vertices[at[2], :2].astype(float)
        ua, ub = mesh.uv[at[0]].astype(float), mesh.uv[at[2]].astype(float)
        scale = (b - a) / (ub - ua) * (1, -1)
        out.append((material.pixels, a - ua * scale * (1, -1), float(scale[0]) / 512))
        np.testing.assert_allclose(scale[0], scale[1], rtol=1e-4)
    return out


@pytest.mark.parametrize("target", TARGETS)
def test_tiles_are_fine_and_show_the_same_where_they_overlap(target):
    found = tiles(target)
    pixels, corner, texel = found[0]
    assert 0.0003 < texel <= 0.0008
    compared = 0
    for other, place, size in found[1:]:
        assert size == pytest.approx(texel, rel=1e-4)
        right, down = np.rint((place - corner) / texel * (1, -1)).astype(int)
        np.testing.assert_allclose((place - corner) / texel * (1, -1), (right, down), atol=0.02)
        assert right % 32 == 0
        assert down % 32 == 0
        if min(512 - abs(right), 512 - abs(down)) <= 0:
            continue
        here = pixels[max(down, 0) : 512 + min(down, 0), max(right, 0) : 512 + min(right, 0)]
        there = other[max(-down, 0) : 512 - max(down, 0), max(-right, 0) : 512 - max(right, 0)]
        np.testing.assert_array_equal(here, there)
        compared += here.size > 0
    assert compared >= 1


def test_edges_of_the_usual_grid_lie_between_texels():
    assert all(np.isin(pixels, (WHITE, BLACK)).all() for pixels, _, _ in tiles(AprilGrid()))


@pytest.mark.parametrize(("name", "target"), [("board", AprilGrid()), ("charuco-board", CharucoBoard())])
def test_the_board_stands_where_the_layout_says(name, target):
    room = make_scene_layout(name, 3)
    assert room.target.target == target
    board = next(piece for piece in room.shell if piece.name.startswith("board"))
    low, high = target.extent
    ends = np.array([(*low, 0), (*high, 0), (low[0], high[1], 0), (high[0], low[1], 0)])
    inside = se3.transform(room.target.T_world_target, ends)
    assert (inside > board.bounding_box[0] - 1e-6).all()
    assert (inside < board.bounding_box[1] + 1e-6).all()
    assert room.target.T_world_target[0, 2] > 0.9  # it looks into the room
    assert room.target.T_world_target[2, 1] > 0.9  # and stands upright


def test_the_pose_of_the_board_depends_on_the_seed():
    poses = [make_scene_layout("board", seed).target.T_world_target for seed in (1, 1, 2)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert np.degrees(se3.rotation_angle(se3.inverse(poses[0]) @ poses[2])) > 0.5


def test_no_path_removes_the_board():
    room = make_scene_layout("board", 1)
    left, _ = room.without(room.target.T_world_target[None, :3, 3], 0.5)
    assert any(piece.name.startswith("board") for piece in left.all_pieces)
