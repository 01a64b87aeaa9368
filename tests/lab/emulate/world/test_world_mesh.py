"""Primitives: exact extents, closed, facing outwards, pictures at true scale."""

from __future__ import annotations

import numpy as np
import pytest

from share.lab.emulate.world.layout import winding_numbers
from share.lab.emulate.world.materials import MATERIAL_KINDS, Material
from share.lab.emulate.world.mesh import (
    DECAL_OFFSET_M,
    Shape,
    box,
    concat_shapes,
    cylinder,
    decal,
    panels,
    polygon,
    prism,
    quad,
    tube,
)

WOOD = Material("wood")  # one picture a metre
BEND = [(np.sin(a), np.cos(a), 0.1 * a) for a in np.linspace(0, 3, 30)]  # a hose is bent softly

SOLIDS = {
    "box": (box((1, 2, 3), (2, 4, 6), WOOD), (1.5, 3, 4.5), 6.0),
    "prism": (prism([(0, 0), (2, 0), (0, 2)], 1, 2, WOOD, WOOD), (0.5, 0.5, 1.5), 2.0),
    "cylinder": (cylinder((0, 0, 1), 0.5, 2, WOOD, WOOD, axis="x", sides=64), (1, 0, 1), 2 * np.pi / 4),
    "cone": (cylinder((0, 0, 0), 1, 3, WOOD, WOOD, sides=64, top=0), (0, 0, 1), np.pi),
    "tube": (tube(BEND, 0.1, WOOD), (np.sin(1.5), np.cos(1.5), 0.15), None),
}


def volume(shape: Shape) -> float:
    """By the divergence theorem; positive where faces look outwards."""
    a, b, c = shape.mesh.triangles.astype(float).swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_face_outwards(name: str) -> None:
    shape, inside, expected = SOLIDS[name]
    corners = shape.mesh.triangles.astype(float)
    far = shape.bounding_box[1] + 1
    assert winding_numbers(corners, np.array([inside, far])) == pytest.approx([1, 0], abs=1e-6)
    if expected is not None:
        assert volume(shape) == pytest.approx(expected, rel=2e-3)  # 64 sides of a circle


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_those_of_the_faces(name: str) -> None:
    mesh = SOLIDS[name][0].mesh
    a, b, c = mesh.triangles.astype(float).swapaxes(0, 1)
    n = np.cross(b - a, c - a)
    area = np.linalg.norm(n, axis=1, keepdims=True)
    kept = area[:, 0] > 1e-9  # the tip of a cone
    for corner in range(3):
        normal = mesh.normals[mesh.faces[kept, corner]]
        assert (normal * n[kept] / area[kept]).sum(1) == pytest.approx(1, abs=1e-2)


def test_box_bounds_are_exact() -> None:
    assert box((1, 2, 3), (2, 4, 6), WOOD).bounding_box.tolist() == [[1, 2, 3], [2, 4, 6]]


def test_box_takes_a_material_by_side_and_leaves_faces_out() -> None:
    steel = Material("steel")
    shape = box((0, 0, 0), (1, 1, 1), {"side": WOOD, "top": steel, "bottom": None, "-x": None})
    normals = shape.mesh.normals[shape.mesh.faces[:, 0]].round().astype(int).tolist()
    assert [-1, 0, 0] not in normals and [0, 0, -1] not in normals and len(normals) == 8
    top = shape.mesh.normals[:, 2] > 0.5
    assert {shape.materials[k] for k in shape.mesh.layer[top]} == {steel}
    with pytest.raises(ValueError, match="must be positive"):
        box((0, 0, 0), (1, 0, 1), WOOD)


@pytest.mark.parametrize(
    "shape",
    [
        box((0, 0, 0), (1.3, 0.7, 2), Material("brick")),
        box((0, 0, 0), (1.3, 0.7, 2), Material("brick"), np.random.default_rng(3)),
        prism([(0, 0), (2, 0), (2, 1), (0, 2)], 0, 1.5, Material("brick"), Material("brick")),
        cylinder((0, 0, 0), 0.4, 1.2, Material("brick"), Material("brick"), axis="y"),
        tube([(0, 0, 0), (3, 0, 0), (6, 0, 0)], 0.2, Material("brick")),
        polygon([(0, 0, 0), (2, 0, 1), (1, 2, 2)], Material("brick")),
        quad((0, 0, 0), (2, 0, 0), (0.5, 0, 1), Material("brick")),
        panels((0, 0, 0), (7, 0, 0), (0, 0, 3), [Material("brick")], 2, np.random.default_rng(1)),
    ],
)
def test_surfaces_are_drawn_at_true_scale(shape: Shape) -> None:
    """Two metres of wall are one picture of brick, along and across: no stretching anywhere."""
    mesh, metres = shape.mesh, MATERIAL_KINDS["brick"].metres
    for a, b in ((0, 1), (1, 2), (2, 0)):
        i, j = mesh.faces[:, a], mesh.faces[:, b]
        on_mesh = np.linalg.norm(mesh.vertices[i] - mesh.vertices[j], axis=1)
        on_picture = np.linalg.norm(mesh.uv[i] - mesh.uv[j], axis=1) * metres
        assert on_picture == pytest.approx(on_mesh, rel=1e-3)


def test_pictures_stand_upright_and_are_not_mirrored() -> None:
    """Seen from the front, u grows to the right and v downwards."""
    mesh = box((0, 0, 0), (1, 1, 1), Material("poster"), cell=3).mesh
    for face in np.unique(mesh.normals.round(), axis=0):
        if face[2] != 0:
            continue
        on = (mesh.normals.round() == face).all(1)
        right = np.cross((0, 0, 1), face)  # of one who looks at the face
        at = mesh.vertices[on].astype(float) @ np.stack([right, (0, 0, -1)], axis=1)
        assert np.corrcoef(at[:, 0], mesh.uv[on, 0])[0, 1] == pytest.approx(1)
        assert np.corrcoef(at[:, 1], mesh.uv[on, 1])[0, 1] == pytest.approx(1)
        assert (mesh.uv[on] > 0.5).all()  # cell 3 of 2 x 2


def test_a_decal_lies_in_front_of_its_wall() -> None:
    mesh = decal((1, 2, 1), (-1, 0, 0), (0, 0, 1), Material("sign")).mesh
    assert mesh.vertices[:, 1] == pytest.approx(2 + DECAL_OFFSET_M)
    assert mesh.normals[0].tolist() == [0, 1, 0]


def test_concat_shares_materials_and_moves_keep_shapes() -> None:
    one, two = box((0, 0, 0), (1, 1, 1), WOOD), box((2, 0, 0), (3, 1, 1), WOOD).placed_at(0, 0, 5, np.pi / 2)
    both = concat_shapes(one, two)
    assert both.materials == (WOOD,)
    assert two.bounding_box == pytest.approx(np.array([[-1, 2, 5], [0, 3, 6]]), abs=1e-6)
    assert volume(both) == pytest.approx(2)
    with pytest.raises(ValueError, match="no mesh"):
        concat_shapes()


def test_an_unknown_material_is_named() -> None:
    with pytest.raises(ValueError, match="material 'wodo' is not known; known: plaster"):
        Material("wodo")
