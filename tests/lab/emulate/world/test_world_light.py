"""Baked light: physics of one lamp, shadows, no seams, the same every time."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.smallroom import SIZE, small_room

from share.errors import UsageError
from share.lab.emulate.types import DrawableRoom, Mesh
from share.lab.emulate.world.build import build_room
from share.lab.emulate.world.layout import Layout, Light
from share.lab.emulate.world.light import bake_light
from share.lab.emulate.world.light_atlas import unfold_patches
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box, concat_shapes, join_meshes, panels, quad
from share.types import F64

pytestmark = pytest.mark.long

BLACK = np.zeros(1, np.float32)
NO_GLOW = np.zeros(1, bool)


def light_at(room: DrawableRoom, points: F64, normal: tuple[float, float, float]) -> F64:
    """Light on the surfaces of this normal that the points (N, 3) lie on: bilinear, as a renderer does."""
    mesh, out = room.mesh, []
    on = np.nonzero(mesh.normals[mesh.faces[:, 0]] @ np.float32(normal) > 0.99)[0]
    corners = np.concatenate([mesh.triangles[on].swapaxes(1, 2), np.ones((len(on), 1, 3))], axis=1)
    solve = np.linalg.pinv(corners)
    for point in points:
        weights = solve @ [*point, 1]
        off = np.abs((corners @ weights[..., None])[..., 0] - [*point, 1]).max(1)
        k = np.nonzero((off < 1e-3) & (weights > -1e-6).all(1))[0][0]
        out.append(bilinear(room.light_map, weights[k] @ room.light_uv[mesh.faces[on[k]]]))
    return np.array(out)


def bilinear(image: np.ndarray, uv: F64) -> float:
    x, y = uv * (image.shape[1], image.shape[0]) - 0.5
    i, j = int(np.floor(y)), int(np.floor(x))
    s, t = y - i, x - j
    part = image[i : i + 2, j : j + 2].astype(float)
    return float(np.array([1 - s, s]) @ part @ np.array([1 - t, t]))


def single(mesh: Mesh) -> Mesh:
    return replace(mesh, layer=np.zeros_like(mesh.layer))


def test_one_lamp_over_a_black_floor_falls_off_as_the_law_says() -> None:
    """cos^4: a small panel facing a parallel plane."""
    mesh = quad((-4, -4, 0), (8, 0, 0), (0, 8, 0), Material("screed")).mesh
    uv, image = bake_light(mesh, BLACK, NO_GLOW, [Light((0, 0, 2.0), size=(0.05, 0.05))], 0.0, 0.2)
    corner, opposite = uv[0], uv[2]
    at = [bilinear(image, corner + (opposite - corner) * (0.5 + d / 8)) for d in (0.0, 1.0, 2.0)]
    expected = [(4 / (4 + 2 * d * d)) ** 2 for d in (0.0, 1.0, 2.0)]
    assert np.array(at) / at[0] == pytest.approx(expected, abs=0.02)


def test_a_white_box_is_brighter_by_its_bounces() -> None:
    """In a closed box of albedo a the total light is the direct light / (1 - a) (energy balance), up to
    the bounces that are followed; so the shadowed ceiling gains on the floor."""
    walls = [
        quad((0, 0, 0), (3, 0, 0), (0, 3, 0), Material("paint")),
        quad((0, 3, 3), (3, 0, 0), (0, -3, 0), Material("paint")),
        quad((3, 0, 0), (-3, 0, 0), (0, 0, 3), Material("paint")),
        quad((0, 3, 0), (3, 0, 0), (0, 0, 3), Material("paint")),
        quad((0, 0, 0), (0, 3, 0), (0, 0, 3), Material("paint")),
        quad((3, 3, 0), (0, -3, 0), (0, 0, 3), Material("paint")),
    ]
    mesh, lamp = concat_shapes(*walls).mesh, [Light((1.5, 1.5, 2.9))]
    ceiling = []
    for albedo in (0.0, 0.3, 0.6):
        uv, image = bake_light(mesh, np.float32([albedo]), NO_GLOW, lamp, 0.0, 0.5)
        up = mesh.normals[:, 2] < -0.5
        ceiling.append(bilinear(image, uv[up].mean(0).astype(float)))
    assert ceiling[0] == 0 and 0 < ceiling[1] < ceiling[2]


def test_under_the_table_and_the_box_it_is_darker(built: DrawableRoom) -> None:
    up = (0.0, 0.0, 1.0)
    under, beside = light_at(built, np.array([(1.3, 0.9, 0.0), (2.5, 0.9, 0.0)]), up)
    assert under < 0.55 * beside
    shadow, free = light_at(built, np.array([(4.3, 2.7, 0.0), (0.7, 2.7, 0.0)]), up)
    assert shadow < 0.7 * free  # behind the box, as seen from the lamp


def test_no_step_between_panels_of_one_wall(built: DrawableRoom) -> None:
    ends = np.array([(x, 2.0, 0.0) for x in (0.97, 0.99, 1.01, 1.03, 1.97, 1.99, 2.01, 2.03)])
    light = light_at(built, ends, (0.0, 0.0, 1.0))
    steps = np.abs(np.diff(light))[[0, 1, 2, 4, 5, 6]] / light.mean()
    assert steps.max() < 0.03


def test_light_is_smooth_on_an_open_wall(built: DrawableRoom) -> None:
    """No grain: neighbours 2 cm apart differ by under 3 % on the north wall."""
    points = np.array([(x, SIZE[1], z) for z in (1.0, 1.8) for x in np.arange(2.0, 4.0, 0.02)])
    light = light_at(built, points, (0.0, -1.0, 0.0))
    assert np.abs(np.diff(light.reshape(2, -1), axis=1)).max() / light.mean() < 0.03


def test_behind_a_decal_and_beside_a_box_no_dark_rim(built: DrawableRoom) -> None:
    """Texels that something covers are filled from their neighbours."""
    rows = np.array([(0.0, y, 1.9) for y in (0.85, 0.97, 1.63, 1.75)])  # the poster ends at 1.0 and 1.6
    light = light_at(built, rows, (1.0, 0.0, 0.0))
    assert light[1:3] == pytest.approx(light[[0, 3]], rel=0.06)
    top = light_at(built, np.array([(2.99, 2.5, 0.0), (2.9, 2.5, 0.0)]), (0.0, 0.0, 1.0))
    assert top[0] > 0.6 * top[1]


def test_lamps_are_bright_and_cast_no_shadow(built: DrawableRoom, small_layout: Layout) -> None:
    lamp = next(p for p in small_layout.pieces if p.name == "lamp").shape.bounding_box.mean(0)
    lamp[2] = 2.9
    assert light_at(built, lamp[None], (0.0, 0.0, -1.0))[0] == 255
    bare = replace(small_layout, pieces=tuple(p for p in small_layout.pieces if p.name != "lamp"))
    floor = np.array([(2.5, 2.0, 0.0)])
    with_lamp, without = (light_at(r, floor, (0.0, 0.0, 1.0))[0] for r in (built, build_room(bare)))
    assert with_lamp == pytest.approx(without, rel=0.02)


def test_mean_light_is_the_brightness_asked_for(small_layout: Layout) -> None:
    dim, bright = (build_room(replace(small_layout, brightness=b)) for b in (0.5, 0.8))
    assert dim.mover_light / bright.mover_light == pytest.approx(0.5 / 0.8, rel=0.03)


def test_same_seed_same_bytes_other_seed_another_room(built: DrawableRoom) -> None:
    again, other = build_room(small_room(1)), build_room(small_room(2))
    assert again.pictures.tobytes() == built.pictures.tobytes()
    assert again.light_map.tobytes() == built.light_map.tobytes()
    assert again.light_uv.tobytes() == built.light_uv.tobytes()
    assert other.pictures.tobytes() != built.pictures.tobytes()


def test_every_vertex_lies_inside_its_own_patch() -> None:
    """No two patches share a texel, pads included, so nothing bleeds."""
    rng = np.random.default_rng(4)
    boxes = [
        box((0, 0, 0), rng.uniform(0.05, 2, 3), Material("wood")).placed_at(9 * k, 0, 0, k) for k in range(60)
    ]
    mesh = single(join_meshes([b.mesh for b in boxes]))
    atlas = unfold_patches(mesh, np.zeros(len(mesh.vertices), np.int32), 16, 600_000)
    cells = atlas.row * atlas.shape[1] + atlas.column
    assert len(np.unique(cells)) == len(cells)
    owner = np.full(atlas.shape, -1)
    owner[atlas.row, atlas.column] = atlas.patch
    for dr, dc in ((1, 0), (0, 1), (1, 1)):
        a = owner[: atlas.shape[0] - dr, : atlas.shape[1] - dc]
        b = owner[dr:, dc:]
        assert ((a == b) | (a < 0) | (b < 0)).all()
    spread = np.linalg.norm(atlas.position[np.searchsorted(atlas.patch, np.arange(360))], axis=1)
    assert len(np.unique(atlas.patch)) == 360 and np.isfinite(spread).all()


def test_the_number_of_texels_is_limited() -> None:
    mesh = quad((0, 0, 0), (100, 0, 0), (0, 100, 0), Material("screed")).mesh
    atlas = unfold_patches(mesh, np.zeros(4, np.int32), 16, 50_000)
    assert 30_000 < len(atlas.row) <= 50_000


def test_panels_of_a_wall_are_one_patch() -> None:
    wall = panels(
        (0, 0, 0), (6, 0, 0), (0, 0, 3), [Material("brick"), Material("block")], 1, np.random.default_rng(1)
    )
    assert (
        len(unfold_patches(wall.mesh, np.zeros(len(wall.mesh.vertices), np.int32), 16, 600_000).vertex) == 1
    )


def test_a_room_without_lamps_is_refused(small_layout: Layout) -> None:
    with pytest.raises(ValueError, match="needs a lamp"):
        build_room(replace(small_layout, lights=()))


def test_without_embree_one_line_names_the_package(
    small_layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(UsageError, match=r"embreex is not installed: pip install 'share-slam\[emulate\]'"):
        build_room(small_layout)
