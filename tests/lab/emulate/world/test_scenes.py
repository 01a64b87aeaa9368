"""The rooms that come with SHARE: furnished as a room can be, passable, repeatable."""

from __future__ import annotations

from collections.abc import Hashable
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import label

from share.errors import UsageError
from share.lab.emulate.world.layout import Layout, Piece
from share.lab.emulate.world.occupancy import Occupancy
from share.lab.emulate.world.scenes import SCENES, hard_rooms, make_scene_layout
from share.types import F64

pytestmark = pytest.mark.long

CLEARANCE = 0.45  # m
SMALL = (9.0, 6.0, 4.0)  # the paper's room
SEEDS = range(3)
few_and_more = pytest.mark.parametrize(
    "seeds", [SEEDS, pytest.param(range(3, 8), marks=pytest.mark.slow)], ids=["few", "more"]
)
ROOMS = ("warehouse", "firestation", "corridor-twins", "whitewall")


@cache
def rooms(name: str, seeds: range = SEEDS) -> list[Layout]:
    return [make_scene_layout(name, seed) for seed in seeds]


def free_share(room: Layout) -> tuple[float, float]:
    """Share of the floor that is one connected place to walk, and the share of all free floor in it."""
    distance, _, step = Occupancy.from_layout(room, 0.1).floor_clearance(0.1, 1.9)
    places, _ = label(distance >= CLEARANCE)
    areas = np.bincount(places.ravel())[1:] * step**2
    return areas.max() / (room.size[0] * room.size[1]), areas.max() / areas.sum()


def described(room: Layout) -> list[tuple[Hashable, ...]]:
    return [
        (p.name, p.shape.mesh.vertices.tobytes(), p.shape.mesh.uv.tobytes(), p.shape.materials)
        for p in room.all_pieces
    ]


@few_and_more
@pytest.mark.parametrize("name", ROOMS)
def test_everything_is_inside_the_room(name: str, seeds: range) -> None:
    for room in rooms(name, seeds):
        for piece in room.all_pieces:
            low, high = piece.bounding_box
            assert (low >= -2e-3).all(), (room.seed, piece.name)
            assert (high <= np.array(room.size) + 2e-3).all(), (room.seed, piece.name)
        for light in room.lights:
            assert (np.array(light.position) > 0).all()
            assert (np.array(light.position) < room.size).all()


@pytest.mark.parametrize("name", ROOMS)
def test_the_same_seed_gives_the_same_room_and_another_seed_another(name: str) -> None:
    assert described(make_scene_layout(name, 2)) == described(rooms(name)[2])
    shapes = {tuple(described(room)) for room in rooms(name)}
    assert len(shapes) == len(SEEDS)


def apart(a: F64, b: F64) -> bool:
    return bool(((a[1] <= b[0] + 1e-3) | (a[0] >= b[1] - 1e-3)).any())


@few_and_more
@pytest.mark.parametrize("name", ROOMS)
def test_solid_things_do_not_pass_through_each_other(name: str, seeds: range) -> None:
    for room in rooms(name, seeds):
        solid = [p for p in room.pieces if p.solid]
        carriers = [p for p in room.shell if p.name.split()[0] in ("column", "girder", "pillar")]
        for i, piece in enumerate(solid):
            clash = [p.name for p in solid[:i] + carriers if not apart(piece.bounding_box, p.bounding_box)]
            assert clash == [], (room.seed, piece.name)


def touches_wall(piece: Piece, walls: F64) -> bool:
    """Whether a piece reaches one of the upright planes (W, 2): axis, place."""
    return any(np.abs(piece.bounding_box[:, int(axis)] - at).min() < 0.02 for axis, at in walls)


@few_and_more
@pytest.mark.parametrize("name", ROOMS)
def test_nothing_floats(name: str, seeds: range) -> None:
    """All stands on the floor, hangs on a wall or under the ceiling."""
    for room in rooms(name, seeds):
        x, y, z = room.size
        walls = [(0, 0), (0, x), (1, 0), (1, y)]
        if name == "corridor-twins":
            wide, end = hard_rooms.corridor_widths(room.size)
            walls += [(0, end), (0, x - end), (1, wide), (1, y - wide)]
        for piece in room.pieces:
            low, high = piece.bounding_box[:, 2]
            held = low < 0.025 or high > z - 0.02 or touches_wall(piece, np.array(walls))
            assert held, (room.seed, piece.name, piece.bounding_box)


@pytest.mark.parametrize(
    ("name", "size", "least"),
    [
        ("warehouse", SMALL, 0.4),
        ("firestation", SMALL, 0.35),
        ("firestation", None, 0.35),
        ("corridor-twins", None, 0.35),
        ("whitewall", None, 0.5),
    ],
)
def test_most_of_the_floor_is_walkable_and_connected(
    name: str, size: tuple[float, float, float] | None, least: float
) -> None:
    for seed in SEEDS:
        share, connected = free_share(make_scene_layout(name, seed, size) if size else rooms(name)[seed])
        assert share >= least, seed
        assert connected > 0.97, seed


