"""The same room on another day."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from share.errors import UsageError
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.stage import make_layout
from share.lab.emulate.world.another_day import another_day
from share.lab.emulate.world.furniture import storage
from share.lab.emulate.world.layout import Layout, Piece
from share.lab.emulate.world.mesh import Shape, concat_shapes
from share.lab.emulate.world.scenes import make_scene_layout

SCENES = "warehouse", "firestation", "corridor-twins"
BUILT_IN = (
    "rack",
    "window",
    "roller door",
    "door",
    "sign",
    "poster",
    "notice",
    "lamp",
    "lockers",
    "extinguisher",
)


@cache
def layout_of(scene: str, seed: int) -> Layout:
    return make_scene_layout(scene, seed)


def kind(piece: Piece) -> str:
    return piece.name.rpartition(" ")[0]


def room_with(shape: Shape) -> Layout:
    """A warehouse with nothing in it but this."""
    return replace(layout_of("warehouse", 1), pieces=(Piece("shelf 0", shape),))


def triangles(layout: Layout) -> int:
    return sum(len(piece.shape.mesh.faces) for piece in layout.pieces)


@pytest.mark.parametrize("scene", SCENES)
def test_a_day_is_repeatable_and_differs_from_others(scene: str) -> None:
    first = layout_of(scene, 5)
    assert another_day(first, 0) is first
    a, b, other = another_day(first, 1), another_day(first, 1), another_day(first, 2)
    for one, same in zip(a.pieces, b.pieces, strict=True):
        assert np.array_equal(one.shape.mesh.vertices, same.shape.mesh.vertices)
    assert a.lights == b.lights != other.lights != first.lights
    assert triangles(a) < triangles(first)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("day", [1, 2, 3])
def test_what_is_built_in_stays_and_loose_things_move_without_collision(scene: str, day: int) -> None:
    first = layout_of(scene, 5)
    later = another_day(first, day)
    assert later.shell == first.shell
    assert [piece.name for piece in later.pieces] == [piece.name for piece in first.pieces]
    moved = []
    for before, after in zip(first.pieces, later.pieces, strict=True):
        old, new = before.bounding_box, after.bounding_box
        if kind(before) in BUILT_IN:
            assert np.array_equal(old[0], new[0]) and (new[1] <= old[1]).all()
        elif np.abs(old.mean(0) - new.mean(0))[:2].max() > 0.05:
            moved.append(after)
        assert (new[0] >= -1e-3).all() and (new[1] <= np.array(later.size) + 1e-3).all()
    assert len(moved) >= 3
    solid = [piece for piece in later.pieces if piece.solid]
    for one in moved:
        for piece in solid:
            apart = (piece.bounding_box[0] >= one.bounding_box[1]) | (
                piece.bounding_box[1] <= one.bounding_box[0]
            )
            assert piece is one or apart.any(), (one.name, piece.name)


def test_cartons_are_taken_from_the_top_with_their_tape_and_labels() -> None:
    rng = np.random.default_rng(3)
    cartons = [storage.carton(rng, 0.5 - 0.02 * k, 0.4, 0.3).placed_at(2, 2, 0.3 * k) for k in range(6)]
    stays = concat_shapes(*cartons[:4])
    (piece,) = another_day(room_with(concat_shapes(*cartons)), 1).pieces
    assert len(piece.shape.mesh.faces) == len(stays.mesh.faces)
    assert piece.bounding_box == pytest.approx(stays.bounding_box)


def test_a_third_of_the_cartons_of_a_pallet_is_taken() -> None:
    rng = np.random.default_rng(3)
    cartons = [storage.carton(rng, 0.3, 0.3, 0.3).placed_at(1 + 0.31 * k, 2) for k in range(9)]
    (piece,) = another_day(room_with(concat_shapes(storage.pallet(rng), *cartons)), 1).pieces
    pallet_faces = len(storage.pallet(np.random.default_rng(3)).mesh.faces)
    carton_sides = 5 * 2
    assert 6 * carton_sides <= len(piece.shape.mesh.faces) - pallet_faces < 7 * (carton_sides + 6)


def test_light_is_other_and_never_none() -> None:
    first = layout_of("warehouse", 5)
    for day in range(1, 6):
        later = another_day(first, day)
        assert len(later.lights) == len(first.lights)
        assert all(light.power > 0 for light in later.lights)
        assert later.brightness != first.brightness


def test_a_day_is_part_of_the_recipe_and_the_first_keeps_its_digest() -> None:
    first = SessionRecipe("warehouse", ("a=walk:",), seed=5)
    second = replace(first, day=1)
    assert "day" not in first.to_mapping() and second.to_mapping()["day"] == 1
    assert first.digest != second.digest
    assert first.motion_seed == 5 != second.motion_seed
    assert triangles(make_layout(second)) < triangles(make_layout(first))


@pytest.mark.parametrize("scene", ["plain", "room.glb"])
def test_scenes_of_which_nothing_is_known_have_one_day(scene: str) -> None:
    with pytest.raises(UsageError, match="leave out --day"):
        make_layout(SessionRecipe(scene, ("a=walk:",), day=1))


def test_a_day_is_a_number_of_days() -> None:
    with pytest.raises(UsageError, match="day -1"):
        SessionRecipe("warehouse", ("a=walk:",), day=-1)
