"""Clearance against distances known analytically."""

from __future__ import annotations

import numpy as np
import pytest

from share.lab.emulate.world.layout import Layout, triangle_distances, winding_numbers
from share.lab.emulate.world.mesh import concat_shapes
from share.lab.emulate.world.occupancy import STEP_M, Occupancy


@pytest.fixture(scope="module")
def occupancy(small_layout: Layout) -> Occupancy:
    return Occupancy.from_layout(small_layout)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((2.5, 2.0, 1.5), 0.5 * np.sqrt(2)),  # to the upper edge of the box
        ((2.5, 1.0, 0.5), np.hypot(0.4, 0.2)),  # to the lower edge of the table's top
        ((4.5, 2.5, 0.6), 0.5),  # between the box and the wall
        ((1.5, 3.0, 2.0), 0.4),  # to the pole
        ((3.5, 2.5, 1.8), 0.8),  # over the box
        ((3.5, 2.5, 0.5), 0.0),  # in the box: pieces are solid
        ((0.3, 2.0, 1.9), 0.3),  # to the wall: the poster on it is not solid
        ((-0.1, 2.0, 1.5), 0.0),  # outside
    ],
)
def test_known_distances(occupancy: Occupancy, point: tuple[float, float, float], expected: float) -> None:
    assert occupancy.clearance(np.array([point]))[0] == pytest.approx(expected, abs=0.6 * STEP_M)


def test_clearance_is_near_the_exact_distance_everywhere(
    occupancy: Occupancy, small_layout: Layout, rng: np.random.Generator
) -> None:
    points = rng.uniform(0, 1, (400, 3)) * small_layout.size
    shapes = [p.shape for p in small_layout.all_pieces if p.solid]
    corners = concat_shapes(*shapes).mesh.triangles.astype(float)
    held = np.max([winding_numbers(s.mesh.triangles.astype(float), points) for s in shapes], axis=0) > 0.5
    exact = np.where(held, 0, triangle_distances(corners, points).min(1))
    error = occupancy.clearance(points) - exact
    assert np.abs(error).max() < np.sqrt(3) * STEP_M
    assert error.max() < STEP_M


def test_floor_clearance_is_for_the_height_of_the_body(occupancy: Occupancy) -> None:
    robot, origin, step = occupancy.floor_clearance(0.1, 0.5)
    person, _, _ = occupancy.floor_clearance(0.1, 1.8)

    def at(grid: np.ndarray, x: float, y: float) -> float:
        i, j = np.round((np.array([x, y]) - origin) / step).astype(int)
        return float(grid[i, j])

    assert at(person, 1.3, 0.9) == 0  # a person does not fit under the table
    assert at(robot, 1.3, 0.9) > 0.3  # a robot does
    assert at(person, 2.5, 2.0) == pytest.approx(0.5, abs=0.6 * STEP_M)
    assert at(person, 4.5, 2.5) == pytest.approx(0.5, abs=0.6 * STEP_M)
    assert robot.shape == (100, 80)


def test_gaps_that_pieces_enclose_stay_free(occupancy: Occupancy) -> None:
    assert occupancy.clearance(np.array([(1.3, 0.9, 0.4)]))[0] > 0.2