@pytest.mark.slow
@pytest.mark.parametrize("name", ["warehouse", "firestation"])
def test_most_of_the_floor_is_walkable_in_every_small_room(name: str) -> None:
    for seed in range(60):
        share, connected = free_share(make_scene_layout(name, seed, SMALL))
        assert share >= 0.35, seed
        assert connected > 0.97, seed


@pytest.mark.slow
def test_a_large_warehouse_holds_more_things_not_larger_ones() -> None:
    small, large = rooms("warehouse")[1], make_scene_layout("warehouse", 1, (18, 12, 6))
    racks = [[p for p in room.pieces if p.name.startswith("rack")] for room in (small, large)]
    assert len(large.pieces) > 1.8 * len(small.pieces)
    assert len(racks[1]) > len(racks[0])
    assert max(np.ptp(p.bounding_box[:, :2], axis=0).max() for p in racks[1]) < 2.7
    assert free_share(large)[0] > 0.35


@pytest.mark.parametrize("size", [None, (9.0, 6.0, 2.7), (30.0, 12.0, 3.5)])
def test_the_two_corridors_look_alike(size: tuple[float, float, float] | None) -> None:
    """Every thing in the north corridor has its like in the south one, but for a few small ones."""
    for seed in SEEDS:
        room = make_scene_layout("corridor-twins", seed, size) if size else rooms("corridor-twins")[seed]
        north, south, T = hard_rooms.twin_corridors(room.size)
        there, here = (contents(room, area) for area in (north, south))
        assert len(there) > 5
        unlike = [b for b in there if min_distance(turned(b, T), here) > 1e-3]
        assert len(unlike) <= 3, seed
        assert all(np.prod(np.ptp(b, axis=0)) < 0.01 for b in unlike)
        assert len(unlike) + abs(len(there) - len(here)) > 0, "no difference at all"


def test_the_ends_of_the_corridors_differ() -> None:
    room = make_scene_layout("corridor-twins", 0)
    (_, T), (wide, end) = hard_rooms.twin_corridors(room.size)[1:], hard_rooms.corridor_widths(room.size)
    x, y, _ = room.size
    west, east = (contents(room, np.array([(a, wide), (a + end, y - wide)])) for a in (0.0, x - end))
    assert max(min_distance(turned(b, T), east) for b in west) > 0.1


def contents(room: Layout, area: F64) -> list[F64]:
    """Bounds of what stands and hangs in an area (2, 2) m of the floor."""
    boxes = [p.bounding_box for p in room.pieces if p.solid]
    return [b for b in boxes if (b.mean(0)[:2] >= area[0]).all() and (b.mean(0)[:2] <= area[1]).all()]


def turned(box: F64, T: F64) -> F64:
    corners = box @ T[:3, :3].T + T[:3, 3]
    return np.stack([corners.min(0), corners.max(0)])


def min_distance(box: F64, others: list[F64]) -> float:
    return min(float(np.abs(box - b).max()) for b in others)


def test_a_fire_station_and_white_walls_have_far_fewer_pieces() -> None:
    def density(name: str) -> float:
        per_room = [len(r.pieces) / (r.size[0] * r.size[1]) for r in rooms(name)]
        return float(np.median(per_room))

    assert density("firestation") < 0.6 * density("warehouse")
    assert density("whitewall") < 0.75 * density("firestation")


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("warehouse", (9, 6, 2)),
        ("warehouse", (31, 20, 8)),
        ("firestation", (5, 6, 4)),
        ("corridor-twins", (9, float("nan"), 3)),
        ("whitewall", (6, 5, -2.7)),
    ],
)
def test_an_unsupported_size_is_refused(name: str, size: tuple[float, float, float]) -> None:
    with pytest.raises(UsageError, match=rf"a {name} cannot be .* m: give a size between .* m and .* m"):
        make_scene_layout(name, 0, size)


def test_an_unknown_scene_is_refused() -> None:
    with pytest.raises(UsageError, match="scene 'attic' is not known; known: warehouse, firestation"):
        make_scene_layout("attic", 0)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ValueError, match="seed -1"):
        make_scene_layout("whitewall", -1)


@pytest.mark.parametrize("name", ROOMS)
@pytest.mark.parametrize("which", ["smallest", "largest"])
def test_the_smallest_and_largest_sizes_are_allowed(name: str, which: str) -> None:
    if (name, which) == ("warehouse", "largest"):
        pytest.skip("takes 10 s; a large warehouse is tested above")
    size = getattr(SCENES[name], which)
    room = make_scene_layout(name, 2, size)
    assert room.size == tuple(map(float, size))
    assert room.lights
