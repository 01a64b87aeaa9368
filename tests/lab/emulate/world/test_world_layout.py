"""Obstacles to recorded paths are removed whole; walls stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from share.lab.emulate.world.layout import Layout, Piece, triangle_distances, winding_numbers
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box


def test_blocking_pieces_are_removed_whole_and_named(small_layout: Layout) -> None:
    over_the_table = np.array([(1.3, 0.9, 0.95), (2.5, 2.0, 1.5)])  # 0.21 m above its top
    assert small_layout.without(over_the_table, 0.2)[1] == ()
    rest, removed = small_layout.without(over_the_table, 0.22)
    assert removed == ("table",)
    assert {p.name for p in rest.pieces} == {"box", "pole", "poster", "lamp"}
    assert rest.shell == small_layout.shell


def test_a_path_inside_a_piece_removes_it(small_layout: Layout) -> None:
    assert small_layout.without(np.array([(3.5, 2.5, 0.5)]), 0.01)[1] == ("box",)


def test_walls_decals_and_a_piece_only_enclosed_by_bounds_stay(small_layout: Layout) -> None:
    under_the_table = np.array([(1.3, 0.9, 0.3)])
    at_the_poster = np.array([(0.01, 1.2, 1.7)])
    assert small_layout.without(np.concatenate([under_the_table, at_the_poster]), 0.2)[1] == ()


def test_names_are_unique(small_layout: Layout) -> None:
    twice = (*small_layout.pieces, Piece("table", box((0, 0, 0), (1, 1, 1), Material("wood"))))
    with pytest.raises(ValueError, match="two pieces are named 'table'"):
        replace(small_layout, pieces=twice)


def test_distance_of_points_from_a_triangle() -> None:
    triangle = np.array([[(0, 0, 0), (2, 0, 0), (0, 2, 0)]], float)
    points = np.array([(0.5, 0.5, 3), (-3, 0.5, 0), (3, -1, 0), (2, 2, 0), (1, 1, 0)], float)
    expected = [3, 3, np.sqrt(2), np.sqrt(2), 0]
    assert triangle_distances(triangle, points)[:, 0] == pytest.approx(expected, abs=1e-12)


def test_winding_of_two_overlapping_boxes() -> None:
    corners = np.concatenate(
        [
            box((0, 0, 0), (2, 2, 2), Material("wood")).mesh.triangles,
            box((1, 1, 1), (3, 3, 3), Material("wood")).mesh.triangles,
        ]
    ).astype(float)
    assert winding_numbers(corners, np.array([(0.5, 0.5, 0.5), (1.5, 1.5, 1.5), (4, 4, 4)])) == pytest.approx(
        [1, 2, 0], abs=1e-9
    )
