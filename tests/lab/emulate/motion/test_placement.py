from dataclasses import replace

import numpy as np
import pytest
from helpers.motion_sim import every

from share.errors import UsageError
from share.lab.emulate.motion.placement import PathToPlace, place_paths
from share.lab.emulate.motion.spline import spline_through
from share.lab.emulate.world.layout import Layout, Piece
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box
from share.lab.emulate.world.occupancy import Occupancy

STEEL = Material("steel")


def room(size=(8.0, 5.0, 3.0), *blocks):
    pieces = tuple(Piece(f"block{k}", box(low, high, STEEL)) for k, (low, high) in enumerate(blocks))
    return Layout("test", 0, size, (), pieces, ())


def flight(reach=1.5, seconds=10.0, phase=0.0):
    t = np.arange(0, seconds + 0.01, 0.02)
    a = 0.6 * t + phase
    p = np.stack([reach * np.sin(a), 0.5 * reach * np.cos(a), 50 + 0.3 * np.sin(2 * a)], axis=1)
    return spline_through(0, t, p, np.tile((0, 0, 0, 1.0), (len(t), 1)))


@pytest.mark.long
def test_a_flight_finds_room_around_it():
    layout = room((8.0, 5.0, 3.0), ((0, 0, 0), (3, 5, 2.9)))
    guest = PathToPlace("d", "drone", flight())
    found, (path,), notes = place_paths(layout, [guest], (1,))
    xyz = path.poses(every(path, 30))[:, :3, 3]
    assert Occupancy.from_layout(layout).clearance(xyz).min() > 0.25
    assert found.pieces == layout.pieces and not notes
    again = place_paths(layout, [guest], (1,))[1][0]
    assert np.array_equal(again.poses(every(path, 3)), path.poses(every(path, 3)))


def test_obstacles_to_a_recorded_path_are_removed_and_named():
    layout = room((4.0, 3.0, 3.0), ((1.8, 1.3, 0), (2.2, 1.7, 2.8)), ((0, 0, 0), (0.1, 0.1, 0.1)))
    found, (path,), notes = place_paths(layout, [PathToPlace("d", "drone", flight(1.6))], (1,))
    xyz = path.poses(every(path, 30))[:, :3, 3]
    assert Occupancy.from_layout(found).clearance(xyz).min() > 0.15
    if len(found.pieces) == 1:
        assert "block0" in notes[0]


def test_obstacles_below_the_head_are_removed():
    desk = room((4.0, 3.0, 2.6), ((0.7, 0.7, 0), (3.3, 2.3, 0.8)))
    head = replace(flight(1.2))
    assert place_paths(desk, [PathToPlace("p", "person", head)], (1,))[0].pieces == ()
    assert len(place_paths(desk, [PathToPlace("p", "drone", head)], (1,))[0].pieces) == 1


@pytest.mark.long
def test_two_recorded_paths_keep_their_distance():
    guests = [PathToPlace(str(k), "drone", flight(1.2, phase=k)) for k in range(2)]
    _, paths, _ = place_paths(room((7.0, 5.0, 3.0)), guests, (1,))
    a, b = (p.poses(every(p, 30))[:, :3, 3] for p in paths)
    assert np.linalg.norm(a - b, axis=1).min() >= 0.45
    shared = np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=2).min(1)
    assert (shared < 1.0).mean() > 0.4


def test_a_path_that_does_not_fit_is_refused_with_the_needed_size():
    with pytest.raises(UsageError, match=r"needs 6\.5 x 3\.5 x .*--size, such as 7,4,3,") as caught:
        place_paths(room((6.0, 4.0, 3.0)), [PathToPlace("d", "drone", flight(3.0))], (1,))
    assert "\n" not in str(caught.value)
    many = [PathToPlace(str(k), "drone", flight(0.9)) for k in range(30)]
    with pytest.raises(UsageError, match="nearer than"):
        place_paths(room((2.6, 1.7, 1.4)), many, (1,))
